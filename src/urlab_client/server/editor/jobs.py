"""Editor ops that are carried out beside the requests, one after the other, and asked for later.

For the dispatcher, which starts them, and for `op_status`, which tells how far they are.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any, Final

from urlab_client.server.refusal import Refusal

__all__ = ["EditorJobs"]

_MOST: Final = 4096
"""Jobs that may wait or whose end nobody asked for."""


class EditorJobs:
    """The jobs of one server. The end of a job is told once, to whoever asks first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._waiting: queue.SimpleQueue[tuple[str, Callable[[], dict[str, Any]]] | None] = queue.SimpleQueue()
        self._results: dict[str, dict[str, Any] | None] = {}
        self._count = 0
        self._open = 0
        self._thread: threading.Thread | None = None

    def start(self, work: Callable[[], dict[str, Any]]) -> str:
        """Have `work` done when those before it are, and return the job's id.

        Args:
            work: Returns the reply or error as plain data; does not raise.

        Raises:
            Refusal: `bad_request` when too many jobs are open.
        """
        with self._lock:
            if len(self._results) >= _MOST:
                raise Refusal("bad_request", f"{_MOST} jobs are open: ask for their ends with op_status")
            self._count += 1
            job = f"job_{self._count}"
            self._results[job] = None
            self._open += 1
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="urlab-editor", daemon=True)
                self._thread.start()
        self._waiting.put((job, work))
        return job

    def take(self, job: str) -> dict[str, Any] | None:
        """Return what a job came to and forget it, or None while it is not done.

        Raises:
            Refusal: `unknown_job`.
        """
        with self._lock:
            if job not in self._results:
                raise Refusal("unknown_job", f"'{job}' is not known: its end was told already, or it never was")
            result = self._results[job]
            if result is not None:
                del self._results[job]
            return result

    @contextmanager
    def alone(self) -> Any:
        """Wait until no job is open, and keep new ones waiting meanwhile."""
        with self._lock:
            self._idle.wait_for(lambda: self._open == 0)
            yield

    def close(self) -> None:
        """Let the thread end after the job under way."""
        if self._thread is not None:
            self._waiting.put(None)

    def _run(self) -> None:
        while (entry := self._waiting.get()) is not None:
            job, work = entry
            result = work()
            with self._lock:
                self._results[job] = result
                self._open -= 1
                self._idle.notify_all()
