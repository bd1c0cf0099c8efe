"""The event loop of one client, run by the thread that waits for a result from it.

Handing a call to another thread costs more than a round trip to the server. The thread that makes a blocking call
therefore runs the loop itself until its call is done. A daemon thread `urlab-io` runs it the rest of the time, for
streams and heartbeats. The rules:

1. Only the holder of `_turn` runs the loop, steps its tasks or closes it.
2. A call that finds no other call in progress takes the turn. If the thread holds it, the call asks the thread to
   yield, which it does between two callbacks. Any other call is queued in the loop, and completed by its runner.
3. A leaving call first returns the turn and then checks for calls in progress. A queued call is first added and then
   checks whether the turn is held. Either of them wakes the thread if otherwise nothing would run the loop.
4. The thread takes the turn when it is woken, or when no call has left for `_IDLE` seconds, so that consecutive calls
   of a script need no hand-over. During such calls it checks less and less often. Only the thread ends the loop.
5. Signals are deferred while the main thread is in this module. An arriving signal makes the call leave the loop; then
   its handler runs, and if the handler raises, the call is cancelled.

A thread with its own running loop, as in a notebook, cannot run a second one: its calls are always queued. The loop
relies on asyncio's public interface only.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
import os
import selectors
import sys
import threading
import time
import weakref
from collections.abc import Callable, Coroutine
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from urlab_client.aio.background import background_thread
from urlab_client.errors import ClientClosed, URLabError
from urlab_client.sync._signals import DeferredSignals

T = TypeVar("T")

GRACE = 1.0
"""Seconds allowed for clean-up, of an interrupted call and in each phase of stopping a loop."""

# A signal that arrives just before the main thread blocks on a lock does not interrupt the wait, and on Windows none
# does. Python looks for signals between two waits, so each is short.
_WAIT_SLICE = 0.1

# Nor does Ctrl-C interrupt select() on Windows: the main thread must not run the loop there.
_MAIN_THREAD_DRIVES = sys.platform != "win32"

# Seconds after a call until the thread runs the loop again. A hand-over costs about a hundredth of this pause.
_IDLE = 0.005

# Longest time between two checks whether calls still follow each other. A thread that wakes up requests the interpreter
# lock. Until it gets the lock, up to five milliseconds later, every release of it costs the caller a system call.
_LONGEST_PAUSE = 0.08

# Seconds between two checks whether the owner is gone. Its finalizer stops the loop, but Python does not call it again
# if a signal handler raises in it.
_OWNER_CHECK_S = 2.0

# Rounds of callbacks between two looks at the sockets.
_ROUNDS = 3

# Seconds after which the thread is asked again for the turn.
_CLAIM_SLICE = 0.05

_log = logging.getLogger("urlab_client.sync")


def client_closed(when: str = "before this call") -> ClientClosed:
    """Return the error of a call to a client that was closed."""
    return ClientClosed(f"The client was closed {when}.", hint="Create a new one.")


def on_io_thread() -> URLabError:
    """Return the error of a call from inside the loop."""
    return URLabError(
        "A blocking call was made on the client's own I/O thread, which would wait for itself.",
        hint="Move the work to another thread, or use urlab_client.aio in code that runs on the event loop.",
    )


class _Selector(selectors.DefaultSelector):
    """Does not ask the system for sockets at each round of callbacks.

    A call is one round that sends, one wait, and one round that takes the reply. asyncio polls before each of them, for
    longer than the call's own code takes, and finds nothing.
    """

    _left_out = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout == 0 and self._left_out < _ROUNDS:  # callbacks are ready
            self._left_out += 1
            return []
        self._left_out = 0
        return super().select(timeout)


class Job(Generic[T]):
    """A coroutine to run on the loop, created by the calling thread and finished by the thread that runs the loop.

    Attributes:
        error: The exception that it raised; otherwise `value` is its result.
        finished: Whether it has ended.
    """

    __slots__ = ("_news", "coro", "error", "finished", "task", "value")

    value: T

    def __init__(self, coro: Coroutine[Any, Any, T]) -> None:
        self.coro = coro
        self.task: asyncio.Task[None] | None = None
        self.error: BaseException | None = None
        self.finished = False
        self._news: SimpleQueue[None] = SimpleQueue()

    @property
    def started(self) -> bool:
        """Whether the coroutine has begun. One that has not must be closed, because cancelling has no effect on it."""
        return inspect.getcoroutinestate(self.coro) != inspect.CORO_CREATED

    def wait(self, timeout: float = _WAIT_SLICE) -> None:
        """Block until the caller has something to check, at most `timeout` seconds."""
        with contextlib.suppress(Empty):
            self._news.get(timeout=timeout)

    def wake(self) -> None:
        """Wake the caller, which checks the job's state."""
        self._news.put(None)


class CallerDrivenLoop:
    """The loop, the daemon thread that runs it when no caller does, and the right to run it.

    Refers to no portal and no façade object, so that dropping these ends the thread.

    Args:
        at_stop: Returns the coroutine that releases the resources on the loop; None if there are none.
        owner: Weak reference to the object without which the loop ends.
    """

    def __init__(self, at_stop: Callable[[], Coroutine[Any, Any, object]] | None, owner: weakref.ref[Any]) -> None:
        # Not new_event_loop(): the user's loop policy is for the user's loop, and pyzmq needs a selector on Windows.
        self._loop = asyncio.SelectorEventLoop(_Selector())
        self._thread = background_thread("urlab-io", self._run)
        self._failure: BaseException | None = None
        self._pid = os.getpid()
        self._at_stop = at_stop
        self._owner = owner
        self._stop_requested = asyncio.Event()
        # A plain lock, which any thread may release: the turn passes from a caller to the thread and back.
        self._turn = threading.Lock()
        self._turn.acquire()  # The thread starts with it.
        self._thread_drives = True
        self._driven: Job[Any] | None = None
        self._left = 0.0
        # A lock and not an event, which a finalizer could interrupt while it is being set.
        self._wake_up = threading.Lock()
        self._wake_up.acquire()
        self._jobs: set[Job[Any]] = set()
        # Guards `_stopping`, `_jobs` and the end of the loop: a job is either refused or finished, never left waiting.
        # Reentrant, because a finalizer may stop the loop in the middle of `run`.
        self._lock = threading.RLock()
        self._stopping = False
        self._ended = False

    def start(self) -> None:
        """Start the thread."""
        try:
            self._thread.start()
        except BaseException:  # the system refuses another thread
            self._loop.close()
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
        """Run `job` until it is finished, and run the handlers of signals that arrive in the meantime.

        Raises:
            URLabError: The caller runs inside the loop.
            ClientClosed: The loop is stopping.
            BaseException: A signal handler raised it. The job was cancelled and had `GRACE` seconds to clean up.
        """
        try:
            drives = self._begin(job)
            signals.on_arrival = lambda: self._call_away(job)
            while not job.finished:
                if signals.arrived:
                    # Here and not in the loop: what a handler raises there would hit whatever task is running.
                    if (raised := signals.let_in()) is not None:
                        raise raised  # noqa: TRY301  # another frame would only lengthen the traceback
                elif drives and not self._ended:
                    self._drive(job, signals)
                else:
                    job.wait()
        except BaseException:
            signals.on_arrival = None
            self._abandon(job)
            raise
        signals.on_arrival = None  # which refers to the job

    def stop(self) -> None:
        """Stop the loop and join the thread, in bounded time. May be called from any thread."""
        if os.getpid() != self._pid:
            return  # A forked child shares the parent's epoll set: closing the loop would break the parent's.
        with DeferredSignals():
            self._request_stop()
            # The garbage collector may call from any thread, also from inside the loop.
            if not self.is_current and threading.current_thread() is not self._thread:
                self._thread.join(4 * GRACE)

    # Calls

    def _begin(self, job: Job[Any]) -> bool:
        """Register `job`, and queue it unless its caller is to run the loop; return whether it is."""
        running = asyncio._get_running_loop()  # noqa: SLF001  # unlike get_running_loop, never raises
        if running is self._loop:
            raise on_io_thread()
        drives = running is None
        if not _MAIN_THREAD_DRIVES:
            drives = drives and threading.current_thread() is not threading.main_thread()
        with self._lock:
            if self._stopping:
                raise self._closed()
            drives = drives and not self._jobs
            self._jobs.add(job)
            if not drives:
                self._loop.call_soon_threadsafe(self._start_job, job)
        if not drives:
            self._ensure_driver()
        return drives

    def _call_away(self, job: Job[Any]) -> None:
        """Make the caller of `job` check whether it should continue waiting."""
        job.wake()
        if self._driven is job:
            self._poke(self._loop.stop)

    def _abandon(self, job: Job[Any]) -> None:
        """Cancel `job`, whose caller was interrupted at any point of `run`, and wait for its clean-up."""
        with self._lock:
            if job.finished:
                return
            if job not in self._jobs:
                job.coro.close()  # never handed over; Python would warn that it was never awaited
                return
            self._loop.call_soon_threadsafe(self._cancel_job, job)
        self._ensure_driver()
        deadline = time.monotonic() + GRACE
        while not job.finished and (left := deadline - time.monotonic()) > 0:
            job.wait(left)
        if not job.finished:
            _log.warning(
                "%s is still running %g s after it was interrupted", getattr(job.coro, "__qualname__", job.coro), GRACE
            )

    def _drive(self, job: Job[Any], signals: DeferredSignals) -> None:
        """Run the loop on this thread until `job` is finished or a signal has arrived."""
        while not self._turn.acquire(blocking=False):
            if signals.arrived:
                return
            # Again in each slice: the thread may have taken the turn only after it was asked.
            self._poke(self._yield)
            if self._turn.acquire(timeout=_CLAIM_SLICE):
                break
        try:
            if job.task is None and not self._ended:  # otherwise this caller comes back from a signal
                self._start_job(job)
            self._driven = job
            # In a loop, because anything may stop the loop: another caller that wants the turn, or code of a task.
            while not (job.finished or signals.arrived or self._ended):
                self._run_loop()
        finally:
            self._driven = None
            self._left = time.monotonic()
            self._turn.release()
            # Only now: a job that was queued before the release saw the turn held and woke nobody (rule 3).
            if self._jobs or self._stopping:
                self._ensure_driver()

    def _run_loop(self) -> None:
        # These exceptions leave the loop when a task raises them. If the task is a job, its caller gets them from it.
        try:
            self._loop.run_forever()
        except (KeyboardInterrupt, SystemExit) as error:
            _log.debug("a task on the loop raised %r", error)

    def _ensure_driver(self) -> None:
        """Wake the thread if no thread runs the loop."""
        if not self._turn.locked():
            self._wake_thread()

    def _wake_thread(self) -> None:
        with contextlib.suppress(RuntimeError):  # It has already been woken.
            self._wake_up.release()

    def _poke(self, callback: Callable[[], object]) -> None:
        with contextlib.suppress(RuntimeError):  # The loop has just been closed.
            self._loop.call_soon_threadsafe(callback)

    def _request_stop(self) -> None:
        with self._lock:
            if not self._stopping:
                self._stopping = True
                self._loop.call_soon_threadsafe(self._stop_requested.set)
        self._wake_thread()

    # In the loop

    def _yield(self) -> None:
        if self._thread_drives:  # the request may be late, when the loop is already run by a caller
            self._loop.stop()

    def _start_job(self, job: Job[Any]) -> None:
        if job in self._jobs:
            job.task = asyncio.Task(self._perform(job), loop=self._loop, name="urlab-call")

    def _cancel_job(self, job: Job[Any]) -> None:
        if job.task is not None:
            job.task.cancel()
        if job in self._jobs and not job.started:  # neither this nor its task will ever run
            self._break_off(job)

    async def _perform(self, job: Job[T]) -> None:
        # Ends the job itself: a callback of the task would take another turn of the loop, a tenth of a step.
        try:
            job.value = await job.coro
        except GeneratorExit:
            raise  # the loop ended before the job
        except asyncio.CancelledError:
            job.error = self._closed("during this call") if self._stopping else asyncio.CancelledError()
        except BaseException as error:  # noqa: BLE001  # raised by the caller
            job.error = error.with_traceback(error.__traceback__ and error.__traceback__.tb_next)  # without this frame
        self._finish_job(job)

    def _break_off(self, job: Job[Any]) -> None:
        job.error = self._closed("during this call")
        if not job.started:
            job.coro.close()  # otherwise Python would warn that it was never awaited
        self._finish_job(job)

    def _finish_job(self, job: Job[Any]) -> None:
        self._jobs.discard(job)
        # Dropped here, not by the caller: Python prints what a signal handler raises during weak-reference callbacks.
        job.task = None
        job.finished = True
        if self._driven is job:
            self._loop.stop()
        else:
            job.wake()

    # The thread

    def _run(self) -> None:
        try:
            self._run_between_calls()
        except BaseException as error:
            self._failure = error
            raise
        finally:
            self._finish()

    def _run_between_calls(self) -> None:
        main = self._loop.create_task(self._main())
        main.add_done_callback(self._note_end)
        while not self._ended:
            self._run_loop()
            if not self._ended and not self._stopping:
                self._thread_drives = False  # before the release: the next holder must not be asked to yield
                self._turn.release()
                self._await_turn()
                self._thread_drives = True
        main.result()  # raises what ended it

    def _finish(self) -> None:
        """Cancel all tasks and fail all calls, because nobody runs the loop any more."""
        with self._lock:
            self._stopping = self._ended = True
        self._poke(self._loop.stop)  # a caller that runs it leaves
        drives = self._thread_drives or self._turn.acquire(timeout=GRACE)
        try:
            if drives:
                self._cancel_all()
        finally:
            with self._lock:
                for job in tuple(self._jobs):
                    self._break_off(job)
                if drives:
                    self._loop.close()
            if drives:
                self._turn.release()

    def _cancel_all(self) -> None:
        # Between two runs of the loop: while it runs, Python 3.14 lists only the tasks that this thread has created.
        end = self._loop.create_task(self._end(asyncio.all_tasks(self._loop)))
        end.add_done_callback(lambda _: self._loop.stop())
        while not end.done():
            self._run_loop()
        end.result()  # raises what ended it

    def _closed(self, when: str = "before this call") -> ClientClosed:
        if self._failure is None:
            return client_closed(when)
        closed = client_closed(f"because urlab-io, which runs its event loop, died of {self._failure!r}")
        closed.__cause__ = self._failure
        return closed

    def _await_turn(self) -> None:
        """Sleep until the thread has the turn again."""
        pause = _IDLE
        while True:
            if self._wake_up.acquire(timeout=pause):
                self._turn.acquire()
                break
            if time.monotonic() - self._left >= _IDLE and self._turn.acquire(blocking=False):
                break
            pause = min(2 * pause, _LONGEST_PAUSE)
        # All work announced so far is in the loop. A wake-up left set would take the turn from the next caller.
        self._wake_up.acquire(blocking=False)

    def _note_end(self, main: asyncio.Task[None]) -> None:
        self._ended = True
        self._loop.stop()

    async def _main(self) -> None:
        while self._owner() is not None and not self._stop_requested.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._stop_requested.wait(), _OWNER_CHECK_S)
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
