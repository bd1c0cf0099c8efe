"""What goes to a worker and what comes back."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from urlab_client.cluster.leases import LeasePool
from urlab_client.protocol.errors import URLabError

__all__ = ["Episode", "Job", "Policy", "RolloutError", "Setup", "seed_of"]

Policy = Callable[[Any, np.random.Generator], Any]
"""`(observation, rng) -> action`, as the spaces of the environment have them: flat arrays, or dictionaries of arrays
with `space_mode="dict"`. Each episode gets a copy of its own, as it was when sent.
"""


class RolloutError(URLabError):
    """An episode failed for good: its policy raised, its attempts are used up, or no worker could be started."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """One finished episode of `T` actions.

    Equal `id`, `seed` and `scene` mean equal arrays, bit for bit, whichever attempt and node they come from, on the
    same build of MuJoCo.

    Attributes:
        id: 0 to n - 1; each appears once.
        seed: Seed of the reset noise and of the policy's generator; follows from the run's seed and `id`.
        scene: The scene's address, or the name of the lease pool.
        address: Where it ran.
        attempt: 1, or more after failures.
        node_id: Ray's id of the node, hexadecimal.
        pid: Process id of the worker.
        observations: Float64, shape (T + 1, observation size); with `space_mode="dict"` dictionaries as the
            environment's, of such arrays, those of cameras uint8 with shape (T + 1, H, W, 3).
        actions: Float32, shape (T, action size), or a dictionary of such arrays.
        rewards: Float64, shape (T,).
        terminated: Whether the termination function ended it.
        truncated: Whether the step limit ended it.
        success: What the task says of the end; None without a task that says so.
        sim_time: Simulated seconds at the end.
        started: Unix time in seconds, by the worker's clock.
        setup: Seconds for lease, server and reset.
        duration: Seconds that it took, with `setup`.
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
    """What the environments of a run are like.

    Attributes:
        key: Equal for equal options: an environment that has it may be used again.
        env_options: Options of `URLabEnv`.
        client_options: Options of the client.
        lease_timeout: Seconds that an attempt waits for a free address.
    """

    key: str
    env_options: Mapping[str, Any]
    client_options: Mapping[str, Any]
    lease_timeout: float

    @classmethod
    def of(cls, env_options: Mapping[str, Any], client_options: Mapping[str, Any], lease_timeout: float) -> Self:
        """Describe environments."""
        options = dict(env_options), dict(client_options)
        dumps: Any = import_module("ray").cloudpickle.dumps  # functions, too, by their code
        return cls(hashlib.sha256(dumps(options)).hexdigest(), *options, lease_timeout)


def seed_of(seed: int, episode: int) -> int:
    """Return the seed of one episode of a run."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])
