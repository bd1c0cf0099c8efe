"""Episodes, and the actor that runs them one at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from urlab_client.cluster.leases import LeasePool
from urlab_client.errors import URLabError, refused_for_good
from urlab_client.integrations.gym.env import URLabEnv
from urlab_client.integrations.gym.spaces import mapped

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown

Policy = Callable[[Any, np.random.Generator], Any]
"""`(observation, rng) -> action`, in the spaces of the environment: flat arrays, or dictionaries of arrays with
`space_mode="dict"`. Each episode gets its own copy of the policy as it was sent.
"""


class RolloutError(URLabError):
    """An episode failed permanently: its policy raised, all attempts failed, or no worker could be started."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """One finished episode of `T` actions.

    Episodes with the same `id`, `seed` and `scene` have the same arrays, bit for bit, on any node and in any attempt,
    with the same build of MuJoCo.

    Attributes:
        id: 0 to n - 1; each appears once.
        seed: Seed of the reset noise and of the policy's generator, derived from the run's seed and `id`.
        scene: Address of the scene, or name of the lease pool.
        address: Address of the server that ran it.
        attempt: 1, or more after failures.
        node_id: Ray's id of the node, hexadecimal.
        pid: Process id of the worker.
        observations: Float64, shape (T + 1, observation size); with `space_mode="dict"` dictionaries of such
            arrays, as in the environment; cameras are uint8 with shape (T + 1, H, W, 3).
        actions: Float32, shape (T, action size), or a dictionary of such arrays.
        rewards: Float64, shape (T,).
        terminated: Whether the termination function ended it.
        truncated: Whether the step limit ended it.
        success: Whether the task was solved; None if the task does not define success.
        sim_time: Simulated seconds at the end.
        started: Unix time in seconds, by the worker's clock.
        setup: Time for lease, server and reset, seconds.
        duration: Total time including `setup`, seconds.
    """

    id: int
    seed: int
    scene: str
    address: str
    attempt: int
    node_id: str
    pid: int
    observations: Any
    actions: Any
    rewards: NDArray[np.float64]
    terminated: bool
    truncated: bool
    success: bool | None
    sim_time: float
    started: float
    setup: float
    duration: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One attempt at one episode of a run."""

    id: int
    seed: int
    scene: str
    attempt: int = 1
    run: str = ""
    leases: LeasePool | None = None
    lease_timeout: float = 0.0

    @property
    def holder(self) -> str:
        """Name of the attempt in the lease pool."""
        return f"{self.run}/{self.id}/{self.attempt}"


def setup_of(env_options: Mapping[str, Any], client_options: Mapping[str, Any]) -> bytes:
    """Return the configuration of the environments of a run; for equal options, environments are reused."""
    # Ray's pickle also serialises functions by value.
    return _ray.cloudpickle.dumps((dict(env_options), dict(client_options)))


def seed_of(seed: int, episode: int) -> int:
    """Return the seed of one episode of a run."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


class Worker:
    """Runs episodes. It keeps its simulated server until the scene or options change, or until a failure.

    The server is a child process that ends with this one, even if this one is killed.
    """

    def __init__(self) -> None:
        self._made_for = ("", b"")  # address and setup
        self._env: URLabEnv | None = None

    def node_id(self) -> str:
        """Return Ray's id of this node; the answer shows that the worker is up."""
        return str(_ray.get_runtime_context().get_node_id())

    def run(self, policy: Policy, setup: bytes, job: Job) -> Episode:
        """Run one attempt of an episode."""
        started, clock = time.time(), time.perf_counter()
        try:
            with ExitStack() as leased:
                address, keep = job.scene, None
                if job.leases is not None:
                    lease = leased.enter_context(job.leases.lease(job.holder, timeout=job.lease_timeout))
                    address, keep = lease.address, lease.keep
                    leased.callback(self.close)  # before another holder gets the address
                    leased.enter_context(lease.of_server(self._environment(address, setup).client))
                env = self._environment(address, setup)
                rng = np.random.default_rng([job.seed, 1])
                observation, info = env.reset(seed=job.seed)
                setting_up = time.perf_counter() - clock
                observations, actions, rewards = [observation], list[Any](), list[float]()
                terminated = truncated = False
                while not (terminated or truncated):
                    if keep is not None:
                        keep()
                    # A copy, because a policy may reuse its array.
                    action = mapped(lambda values: np.array(values, dtype=np.float32), policy(observation, rng))
                    observation, reward, terminated, truncated, info = env.step(action)
                    observations.append(observation)
                    actions.append(action)
                    rewards.append(reward)
        except BaseException as error:
            if not refused_for_good(error):
                self.close()  # the next attempt starts from scratch
            raise
        return Episode(
            id=job.id,
            seed=job.seed,
            scene=job.scene,
            address=address,
            attempt=job.attempt,
            node_id=self.node_id(),
            pid=os.getpid(),
            observations=_stacked(observations),
            actions=_stacked(actions),
            rewards=np.array(rewards),
            terminated=terminated,
            truncated=truncated,
            success=info.get("success"),
            sim_time=info["sim_time"],
            started=started,
            setup=setting_up,
            duration=time.perf_counter() - clock,
        )

    def close(self) -> None:
        """Stop the simulated server. Idempotent."""
        env, self._env = self._env, None
        if env is not None:
            env.close()

    def _environment(self, address: str, setup: bytes) -> URLabEnv:
        if self._env is None or self._made_for != (address, setup):
            self.close()
            env_options, client_options = _ray.cloudpickle.loads(setup)
            self._env = URLabEnv.connect(address, client_options=client_options, **env_options)
            self._made_for = address, setup
        return self._env


def _stacked(rows: Sequence[Any]) -> Any:
    """Return arrays, or dictionaries of them, with a leading axis."""
    if isinstance(rows[0], dict):
        first = cast("dict[str, Any]", rows[0])
        return {key: _stacked([row[key] for row in rows]) for key in first}
    return np.stack(rows)


def run_episode(
    policy: Policy,
    scene: str,
    episode: int,
    *,
    seed: int = 0,
    max_episode_steps: int = 200,
    env_options: Mapping[str, Any] = MappingProxyType({}),
    client_options: Mapping[str, Any] = MappingProxyType({}),
) -> Episode:
    """Run one episode in this process, for example as a Ray task: `ray.remote(run_episode).remote(policy, scene, i)`.

    Starts a simulated server for the episode and stops it afterwards. The result has the same arrays, bit for bit, as
    the episode that `rollouts` returns for the same arguments, so Ray may repeat the task anywhere.

    Args:
        policy: See `rollouts` for this and all other arguments.
        scene: `sim://MODEL` address.
        episode: Id of the episode.
        seed: Seed of the run.
        max_episode_steps: Actions after which the episode is truncated.
        env_options: Further options of `URLabEnv`.
        client_options: Further options of the client.

    Returns:
        The episode. `attempt` is always 1, because Ray does not report its attempts.

    Raises:
        URLabError: The server failed.
    """
    worker = Worker()
    setup = setup_of({**env_options, "max_episode_steps": max_episode_steps}, client_options)
    try:
        return worker.run(policy, setup, Job(id=episode, seed=seed_of(seed, episode), scene=scene))
    finally:
        worker.close()
