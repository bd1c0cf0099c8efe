"""Tasks on the bundled robots, registered with Gymnasium under `urlab/`.

The functions take single observations and batches alike. A task's rewards follow from what its robot's reply holds,
so they are the same on a simulated server, in the editor and in a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import gymnasium
import numpy as np

from urlab_client.integrations.gym.batch import URLabBatchEnv
from urlab_client.integrations.gym.env import RewardFn, TerminationFn, URLabEnv
from urlab_client.integrations.gym.shipped_tasks import Reach, Walk
from urlab_client.integrations.gym.spaces import Observation, SpaceMapping
from urlab_client.integrations.gym.task import Task
from urlab_client.integrations.gym.vector import URLabVectorEnv
from urlab_client.protocol.base import Floats

__all__ = ["FULL_TASKS", "TASKS", "RewardedRobot", "make", "make_vec", "register"]

FALLEN_M: Final = 0.15
"""Height of the trunk below which the quadruped has fallen, metres."""

UPRIGHT: Final = 0.5
"""Cosine of the tilt below which the quadruped has fallen."""

TARGET_M: Final = (0.35, 0.2, 0.4)
"""Where the arm is to hold its hand, metres, in the world frame."""


@dataclass(frozen=True)
class RewardedRobot:
    """A robot and what it is to do.

    Attributes:
        robot: Bundled robot.
        n_substeps: Physics steps per action.
        max_episode_steps: Actions per episode.
        reset_noise: See `URLabEnv`.
        reward: Makes the reward function for an environment's mapping.
        termination: Makes the termination function, or None for a task that cannot fail.
    """

    robot: str
    n_substeps: int
    max_episode_steps: int
    reset_noise: float
    reward: Callable[[SpaceMapping], RewardFn]
    termination: Callable[[SpaceMapping], TerminationFn] | None = None


def _walk(mapping: SpaceMapping) -> RewardFn:
    """Forward speed of the trunk, plus half a point for standing, minus the effort."""
    key = mapping.keys[0]

    def reward(before: Observation, action: Any, after: Observation, info: dict[str, Any]) -> Floats:
        speed = mapping.field(after, key, "qvel")[..., 0]
        torques = mapping.set_points(action)[key]
        return speed + 0.5 - 2e-4 * np.sum(torques**2, axis=-1)

    return reward


def _fallen(mapping: SpaceMapping) -> TerminationFn:
    key = mapping.keys[0]

    def fallen(observation: Observation, info: dict[str, Any]) -> Any:
        qpos = mapping.field(observation, key, "qpos")
        x, y = qpos[..., 4], qpos[..., 5]  # of the unit quaternion (w, x, y, z)
        return (qpos[..., 2] < FALLEN_M) | (1.0 - 2.0 * (x**2 + y**2) < UPRIGHT)

    return fallen


def _reach(mapping: SpaceMapping) -> RewardFn:
    """Negative distance of the hand from `TARGET_M`."""
    key = mapping.keys[0]

    def reward(before: Observation, action: Any, after: Observation, info: dict[str, Any]) -> Floats:
        hand = mapping.field(after, key, "sensors")[..., :3]
        return -np.linalg.norm(hand - np.array(TARGET_M), axis=-1)

    return reward


TASKS: Final = {
    "urlab/Quadruped-v0": RewardedRobot(
        robot="quadruped",
        n_substeps=10,
        max_episode_steps=500,
        reset_noise=0.05,
        reward=_walk,
        termination=_fallen,
    ),
    "urlab/Arm-v0": RewardedRobot(robot="arm", n_substeps=10, max_episode_steps=200, reset_noise=0.05, reward=_reach),
}
"""Robots with rewards alone, by their Gymnasium id."""

FULL_TASKS: Final[dict[str, type[Task]]] = {"urlab/Reach-v0": Reach, "urlab/Walk-v0": Walk}
"""Tasks whose goal varies, by their Gymnasium id."""


def make(task_id: str, address: str | None = None, **options: Any) -> URLabEnv:
    """Make the environment of a task over a client of its own, which it closes.

    Args:
        task_id: Key of `TASKS` or `FULL_TASKS`.
        address: Where the robot is; a simulated server of its own by default.
        options: Further arguments of `URLabEnv`.

    Raises:
        URLabError: The server cannot be reached, or has no articulation.
    """
    if task_id in FULL_TASKS:
        goal = FULL_TASKS[task_id]()
        return URLabEnv.connect(address or goal.scene_address, task=goal, **options)
    task = TASKS[task_id]
    options = {"n_substeps": task.n_substeps, "reset_noise": task.reset_noise, **options}
    env = URLabEnv.connect(address or f"sim://{task.robot}", **options)
    env.reward_fn = task.reward(env.mapping)
    env.termination_fn = None if task.termination is None else task.termination(env.mapping)
    return env


def make_vec(
    task_id: str, num_envs: int = 1, backend: Literal["servers", "batch"] = "servers", **options: Any
) -> URLabVectorEnv | URLabBatchEnv:
    """Make the vector environment of a task.

    Args:
        task_id: Key of `TASKS` or `FULL_TASKS`.
        num_envs: Number of environments.
        backend: `servers` for a simulated server each, `batch` for physics in this process without a wire.
        options: Further arguments of `URLabVectorEnv` or `URLabBatchEnv`.

    Raises:
        ValueError: An unknown backend.
        URLabError: A server cannot be started.
    """
    if backend not in ("servers", "batch"):
        raise ValueError(f"backend must be 'servers' or 'batch', not {backend!r}")
    kind = URLabVectorEnv if backend == "servers" else URLabBatchEnv
    if task_id in FULL_TASKS:
        goal = FULL_TASKS[task_id]()
        return kind(goal.scene_address, num_envs, task=goal, **options)
    task = TASKS[task_id]
    options = {
        "n_substeps": task.n_substeps,
        "reset_noise": task.reset_noise,
        "max_episode_steps": task.max_episode_steps,
        **options,
    }
    env = kind(f"sim://{task.robot}", num_envs, **options)
    env.reward_fn = task.reward(env.mapping)
    env.termination_fn = None if task.termination is None else task.termination(env.mapping)
    return env


def register() -> None:
    """Register the tasks with Gymnasium; again is without effect."""
    for task_id, task in (*TASKS.items(), *FULL_TASKS.items()):
        if task_id not in gymnasium.registry:
            gymnasium.register(  # pyright: ignore[reportUnknownMemberType]  # its kwargs are a bare dict
                task_id,
                entry_point=make,
                vector_entry_point=make_vec,
                max_episode_steps=task.max_episode_steps,
                kwargs={"task_id": task_id},
            )
