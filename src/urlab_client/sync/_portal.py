"""Calls from blocking code into an event loop."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import weakref
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec, TypeVar

from urlab_client.aio.streams.stream import Stream
from urlab_client.errors import ClientClosed, ForkedError, URLabError, URLabRPCError
from urlab_client.protocol.messages.streams import StreamItem
from urlab_client.sync._loop import CallerDrivenLoop, Job, client_closed, on_io_thread
from urlab_client.sync._signals import DeferredSignals

P = ParamSpec("P")
T = TypeVar("T")
A = TypeVar("A")
Item = TypeVar("Item", bound=StreamItem)


class Portal:
    """Runs coroutines of blocking code on one client's event loop.

    Cheap to create: the loop and the daemon thread that runs it between calls start with the first `call`. They end
    with `close`, when the portal is garbage-collected, or at interpreter exit. Then `at_stop` runs, remaining tasks are
    cancelled and awaited, asynchronous generators are closed and the thread is joined, each in bounded time.

    Args:
        at_stop: Returns the coroutine that releases the resources on the loop. It must not refer to the portal.

    Raises:
        URLabError: gevent or Eventlet has replaced Python's threads or sockets.
    """

    __slots__ = ("__weakref__", "_at_stop", "_closed", "_finalizer", "_io", "_lock", "_pid", "_twins")

    def __init__(self, at_stop: Callable[[], Coroutine[Any, Any, object]] | None = None) -> None:
        _refuse_greenlets()
        self._at_stop = at_stop
        self._pid = os.getpid()
        self._lock = threading.RLock()
        self._io: CallerDrivenLoop | None = None
        self._finalizer: weakref.finalize[[], Portal] | None = None
        self._closed = False
        # Weak: twins refer to the portal, so with strong references only the cycle collector would close it.
        self._twins: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()

    @property
    def is_open(self) -> bool:
        """Whether the thread runs and belongs to this process."""
        return self._io is not None and not self._io.stopping and self._pid == os.getpid()

    def call(self, function: Callable[P, Coroutine[Any, Any, T]], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Run the coroutine that `function` returns on the loop, block until it is done, and return its result.

        If possible, this thread runs the loop. An exception that a signal handler raises during the call, such as
        `KeyboardInterrupt`, cancels the coroutine, gives its `finally` blocks up to `GRACE` seconds, and propagates.
        The portal stays usable.

        Raises:
            ForkedError: This process is a fork of the one that created the portal.
            ClientClosed: The portal was closed before or during the call.
            URLabError: Called from inside the loop, where waiting would never end.
        """
        with DeferredSignals() as signals:
            io = self._ready()
            # The coroutine is made here, where no signal handler can come between it and the job.
            job = Job(function(*args, **kwargs))
            io.run(job, signals)
        # Since Python 3.13 the traceback contains frames that refer to the job.
        error, job.error = job.error, None
        if error is None:
            return job.value
        try:
            # The message and notes of a refusal by the server are enough; frames of the client would hide them.
            raise error.with_traceback(None) if isinstance(error, URLabRPCError) else error
        finally:
            del error, job  # The traceback refers to this frame: avoid a cycle.

    def next(self, function: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """`call` for a façade's `__next__`: `StopAsyncIteration` becomes `StopIteration`."""
        try:
            return self.call(function)
        except StopAsyncIteration:
            raise StopIteration from None

    def next_of(self, stream: Stream[Item]) -> Item:
        """`next` for a stream. Buffered items are returned without entering the loop."""
        try:
            with DeferredSignals():
                item = stream.receive_nowait()
            return self.next(stream.__anext__) if item is None else item
        except ClientClosed as error:
            if error.__cause__ is not None:  # the loop died
                raise
            raise StopIteration from None

    def release(self, function: Callable[P, Coroutine[Any, Any, object]], /, *args: P.args, **kwargs: P.kwargs) -> None:
        """`call` for releasing resources; does nothing after the client was closed, or in a forked child."""
        with contextlib.suppress(ClientClosed, ForkedError):
            self.call(function, *args, **kwargs)

    def close(
        self, last: Callable[P, Coroutine[Any, Any, object]] | None = None, /, *args: P.args, **kwargs: P.kwargs
    ) -> None:
        """Run `last`, then end the loop and its thread. Later calls raise `ClientClosed`; closing again does nothing.

        An exception that a signal handler raises during `last` cancels it; the loop still ends in bounded time.

        Does nothing in a forked child, because the resources belong to the parent.
        """
        if self._closed or os.getpid() != self._pid:
            return
        if self._io is not None and self._io.is_current:
            raise on_io_thread()
        with DeferredSignals():
            try:
                if last is not None:
                    with contextlib.suppress(ClientClosed):  # Another thread was faster.
                        self.call(last, *args, **kwargs)
            finally:
                with self._lock:
                    self._closed = True
                if self._finalizer is not None:
                    self._finalizer()

    def twin(self, aio: object, make: Callable[[], A]) -> A:
        """Return the blocking twin of `aio`: the same object while it is referenced, otherwise a new one."""
        found = self._twins.get(id(aio))
        if found is None:
            if os.getpid() != self._pid:
                raise _forked()  # Another thread may have held the lock at the fork.
            with self._lock:
                found = self._twins.get(id(aio))
                if found is None:
                    found = self._twins[id(aio)] = make()
        return found

    def _ready(self) -> CallerDrivenLoop:
        """Return the loop, started if necessary, or raise if it cannot be used."""
        if os.getpid() != self._pid:
            raise _forked()
        if self._io is None:
            with self._lock:
                if self._closed:
                    raise client_closed()
                if self._io is None:
                    io = CallerDrivenLoop(self._at_stop, weakref.ref(self))
                    io.start()
                    self._finalizer = weakref.finalize(self, io.stop)
                    self._io = io
        return self._io


def _refuse_greenlets() -> None:
    """Raise if gevent or Eventlet has replaced threads or sockets, with which calls would hang or fail."""
    gevent: Any = sys.modules.get("gevent.monkey")
    eventlet: Any = sys.modules.get("eventlet.patcher")
    if gevent is not None and any(map(gevent.is_module_patched, ("threading", "select"))):
        library = "gevent"
    elif eventlet is not None and any(map(eventlet.is_monkey_patched, ("thread", "select"))):
        library = "Eventlet"
    else:
        return
    raise URLabError(
        f"The blocking client needs Python's own threads and sockets, which {library} has replaced in this process.",
        hint="Use it in a separate process, or use urlab_client.aio with asyncio.run().",
    )


def _forked() -> ForkedError:
    return ForkedError(
        "This client was created before the process forked. Its thread and sockets belong to the parent.",
        hint="Create a client in the child, or start workers with multiprocessing's 'spawn' method.",
    )
