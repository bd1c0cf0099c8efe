"""A thread that serves requests one by one, and is replaced when one of them does not return.

For the request socket and shared memory. A thread inside a call of MuJoCo cannot be interrupted. It can only be
abandoned: another thread sends the reply and serves from then on.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from urlab_client.server.system.health import Health, ended


class ServingThread:
    """The current serving thread. It calls `begin` before a request and `finish` after it."""

    def __init__(self, name: str, run: Callable[[bytes | None], None], health: Health) -> None:
        """Configure the thread; `start` starts it.

        Args:
            name: Name of the thread.
            run: Body of the thread. Its argument is the reply to send first when it replaces another thread.
            health: Notified when the thread dies.
        """
        self._name = name
        self._run = run
        self._health = health
        self._lock = threading.Lock()
        self._working = False
        self._thread = self._made(None)

    def _made(self, owed: bytes | None) -> threading.Thread:
        return self._health.thread(self._name, self._run, owed)

    def start(self) -> None:
        """Start the thread."""
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
        """Mark the calling thread as working on a request."""
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
            thread: The thread that does not return.
            owed: The reply that the new thread sends for it.
            release: Called before the new thread starts, to hand over what the old one holds.
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
        """Wait for the thread to end and return whether it has. Does not wait for replaced threads."""
        if self.is_current:
            return False
        return ended(self._thread, timeout)
