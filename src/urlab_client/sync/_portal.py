"""What the generated façade stands on: an event loop per client, and the base of its classes.

Everything blocking-only lives here; the other modules of `urlab_client.sync` are generated and hold no behaviour.

**Who runs the loop.** Handing a call to another thread costs more than a round trip to the server, so the thread that
makes a blocking call runs the loop itself until its call is done; a daemon thread `urlab-io` runs it the rest of the
time, for streams and heartbeats. The rules:

1. Only the holder of `_turn` runs the loop, steps its tasks or closes it.
2. A call that finds no other one under way takes the turn. If the thread has it, the thread is asked to yield, and
   does between two callbacks. Any other call is queued in the loop, and whoever runs that completes it.
3. Who leaves gives the turn back first and then looks for calls still under way; who queues a call does that first
   and then looks whether anybody has the turn. Either of them rings the thread's bell if nobody would run the loop.
4. The thread takes the turn when the bell rings, or when no call has left for `_IDLE`: consecutive calls of a script
   cost no hand-over. While they last it looks more and more rarely. It alone sees the loop to its end.
5. An exception that a signal handler raises amid the loop's own code would lose callbacks. While the main thread runs
   the loop, handlers are therefore kept back; a signal makes it leave the loop, and the handler runs then.

A thread with a running loop of its own, as in a notebook, cannot run a second one: its calls are always queued.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import inspect
import logging
import os
import signal
import sys
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Coroutine
from types import FrameType, TracebackType
from typing import Any, Generic, Protocol, TypeVar, cast, overload

from urlab_client.protocol.errors import ClientClosed, ForkedError, URLabError, URLabRPCError
from urlab_client.protocol.names import NameMap

__all__ = ["GRACE", "Facade", "FacadeRoot", "Portal", "aio_of", "portal_of"]

T = TypeVar("T")
A = TypeVar("A")
A_co = TypeVar("A_co", covariant=True)
F = TypeVar("F", bound="Facade")

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

# Seconds after which the thread is asked again for the turn, and a caller that waits for it looks for signals.
_CLAIM_SLICE = 0.05

_SIGNALS = sorted(int(number) for number in signal.valid_signals())
# What `signal` wraps: its own functions make enumerations of everything, which takes ten times as long.
_signal: Any = importlib.import_module("_signal")
_get_handler: Callable[[int], Any] = _signal.getsignal
_set_handler: Callable[[int, Any], Any] = _signal.signal

_log = logging.getLogger("urlab_client.sync")


class _Job(Generic[T]):
    """A coroutine on its way through the loop: made by the calling thread, finished by who runs the loop."""

    __slots__ = ("_waiter", "coro", "error", "finished", "task", "value")

    value: T

    def __init__(self, coro: Coroutine[Any, Any, T]) -> None:
        self.coro = coro
        self.task: asyncio.Task[None] | None = None
        self.error: BaseException | None = None
        self.finished = False
        self._waiter = threading.Lock()
        self._waiter.acquire()

    def wait(self, timeout: float = threading.TIMEOUT_MAX) -> bool:
        """Block until the job is finished, at most `timeout` seconds; return whether it is."""
        while not self.finished and timeout > 0:
            piece = min(timeout, _WAIT_SLICE)
            self._waiter.acquire(timeout=piece)
            timeout -= piece
        return self.finished

    def finish(self) -> None:
        """Let the caller go on. `value` or `error` is set by now."""
        self.finished = True
        self._waiter.release()


class _SignalGate:
    """Keeps Python's signal handlers from running while the main thread runs a loop. Does nothing in other threads.

    Args:
        leave: Makes the thread leave the loop; called when a signal comes.
    """

    __slots__ = ("_leave", "_replaced", "pending")

    def __init__(self, leave: Callable[[], object]) -> None:
        self.pending: list[tuple[int, FrameType | None]] = []
        self._leave = leave
        self._replaced: list[tuple[int, Any]] = []

    def shut(self) -> None:
        """Put handlers aside. What strikes meanwhile leaves some of them to `open`."""
        if threading.get_ident() == threading.main_thread().ident:
            for number in _SIGNALS:
                handler = _get_handler(number)
                if callable(handler):
                    self._replaced.append((number, handler))
                    _set_handler(number, self._keep)

    def open(self) -> None:
        """Put the handlers back. One that runs and raises as soon as it is back does not keep the others out."""
        try:
            while self._replaced:
                _set_handler(*self._replaced[-1])
                self._replaced.pop()
        finally:
            if self._replaced:
                self.open()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        self.pending.append((number, frame))
        self._leave()


class _Stream(Protocol[A_co]):
    """Something asynchronous whose waiting items can be read from any thread."""

    def receive_nowait(self) -> A_co | None: ...

    def __anext__(self) -> Coroutine[Any, Any, A_co]: ...


class _LoopHost:
    """The loop, the daemon thread that runs it when nobody else does, and the right to run it.

    Refers to no portal and no façade object, so that dropping these ends the thread.
    """

    def __init__(self, at_stop: Callable[[], Coroutine[Any, Any, object]] | None) -> None:
        # Not new_event_loop(): the user's loop policy is about the user's loop, and pyzmq needs a selector on Windows.
        self._loop = asyncio.SelectorEventLoop()
        self._thread = threading.Thread(target=self._run, name="urlab-io", daemon=True)
        self._pid = os.getpid()
        self._at_stop = at_stop
        self._stop_requested = asyncio.Event()
        self._turn = threading.Lock()
        self._turn.acquire()  # The thread starts with it.
        self._thread_drives = True
        self._driven: _Job[Any] | None = None
        self._left = 0.0
        # A lock and not an event, which a signal handler or a finalizer could find half set.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._jobs: set[_Job[Any]] = set()
        # Guards `_stopping`, `_jobs` and the loop's end: a job is either refused or finished, never left waiting.
        # Reentrant, because a signal handler may close the client in the middle of `submit`.
        self._lock = threading.RLock()
        self._stopping = False
        self._ended = False

    def start(self) -> None:
        """Start the thread. If that is interrupted, the thread, should there be one, ends by itself."""
        try:
            self._thread.start()
        except Exception:
            self._loop.close()
            raise
        except BaseException:
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

    def run(self, job: _Job[Any]) -> None:
        """Run `job` until it is finished. Raises `ClientClosed` if the loop is on its way out."""
        if not (self._may_drive() and self._enlist(job)):
            self._submit(job)
            job.wait()
        while not job.finished:
            for number, frame in self._drive(job):
                # As if it came now: the handler may raise, or use the client.
                handler = _get_handler(number)
                if callable(handler):
                    handler(number, frame)

    def abandon(self, job: _Job[Any]) -> None:
        """Cancel `job`, whose caller was interrupted anywhere in `run`; wait for its clean-up."""
        with self._lock:
            if under_way := job in self._jobs:
                self._loop.call_soon_threadsafe(self._cancel_job, job)
        if not under_way:
            job.coro.close()
            return
        self._see_to_driver()
        if not job.wait(GRACE):
            _log.warning("%s goes on %g s after it was interrupted", getattr(job.coro, "__qualname__", job.coro), GRACE)

    def stop(self) -> None:
        """Wind the loop down and join the thread, in bounded time, from any thread."""
        if os.getpid() != self._pid:
            return  # A forked child shares the parent's epoll set: closing the loop would deafen the parent's.
        self._request_stop()
        # The garbage collector may call from any thread, also from inside the loop.
        if not self.is_current and threading.current_thread() is not self._thread:
            self._thread.join(4 * GRACE)

    # Calls

    def _may_drive(self) -> bool:
        if asyncio._get_running_loop() is not None:  # noqa: SLF001  # unlike get_running_loop, never raises
            return False
        return _MAIN_THREAD_DRIVES or threading.current_thread() is not threading.main_thread()

    def _enlist(self, job: _Job[Any]) -> bool:
        """Register `job` unless others are under way; return whether it was registered."""
        with self._lock:
            if self._stopping:
                raise _closed()
            if self._jobs:
                return False
            self._jobs.add(job)
            return True

    def _submit(self, job: _Job[Any]) -> None:
        with self._lock:
            if self._stopping:
                raise _closed()
            self._jobs.add(job)
            self._loop.call_soon_threadsafe(self._start_job, job)
        self._see_to_driver()

    def _drive(self, job: _Job[Any]) -> list[tuple[int, FrameType | None]]:
        """Run the loop on this thread until `job` is finished or signals come; return these."""
        if self._ended:
            job.wait(_CLAIM_SLICE)
            return []
        gate = _SignalGate(self._leave)
        try:
            gate.shut()
            if self._claim(job, gate):
                try:
                    self._run_until_finished(job, gate)
                finally:
                    self._give_back()
        finally:
            gate.open()
        return gate.pending

    def _claim(self, job: _Job[Any], gate: _SignalGate) -> bool:
        """Get the turn; return False if `job` was finished or a signal came before."""
        while not self._turn.acquire(blocking=False):
            if job.finished or gate.pending:
                return False
            self._poke(self._yield)
            if self._turn.acquire(timeout=_CLAIM_SLICE):
                break
        return True

    def _run_until_finished(self, job: _Job[Any], gate: _SignalGate) -> None:
        if self._ended:
            return
        if job.task is None:
            job.task = self._loop.create_task(self._perform(job))
        self._driven = job
        try:
            while not (job.finished or gate.pending or self._ended):
                self._run_loop()
        finally:
            self._driven = None

    def _run_loop(self) -> None:
        # A task that raises one of these breaks out of the loop. If it is a job, its caller gets it through that.
        try:
            self._loop.run_forever()
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

    def _leave(self) -> None:
        """Make whoever runs the loop leave it soon."""
        self._poke(self._loop.stop)

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

    def _start_job(self, job: _Job[Any]) -> None:
        if job in self._jobs:
            job.task = self._loop.create_task(self._perform(job))

    def _cancel_job(self, job: _Job[Any]) -> None:
        if job.task is not None:
            job.task.cancel()
        elif job in self._jobs:  # The interrupt came before the start was scheduled.
            self._break_off(job)

    async def _perform(self, job: _Job[Any]) -> None:
        # Rather than a callback of the task: that would take one more turn of the loop.
        try:
            job.value = await job.coro
        except GeneratorExit:
            raise  # The loop ended first, and the job with it.
        except asyncio.CancelledError as error:
            job.error = _closed("during this call") if self._stopping else error.with_traceback(None)
        except BaseException as error:  # noqa: BLE001  # what it is, is the caller's business
            trace = error.__traceback__
            job.error = error.with_traceback(None if trace is None else trace.tb_next)  # without this frame
            del trace
        self._finish_job(job)

    def _break_off(self, job: _Job[Any]) -> None:
        job.error = _closed("during this call")
        if job.task is None:
            job.coro.close()
        self._finish_job(job)

    def _finish_job(self, job: _Job[Any]) -> None:
        self._jobs.discard(job)
        # Not left to the caller to drop: a signal handler that raises amid weak reference callbacks gets printed.
        job.task = None
        job.finish()
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
        await self._stop_requested.wait()
        if self._at_stop is not None:
            await _in_bounded_time(asyncio.ensure_future(self._at_stop()))
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
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


class Portal:
    """The way from blocking code into one client's event loop.

    Cheap to make: the loop and the daemon thread that runs it between calls start with the first `call`. They end
    with `close`, when the portal is garbage collected, or at interpreter exit; then `at_stop` runs, remaining tasks are
    cancelled and awaited, asynchronous generators are closed and the thread is joined, each in bounded time.

    Args:
        at_stop: Makes the coroutine that releases what lives on the loop. It must not refer to the portal.
    """

    __slots__ = ("__weakref__", "_at_stop", "_closed", "_finalizer", "_io", "_lock", "_pid", "_twins")

    def __init__(self, at_stop: Callable[[], Coroutine[Any, Any, object]] | None = None) -> None:
        self._at_stop = at_stop
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._io: _LoopHost | None = None
        self._finalizer: weakref.finalize[[], Portal] | None = None
        self._closed = False
        # Weak: twins refer to the portal, so a strong reference back would leave closing to the cycle collector.
        self._twins: weakref.WeakValueDictionary[int, Facade] = weakref.WeakValueDictionary()

    @property
    def is_open(self) -> bool:
        """Whether the thread runs and belongs to this process."""
        return self._io is not None and not self._io.stopping and self._pid == os.getpid()

    def call(self, coro: Coroutine[Any, Any, T]) -> T:
        """Run `coro` on the loop and return its result; block until then. Where possible this thread runs the loop.

        An exception that strikes the calling thread meanwhile, such as `KeyboardInterrupt`, cancels the coroutine,
        gives its `finally` blocks up to `GRACE` seconds, and goes on. The portal stays usable.

        Raises:
            ForkedError: If this process is a fork of the one that made the portal.
            ClientClosed: If the portal is closed, before or during the call.
            URLabError: If called from inside the loop, where waiting would never end.
        """
        io: _LoopHost | None = None
        job = _Job(coro)
        try:
            io = self._ready()
            io.run(job)
        except BaseException:
            if io is None:
                coro.close()
            else:
                io.abandon(job)
            raise
        # Since Python 3.13 the traceback leads to frames that refer to the job.
        error, job.error = job.error, None
        if error is None:
            return job.value
        # A refusal by the server is told by its message and its notes; frames of the client would only bury them.
        trace = None if isinstance(error, URLabRPCError) else _without_earlier_raise(error.__traceback__)
        try:
            raise error.with_traceback(trace)
        finally:
            del error, job, trace  # The traceback refers to this frame: leave no cycle.

    def next(self, coro: Coroutine[Any, Any, T]) -> T:
        """`call` for a façade's `__next__`: the end of the asynchronous iteration ends the blocking one."""
        try:
            return self.call(coro)
        except StopAsyncIteration:
            raise StopIteration from None

    def next_of(self, stream: _Stream[A]) -> A:
        """`next` for a stream. All of a batch but its first item takes no way through the loop."""
        item = stream.receive_nowait()
        return self.next(stream.__anext__()) if item is None else item

    def release(self, coro: Coroutine[Any, Any, object]) -> None:
        """`call` for what only lets go: after the client was closed, or in a forked child, there is nothing to do."""
        with contextlib.suppress(ClientClosed, ForkedError):
            self.call(coro)

    def close(self, last: Coroutine[Any, Any, object] | None = None) -> None:
        """Run `last`, then end the loop and its thread. Later calls raise `ClientClosed`; closing again does nothing.

        In a forked child, too, this does nothing: what there is to release belongs to the parent.
        """
        if self._closed or os.getpid() != self._pid:
            if last is not None:
                last.close()
            return
        if self._io is not None and self._io.is_current:
            if last is not None:
                last.close()
            raise _on_io_thread()
        try:
            if last is not None:
                with contextlib.suppress(ClientClosed):  # Another thread was faster.
                    self.call(last)
        finally:
            with self._lock:
                self._closed = True
            if self._finalizer is not None:
                self._finalizer()

    # None is an object, too; the first match wins.
    @overload
    def wrap(self, cls: type[F], aio: None) -> None: ...  # type: ignore[overload-overlap]  # pyright: ignore[reportOverlappingOverload]
    @overload
    def wrap(self, cls: type[F], aio: object) -> F: ...
    def wrap(self, cls: type[F], aio: object) -> F | None:
        """Return the façade twin of `aio`, always the same one; None for None.

        Args:
            cls: Façade class of the declared type; the twin's is that of `aio`'s own class, which may be derived.
            aio: The asynchronous object.
        """
        if aio is None:
            return None
        twin = self._twins.get(id(aio))
        if twin is None:
            if os.getpid() != self._pid:
                raise _forked()  # Another thread may have held the lock at the fork.
            with self._lock:
                twin = self._twins.get(id(aio))
                if twin is None:
                    actual = next((_FACADES[base] for base in type(aio).__mro__ if base in _FACADES), cls)
                    twin = cast("Facade", object.__new__(actual))
                    self.adopt(twin, aio)
        return cast("F", twin)

    def adopt(self, twin: Facade, aio: object) -> None:
        """Make `twin` the façade of `aio`."""
        Facade.__init__(twin, aio, self)
        self._twins[id(aio)] = twin

    def _ready(self) -> _LoopHost:
        """Return the running loop, or raise the reason why there cannot be one."""
        if os.getpid() != self._pid:
            raise _forked()
        if self._io is None:
            with self._lock:
                if self._closed:
                    raise _closed()
                if self._io is None:
                    io = _LoopHost(self._at_stop)
                    io.start()
                    self._finalizer = weakref.finalize(self, io.stop)
                    self._io = io
        elif self._io.is_current:
            raise _on_io_thread()
        return self._io


def _closed(when: str = "before this call") -> ClientClosed:
    return ClientClosed(f"The client was closed {when}.", hint="Make a new one.")


def _forked() -> ForkedError:
    return ForkedError(
        "This client was made before the process forked: its thread and sockets stayed with the parent.",
        hint="Make a client in the child, or start workers with multiprocessing's 'spawn' method.",
    )


def _on_io_thread() -> URLabError:
    return URLabError(
        "A blocking call was made on the client's own I/O thread, which would wait for itself.",
        hint="Hand the work to another thread, or use urlab_client.aio in code that runs on the event loop.",
    )


def _without_earlier_raise(trace: TracebackType | None) -> TracebackType | None:
    """Cut off what raising the same exception object through an earlier call left at the end of `trace`.

    The leftover begins in a frame of that call's callers and goes on through `Portal.call`.
    """
    entry = trace
    while entry is not None and entry.tb_frame.f_code is not Portal.call.__code__:
        entry = entry.tb_next
    if trace is None or entry is None:
        return trace
    callers = {entry.tb_frame}
    frame = entry.tb_frame.f_back
    while frame is not None:
        callers.add(frame)
        frame = frame.f_back
    if trace.tb_frame in callers:
        return trace  # A coroutine of this loop made a blocking call into another one: nothing is left over.
    last = trace
    while last.tb_next is not None and last.tb_next.tb_frame not in callers:
        last = last.tb_next
    last.tb_next = None
    return trace


_FACADES: dict[type, type[Facade]] = {}


class Facade:
    """Base of the generated classes: the blocking twin of one asynchronous object.

    A subclass names the class it stands for: `class Scene(Facade, twin=aio.Scene)`. It is made by `Portal.wrap` only.
    """

    __slots__ = ("__weakref__", "_aio", "_maps", "_portal")

    _aio: Any
    _maps: dict[str, tuple[NameMap[Any], NameMap[Any]]]
    _portal: Portal

    def __init_subclass__(cls, *, twin: type | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if twin is not None:
            _FACADES[twin] = cls

    def __init__(self, aio: object, portal: Portal) -> None:
        self._aio = aio
        self._portal = portal
        self._maps = {}

    def _map(self, name: str, cls: type[F], source: NameMap[Any]) -> NameMap[F]:
        """Return the twins of the entries of `source`, as the same map as long as property `name` has this `source`.

        Remembered here, not in the map: the loop's tasks keep `source` alive, which must not keep the twins.
        """
        known, twins = self._maps.get(name, (None, None))
        if twins is None or known is not source:
            entries = cast("NameMap[object]", source).items()
            twins = NameMap({key: self._portal.wrap(cls, entry) for key, entry in entries}, source.aliases, source.kind)
            self._maps[name] = source, twins
        return twins

    def __repr__(self) -> str:
        if type(self._aio).__repr__ is object.__repr__:
            return super().__repr__()
        return repr(self._aio)

    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError(
            f"{type(self).__name__} cannot be pickled or copied: it belongs to a connection of this process. "
            "Make a client where it is needed."
        )


class _Twin(Protocol[A_co]):
    @property
    def _aio(self) -> A_co: ...


def aio_of(twin: _Twin[A_co]) -> A_co:
    """Return the async object that a façade object stands for."""
    return twin._aio  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]


def portal_of(twin: Facade) -> Portal:
    """Return the way into the event loop of a façade object's client."""
    return twin._portal  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]


class FacadeRoot(Facade):
    """Base of a generated class that users construct: owns the portal."""

    __slots__ = ("_opened_at",)

    def __init__(self, aio: Any) -> None:
        Portal(aio.close).adopt(self, aio)
        self._opened_at = _first_line_outside_package()

    def __del__(self) -> None:
        portal: Portal | None = getattr(self, "_portal", None)  # None if the constructor failed.
        if portal is not None and portal.is_open:
            file, line = self._opened_at
            message = f"unclosed {self!r}, opened at {file}:{line}; use `with` or call close()"
            warnings.warn_explicit(message, ResourceWarning, file, line)


def _first_line_outside_package() -> tuple[str, int]:
    package = __name__.partition(".")[0]
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame = frame.f_back
    return (frame.f_code.co_filename, frame.f_lineno) if frame is not None else ("<unknown>", 0)
