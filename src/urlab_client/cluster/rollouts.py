"""`rollouts`: many episodes on the workers of a Ray cluster, returned as they finish."""

from __future__ import annotations

import logging
import math
import time
import uuid
import weakref
from collections import deque
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from types import MappingProxyType
from typing import Any, Final, Self

import anyio.to_thread

from urlab_client.cluster.episodes import Episode, Job, Policy, RolloutError, Worker, seed_of, setup_of
from urlab_client.cluster.leases import LeasePool
from urlab_client.errors import URLabError, refused_for_good

log: logging.Logger = logging.getLogger("urlab_client.cluster")

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown
_SLICE_S: Final = 0.2  # how often cancelled readers and overdue episodes are checked
_FETCH_S: Final = 60.0


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

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Number of idle workers."""
        return len(self._waiting)

    def lend(self, run: object) -> None:
        """Serve a run alone, until it gives the workers back; used by `rollouts`."""
        if self._closed:
            raise URLabError("The worker pool is closed.", hint="Create a new one.")
        if self._run is not None and self._run() not in (None, run):
            raise URLabError("Another run is using the worker pool.", hint="Finish or close that run first.")
        self._run = weakref.ref(run)

    def start(self) -> tuple[Any, bool]:
        """Return a worker for the run, and whether it comes from an earlier run; used by `rollouts`."""
        return (self._waiting.pop(), True) if self._waiting else (self._actor.remote(), False)

    def give_back(self, workers: Iterable[Any]) -> None:
        """Take back the workers of a finished run; used by `rollouts`."""
        self._run = None
        self._waiting.extend(workers)
        if self._closed:
            self.close()

    def close(self) -> None:
        """End the workers and their servers; those of a current run end with it. Idempotent; does not wait."""
        self._closed = True
        for worker in self._waiting:
            _ray.kill(worker)
        self._waiting.clear()


@dataclass(frozen=True, slots=True, eq=False)
class _Busy:
    """A worker that runs a job, or that starts."""

    worker: Any
    job: Job | None = None
    deadline: float = math.inf
    kept: bool = False
    """Whether it comes from an earlier run; if it has died since, that is not a failure of this run."""


class Rollouts(Iterator[Episode], AsyncIterator[Episode]):
    """The episodes of a run in the order in which they finish. Iterate once, with `for` or `async for`.

    Iterating drives the run: each worker holds one episode, running or finished, and gets the next one after you have
    taken it. Closing ends the workers and their servers and releases the leases. It happens automatically after the
    last episode and after an error; use the object as a context manager to leave early. Workers of a `WorkerPool`
    return to it, except those in the middle of an episode.
    """

    def __init__(
        self,
        policy: Policy,
        setup: bytes,
        jobs: Sequence[Job],
        *,
        workers: WorkerPool,
        owns_workers: bool,
        n_workers: int,
        retries: int,
        episode_timeout: float,
        start_timeout: float,
    ) -> None:
        self._policy: Any = _ray.put(policy)
        self._setup: Any = _ray.put(setup)
        self._todo = deque(jobs)
        self._n_workers = n_workers
        self._retries = retries
        self._episode_timeout = episode_timeout
        self._start_timeout = start_timeout
        self._workers = workers
        self._owns_workers = owns_workers
        self._borrowed = False
        self._busy: dict[Any, _Busy] = {}  # by the reply that ends it
        self._idle: list[Any] = []
        self._finished: deque[Episode] = deque()
        self._failed_starts = 0
        self._working_since = time.monotonic()
        self._reading = False
        self._closed = False

    def __next__(self) -> Episode:
        while not self._finished:
            if self._over():
                raise StopIteration
            self._turn()
        return self._finished.popleft()

    async def __anext__(self) -> Episode:
        while not self._finished:
            if self._over():
                raise StopAsyncIteration
            # Results stay in `_finished`, so a cancelled reader loses nothing.
            await anyio.to_thread.run_sync(self._turn)
        return self._finished.popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self.close()

    def close(self) -> None:
        """End the workers and their servers, and release the leases. Idempotent; does not wait."""
        if self._closed:
            return
        self._closed = True
        self._todo.clear()
        for busy in self._busy.values():
            if busy.job is not None:
                self._end(busy)
        if self._borrowed:
            self._workers.give_back([*self._idle, *(busy.worker for busy in self._busy.values() if busy.job is None)])
        if self._owns_workers:
            self._workers.close()
        self._busy.clear()
        self._idle.clear()

    def _over(self) -> bool:
        if not self._closed and not self._todo and not self._running():
            self.close()
        return self._closed

    def _running(self) -> int:
        return sum(busy.job is not None for busy in self._busy.values())

    def _turn(self) -> None:
        """Assign work, wait briefly for results, and handle failures."""
        if self._reading:
            raise RuntimeError("another reader is already iterating over these rollouts")
        self._reading = True
        try:
            self._hand_out()
            refs = [*self._busy]
            ready, _ = _ray.wait(refs, num_returns=len(refs), timeout=0)
            if not ready:
                ready, _ = _ray.wait(refs, num_returns=1, timeout=_SLICE_S)
            for ref in ready:
                self._take(ref, self._busy.pop(ref))
            self._look_at_clock()
        except BaseException:
            self.close()
            raise
        finally:
            self._reading = False

    def _hand_out(self) -> None:
        if not self._borrowed:
            self._workers.lend(self)
            self._borrowed = True
        while self._idle and self._todo:
            worker, job = self._idle.pop(), self._todo.popleft()
            ref = worker.run.remote(self._policy, self._setup, job)
            self._busy[ref] = _Busy(worker, job, time.monotonic() + self._episode_timeout)
        while self._todo and len(self._busy) < min(self._n_workers, self._running() + len(self._todo)):
            worker, kept = self._workers.start()
            self._busy[worker.node_id.remote()] = _Busy(worker, kept=kept)

    def _take(self, ref: Any, busy: _Busy) -> None:
        """Take a result, or a worker that has started."""
        try:
            found = _ray.get(ref, timeout=_FETCH_S)
        except _ray.exceptions.RayError as error:
            if busy.job is None:
                self._end(busy)
                self._failed_to_start(busy, error)
                return
            cause = error
            if isinstance(error, _ray.exceptions.RayTaskError):
                cause = error.cause if isinstance(error.cause, Exception) else error
                self._idle.append(busy.worker)
                if not isinstance(cause, URLabError) or refused_for_good(cause):
                    # A policy that raises would raise again, and what was refused would be refused again.
                    raise RolloutError(f"Episode {busy.job.id} raised {type(cause).__name__}: {cause}") from error
            else:  # the worker, its node or the result is lost
                self._end(busy)
            self._again(busy.job, cause)
        else:
            self._idle.append(busy.worker)
            if busy.job is None:
                self._failed_starts = 0
            else:
                self._finished.append(found)

    def _failed_to_start(self, busy: _Busy, error: Exception) -> None:
        if busy.kept:
            log.info("a worker ended since the last run: %s", error)
            return
        self._failed_starts += 1
        log.warning("a worker did not start: %s", error)
        if self._failed_starts > self._retries:
            raise RolloutError(f"{self._failed_starts} workers in a row did not start.") from error

    def _look_at_clock(self) -> None:
        now = time.monotonic()
        for ref, busy in list(self._busy.items()):
            if busy.job is not None and now > busy.deadline:
                del self._busy[ref]
                self._end(busy)
                self._again(busy.job, TimeoutError(f"not finished within {self._episode_timeout:g} s"))
        if self._running() or self._idle or not self._busy:
            self._working_since = now
        elif now - self._working_since > self._start_timeout:
            raise RolloutError(
                f"The cluster placed no worker within {self._start_timeout:g} s.",
                hint=f"It has {_ray.cluster_resources()}; see worker_options and start_timeout.",
            )

    def _again(self, job: Job, error: Exception) -> None:
        if job.attempt > self._retries:
            raise RolloutError(
                f"Episode {job.id} failed {job.attempt} times, the last time with {type(error).__name__}: {error}"
            ) from error
        log.warning("episode %d, attempt %d: %s; it is run again", job.id, job.attempt, error)
        self._todo.appendleft(replace(job, attempt=job.attempt + 1))

    def _end(self, busy: _Busy) -> None:
        _ray.kill(busy.worker)
        if busy.job is not None and busy.job.leases is not None:
            busy.job.leases.give_back(busy.job.holder)


def rollouts(
    policy: Policy,
    scenes: str | Sequence[str] | LeasePool,
    n: int,
    *,
    ids: Iterable[int] | None = None,
    seed: int = 0,
    max_episode_steps: int = 200,
    env_options: Mapping[str, Any] = MappingProxyType({}),
    client_options: Mapping[str, Any] = MappingProxyType({}),
    workers: WorkerPool | None = None,
    n_workers: int = 0,
    worker_options: Mapping[str, Any] = MappingProxyType({}),
    retries: int = 3,
    episode_timeout: float = 300.0,
    start_timeout: float = 120.0,
    lease_timeout: float = 60.0,
) -> Rollouts:
    """Run `n` episodes on the cluster and return each of them exactly once, as they finish.

    If the worker, node, server or lease of an episode fails, the episode runs again from its start, elsewhere if
    necessary, with the same seed and therefore the same result. Failed attempts do not appear in the output.

    Args:
        policy: The policy, sent to the workers by value; each episode starts with a fresh copy.
        scenes: `sim://MODEL` addresses that the workers serve, in blocks of `n / len(scenes)` episodes; or a pool of
            addresses to lease, one per episode.
        n: Number of episodes.
        ids: Ids of the episodes to run, from 0 to n - 1, such as `missing_ids` of an earlier run; None for all.
        seed: Seed of the run.
        max_episode_steps: Actions after which an episode is truncated.
        env_options: Further options of `URLabEnv`: `task`, `randomise`, `observations`, `cameras`, `space_mode`,
            `reward_fn`, `termination_fn`, `n_substeps`, `reset_noise`, `keyframe`.
        client_options: Further options of the workers' clients.
        workers: Pool of workers to use; otherwise the run starts its own.
        n_workers: Maximum number of workers and of episodes in flight; 0 for one per processor of the cluster, or per
            address of the pool. Not with `workers`, which has its own number and options.
        worker_options: Options of the Ray actors, such as `num_cpus` or `resources`; one processor each by default.
        retries: Number of attempts of an episode after the first one.
        episode_timeout: Longest duration of an attempt, after which its worker is killed, seconds.
        start_timeout: Time without any worker after which the run fails, seconds.
        lease_timeout: Longest wait of an attempt for a free address, seconds.

    Returns:
        The episodes. Iterating raises `RolloutError` if an episode fails permanently.

    Raises:
        ValueError: An option is out of range or belongs to `workers`, or a scene is not a `sim://` address.
        URLabError: Ray is not initialised.
    """
    names = [scenes.name] if isinstance(scenes, LeasePool) else [scenes] if isinstance(scenes, str) else list(scenes)
    leases = scenes if isinstance(scenes, LeasePool) else None
    if not names or (leases is None and not all(name.startswith("sim://") for name in names)):
        raise ValueError(f"scenes must be one or more sim:// addresses, or a LeasePool of others, not {names!r}")
    if n < 0 or seed < 0 or n_workers < 0 or retries < 0 or max_episode_steps < 1:
        raise ValueError("n, seed, n_workers and retries must be 0 or more, and max_episode_steps at least 1")
    if min(episode_timeout, start_timeout, lease_timeout) <= 0:
        raise ValueError("episode_timeout, start_timeout and lease_timeout must be above 0 seconds")
    if workers is not None and (n_workers or worker_options):
        raise ValueError("n_workers and worker_options cannot be used with workers: pass them to the WorkerPool")
    if reserved := {"client", "max_episode_steps", "owns_client", "render_camera", "render_mode"} & env_options.keys():
        raise ValueError(f"env_options cannot have {', '.join(sorted(reserved))}")
    chosen = list(range(n)) if ids is None else sorted(ids)
    if len(set(chosen)) != len(chosen) or (chosen and not 0 <= chosen[0] <= chosen[-1] < n):
        raise ValueError(f"ids must be unique and from 0 to {n - 1}")
    pool = WorkerPool(n_workers, worker_options=worker_options) if workers is None else workers
    run = uuid.uuid4().hex
    jobs = [
        Job(
            id=i,
            seed=seed_of(seed, i),
            scene=names[i * len(names) // n],
            run=run,
            leases=leases,
            lease_timeout=lease_timeout,
        )
        for i in chosen
    ]
    most = pool.n_workers or (leases.size if leases else int(_ray.cluster_resources().get("CPU", 1)))
    return Rollouts(
        policy,
        setup_of({**env_options, "max_episode_steps": max_episode_steps}, client_options),
        jobs,
        workers=pool,
        owns_workers=workers is None,
        n_workers=max(most, 1),
        retries=retries,
        episode_timeout=episode_timeout,
        start_timeout=start_timeout,
    )
