"""Notifying the event loop of changes in a region: a doorbell if the server has one, otherwise a polling thread.

Linux and macOS do not signal a publication, so the counter must be polled. The event loop's timers are too coarse
because they round up to a millisecond. So one thread per client polls all watched regions and sleeps between rounds. It
ends when no watch remains.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from weakref import WeakMethod

from urlab_client.aio.background import Tell, background_thread
from urlab_client.aio.transport.readiness import watch_socket
from urlab_client.errors import URLabError
from urlab_client.events import ClientEvent
from urlab_client.protocol import doorbell

log: logging.Logger = logging.getLogger("urlab_client.transport")

_LINGER_S = 1.0
_BLOCK_S = 0.05

# (waited less than, sleep between polls), seconds.
_PACES = ((0.001, 50e-6), (0.05, 200e-6), (2.0, 1e-3))
_SLOWEST_S = 5e-3
_FASTEST_STREAM_S = 100e-6


class RegionPoll:
    """A watch that the thread polls.

    Args:
        probe: Callback that returns whether there is news. Called on the thread; must not block or raise.
        notify: Callback invoked on the event loop when there is news; not again before `resume`.
        block: Function that sleeps until the server signals, for at most the given seconds; None without signals.
    """

    def __init__(
        self, probe: Callable[[], bool], notify: Callable[[], None], block: Callable[[float], object] | None = None
    ) -> None:
        self.probe = probe
        self.notify = notify
        self.block = block
        self.notified: bool = False
        self._since = time.monotonic()

    def resume(self) -> None:
        """Poll again after the news has been consumed."""
        self._since = time.monotonic()
        self.notified = False

    def pace(self, now: float) -> float:
        """Return the seconds to sleep before the next poll."""
        waited = now - self._since
        return next((pace for limit, pace in _PACES if waited < limit), _SLOWEST_S)


class ReplyPoll(RegionPoll):
    """Waits for one reply: polls frequently at first and less often as the wait grows."""


class StreamPoll(RegionPoll):
    """Waits for successive publications, with four polls between two of them."""

    def __init__(self, probe: Callable[[], bool], notify: Callable[[], None]) -> None:
        super().__init__(probe, notify)
        self._interval = 4 * _SLOWEST_S

    def resume(self) -> None:
        """Poll again after the news has been consumed."""
        self._interval += (time.monotonic() - self._since - self._interval) / 8
        super().resume()

    def pace(self, now: float) -> float:
        """Return the seconds to sleep before the next poll."""
        interval = max(self._interval, now - self._since)  # poll a stopped stream less often
        return min(max(interval / 4, _FASTEST_STREAM_S), _SLOWEST_S)


class Poller:
    """The polling thread. Use from one event loop. If it dies, the next watch starts another one.

    Args:
        loop: The event loop.
        tell: Publishes the event of its death; a method of something that the client owns.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, tell: Tell | None) -> None:
        self._loop = loop
        self._tell = None if tell is None else WeakMethod(tell)  # the thread keeps no client that was forgotten
        self._changed = threading.Condition()
        self._watches: list[RegionPoll] = []
        self._thread: threading.Thread | None = None
        self._closed = False

    def add(self, watch: RegionPoll) -> None:
        """Start polling `watch`."""
        with self._changed:
            self._watches.append(watch)
            if self._thread is None and not self._closed:
                self._thread = background_thread("urlab-shm", self._run, tell=self._report, failed=self._die)
                self._thread.start()
            self._changed.notify()

    def remove(self, watch: RegionPoll) -> None:
        """Stop polling `watch`. When this returns, `probe` is not running and is not called again. Idempotent."""
        with self._changed:
            if watch in self._watches:
                self._watches.remove(watch)

    def close(self) -> None:
        """End the thread. Idempotent."""
        with self._changed:
            self._closed = True
            self._watches.clear()
            self._changed.notify()
            thread = self._thread
        if thread is not None:
            thread.join(2 * _BLOCK_S)

    def _report(self, event: ClientEvent) -> None:
        tell = None if self._tell is None else self._tell()
        if tell is not None:
            tell(event)

    def _die(self, error: URLabError) -> None:
        # The watches remain: their owners also look at the regions themselves, a few times a second.
        with self._changed:
            self._thread = None

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._watches:
                    self._changed.wait(_LINGER_S)
                if self._closed or not self._watches:
                    self._thread = None
                    return
                pause, block = self._look()
                if block is None:
                    self._changed.wait(pause)
            if block is not None:
                block(min(pause, _BLOCK_S))

    def _look(self) -> tuple[float, Callable[[float], object] | None]:
        """Poll all watches once. Return how long to sleep, and how."""
        pause, block, now = _SLOWEST_S, None, time.monotonic()
        for watch in self._watches:
            pause = min(pause, watch.pace(now))
            block = block or watch.block
            if not watch.notified and watch.probe():
                watch.notified = True
                with contextlib.suppress(RuntimeError):  # the loop is closed, so there are no waiters
                    self._loop.call_soon_threadsafe(watch.notify)
        return pause, block


class Doorbell:
    """The client's end of the doorbell.

    Args:
        loop: The event loop.
        path: Path of the socket.
        on_ring: Callback for each kind of ring.
        on_lost: Callback invoked when the server is gone.

    Raises:
        OSError: No server accepts connections there.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        path: Path,
        on_ring: dict[bytes, Callable[[], None]],
        on_lost: Callable[[], None],
    ) -> None:
        self._on_ring = on_ring
        self._on_lost = on_lost
        if len(str(path).encode()) > doorbell.MAX_PATH_BYTES:
            raise OSError(f"{path} is too long for a socket")
        if not hasattr(socket, "AF_UNIX"):
            raise OSError("this system has no Unix sockets")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(str(path))
            self._readiness = watch_socket(loop, self._socket, self._on_readable)
        except BaseException:
            self._socket.close()
            raise

    def ring(self, message: bytes) -> None:
        """Wake the server."""
        try:
            self._socket.send(message)
        except BlockingIOError:
            pass  # earlier rings are still pending
        except OSError:
            self._lose()

    def close(self) -> None:
        """Close the connection. Idempotent."""
        if self._socket.fileno() >= 0:
            self._readiness.close()
            self._socket.close()

    def _on_readable(self) -> None:
        try:
            rings = self._socket.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            rings = b""
        if not rings:
            self._lose()
            return
        for message, act in self._on_ring.items():
            if message in rings:
                act()

    def _lose(self) -> None:
        if self._socket.fileno() >= 0:
            self.close()
            self._on_lost()
