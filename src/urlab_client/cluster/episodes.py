"""The data that workers receive and return."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from urlab_client.cluster.leases import LeasePool
from urlab_client.errors import URLabError

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
    """One attempt at one episode; `holder` names it in the lease pool."""

    id: int
    seed: int
    scene: str
    attempt: int
    holder: str
    leases: LeasePool | None


@dataclass(frozen=True, slots=True)
class Setup:
    """Configuration of the environments of a run.

    Attributes:
        key: Equal for equal options; an environment with the same key can be reused.
        env_options: Options of `URLabEnv`.
        client_options: Options of the client.
        lease_timeout: Longest wait of an attempt for a free address, seconds.
    """

    key: str
    env_options: Mapping[str, Any]
    client_options: Mapping[str, Any]
    lease_timeout: float

    @classmethod
    def of(cls, env_options: Mapping[str, Any], client_options: Mapping[str, Any], lease_timeout: float) -> Self:
        """Build the configuration."""
        options = dict(env_options), dict(client_options)
        dumps: Any = import_module("ray").cloudpickle.dumps  # also serialises functions by value
        return cls(hashlib.sha256(dumps(options)).hexdigest(), *options, lease_timeout)


def seed_of(seed: int, episode: int) -> int:
    """Return the seed of one episode of a run."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])
