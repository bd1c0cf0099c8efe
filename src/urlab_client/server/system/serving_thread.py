"""A thread that serves requests one after the other, and gives way to another when it does not come back from one.

For the request socket and shared memory. A thread inside a call of MuJoCo cannot be broken off; what can be done is to
let it be, answer in its place, and go on with a fresh thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from urlab_client.server.system.thread_join import ended

__all__ = ["ServingThread"]


class ServingThread:
    """The thread that serves at present. It calls `begin` before it works on a request and `finish` after it."""

    def __init__(self, name: str, run: Callable[[bytes | None], None]) -> None:
        """Prepare; `start` starts it.

        Args:
            name: Of the thread.
            run: What it does. Is given the reply to send first, when it stands in for another thread.
        """
        self._name = name
        self._run = run
        self._lock = threading.Lock()
        self._working = False
        self._thread = self._made(None)

    def _made(self, owed: bytes | None) -> threading.Thread:
        return threading.Thread(target=self._run, args=(owed,), name=self._name, daemon=True)

    def start(self) -> None:
        """Start to serve."""
        self._thread.start()

    @property
    def started(self) -> bool:
        """Whether it was started."""
        return self._thread.ident is not None

    @property
    def alive(self) -> bool:
        """Whether requests are served."""
        return self._thread.is_alive()

    @property
    def is_current(self) -> bool:
        """Whether the calling thread is the one that serves."""
        return threading.current_thread() is self._thread

    def begin(self) -> None:
        """Say that the calling thread works on a request."""
        self._working = True

    def finish(self) -> bool:
        """Say that it has done so; return False when another thread has answered in its place and serves now."""
        with self._lock:
            if not self.is_current:
                return False
            self._working = False
            return True

    def relieve(self, thread: threading.Thread, owed: bytes, release: Callable[[], None]) -> bool:
        """Let another thread serve if `thread` does so and works on a request.

        Args:
            thread: The thread that does not come back.
            owed: The reply that the new one sends for it.
            release: Called before the new one starts: gives it what the old one holds.
        """
        with self._lock:
            if thread is not self._thread or not self._working:
                return False
            self._working = False
            release()
            self._thread = self._made(owed)
            self._thread.start()
            return True

    def join(self, timeout: float) -> bool:
        """Wait for its end and return whether it has ended; a thread that was relieved is not waited for."""
        if self.is_current:
            return False
        return ended(self._thread, timeout)
