"""`Task`: what robots are to do, written once for single environments, servers and batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, cast

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client.aio.model.mirror import model_names
from urlab_client.integrations.gym.spaces import Observation, Space, SpaceMapping, SpaceMode, dict_space
from urlab_client.integrations.gym.starts import ResetNoise, noise_of
from urlab_client.protocol.base import Floats
from urlab_client.protocol.names import unknown_name

__all__ = [
    "EpisodeSettings",
    "Start",
    "States",
    "Task",
    "TaskScene",
    "add_observed",
    "check_alone",
    "joined",
    "with_task",
]

Bools = NDArray[np.bool_]


class TaskScene:
    """The compiled scene of a task, by the names that its models use: `ARTICULATION/NAME`.

    Attributes:
        model: The compiled model; not to be changed.
        mapping: Its articulations as spaces.
    """

    def __init__(self, model: mujoco.MjModel, mapping: SpaceMapping) -> None:
        self.model = model
        self.mapping = mapping
        self.data: mujoco.MjData = mujoco.MjData(model)
        self._ids: dict[str, dict[str, int]] = {}

    def id(self, kind: str, name: str) -> int:
        """Return the id of a `body`, `site`, `geom` or `joint`.

        Raises:
            KeyError: There is none of this name.
        """
        known = self._ids.setdefault(kind, {n: i for i, n in enumerate(model_names(self.model, kind))})
        found = known.get(name, known.get(name.replace("/", "_", 1)))
        if found is None:
            raise unknown_name(kind, name, filter(None, known))
        return found

    def geoms(self, name: str) -> NDArray[np.intp]:
        """Return the geoms of a body, without those of its children, or one geom by its name.

        Args:
            name: Of a body or a geom; where both have it the body's, and `geom:NAME` is the geom's.

        Raises:
            KeyError: Neither has this name.
        """
        if not name.startswith("geom:"):
            try:
                return np.flatnonzero(self.model.geom_bodyid == self.id("body", name))
            except KeyError:
                pass
        return np.array([self.id("geom", name.removeprefix("geom:"))], dtype=np.intp)


class Start:
    """Where one episode starts: what `Task.reset` changes.

    Attributes:
        scene: The scene.
        qpos: Positions of the whole scene, shape (nq,), as the keyframe or the model has them; written in place.
        goal: What the episode is about, by name: numbers or arrays of one shape for all episodes.
    """

    def __init__(self, scene: TaskScene, qpos: Floats) -> None:
        self.scene = scene
        self.qpos = qpos
        self.goal: dict[str, Floats] = {}

    def joint(self, name: str, position: float) -> None:
        """Set a hinge or slide joint, radians or metres."""
        self.qpos[self.scene.model.jnt_qposadr[self.scene.id("joint", name)]] = position

    def place(self, body: str, position: Sequence[float] | Floats, quaternion: Sequence[float] = (1, 0, 0, 0)) -> None:
        """Place a body that has a free joint.

        Args:
            body: Its name.
            position: Metres, world frame, shape (3,).
            quaternion: (w, x, y, z), world frame.

        Raises:
            ValueError: The body has no free joint.
        """
        model, body_id = self.scene.model, self.scene.id("body", body)
        joint = int(model.body_jntadr[body_id])
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"body {body!r} has no free joint, so it cannot be placed")
        address = int(model.jnt_qposadr[joint])
        self.qpos[address : address + 3] = position
        self.qpos[address + 3 : address + 7] = quaternion

    def noise(self, rng: np.random.Generator, key: str, noise: ResetNoise) -> None:
        """Move the hinge and slide joints of an articulation at random, within their ranges."""
        model, mapping = self.scene.model, self.scene.mapping
        joints = mapping.layout(key).joints
        ids = np.array([joints[name] for name in mapping.joint_names(key, model)], dtype=np.intp)
        address = model.jnt_qposadr[ids]
        self.qpos[address] = noise.drawn(rng, model, ids, self.qpos[address])


class States:
    """The states of n environments, as a task sees them. Arrays have a leading axis of n.

    Poses belong to `qpos` as it is, also right after a step; they are computed when first asked for.

    Attributes:
        scene: The scene.
        qpos: Positions of the whole scene, shape (n, nq).
        qvel: Velocities, shape (n, nv).
        time: Simulation time, seconds, shape (n,).
        goal: What `Task.reset` put into `Start.goal`, each with a leading axis.
    """

    def __init__(
        self, scene: TaskScene, qpos: Floats, qvel: Floats, time: Floats, goals: Sequence[Mapping[str, Floats]]
    ):
        self.scene = scene
        self.qpos = qpos
        self.qvel = qvel
        self.time = time
        known = next(
            filter(None, goals), dict[str, Floats]()
        )  # one that has had no episode yet has no goal: it shows another's
        self.goal: dict[str, NDArray[np.float64]] = {
            name: np.array([(goal or known)[name] for goal in goals]) for name in known
        }

    def __len__(self) -> int:
        return len(self.qpos)

    def positions(self, key: str) -> Floats:
        """Return the positions of an articulation, shape (n, its nq), as `qpos_array` has them."""
        return self.qpos[:, self.scene.mapping.layout(key).qpos_adr]

    def velocities(self, key: str) -> Floats:
        """Return the velocities of an articulation, shape (n, its nv), as `qvel_array` has them."""
        return self.qvel[:, self.scene.mapping.layout(key).qvel_adr]

    def body_position(self, name: str) -> Floats:
        """Return where a body is, metres, world frame, shape (n, 3)."""
        return self._poses["xpos"][:, self.scene.id("body", name)]

    def body_quaternion(self, name: str) -> Floats:
        """Return a body's orientation, (w, x, y, z), world frame, shape (n, 4)."""
        return self._poses["xquat"][:, self.scene.id("body", name)]

    def site_position(self, name: str) -> Floats:
        """Return where a site is, metres, world frame, shape (n, 3)."""
        return self._poses["site_xpos"][:, self.scene.id("site", name)]

    def touching(self, one: str, other: str | None = None) -> Bools:
        """Return whether bodies or geoms touch, shape (n,); with one name, whether it touches anything.

        Names are those of `TaskScene.geoms`.
        """
        first = self.scene.geoms(one)
        second = None if other is None else self.scene.geoms(other)
        touching = np.zeros(len(self), dtype=bool)
        for i, pairs in enumerate(self._contacts):
            mine = np.isin(pairs, first)
            partner = np.ones_like(mine) if second is None else np.isin(pairs, second)
            touching[i] = bool((mine & partner[:, ::-1]).any())
        return touching

    @cached_property
    def _poses(self) -> dict[str, Floats]:
        model, data = self.scene.model, self.scene.data
        found = {name: np.zeros((len(self), *getattr(data, name).shape)) for name in ("xpos", "xquat", "site_xpos")}
        for i, qpos in enumerate(self.qpos):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            for name, values in found.items():
                values[i] = getattr(data, name)
        return found

    @cached_property
    def _contacts(self) -> list[NDArray[np.int32]]:
        model, data = self.scene.model, self.scene.data
        found: list[NDArray[np.int32]] = []
        for qpos in self.qpos:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            found.append(np.array(data.contact.geom[: data.ncon]).reshape(-1, 2))
        return found


def joined(parts: Sequence[States | None]) -> States:
    """Return states of several environments as one. One that is not known, None, shows what the first known one does.

    Raises:
        ValueError: None is known.
    """
    known = next((part for part in parts if part is not None), None)
    if known is None:
        raise ValueError("no environment has a state")
    rows = [known if part is None else part for part in parts]
    return States(
        known.scene,
        np.concatenate([row.qpos for row in rows]),
        np.concatenate([row.qvel for row in rows]),
        np.concatenate([row.time for row in rows]),
        [{name: values[0] for name, values in row.goal.items()} for row in rows],
    )


def with_task(space: Space, task: Task | None) -> Space:
    """Return an observation space with room for what a task adds: at the end, or as `task` in a dictionary."""
    if task is None or not task.n_observed:
        return space
    if isinstance(space, spaces.Dict):
        added = spaces.Box(-np.inf, np.inf, (task.n_observed,), dtype=np.float64)
        return dict_space({**cast("Mapping[str, Space]", space), "task": added})
    return spaces.Box(-np.inf, np.inf, (int(np.prod(space.shape or ())) + task.n_observed,), dtype=np.float64)


def add_observed(observation: Observation, task: Task, observed: Floats) -> Observation:
    """Add what a task observes, shape (…, n_observed), to an observation with the same leading axes.

    Raises:
        ValueError: It has another shape.
    """
    if observed.shape[-1:] != (task.n_observed,):
        raise ValueError(
            f"{type(task).__name__}.observe() returned {observed.shape[-1]} numbers; n_observed is {task.n_observed}"
        )
    if not task.n_observed:
        return observation
    if isinstance(observation, dict):
        return {**cast("dict[str, Observation]", observation), "task": observed}
    return np.concatenate([observation, observed], axis=-1)


def check_alone(task: Task | None, **others: object) -> None:
    """Refuse functions that a task takes the place of.

    Raises:
        ValueError: Some are given beside a task.
    """
    given = [name for name, value in others.items() if value]
    if task is not None and given:
        raise ValueError(f"a task settles {', '.join(given)}: override its method instead")


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """What episodes are like: as the arguments of an environment say, else its task, else the defaults.

    Attributes:
        observations: Observed fields or level.
        n_substeps: Physics steps per action.
        max_episode_steps: Actions per episode, or None.
        keyframe: Where episodes start; the initial state for None.
        reset_noise: Largest deviation of joints from there.
        space_mode: `flat` or `dict`.
        cameras: Cameras whose pictures are observed.
        articulations: Articulations that are observed; all for None.
    """

    observations: str | Sequence[str]
    n_substeps: int
    max_episode_steps: int | None
    keyframe: str | None
    reset_noise: ResetNoise
    space_mode: SpaceMode
    cameras: Sequence[str]
    articulations: Sequence[str] | None

    @classmethod
    def of(
        cls,
        task: Task | None,
        *,
        observations: str | Sequence[str] | None,
        n_substeps: int | None,
        max_episode_steps: int | None,
        keyframe: str | None,
        reset_noise: float | ResetNoise | None,
        space_mode: SpaceMode | None,
        cameras: Sequence[str] | None = None,
    ) -> EpisodeSettings:
        """Return the settings in force; None asks for those of the task, or the defaults.

        Raises:
            ValueError: A number is below 1, or noise negative.
        """
        defaults = _NO_TASK if task is None else task
        settings = cls(
            observations=defaults.observations if observations is None else observations,
            n_substeps=defaults.n_substeps if n_substeps is None else n_substeps,
            max_episode_steps=defaults.max_episode_steps if max_episode_steps is None else max_episode_steps,
            keyframe=defaults.keyframe if keyframe is None else keyframe,
            reset_noise=noise_of(defaults.reset_noise if reset_noise is None else reset_noise),
            space_mode=defaults.space_mode if space_mode is None else space_mode,
            cameras=tuple(defaults.cameras if cameras is None else cameras),
            articulations=defaults.articulations,
        )
        if settings.n_substeps < 1:
            raise ValueError(f"n_substeps must be at least 1, not {settings.n_substeps}")
        if settings.max_episode_steps is not None and settings.max_episode_steps < 1:
            raise ValueError(f"max_episode_steps must be at least 1 or None, not {settings.max_episode_steps}")
        return settings


_NO_TASK: Final = EpisodeSettings("standard", 1, None, None, ResetNoise(), "flat", (), None)


class Task:
    """What robots are to do. Derive from it, and give an object of it to any of the environments.

    All methods but `reset` see n environments at once, n being 1 in a single one, and return arrays of n. An object
    serves one environment, single or vector.

    The arguments of an environment that have the names of attributes here win over these.

    Attributes:
        scene_address: Where the scene comes from.
        observations: Observed fields or level; see `URLabEnv`. What is judged does not depend on them.
        n_observed: Numbers that `observe` adds to an observation.
        n_substeps: Physics steps per action.
        max_episode_steps: Actions per episode, or None.
        keyframe: Where episodes start before `reset` changes that; the initial state for None.
        reset_noise: Largest deviation of joints from there, before `reset` changes that; see `URLabEnv`.
        space_mode: `flat` or `dict`.
        cameras: Cameras whose pictures are observed, which takes `dict`.
        articulations: Articulations whose fields are observed; all for None.
        scene: The scene, from `setup` on.
    """

    scene_address: ClassVar[str]
    observations: ClassVar[str | Sequence[str]] = "minimal"
    n_observed: ClassVar[int] = 0
    n_substeps: ClassVar[int] = 10
    max_episode_steps: ClassVar[int | None] = 200
    keyframe: ClassVar[str | None] = None
    reset_noise: ClassVar[float | ResetNoise] = 0.0
    space_mode: ClassVar[SpaceMode] = "flat"
    cameras: ClassVar[Sequence[str]] = ()
    articulations: ClassVar[Sequence[str] | None] = None
    scene: TaskScene

    def setup(self, scene: TaskScene) -> None:
        """Take note of the scene; called once, before anything else. Look names up here."""
        self.scene = scene

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """Choose where one episode starts and what it is about.

        Args:
            rng: The environment's generator: all that may vary with the seed is drawn from it.
            start: To be changed.
        """

    def observe(self, states: States) -> Floats:
        """Return what an observation holds besides the fields, shape (n, n_observed): goals, commands."""
        return np.zeros((len(states), self.n_observed))

    def reward(self, states: States, actions: Any) -> Floats:
        """Return the rewards for the states that actions led to, shape (n,)."""
        raise NotImplementedError

    def terminated(self, states: States) -> Bools:
        """Return which episodes end for good, shape (n,)."""
        return np.zeros(len(states), dtype=bool)

    def success(self, states: States) -> Bools | None:
        """Return which states are a success, shape (n,): `success` in `info`. None for a task that knows none."""
        return None

    def ended(self, success: bool, steps: int) -> None:
        """Learn how an episode ended, for a curriculum: what `reset` draws from may depend on it.

        Args:
            success: Whether its last state was a success.
            steps: Actions it took.
        """
