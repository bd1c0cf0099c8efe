"""The actor that runs episodes, one at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from urlab_client.cluster.episodes import Episode, Job, Policy, Setup, seed_of
from urlab_client.cluster.leases import Lease
from urlab_client.errors import refused_for_good
from urlab_client.integrations.gym.env import URLabEnv

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown


class Worker:
    """Runs episodes. It keeps its simulated server until the scene or options change, or until a failure.

    The server is a child process that ends with this one, even if this one is killed.
    """

    def __init__(self) -> None:
        self._made_for = ("", "")  # address and key of the setup
        self._env: URLabEnv | None = None

    def node_id(self) -> str:
        """Return Ray's id of this node; the answer shows that the worker is up."""
        return str(_ray.get_runtime_context().get_node_id())

    def run(self, policy: Policy, setup: Setup, job: Job) -> Episode:
        """Run one attempt of an episode.

        Raises:
            LeaseBusy: A client outside the pool is using the leased server.
            URLabError: The server or the lease failed.
        """
        try:
            if job.leases is None:
                return self._run(policy, setup, job, None)
            with job.leases.lease(job.holder, timeout=setup.lease_timeout) as lease:
                try:
                    env = self._environment(lease.address, setup)
                    with lease.of_server(env.client):
                        return self._run(policy, setup, job, lease)
                finally:
                    self.close()  # before another holder gets the address
        except BaseException as error:
            if not refused_for_good(error):
                self.close()  # the next attempt starts from scratch
            raise

    def close(self) -> None:
        """Stop the simulated server. Idempotent."""
        env, self._env = self._env, None
        if env is not None:
            env.close()

    def _run(self, policy: Policy, setup: Setup, job: Job, lease: Lease | None) -> Episode:
        started, clock = time.time(), time.perf_counter()
        address = job.scene if lease is None else lease.address
        env = self._environment(address, setup)
        rng = np.random.default_rng([job.seed, 1])
        observation, info = env.reset(seed=job.seed)
        setting_up = time.perf_counter() - clock
        observations, actions, rewards = [observation], list[Any](), list[float]()
        terminated = truncated = False
        while not (terminated or truncated):
            if lease is not None:
                lease.keep()
            action = _float32(policy(observation, rng))
            observation, reward, terminated, truncated, info = env.step(action)
            observations.append(observation)
            actions.append(action)
            rewards.append(float(reward))
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
            terminated=bool(terminated),
            truncated=bool(truncated),
            success=info.get("success"),
            sim_time=float(info["sim_time"]),
            started=started,
            setup=setting_up,
            duration=time.perf_counter() - clock,
        )

    def _environment(self, address: str, setup: Setup) -> URLabEnv:
        wanted = (address, setup.key)
        if self._env is not None and self._made_for == wanted:
            return self._env
        self.close()
        self._env = URLabEnv.connect(address, client_options=setup.client_options, **setup.env_options)
        self._made_for = wanted
        return self._env


def _float32(action: Any) -> Any:
    if isinstance(action, Mapping):
        given = cast("Mapping[str, Any]", action)
        return {key: _float32(value) for key, value in given.items()}
    return np.array(action, dtype=np.float32)  # a copy, because a policy may reuse its array


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
    setup = Setup.of({**env_options, "max_episode_steps": max_episode_steps}, client_options, lease_timeout=0.0)
    worker = Worker()
    job = Job(id=episode, seed=seed_of(seed, episode), scene=scene, attempt=1, holder="", leases=None)
    try:
        return worker.run(policy, setup, job)
    finally:
        worker.close()
