"""Health of a server's threads, and callbacks for when one dies.

`Health.thread` makes all threads of a server, and reports their unexpected end here. The dispatcher then refuses every
request, and `SimulatedServer` calls the user's callbacks.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TypeVarTuple

from urlab_client._background import daemon

__all__ = ["Health"]

logger: logging.Logger = logging.getLogger("urlab_client.server")

Ts = TypeVarTuple("Ts")


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
            name: Its name.
            run: Its body.
            arguments: Arguments of `run`.
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
