"""What goes to a worker and what comes back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client.cluster.leases import LeasePool
from urlab_client.protocol.errors import URLabError

__all__ = ["Episode", "Job", "Policy", "RolloutError", "seed_of"]

Policy = Callable[[NDArray[Any], np.random.Generator], Any]
"""`(observation, rng) -> action`, with flat arrays. Each episode gets a copy of its own, as it was when sent."""


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
        observations: Float64, shape (T + 1, observation size).
        actions: Float32, shape (T, action size).
        rewards: Float64, shape (T,).
        terminated: Whether the termination function ended it.
        truncated: Whether the step limit ended it.
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
    observations: NDArray[Any]
    actions: NDArray[Any]
    rewards: NDArray[np.float64]
    terminated: bool
    truncated: bool
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


def seed_of(seed: int, episode: int) -> int:
    """Return the seed of one episode of a run."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])
