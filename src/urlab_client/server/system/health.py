"""Whether the threads of a server run, and who is told when one of them died.

For what has a thread, which reports its unexpected end here, for the dispatcher, which then refuses every request, and
for `SimulatedServer`, which tells whoever runs it.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager

__all__ = ["Health"]

logger: logging.Logger = logging.getLogger("urlab_client.server")


class Health:
    """What became of the threads of one server. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._failure: str | None = None
        self._callbacks: list[Callable[[str], None]] = []

    @property
    def failure(self) -> str | None:
        """Which thread died first, and of what; None while all run."""
        return self._failure

    def report(self, error: BaseException) -> str:
        """Take note that the calling thread ends with an error, and return how that reads."""
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

    @contextmanager
    def watch(self) -> Generator[None]:
        """Report what ends the block, and let the thread end quietly."""
        try:
            yield
        except BaseException as error:  # noqa: BLE001 - whatever it is, nobody else hears of it
            self.report(error)

    def add_callback(self, callback: Callable[[str], None]) -> None:
        """Call this once with the first failure from now on, on the thread that dies; at once if there was one."""
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
        logger.exception("%r could not be told that the server failed", callback)
