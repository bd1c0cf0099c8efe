"""Learning when a socket becomes readable, on every event loop.

A loop with `add_reader` watches sockets itself. For other loops, above all Windows' default Proactor loop, a thread
watches the sockets: one per loop, which runs while there are sockets to watch. It removes a socket from its list before
it notifies the loop, and adds it again after the loop has handled it, so it never notifies twice.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Collection
from typing import Any, ClassVar, Final, Protocol, cast
from weakref import WeakValueDictionary

import zmq

from urlab_client.aio.background import Tell, background_thread
from urlab_client.events import ClientEvent

# Interval of the thread's checks whether the loop was closed while clients were open.
_CHECK_MS: Final = 1000
_JOIN_S: Final = 1.0
_AGAIN_S: Final = 1.0

_DRAIN_BYTES: Final = 4096
_POLLIN: Final = int(zmq.POLLIN)


class Watchable(Protocol):
    """A ZeroMQ socket or a socket of the system."""

    def fileno(self) -> int:
        """Return the descriptor to watch."""
        ...


class Readiness(Protocol):
    """The watch on one socket."""

    def expect(self) -> None:
        """Resume watching if `awaited` had ended it."""
        ...

    def close(self) -> None:
        """Stop watching. Call before the socket is closed. Idempotent."""
        ...


def watch_socket(
    loop: asyncio.AbstractEventLoop,
    watched: Watchable,
    on_readable: Callable[[], object],
    *,
    awaited: Callable[[], bool] | None = None,
    tell: Tell | None = None,
) -> Readiness:
    """Call `on_readable` on the event loop whenever a socket is readable.

    Args:
        loop: The running event loop.
        watched: The socket.
        on_readable: Callback to invoke. It may find nothing to read.
        awaited: Callback that returns whether anything is expected. A watching thread is active only from `expect`
            until this returns False, because waking the thread would delay a reply that the loop polls for itself. None
            to watch always.
        tell: Publishes the event that a watching thread died. Another one follows after a pause.
    """
    try:
        loop.add_reader(watched.fileno(), on_readable)
    except NotImplementedError:
        return _Watched(_Watcher.of(loop), watched.fileno(), on_readable, awaited, tell)
    return _Reader(loop, watched.fileno())


class _Reader:
    """A socket that its event loop watches."""

    def __init__(self, loop: asyncio.AbstractEventLoop, fd: int) -> None:
        self._loop = loop
        self._fd = fd
        self._closed = False

    def expect(self) -> None:
        """See `Readiness.expect`: the loop always watches."""

    def close(self) -> None:
        """See `Readiness.close`."""
        if not self._closed:
            self._closed = True
            if not self._loop.is_closed():  # an abandoned client may outlive its loop
                self._loop.remove_reader(self._fd)


class _Watched:
    """A socket that the thread watches."""

    def __init__(
        self,
        watcher: _Watcher,
        fd: int,
        on_readable: Callable[[], object],
        awaited: Callable[[], bool] | None,
        tell: Tell | None,
    ) -> None:
        self.fd = fd
        self.tell_event = tell
        self._watcher = watcher
        self._on_readable = on_readable
        self._awaited = awaited
        self._armed = False
        self._closed = False
        if awaited is None:
            self.expect()

    def expect(self) -> None:
        """See `Readiness.expect`."""
        if not self._armed and not self._closed:
            self._armed = True
            self._watcher.arm(self)

    def close(self) -> None:
        """See `Readiness.close`."""
        if not self._closed:
            self._closed = True
            self._watcher.release(self)

    def tell(self) -> None:
        """Handle that the socket is readable. Called on the event loop."""
        self._armed = False
        try:
            if not self._closed:
                self._on_readable()
        finally:
            if self._awaited is None or self._awaited():
                self.expect()


class _Watcher:
    """The watching thread of one event loop.

    It uses ZeroMQ's poll, which is not limited to the 512 sockets of `select.select` on Windows.
    """

    _of_loops: ClassVar[dict[asyncio.AbstractEventLoop, _Watcher]] = {}

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        # Weak: an unclosed client is collected with its loop before this thread sees that the loop is closed.
        self._armed: WeakValueDictionary[int, _Watched] = WeakValueDictionary()
        self._users = 0
        self._ended = False
        self._rung = False
        self._bell, self._button = socket.socketpair()
        self._start()

    @classmethod
    def of(cls, loop: asyncio.AbstractEventLoop) -> _Watcher:
        """Return the watcher of `loop` and count the caller as a user."""
        watcher = cls._of_loops.get(loop)
        if watcher is None:
            watcher = cls._of_loops[loop] = cls(loop)
        watcher._users += 1
        return watcher

    def arm(self, watched: _Watched) -> None:
        """Watch a socket until it is readable."""
        with self._lock:
            self._armed[watched.fd] = watched
            self._ring()

    def release(self, watched: _Watched) -> None:
        """Stop watching a socket. The last user ends the thread."""
        with self._lock:
            if self._armed.get(watched.fd) is watched:
                del self._armed[watched.fd]
            self._users -= 1
            last = not self._users
            self._ended = self._ended or last
            self._ring()
        if last:
            self._forget()
            self._thread.join(_JOIN_S)
            if not self._thread.is_alive():
                self._finish()  # as it has done itself, unless it died

    def _ring(self) -> None:
        if not self._rung:
            self._rung = True
            self._button.send(b"\0")

    def _forget(self) -> None:
        if self._of_loops.get(self._loop) is self:
            del self._of_loops[self._loop]

    def _start(self) -> None:
        self._thread = background_thread("urlab-sockets", self._run, tell=self._on_death)
        self._thread.start()

    def _on_death(self, event: ClientEvent) -> None:
        for watched in tuple(self._armed.values()):
            if watched.tell_event is not None:
                watched.tell_event(event)
        self._loop.call_later(_AGAIN_S, self._begin_again)

    def _begin_again(self) -> None:
        if not self._ended:
            self._rung = False  # the thread may have died between reading and noting it
            self._start()

    def _run(self) -> None:
        while self._look():
            pass
        self._finish()

    def _finish(self) -> None:
        with self._lock:
            self._rung = True  # suppresses any further ring
            self._armed.clear()
        self._forget()
        self._bell.close()
        self._button.close()

    def _look(self) -> bool:
        """Wait for a readable socket and notify the loop. Return whether to continue."""
        with self._lock:
            if self._ended:
                return False
            fds = [self._bell.fileno(), *self._armed]
        try:
            ready = _poll(fds, _CHECK_MS)
        except zmq.ZMQError:  # on Windows, if a socket was closed meanwhile
            self._drop_closed()
            return True
        with self._lock:
            if self._bell.fileno() in ready:
                self._bell.recv(_DRAIN_BYTES)
                self._rung = False
            notified = [watched for fd in ready if (watched := self._armed.pop(fd, None)) is not None]
        try:
            for watched in notified:
                self._loop.call_soon_threadsafe(watched.tell)
        except RuntimeError:  # the loop is closed
            return False
        return not self._loop.is_closed()

    def _drop_closed(self) -> None:
        with self._lock:
            for fd in tuple(self._armed):
                try:
                    _poll([fd], 0)
                except zmq.ZMQError:
                    del self._armed[fd]


def _poll(fds: Collection[int], timeout_ms: int) -> list[int]:
    """Return the descriptors that are readable or broken."""
    poll: Callable[[list[tuple[int, int]], int], list[tuple[int, int]]] = cast("Any", zmq.zmq_poll)
    return [fd for fd, _ in poll([(fd, _POLLIN) for fd in fds], timeout_ms)]
