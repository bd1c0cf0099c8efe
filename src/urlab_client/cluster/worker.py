"""The actor that runs episodes, one at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

import numpy as np

from urlab_client.cluster.episodes import Episode, Job, Policy, seed_of
from urlab_client.cluster.leases import Lease
from urlab_client.integrations.gym.env import URLabEnv

__all__ = ["Worker", "run_episode"]

_ray: Any = import_module("ray")  # Any: Ray's hints leave every remote call unknown


class Worker:
    """Runs episodes. A simulated server serves the episodes of its scene until another scene or a failure comes.

    The server is a child process that ends with this one, however that ends.
    """

    def __init__(self, env_options: Mapping[str, Any], client_options: Mapping[str, Any], lease_timeout: float) -> None:
        self._env_options = env_options
        self._client_options = client_options
        self._lease_timeout = lease_timeout
        self._address = ""
        self._env: URLabEnv | None = None

    def node_id(self) -> str:
        """Return Ray's id of this node; that it answers says that the worker is up."""
        return str(_ray.get_runtime_context().get_node_id())

    def run(self, policy: Policy, job: Job) -> Episode:
        """Run one attempt of an episode.

        Raises:
            LeaseBusy: Somebody outside the pool uses the leased server.
            URLabError: The server or the lease failed.
        """
        try:
            if job.leases is None:
                return self._run(policy, job, None)
            with job.leases.lease(job.holder, timeout=self._lease_timeout) as lease:
                try:
                    env = self._environment(lease.address)
                    with lease.of_server(env.client):
                        return self._run(policy, job, lease)
                finally:
                    self.close()  # before somebody else gets the address
        except BaseException:
            self.close()  # the next attempt starts afresh
            raise

    def close(self) -> None:
        """End the simulated server. Idempotent."""
        env, self._env = self._env, None
        if env is not None:
            env.close()

    def _run(self, policy: Policy, job: Job, lease: Lease | None) -> Episode:
        started, clock = time.time(), time.perf_counter()
        env = self._environment(job.scene if lease is None else lease.address)
        rng = np.random.default_rng([job.seed, 1])
        observation, info = env.reset(seed=job.seed)
        setup = time.perf_counter() - clock
        observations, actions, rewards = [np.array(observation)], list[Any](), list[float]()
        terminated = truncated = False
        while not (terminated or truncated):
            if lease is not None:
                lease.keep()
            action = np.asarray(policy(observation, rng), dtype=np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            observations.append(np.array(observation))
            actions.append(action)
            rewards.append(float(reward))
        return Episode(
            id=job.id,
            seed=job.seed,
            scene=job.scene,
            address=self._address,
            attempt=job.attempt,
            node_id=self.node_id(),
            pid=os.getpid(),
            observations=np.stack(observations),
            actions=np.stack(actions),
            rewards=np.array(rewards),
            terminated=bool(terminated),
            truncated=bool(truncated),
            sim_time=float(info["sim_time"]),
            started=started,
            setup=setup,
            duration=time.perf_counter() - clock,
        )

    def _environment(self, address: str) -> URLabEnv:
        if self._env is not None and self._address == address:
            return self._env
        self.close()
        self._env = URLabEnv.connect(address, client_options=self._client_options, **self._env_options)
        self._address = address
        return self._env


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
    """Run one episode of a run in this process: as a Ray task, `ray.remote(run_episode).remote(policy, scene, i)`.

    A simulated server is started for it and ended after it. The result has the arrays, bit for bit, of the episode
    that `rollouts` hands out for the same arguments, so Ray may run the task again wherever it likes.

    Args:
        policy: See `rollouts`, here and for all other arguments.
        scene: `sim://MODEL` address.
        episode: Id of the episode.
        seed: Seed of the run.
        max_episode_steps: Actions after which the episode is truncated.
        env_options: Further options of `URLabEnv`.
        client_options: Further options of the client.

    Returns:
        The episode. Its `attempt` is 1: Ray does not say how often it tried.

    Raises:
        URLabError: The server failed.
    """
    worker = Worker({**env_options, "max_episode_steps": max_episode_steps}, client_options, lease_timeout=0.0)
    job = Job(id=episode, seed=seed_of(seed, episode), scene=scene, attempt=1, holder="", leases=None)
    try:
        return worker.run(policy, job)
    finally:
        worker.close()
