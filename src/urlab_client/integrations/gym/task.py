"""`Task`: starts, goals, rewards and ends of episodes, defined once for all kinds of environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, ClassVar, cast

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client.aio.arguments import require
from urlab_client.aio.model.mirror import model_names
from urlab_client.integrations.gym.spaces import Observation, Space, SpaceMapping, SpaceMode, dict_space
from urlab_client.protocol.base import Floats
from urlab_client.values.names import unknown_name

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ResetNoise:
    """Largest deviation of joints at a reset. A joint with a range stays within it.

    Attributes:
        hinge: Largest deviation of hinge joints, radians.
        slide: Largest deviation of slide joints, metres.
    """

    hinge: float = 0.0
    slide: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("hinge", self.hinge), ("slide", self.slide)):
            require("reset_noise", value, Real, "a ResetNoise or a number")
            if not 0 <= value < np.inf:
                raise ValueError(f"reset_noise must be 0 or more, not {value} for {name} joints")

    def __bool__(self) -> bool:
        return self.hinge > 0 or self.slide > 0

    def add(self, rng: np.random.Generator, model: mujoco.MjModel, joints: NDArray[np.intp], qpos: Floats) -> None:
        """Add random noise in place to the positions of hinge and slide joints, given their ids; shape (nq,)."""
        address = model.jnt_qposadr[joints]
        positions: Floats = qpos[address]
        scale = np.where(model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE, self.slide, self.hinge)
        limited = model.jnt_limited[joints].astype(bool)
        lower, upper = model.jnt_range[joints].T
        # A joint that is already outside its range, for example after a keyframe, must not move further out.
        low = np.where(limited, np.clip(positions - scale, np.minimum(lower, positions), None), positions - scale)
        high = np.where(limited, np.clip(positions + scale, None, np.maximum(upper, positions)), positions + scale)
        qpos[address] = rng.uniform(low, high)


class TaskScene:
    """The compiled scene of a task. Elements are looked up by the names in their models: `ARTICULATION/NAME`.

    Attributes:
        model: The compiled model. Do not change it.
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
            KeyError: The scene has no such element.
        """
        known = self._ids.setdefault(kind, {n: i for i, n in enumerate(model_names(self.model, kind))})
        found = known.get(name, known.get(name.replace("/", "_", 1)))
        if found is None:
            raise unknown_name(kind, name, filter(None, known))
        return found

    def geoms(self, name: str) -> NDArray[np.intp]:
        """Return the ids of the geoms of a body, without those of its children, or the id of one geom.

        Args:
            name: Name of a body or a geom. If both have the same name, it means the body, and `geom:NAME` the geom.

        Raises:
            KeyError: No body or geom has this name.
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
        qpos: Positions of the whole scene, shape (nq,), initially those of the keyframe or the model. Write in place.
        goal: Goal of the episode, by name: numbers or arrays whose shape is the same in all episodes.
    """

    def __init__(self, scene: TaskScene, qpos: Floats) -> None:
        self.scene = scene
        self.qpos = qpos
        self.goal: dict[str, Floats] = {}

    def joint(self, name: str, position: float) -> None:
        """Set the position of a hinge joint (radians) or slide joint (metres)."""
        self.qpos[self.scene.model.jnt_qposadr[self.scene.id("joint", name)]] = position

    def place(self, body: str, position: Sequence[float] | Floats, quaternion: Sequence[float] = (1, 0, 0, 0)) -> None:
        """Place a body that has a free joint.

        Args:
            body: Name of the body.
            position: Position, metres, world frame, shape (3,).
            quaternion: Orientation, (w, x, y, z), world frame.

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
        """Add random noise to the hinge and slide joints of an articulation, within their ranges."""
        model = self.scene.model
        noise.add(rng, model, self.scene.mapping.scalar_joints(key, model), self.qpos)


class States:
    """The states of n environments, as passed to a task. Arrays have a leading axis of n.

    Poses always match `qpos`, also directly after a step. They are computed on first use.

    Attributes:
        scene: The scene.
        qpos: Positions of the whole scene, shape (n, nq).
        qvel: Velocities, shape (n, nv).
        time: Simulation time, seconds, shape (n,).
        goal: Values that `Task.reset` put into `Start.goal`, each with a leading axis.
    """

    def __init__(
        self, scene: TaskScene, qpos: Floats, qvel: Floats, time: Floats, goals: Sequence[Mapping[str, Floats]]
    ):
        self.scene = scene
        self.qpos = qpos
        self.qvel = qvel
        self.time = time
        # An environment without an episode so far has no goal: its row repeats another environment's.
        known = next(filter(None, goals), dict[str, Floats]())
        self.goal: dict[str, NDArray[np.float64]] = {
            name: np.array([(goal or known)[name] for goal in goals]) for name in known
        }

    def __len__(self) -> int:
        return len(self.qpos)

    def positions(self, key: str) -> Floats:
        """Return the positions of an articulation, shape (n, its nq), in the order of `qpos_array`."""
        return self.qpos[:, self.scene.mapping.layout(key).qpos_adr]

    def velocities(self, key: str) -> Floats:
        """Return the velocities of an articulation, shape (n, its nv), in the order of `qvel_array`."""
        return self.qvel[:, self.scene.mapping.layout(key).qvel_adr]

    def body_position(self, name: str) -> Floats:
        """Return the position of a body, metres, world frame, shape (n, 3)."""
        return self._poses["xpos"][:, self.scene.id("body", name)]

    def body_quaternion(self, name: str) -> Floats:
        """Return the orientation of a body, (w, x, y, z), world frame, shape (n, 4)."""
        return self._poses["xquat"][:, self.scene.id("body", name)]

    def site_position(self, name: str) -> Floats:
        """Return the position of a site, metres, world frame, shape (n, 3)."""
        return self._poses["site_xpos"][:, self.scene.id("site", name)]

    def touching(self, one: str, other: str | None = None) -> Bools:
        """Return whether two bodies or geoms touch, shape (n,). With one name: whether it touches anything.

        Names are resolved as in `TaskScene.geoms`.
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
    """Return the states of several environments as one. A missing state (None) repeats the first known one."""
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
    """Return an observation space extended by what a task observes: at the end, or as `task` in a dictionary."""
    if task is None or not task.n_observed:
        return space
    if isinstance(space, spaces.Dict):
        added = spaces.Box(-np.inf, np.inf, (task.n_observed,), dtype=np.float64)
        return dict_space({**cast("Mapping[str, Space]", space), "task": added})
    return spaces.Box(-np.inf, np.inf, (int(np.prod(space.shape or ())) + task.n_observed,), dtype=np.float64)


def add_observed(observation: Observation, task: Task, observed: Floats) -> Observation:
    """Add what a task observes, shape (…, n_observed), to an observation with the same leading axes."""
    if observed.shape[-1:] != (task.n_observed,):
        raise ValueError(
            f"{type(task).__name__}.observe() returned {observed.shape[-1]} numbers; n_observed is {task.n_observed}"
        )
    if not task.n_observed:
        return observation
    if isinstance(observation, dict):
        return {**cast("dict[str, Observation]", observation), "task": observed}
    return np.concatenate([observation, observed], axis=-1)


class Task:
    """What robots are to do. Derive a class from it and pass an instance to any of the environments.

    All methods except `reset` handle n environments at once and return arrays of length n; a single environment has
    n = 1. An instance serves one environment, single or vector.

    Arguments of an environment override the attributes of the same name here.

    Attributes:
        scene_address: Address of the scene.
        observations: Observed fields, or an observation level; see `URLabEnv`. Rewards, terminations and success do
            not depend on them.
        n_observed: Length of what `observe` adds to an observation.
        n_substeps: Physics steps per action.
        max_episode_steps: Actions per episode, or None for no limit.
        keyframe: Keyframe in which episodes start before `reset` changes the start, or None for the initial state.
        reset_noise: Largest deviation of joints from the start, before `reset` changes it; see `URLabEnv`.
        space_mode: `flat` or `dict`.
        cameras: Cameras whose pictures are observed. Requires `dict`.
        articulations: Articulations whose fields are observed, or None for all.
        scene: The scene, available from `setup` on.
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
        """Store the scene. Called once, before any other method; look up names here."""
        self.scene = scene

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """Choose the start and the goal of one episode.

        Args:
            rng: The environment's random generator. Draw everything that depends on the seed from it.
            start: The start, to be changed in place.
        """

    def observe(self, states: States) -> Floats:
        """Return what observations hold besides the fields, such as goals and commands, shape (n, n_observed)."""
        return np.zeros((len(states), self.n_observed))

    def reward(self, states: States, actions: Any) -> Floats:
        """Return the rewards for the states that the actions led to, shape (n,)."""
        raise NotImplementedError

    def terminated(self, states: States) -> Bools:
        """Return which episodes terminate, shape (n,)."""
        return np.zeros(len(states), dtype=bool)

    def success(self, states: States) -> Bools | None:
        """Return which states are a success, shape (n,); `info` has it as `success`. None if the task defines none."""
        return None

    def ended(self, success: bool, steps: int) -> None:
        """Handle the end of an episode. A curriculum can use it to adapt what `reset` draws.

        Args:
            success: Whether the last state of the episode was a success.
            steps: Number of actions in the episode.
        """
