"""Editor ops that run in the background, one after the other.

For the dispatcher, which starts them, and for `op_status`, which returns their progress and results.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, Final

from urlab_client.server.refusal import Refusal
from urlab_client.server.system.threads import Health

_MOST: Final = 4096
"""Maximum number of jobs that wait, and of results that nobody has fetched; beyond it the oldest results go."""

_KEPT_S: Final = 300.0
"""Seconds after which a result that nobody has fetched goes."""


class EditorJobs:
    """The jobs of one server. The result of a job is returned once, to the first caller.

    Results outlive the session that asked for them, so that it may be renewed meanwhile, but not for ever, as the
    plugin's do: a client that never fetches its results must not use up the server's memory.
    """

    def __init__(self, health: Health, clock: Callable[[], float] = time.monotonic) -> None:
        self._health = health
        self._death: str | None = None
        self._clock = clock
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._waiting: queue.SimpleQueue[tuple[str, Callable[[], dict[str, Any]]] | None] = queue.SimpleQueue()
        self._results: dict[str, dict[str, Any] | None] = {}
        self._ended: dict[str, float] = {}  # in the order of their ends
        self._count = 0
        self._open = 0
        self._thread: threading.Thread | None = None

    def start(self, work: Callable[[], dict[str, Any]]) -> str:
        """Queue `work` behind earlier jobs and return the job's id.

        Args:
            work: Returns the reply or error as plain data; does not raise.
        """
        with self._lock:
            self._check_alive()
            if self._open >= _MOST:
                raise Refusal("bad_request", f"{_MOST} jobs wait already: let them end first")
            self._count += 1
            job = f"job_{self._count}"
            self._results[job] = None
            self._open += 1
            if self._thread is None:
                self._thread = self._health.thread("urlab-editor", self._run, on_death=self._die)
                self._thread.start()
        self._waiting.put((job, work))
        return job

    def take(self, job: str) -> dict[str, Any] | None:
        """Return the result of a job and forget the job, or return None while it is not done; refuse unknown jobs."""
        with self._lock:
            self._expire()
            if job not in self._results:
                raise Refusal(
                    "unknown_job",
                    f"'{job}' is not known: its result was already returned or has expired, or it never existed",
                )
            result = self._results[job]
            if result is not None:
                del self._results[job], self._ended[job]
            return result

    @contextmanager
    def alone(self) -> Generator[None]:
        """Wait until no job is open, and keep new ones waiting meanwhile."""
        with self._lock:
            self._idle.wait_for(lambda: self._open == 0 or self._death is not None)
            self._check_alive()
            yield

    def close(self) -> None:
        """Let the thread end after the queued jobs."""
        if self._thread is not None:
            self._waiting.put(None)

    def _expire(self) -> None:
        now = self._clock()
        while self._ended:
            oldest, ended = next(iter(self._ended.items()))
            if len(self._ended) <= _MOST and now - ended <= _KEPT_S:
                break
            del self._results[oldest], self._ended[oldest]

    def _run(self) -> None:
        while (entry := self._waiting.get()) is not None:
            job, work = entry
            result = work()
            with self._lock:
                self._results[job] = result
                self._ended[job] = self._clock()
                self._expire()
                self._open -= 1
                self._idle.notify_all()

    def _die(self, reason: str) -> None:
        with self._lock:
            self._death = reason
            self._idle.notify_all()

    def _check_alive(self) -> None:
        if self._death is not None:
            raise Refusal("internal_error", self._death)
