"""Tasks on the bundled robots, registered with Gymnasium under `urlab/`."""

from __future__ import annotations

import sys
from typing import Any, Final, Literal

import gymnasium

from urlab_client.integrations.gym.batch import URLabBatchEnv
from urlab_client.integrations.gym.env import URLabEnv
from urlab_client.integrations.gym.shipped_tasks import FixedReach, Push, PushPictures, Reach, Run, Walk
from urlab_client.integrations.gym.task import Task
from urlab_client.integrations.gym.vector import URLabVectorEnv

TASKS: Final[dict[str, type[Task]]] = {
    "urlab/Arm-v0": FixedReach,
    "urlab/Quadruped-v0": Run,
    "urlab/Push-v0": Push,
    "urlab/PushPictures-v0": PushPictures,
    "urlab/Reach-v0": Reach,
    "urlab/Walk-v0": Walk,
}
"""Tasks by their Gymnasium id."""


def make(task_id: str, address: str | None = None, **options: Any) -> URLabEnv:
    """Make the environment of a task. It creates its own client and closes it.

    Args:
        task_id: Key of `TASKS`.
        address: Address of the server; by default, a simulated server is started.
        options: Further arguments of `URLabEnv`.

    Raises:
        URLabError: The server cannot be reached or has no articulation.
    """
    task = TASKS[task_id]()
    return URLabEnv.connect(address or task.scene_address, task=task, **options)


def make_endless(task_id: str, **options: Any) -> URLabEnv:
    """Make an environment that leaves truncation to Gymnasium: `gymnasium.make(…, max_episode_steps=…)`."""
    return make(task_id, max_episode_steps=sys.maxsize, **options)


def make_vec(
    task_id: str, num_envs: int = 1, backend: Literal["servers", "batch"] = "servers", **options: Any
) -> URLabVectorEnv | URLabBatchEnv:
    """Make the vector environment of a task.

    Args:
        task_id: Key of `TASKS`.
        num_envs: Number of environments.
        backend: `servers` for one simulated server per environment, `batch` for physics in this process without a
            wire.
        options: Further arguments of `URLabVectorEnv` or `URLabBatchEnv`.

    Raises:
        ValueError: The backend is unknown.
        URLabError: A server cannot be started.
    """
    if backend not in ("servers", "batch"):
        raise ValueError(f"backend must be 'servers' or 'batch', not {backend!r}")
    kind = URLabVectorEnv if backend == "servers" else URLabBatchEnv
    task = TASKS[task_id]()
    return kind(task.scene_address, num_envs, task=task, **options)


def register() -> None:
    """Register the tasks with Gymnasium. Calling it again has no effect."""
    for task_id, task in TASKS.items():
        if task_id not in gymnasium.registry:
            gymnasium.register(  # pyright: ignore[reportUnknownMemberType]  # its kwargs are a bare dict
                task_id,
                # A string, so that the specification can be serialised: Minari stores it with its datasets.
                entry_point=f"{__name__}:{make_endless.__name__}",
                vector_entry_point=f"{__name__}:{make_vec.__name__}",
                max_episode_steps=task.max_episode_steps,
                kwargs={"task_id": task_id},
            )
