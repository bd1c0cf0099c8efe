"""The options that all environments share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from urlab_client.aio.arguments import collection, integer, require, text
from urlab_client.integrations.gym.spaces import Field, Observation, SpaceMode, fields_of
from urlab_client.integrations.gym.task import ResetNoise, Task

RewardFn = Callable[[Observation, Any, Observation, dict[str, Any]], Any]
"""`(observation, action, next_observation, info) -> reward`."""

TerminationFn = Callable[[Observation, dict[str, Any]], Any]
"""`(observation, info) -> terminated`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeSettings:
    """Settings of episodes: the arguments of an environment, else the values of its task, else the defaults.

    `URLabEnv` and `Task` describe them.
    """

    task: Task | None
    reward_fn: RewardFn | None
    termination_fn: TerminationFn | None
    fields: tuple[Field, ...]
    n_substeps: int
    max_episode_steps: int | None
    keyframe: str | None
    reset_noise: ResetNoise
    space_mode: SpaceMode
    cameras: tuple[str, ...]
    articulations: Sequence[str] | None
    render_mode: str | None
    render_camera: str | None

    @classmethod
    def of(
        cls,
        task: Task | None,
        *,
        observations: str | Sequence[str] | None = None,
        reward_fn: RewardFn | None = None,
        termination_fn: TerminationFn | None = None,
        n_substeps: int | None = None,
        max_episode_steps: int | None = None,
        keyframe: str | None = None,
        reset_noise: float | ResetNoise | None = None,
        space_mode: SpaceMode | None = None,
        cameras: Sequence[str] | None = None,
        render_mode: str | None = None,
        render_camera: str | None = None,
    ) -> EpisodeSettings:
        """Return the effective settings. None selects the value of the task, or the default without a task."""
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {render_mode!r}")
        if task is not None:
            functions = {"reward_fn": reward_fn, "termination_fn": termination_fn}
            if given := [name for name, function in functions.items() if function]:
                raise ValueError(
                    f"{', '.join(given)} cannot be given together with a task: override the task's method instead"
                )
            require("task", task, Task, "a Task")
        if not isinstance(observations, str | None):
            collection("observations", observations)
        defaults = _NoTask if task is None else task
        most = defaults.max_episode_steps if max_episode_steps is None else max_episode_steps
        noise = defaults.reset_noise if reset_noise is None else reset_noise
        settings = cls(
            task=task,
            reward_fn=reward_fn,
            termination_fn=termination_fn,
            fields=fields_of(defaults.observations if observations is None else observations),
            n_substeps=integer("n_substeps", defaults.n_substeps if n_substeps is None else n_substeps),
            max_episode_steps=None if most is None else integer("max_episode_steps", most),
            keyframe=defaults.keyframe if keyframe is None else text("keyframe", keyframe),
            reset_noise=noise if isinstance(noise, ResetNoise) else ResetNoise(hinge=noise),
            space_mode=defaults.space_mode if space_mode is None else space_mode,
            cameras=tuple(collection("cameras", defaults.cameras if cameras is None else cameras)),
            articulations=defaults.articulations,
            render_mode=render_mode,
            render_camera=render_camera,
        )
        if settings.n_substeps < 1:
            raise ValueError(f"n_substeps must be at least 1, not {settings.n_substeps}")
        if settings.max_episode_steps is not None and settings.max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1 or None, not {settings.max_episode_steps}")
        return settings


class _NoTask(Task):
    """The defaults of environments without a task."""

    observations = "standard"
    n_substeps = 1
    max_episode_steps = None


def client_defaults(options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return client options with the defaults of environments filled in.

    Environments step physics themselves. A MuJoCo version other than the server's does not stop them; the client only
    warns about it.
    """
    return {"step_mode": "direct", "mujoco_version_check": False, **options}


def keyframe_option(options: dict[str, Any] | None) -> str | None:
    """Return the keyframe named in the options of a reset."""
    unknown = set(options or {}) - {"keyframe"}
    if unknown:
        raise ValueError(f"unknown reset options {', '.join(map(str, unknown))}; the only option is 'keyframe'")
    return None if options is None else options.get("keyframe")
