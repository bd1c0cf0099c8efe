"""Workers that stay up between runs."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import MappingProxyType, TracebackType
from typing import Any, Self

from urlab_client.cluster.worker import Worker
from urlab_client.errors import URLabError

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown


class WorkerPool:
    """Workers for several runs, one run at a time: `rollouts(…, workers=pool)`.

    They start with the first run that needs them. Between two runs they wait, each with the simulated server of its
    last scene, which the next run reuses if its scene and options are the same. Each occupies its processor meanwhile.
    A worker that died, alone or with its node, is replaced in the next run.
    """

    def __init__(self, n_workers: int = 0, *, worker_options: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Create a pool without workers.

        Args:
            n_workers: Maximum number of workers; 0 for one per processor of the cluster, or per leased address.
            worker_options: Options of the Ray actors, such as `num_cpus` or `resources`; one processor each by default.

        Raises:
            ValueError: `n_workers` is below 0.
            URLabError: Ray is not initialised.
        """
        if n_workers < 0:
            raise ValueError(f"n_workers must be 0 or more, not {n_workers}")
        if not _ray.is_initialized():
            raise URLabError("Ray is not initialised.", hint="Call ray.init() first.")
        self.n_workers = n_workers
        # Ray's own restarts are off: an episode whose worker died must be counted as an attempt.
        options = {"num_cpus": 1, "scheduling_strategy": "SPREAD", **worker_options, "max_restarts": 0}
        self._actor = _ray.remote(Worker).options(**options)
        self._waiting: list[Any] = []
        self._run: weakref.ref[object] | None = None  # a garbage-collected run has no workers
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Number of idle workers."""
        return len(self._waiting)

    def lend(self, run: object) -> list[Any]:
        """Lend all workers to a run, which returns the remaining ones; used by `rollouts`.

        Raises:
            URLabError: Another run has them, or the pool is closed.
        """
        if self._closed:
            raise URLabError("The worker pool is closed.", hint="Create a new one.")
        if self._run is not None and self._run() is not None:
            raise URLabError("Another run is using the worker pool.", hint="Finish or close that run first.")
        self._run = weakref.ref(run)
        lent, self._waiting = self._waiting, []
        return lent

    def start(self) -> Any:
        """Start a worker for the run; used by `rollouts`."""
        return self._actor.remote()

    def give_back(self, workers: Sequence[Any]) -> None:
        """Take back the workers of a finished run; used by `rollouts`."""
        self._run = None
        if self._closed:
            _end(workers)
        else:
            self._waiting.extend(workers)

    def close(self) -> None:
        """End the workers and their servers; those of a current run end with it. Idempotent; does not wait."""
        self._closed = True
        _end(self._waiting)
        self._waiting.clear()


def _end(workers: Sequence[Any]) -> None:
    for worker in workers:
        _ray.kill(worker)
