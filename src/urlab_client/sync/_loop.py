"""The event loop of one client, run by whoever waits for something in it.

Handing a call to another thread costs more than a round trip to the server, so the thread that makes a blocking call
runs the loop itself until its call is done; a daemon thread `urlab-io` runs it the rest of the time, for streams and
heartbeats. The rules:

1. Only the holder of `_turn` runs the loop, steps its tasks or closes it.
2. A call that finds no other one under way takes the turn. If the thread has it, the thread is asked to yield, and
   does between two callbacks. Any other call is queued in the loop, and whoever runs that completes it.
3. Who leaves gives the turn back first and then looks for calls still under way; who queues a call does that first
   and then looks whether anybody has the turn. Either of them rings the thread's bell if nobody would run the loop.
4. The thread takes the turn when the bell rings, or when no call has left for `_IDLE`: consecutive calls of a script
   cost no hand-over. While they last it looks more and more rarely. It alone sees the loop to its end.
5. Signals are deferred for as long as the main thread is in this module. One that arrives makes the call leave the
   loop; its handler runs then, and if it raises, the call is broken off.

A thread with a running loop of its own, as in a notebook, cannot run a second one: its calls are always queued.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any, Generic, TypeVar

from urlab_client.protocol.errors import ClientClosed
from urlab_client.sync._caller_loop import CallerLoop
from urlab_client.sync._signals import DeferredSignals

__all__ = ["GRACE", "CallerDrivenLoop", "Job", "client_closed"]

T = TypeVar("T")

GRACE = 1.0
"""Seconds given to clean-up: to an interrupted call, and to each phase of stopping a loop."""

# A lock wait on Windows does not see Ctrl-C, so there it is taken in slices.
_WAIT_SLICE = 0.1 if sys.platform == "win32" else threading.TIMEOUT_MAX

# Nor does select() see it there: the main thread must not run the loop.
_MAIN_THREAD_DRIVES = sys.platform != "win32"

# Seconds after a call until the thread runs the loop again. A hand-over then costs a hundredth of the pause.
_IDLE = 0.005

# The longest time between two looks whether calls still follow each other. A thread that wakes up wants the interpreter
# lock, and for the up to five milliseconds until it gets it, every release of the lock costs the caller a system call.
_LONGEST_PAUSE = 0.08

# Seconds after which the thread is asked again for the turn.
_CLAIM_SLICE = 0.05

# Seconds between two looks whether there still is a portal. A signal handler that raises in the collector's callback,
# before that defers signals, takes the portal's end away from it.
_ORPHAN_S = 5.0

_log = logging.getLogger("urlab_client.sync")


def client_closed(when: str = "before this call") -> ClientClosed:
    """Return the error of a call to a client that was closed."""
    return ClientClosed(f"The client was closed {when}.", hint="Make a new one.")


class Job(Generic[T]):
    """A coroutine on its way through the loop: made by the calling thread, finished by who runs the loop.

    Attributes:
        error: What it raised; else `value` is its result.
        finished: Whether it has ended.
        leave: Whether its caller has reason to stop waiting for that.
        started: Whether the coroutine has run at all: one that has not must be closed, cancelling would do nothing.
    """

    __slots__ = ("_waiter", "coro", "error", "finished", "leave", "started", "task", "value")

    value: T

    def __init__(self, coro: Coroutine[Any, Any, T]) -> None:
        self.coro = coro
        self.task: asyncio.Task[None] | None = None
        self.error: BaseException | None = None
        self.finished = False
        self.leave = False
        self.started = False
        self._waiter: threading.Lock | None = None

    def wait(self, timeout: float = threading.TIMEOUT_MAX) -> None:
        """Block until the job is finished or its caller has to leave, at most `timeout` seconds."""
        waiter = self._waiter = self._waiter or threading.Lock()
        waiter.acquire(blocking=False)
        while not (self.finished or self.leave) and timeout > 0:
            piece = min(timeout, _WAIT_SLICE)
            waiter.acquire(timeout=piece)
            timeout -= piece

    def wake(self) -> None:
        """Let the caller look what there is."""
        if self._waiter is not None:
            with contextlib.suppress(RuntimeError):  # it has been woken already
                self._waiter.release()


class CallerDrivenLoop:
    """The loop, the daemon thread that runs it when nobody else does, and the right to run it.

    Refers to no portal and no façade object, so that dropping these ends the thread.

    Args:
        at_stop: Makes the coroutine that releases what lives on the loop; None if there is nothing.
        owner: Refers to the portal: the loop ends when that is gone.
    """

    def __init__(
        self, at_stop: Callable[[], Coroutine[Any, Any, object]] | None, owner: Callable[[], object | None]
    ) -> None:
        self._owner = owner
        # Not new_event_loop(): the user's loop policy is about the user's loop, and pyzmq needs a selector on Windows.
        self._loop = CallerLoop()
        self._thread = threading.Thread(target=self._run, name="urlab-io", daemon=True)
        self._pid = os.getpid()
        self._at_stop = at_stop
        self._stop_requested = asyncio.Event()
        self._turn = threading.Lock()
        self._turn.acquire()  # The thread starts with it.
        self._thread_drives = True
        self._driven: Job[Any] | None = None
        self._left = 0.0
        # A lock and not an event, which a finalizer could find half set.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._jobs: set[Job[Any]] = set()
        # Guards `_stopping`, `_jobs` and the loop's end: a job is either refused or finished, never left waiting.
        # Reentrant, because a finalizer may stop the loop in the middle of `run`.
        self._lock = threading.RLock()
        self._stopping = False
        self._ended = False

    def start(self) -> None:
        """Start the thread."""
        try:
            self._thread.start()
        except BaseException:
            if self._thread.ident is None:
                self._loop.close()
            else:
                self._request_stop()
            raise

    @property
    def is_current(self) -> bool:
        """Whether the caller runs inside the loop."""
        return asyncio._get_running_loop() is self._loop  # noqa: SLF001  # unlike get_running_loop, never raises

    @property
    def stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stopping

    def run(self, job: Job[Any], signals: DeferredSignals) -> None:
        """Run `job` until it is finished, and let signals in that arrive meanwhile.

        Raises:
            ClientClosed: The loop is on its way out.
            BaseException: A signal handler raised it. The job was cancelled, and had `GRACE` seconds to clean up.
        """
        try:
            drives = self._may_drive() and self._enlist(job)
            if not drives:
                self._submit(job)
            signals.on_arrival = lambda: self._call_away(job)
            while not job.finished:
                job.leave = False  # before looking why it was set
                if signals.arrived:
                    if (raised := signals.let_in()) is not None:
                        raise raised  # noqa: TRY301  # another frame would only lengthen the traceback
                elif drives:
                    self._drive(job)
                else:
                    job.wait()
        except BaseException:
            signals.on_arrival = None
            self._abandon(job)
            raise
        signals.on_arrival = None  # which refers to the job

    def stop(self) -> None:
        """Wind the loop down and join the thread, in bounded time, from any thread."""
        if os.getpid() != self._pid:
            return  # A forked child shares the parent's epoll set: closing the loop would deafen the parent's.
        with DeferredSignals():
            self._request_stop()
            # The garbage collector may call from any thread, also from inside the loop.
            if not self.is_current and threading.current_thread() is not self._thread:
                self._thread.join(4 * GRACE)

    # Calls

    def _may_drive(self) -> bool:
        if asyncio._get_running_loop() is not None:  # noqa: SLF001  # unlike get_running_loop, never raises
            return False
        return _MAIN_THREAD_DRIVES or threading.current_thread() is not threading.main_thread()

    def _enlist(self, job: Job[Any]) -> bool:
        """Register `job` unless others are under way; return whether it was registered."""
        with self._lock:
            if self._stopping:
                raise client_closed()
            if self._jobs:
                return False
            self._jobs.add(job)
            return True

    def _submit(self, job: Job[Any]) -> None:
        with self._lock:
            if self._stopping:
                raise client_closed()
            self._jobs.add(job)
            self._loop.call_soon_threadsafe(self._start_job, job)
        self._see_to_driver()

    def _call_away(self, job: Job[Any]) -> None:
        """Make the caller of `job` look whether it should go on waiting."""
        job.leave = True
        job.wake()
        if self._driven is job:
            self._poke(self._loop.stop)

    def _abandon(self, job: Job[Any]) -> None:
        """Cancel `job`, whose caller was interrupted anywhere in `run`; wait for its clean-up."""
        with self._lock:
            if job.finished:
                return
            if job not in self._jobs:
                job.coro.close()
                return
            self._loop.call_soon_threadsafe(self._cancel_job, job)
        drives = self._may_drive()
        if not drives:
            self._see_to_driver()
        deadline = time.monotonic() + GRACE
        while not job.finished and (left := deadline - time.monotonic()) > 0:
            job.leave = False
            if drives:
                self._drive(job, deadline)
            else:
                job.wait(left)
        if not job.finished:
            _log.warning(
                "%s is still running %g s after it was interrupted", getattr(job.coro, "__qualname__", job.coro), GRACE
            )

    def _drive(self, job: Job[Any], deadline: float | None = None) -> None:
        """Run the loop on this thread until `job` is finished, its caller called away or the deadline has passed."""
        if self._ended:
            job.wait(_CLAIM_SLICE)
            return
        if not self._turn.acquire(blocking=False) and not self._claim(job, deadline):
            return
        try:
            if self._ended:
                return
            if job.task is None:
                job.task = asyncio.Task(self._perform(job), loop=self._loop, name="urlab-call")
            timer = None if deadline is None else self._loop.call_at(deadline, self._call_away, job)
            self._driven = job
            while not (job.finished or job.leave or self._ended):
                self._run_loop()
            self._driven = None
            if timer is not None:
                timer.cancel()
        finally:
            self._give_back()

    def _claim(self, job: Job[Any], deadline: float | None) -> bool:
        """Get the turn; return False if `job` was finished, its caller called away or the deadline past before."""
        while not self._turn.acquire(blocking=False):
            if job.finished or job.leave or (deadline is not None and time.monotonic() >= deadline):
                return False
            self._poke(self._yield)
            if self._turn.acquire(timeout=_CLAIM_SLICE):
                break
        return True

    def _run_loop(self) -> None:
        # A task that raises one of these breaks out of the loop. If it is a job, its caller gets it through that.
        try:
            self._loop.run_until_stopped()
        except (KeyboardInterrupt, SystemExit) as error:
            _log.debug("a task on the loop raised %r", error)

    def _give_back(self) -> None:
        self._left = time.monotonic()
        self._turn.release()
        if self._jobs or self._stopping:
            self._see_to_driver()

    def _see_to_driver(self) -> None:
        """Wake the thread if nobody runs the loop."""
        if not self._turn.locked():
            self._ring()

    def _ring(self) -> None:
        with contextlib.suppress(RuntimeError):  # It has been rung already.
            self._bell.release()

    def _poke(self, callback: Callable[[], object]) -> None:
        with contextlib.suppress(RuntimeError):  # The loop has just been closed.
            self._loop.call_soon_threadsafe(callback)

    def _request_stop(self) -> None:
        with self._lock:
            if not self._stopping:
                self._stopping = True
                self._loop.call_soon_threadsafe(self._stop_requested.set)
        self._ring()

    # In the loop

    def _yield(self) -> None:
        if self._thread_drives:
            self._loop.stop()

    def _start_job(self, job: Job[Any]) -> None:
        if job in self._jobs:
            job.task = asyncio.Task(self._perform(job), loop=self._loop, name="urlab-call")

    def _cancel_job(self, job: Job[Any]) -> None:
        if job.started and job.task is not None:
            job.task.cancel()
        elif job in self._jobs:
            self._break_off(job)

    async def _perform(self, job: Job[Any]) -> None:
        # Rather than a callback of the task: that would take one more turn of the loop.
        if job.finished:
            return
        job.started = True
        try:
            job.value = await job.coro
        except GeneratorExit:
            raise  # The loop ended first, and the job with it.
        except asyncio.CancelledError as error:
            job.error = client_closed("during this call") if self._stopping else error.with_traceback(None)
        except BaseException as error:  # noqa: BLE001  # what it is, is the caller's business
            trace = error.__traceback__
            job.error = error.with_traceback(None if trace is None else trace.tb_next)  # without this frame
            del trace
        self._finish_job(job)

    def _break_off(self, job: Job[Any]) -> None:
        job.error = client_closed("during this call")
        if not job.started:
            job.coro.close()
        self._finish_job(job)

    def _finish_job(self, job: Job[Any]) -> None:
        self._jobs.discard(job)
        # Not left to the caller to drop: a signal handler that raises amid weak reference callbacks gets printed.
        job.task = None
        job.finished = True
        job.wake()
        if self._driven is job:
            self._loop.stop()

    # The thread

    def _run(self) -> None:
        main = self._loop.create_task(self._main())
        main.add_done_callback(self._note_end)
        while not self._ended:
            self._run_loop()
            if not self._ended and not self._stopping:
                self._thread_drives = False
                self._turn.release()
                self._await_turn()
                self._thread_drives = True
        # Between two runs of the loop: while it runs, Python 3.14 tells only of those tasks that this thread has made.
        end = self._loop.create_task(self._end(asyncio.all_tasks(self._loop)))
        end.add_done_callback(lambda _: self._loop.stop())
        while not end.done():
            self._run_loop()
        with self._lock:
            for job in tuple(self._jobs):
                self._break_off(job)
            self._loop.close()
        self._turn.release()

    def _await_turn(self) -> None:
        """Sleep until the turn is the thread's again."""
        pause = _IDLE
        while True:
            if self._bell.acquire(timeout=pause):
                self._turn.acquire()
                break
            if time.monotonic() - self._left >= _IDLE and self._turn.acquire(blocking=False):
                break
            pause = min(2 * pause, _LONGEST_PAUSE)
        # Whatever it rang for until now is in the loop. Left ringing, it would take the turn from the next caller.
        self._bell.acquire(blocking=False)

    def _note_end(self, main: asyncio.Task[None]) -> None:
        self._ended = True
        self._loop.stop()

    async def _main(self) -> None:
        stop = asyncio.ensure_future(self._stop_requested.wait())
        while not (await asyncio.wait((stop,), timeout=_ORPHAN_S))[0]:
            if self._owner() is None:
                self._request_stop()
        if self._at_stop is not None:
            await _in_bounded_time(asyncio.ensure_future(self._at_stop()))

    async def _end(self, tasks: set[asyncio.Task[Any]]) -> None:
        for task in tasks:
            task.cancel()
        await _in_bounded_time(*tasks)
        await _in_bounded_time(asyncio.ensure_future(self._loop.shutdown_asyncgens()))


async def _in_bounded_time(*tasks: asyncio.Task[Any]) -> None:
    if not tasks:
        return
    done, pending = await asyncio.wait(tasks, timeout=GRACE)
    for task in done:
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.debug("a task failed while the client was closing", exc_info=error)
    for task in pending:
        _log.debug("a task outlived the closing of its client: %r", task)
