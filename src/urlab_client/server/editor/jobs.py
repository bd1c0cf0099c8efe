"""Editor ops that run in the background, one after the other.

For the dispatcher, which starts them, and for `op_status`, which returns their progress and results.
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
"""Maximum number of jobs that wait or whose result was not fetched."""


class EditorJobs:
    """The jobs of one server. The result of a job is returned once, to the first caller."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._waiting: queue.SimpleQueue[tuple[str, Callable[[], dict[str, Any]]] | None] = queue.SimpleQueue()
        self._results: dict[str, dict[str, Any] | None] = {}
        self._count = 0
        self._open = 0
        self._thread: threading.Thread | None = None

    def start(self, work: Callable[[], dict[str, Any]]) -> str:
        """Queue `work` behind earlier jobs and return the job's id.

        Args:
            work: Returns the reply or error as plain data; does not raise.

        Raises:
            Refusal: `bad_request` if too many jobs are open.
        """
        with self._lock:
            if len(self._results) >= _MOST:
                raise Refusal("bad_request", f"{_MOST} jobs are open: fetch their results with op_status")
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
        """Return the result of a job and forget the job, or return None while it is not done.

        Raises:
            Refusal: `unknown_job` if there is no such job, or its result was already returned.
        """
        with self._lock:
            if job not in self._results:
                raise Refusal(
                    "unknown_job", f"'{job}' is not known: its result was already returned, or it never existed"
                )
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
        """Let the thread end after the queued jobs."""
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
