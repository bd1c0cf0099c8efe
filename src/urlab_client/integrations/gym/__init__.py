"""Gymnasium environments: `URLabEnv` over one client, `URLabVectorEnv` over many, `URLabBatchEnv` without a wire.

Needs the extra `gym`. Importing this package registers the environments in `tasks` for `gymnasium.make`;
`register_task` adds tasks of your own.
"""

from urlab_client.integrations.gym.batch import URLabBatchEnv
from urlab_client.integrations.gym.env import URLabEnv
from urlab_client.integrations.gym.settings import EpisodeOptions, RewardFn, TerminationFn
from urlab_client.integrations.gym.spaces import Actions, SpaceMapping, SpaceMode
from urlab_client.integrations.gym.task import EpisodeEnd, ResetNoise, Start, States, Task, TaskScene
from urlab_client.integrations.gym.tasks import (
    TASKS,
    FixedReach,
    Push,
    PushPictures,
    Reach,
    Run,
    Walk,
    register_task,
    task_named,
)
from urlab_client.integrations.gym.vector import URLabVectorEnv

__all__ = [
    "TASKS",
    "Actions",
    "EpisodeEnd",
    "EpisodeOptions",
    "FixedReach",
    "Push",
    "PushPictures",
    "Reach",
    "ResetNoise",
    "RewardFn",
    "Run",
    "SpaceMapping",
    "SpaceMode",
    "Start",
    "States",
    "Task",
    "TaskScene",
    "TerminationFn",
    "URLabBatchEnv",
    "URLabEnv",
    "URLabVectorEnv",
    "Walk",
    "register_task",
    "task_named",
]
