"""The threads of a server: their health, those that serve requests, and the heaps that they share.

`Health.thread` makes all of them, and reports their unexpected end here. The dispatcher then refuses every request, and
`SimulatedServer` calls the user's callbacks.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import Final, TypeVarTuple

from urlab_client._platform.threads import daemon

logger: logging.Logger = logging.getLogger("urlab_client.server")

Ts = TypeVarTuple("Ts")


SLICE_S: Final = 0.1


def within(timeout: float, attempt: Callable[[float], bool]) -> bool:
    """Try for `timeout` seconds, in at least two slices, and return whether it succeeded.

    After a process was stopped or got no processor time, its deadline may have passed although no other thread has run.
    With slices, such a pause uses up one of them, and another follows.
    """
    return any(attempt(SLICE_S) for _ in range(max(2, math.ceil(timeout / SLICE_S))))


def ended(thread: threading.Thread, timeout: float) -> bool:
    """Wait until a thread has ended, for `timeout` seconds, and return whether it has."""

    def joined(seconds: float) -> bool:
        thread.join(seconds)
        return not thread.is_alive()

    return within(timeout, joined)


class Health:
    """Failures of the threads of one server. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._failure: str | None = None
        self._callbacks: list[Callable[[str], None]] = []

    @property
    def failure(self) -> str | None:
        """Which thread died first, and why; None while all are running."""
        return self._failure

    def report(self, error: BaseException) -> str:
        """Record that the calling thread ends with an error, and return the message."""
        name = threading.current_thread().name
        detail = f": {error}" if str(error) else ""
        reason = f"the server's thread '{name}' died of {type(error).__name__}{detail}"
        logger.error("%s; the server must be started again", reason, exc_info=error)
        with self._lock:
            callbacks, self._callbacks = self._callbacks, []
            if self._failure is None:
                self._failure = reason
        for callback in callbacks:
            _tell(callback, reason)
        return reason

    def thread(
        self,
        name: str,
        run: Callable[[*Ts], object],
        *arguments: *Ts,
        on_death: Callable[[str], object] = lambda _: None,
    ) -> threading.Thread:
        """Return a daemon thread, not started, whose death by an exception is reported.

        Args:
            on_death: Called with the message after the report, on that thread, to fail what waits for it.
        """
        return daemon(name, run, *arguments, failed=lambda error: on_death(self.report(error)))

    def add_callback(self, callback: Callable[[str], None]) -> None:
        """Call `callback` once with the first failure, on the thread that dies; immediately if there was one."""
        with self._lock:
            reason = self._failure
            if reason is None:
                self._callbacks.append(callback)
        if reason is not None:
            _tell(callback, reason)


def _tell(callback: Callable[[str], None], reason: str) -> None:
    try:
        callback(reason)
    except Exception:
        logger.exception("%r failed when called with the failure of the server", callback)


class ServedThread:
    """A part of a server with a thread of its own, which ends once `_stopping` is set.

    Attributes:
        thread: The thread, made by `Health.thread`.
    """

    def __init__(self, thread: threading.Thread) -> None:
        self.thread: threading.Thread = thread
        self._stopping = threading.Event()

    @property
    def alive(self) -> bool:
        return self.thread.is_alive()

    @property
    def started(self) -> bool:
        return self.thread.ident is not None

    def start(self) -> None:
        self.thread.start()

    def stop(self) -> None:
        self._stopping.set()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end after `stop`; return False if it is still busy after `timeout` seconds."""
        return not self.started or ended(self.thread, timeout)


class ServingThread(ServedThread):
    """A thread that serves requests one by one. It calls `begin` before a request and `finish` after it.

    Inside a call of MuJoCo it cannot be interrupted, only abandoned: another thread then sends the reply and serves.
    """

    def __init__(self, name: str, run: Callable[[bytes | None], None], health: Health) -> None:
        """Configure the thread; `start` starts it.

        Args:
            run: Body of the thread. Its argument is the reply to send first when it replaces another thread.
        """
        self._make: Callable[[bytes | None], threading.Thread] = partial(health.thread, name, run)
        super().__init__(self._make(None))
        self._lock = threading.Lock()
        self._working = False

    @property
    def is_current(self) -> bool:
        return threading.current_thread() is self.thread

    def begin(self) -> None:
        self._working = True

    def finish(self) -> bool:
        """Mark the request as finished; return False if another thread has answered it and serves now."""
        with self._lock:
            if not self.is_current:
                return False
            self._working = False
            return True

    def relieve(self, thread: threading.Thread, owed: bytes, release: Callable[[], None]) -> bool:
        """Replace `thread` if it is the serving thread and working on a request.

        Args:
            owed: The reply that the new thread sends for it.
            release: Called before the new thread starts, to hand over what the old one holds.
        """
        with self._lock:
            if thread is not self.thread or not self._working:
                return False
            self._working = False
            release()
            self.thread: threading.Thread = self._make(owed)
            self.thread.start()
            return True

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end and return whether it has. Does not wait for replaced threads."""
        return not self.is_current and super().join(timeout)


# Settings of glibc's allocator, without effect with other C libraries.

_M_ARENA_MAX = -8  # of mallopt


def limit_arenas() -> None:
    """Make all threads of this process allocate from two heaps.

    Each play session draws and compiles in its own threads. By default glibc gives each new thread its own heap, up to
    eight per processor, and each keeps about ten MiB of the renderer's memory.
    """
    _ask("mallopt", _M_ARENA_MAX, 2)


def trim() -> None:
    """Return free pages of the heaps to the system; after many play sessions glibc keeps tens of MiB of them."""
    _ask("malloc_trim", 0)


def _ask(function: str, *arguments: int) -> None:
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library
            getattr(ctypes.CDLL(None), function)(*arguments)
