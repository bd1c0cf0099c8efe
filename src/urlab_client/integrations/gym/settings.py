"""The options that all environments share."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, TypedDict, Unpack
from weakref import WeakValueDictionary

import mujoco

from urlab_client.aio.arguments import at_least, collection, require, text
from urlab_client.aio.launch import SCHEME, SHARED_MEMORY, with_model_options, with_option
from urlab_client.integrations.gym.spaces import Actions, Field, Observation, SpaceMapping, SpaceMode, fields_of
from urlab_client.integrations.gym.task import Memory, ResetNoise, Task, TaskScene, check_declared
from urlab_client.randomise.declaration import Randomisation

RewardFn = Callable[[Observation, Any, Observation, dict[str, Any]], Any]
"""`(observation, action, next_observation, info) -> reward`."""

TerminationFn = Callable[[Observation, dict[str, Any]], Any]
"""`(observation, info) -> terminated`."""


_REGIONS_BYTES: Final = 64 << 20
"""Room for the regions of a server with cameras; containers often have as much for all their programs."""


class EpisodeOptions(TypedDict, total=False):
    """The options that all environments share. If one is missing or None, the value of the task applies.

    Attributes:
        task: What the robots are to do. It sets rewards and episode ends, and may change the start that `keyframe` and
            `reset_noise` give. One instance serves one environment, single or vector, until its `close()`.
        space_mode: `flat` for one array (the default), or `dict` for dictionaries by articulation (its
            actor id, if its key is a name of the engine) and field.
        observations: An observation level, `minimal` (qpos, qvel) or `standard` (adds ctrl, act, sensors), or a
            sequence of those fields. `standard` without a task.
        actions: How actions become set-points, for all articulations or by key. Without a task, and for articulations
            that are not named, actions are the set-points themselves.
        reward_fn: Function called with the observation before the action, the action, the observation after it, and
            `info`. Without one, rewards are 0. In a vector environment, arguments and result have a leading axis.
        termination_fn: Function called with the observation after the action and `info`, likewise. Without one,
            episodes never terminate.
        max_episode_steps: Actions after which an episode is truncated. No limit without a task.
        cameras: Cameras whose frames are part of the observation, under `cameras`, as `ARTICULATION/CAMERA` or as the
            name of a scene-level camera. Requires `space_mode="dict"`.
        n_substeps: Physics steps per action; 1 without a task.
        reset_noise: Largest deviation of joints at a reset: a `ResetNoise`, or radians for hinge joints only. A joint
            stays within its range. No noise without a task.
        keyframe: Keyframe in which episodes start unless `reset` names another; the initial state by default.
        render_mode: None or `rgb_array`.
        render_camera: Camera that `render` shows; the first colour camera of the scene by default.
    """

    task: Task | None
    space_mode: SpaceMode | None
    observations: str | Sequence[str] | None
    actions: Actions | Mapping[str, Actions] | None
    reward_fn: RewardFn | None
    termination_fn: TerminationFn | None
    max_episode_steps: int | None
    cameras: Sequence[str] | None
    n_substeps: int | None
    reset_noise: float | ResetNoise | None
    keyframe: str | None
    render_mode: Literal["rgb_array"] | None
    render_camera: str | None


_SERVING: Final[WeakValueDictionary[int, EpisodeSettings]] = WeakValueDictionary()
"""The settings of each open environment with a task, by the id of the task, which the settings keep alive."""


class EpisodeSettings:
    """Settings of an environment's episodes: its arguments, else the values of its task, else the defaults.

    Raises:
        ValueError: An option is out of range or contradicts another, a hook or attribute of the task is misspelt, or
            the task already serves another environment.
    """

    def __init__(self, **options: Unpack[EpisodeOptions]) -> None:
        get, task = options.get, options.get("task")
        if task is not None:
            if given := [name for name in ("reward_fn", "termination_fn") if get(name)]:
                raise ValueError(
                    f"{', '.join(given)} cannot be given together with a task: override the task's method instead"
                )
            require("task", task, Task, "a Task")
            check_declared(task)
            if id(task) in _SERVING:
                raise ValueError(
                    f"this {type(task).__name__} already serves another environment: make one for each environment, "
                    "or close() the other one first"
                )
        defaults = _NoTask if task is None else task

        def chosen(name: str) -> Any:
            given = get(name)
            return getattr(defaults, name) if given is None else given

        noise, keyframe = chosen("reset_noise"), chosen("keyframe")
        self.task = task
        self.reward_fn: RewardFn | None = get("reward_fn")
        self.termination_fn: TerminationFn | None = get("termination_fn")
        self.fields: tuple[Field, ...] = fields_of(chosen("observations"))
        self.actions: Actions | Mapping[str, Actions] | None = _actions(chosen("actions"))
        self.n_substeps: int = at_least("n_substeps", chosen("n_substeps"), 1)
        most = chosen("max_episode_steps")
        self.max_episode_steps: int | None = None if most is None else at_least("max_episode_steps", most, 1)
        self.keyframe: str | None = None if keyframe is None else text("keyframe", keyframe)
        self.reset_noise: ResetNoise = noise if isinstance(noise, ResetNoise) else ResetNoise(hinge=noise)
        self.space_mode: SpaceMode = chosen("space_mode")
        self.cameras: tuple[str, ...] = tuple(collection("cameras", chosen("cameras")))
        observed = defaults.articulations
        self.articulations: Sequence[str] | None = (
            None if observed is None else tuple(collection("articulations", observed))
        )
        self.render_mode: str | None = get("render_mode")
        self.render_camera: str | None = get("render_camera")
        if self.render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', not {self.render_mode!r}")

    def memory(self, model: mujoco.MjModel, mapping: SpaceMapping, n: int) -> Memory | None:
        """Set the task up and return what it keeps of `n` environments; None without a task.

        From then on the task serves no other environment, until `release`.
        """
        if self.task is None:
            return None
        scene = TaskScene(model, mapping)
        self.task.setup(scene)
        memory = Memory(self.task, scene, n)
        _SERVING[id(self.task)] = self
        return memory

    def release(self) -> None:
        """Let the task serve another environment."""
        if self.task is not None and _SERVING.get(id(self.task)) is self:
            del _SERVING[id(self.task)]


def _actions(given: Actions | Mapping[str, Actions] | None) -> Actions | Mapping[str, Actions] | None:
    if given is not None:
        for each in given.values() if isinstance(given, Mapping) else [given]:
            require("actions", each, Actions, "Actions, or a dictionary of Actions by articulation")
    return given


class _NoTask(Task):
    """The defaults of environments without a task."""

    observations = "standard"
    n_substeps = 1
    max_episode_steps = None


def client_defaults(options: Mapping[str, Any], address: str = "", servers: int = 1) -> Mapping[str, Any]:
    """Return client options with the defaults of environments filled in.

    Environments step physics themselves. A MuJoCo version other than the server's does not stop them; the client only
    warns about it. Servers that are started for a `sim://` address are stepped over shared memory if there is room.
    """
    shares = address.startswith(SCHEME) and _free_memory() >= servers * _REGIONS_BYTES
    transport = {"transport": "shm"} if shares else {}
    return {"step_mode": "direct", "mujoco_version_check": False, **transport, **options}


def _free_memory() -> int:
    """Return the bytes that programs can still share; 0 where the system has no such folder (measured on Linux)."""
    try:
        return shutil.disk_usage(SHARED_MEMORY).free
    except OSError:
        return 0


def served_address(address: str, randomise: Randomisation | None) -> str:
    """Return an address whose server, if it is started for it, varies its scene and honours the model's `<option>`."""
    if randomise is not None and address.startswith(SCHEME):
        address = with_option(address, "randomise", randomise.to_json())
    return with_model_options(address)


def keyframe_option(options: dict[str, Any] | None) -> str | None:
    """Return the keyframe named in the options of a reset."""
    unknown = set(options or {}) - {"keyframe"}
    if unknown:
        raise ValueError(f"unknown reset options {', '.join(map(str, unknown))}; the only option is 'keyframe'")
    return None if options is None else options.get("keyframe")
