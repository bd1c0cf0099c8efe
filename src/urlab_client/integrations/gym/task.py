"""`Task`: starts, goals, rewards and ends of episodes, defined once for all kinds of environments."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple, cast

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client.aio.arguments import at_least, collection, mapping, require
from urlab_client.integrations.gym.spaces import Actions, Space, SpaceMapping, SpaceMode, dict_space, unbounded
from urlab_client.protocol.base import Floats

Bools = NDArray[np.bool_]
_SKY_M: Final = 1e3


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
        self._ids: dict[tuple[str, str], int] = {}  # tasks ask in each step

    def id(self, kind: str, name: str) -> int:
        """Return the id of a `body`, `site`, `geom` or `joint`.

        Raises:
            KeyError: The scene has no such element.
        """
        found = self._ids.get((kind, name))
        if found is None:
            found = self._ids[kind, name] = self.mapping.id(kind, name)
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
        qpos: Positions of the whole scene, shape (nq,), initially those of the keyframe or the model. Write them.
        qvel: Velocities of the whole scene, shape (nv,), likewise.
        goal: Goal of the episode, by name: numbers or arrays whose shape is the same in all episodes.
        index: Index of the environment.
        memory: What the task keeps of the environment, by name, initially zeros. Write it.
    """

    def __init__(
        self,
        scene: TaskScene,
        qpos: Floats,
        qvel: Floats,
        index: int = 0,
        memory: Mapping[str, Floats] = MappingProxyType({}),
    ) -> None:
        self.scene = scene
        self.qpos = qpos
        self.qvel = qvel
        self.index = index
        self.memory: dict[str, Any] = dict(memory)
        self.goal: dict[str, Floats] = {}

    def joint(self, name: str, position: float, velocity: float | None = None) -> None:
        """Set the position of a hinge (radians) or slide joint (metres) and, if given, its velocity, per second."""
        joint = self.scene.id("joint", name)
        self.qpos[self.scene.model.jnt_qposadr[joint]] = position
        if velocity is not None:
            self.qvel[self.scene.model.jnt_dofadr[joint]] = velocity

    def place(
        self,
        body: str,
        position: Sequence[float] | Floats,
        quaternion: Sequence[float] = (1, 0, 0, 0),
        velocity: Sequence[float] | Floats | None = None,
        spin: Sequence[float] | Floats | None = None,
    ) -> None:
        """Place a body that has a free joint.

        Args:
            body: Name of the body.
            position: Position, metres, world frame, shape (3,).
            quaternion: Orientation, (w, x, y, z), world frame.
            velocity: Velocity, m/s, world frame, shape (3,); None leaves it as it is.
            spin: Angular velocity, rad/s, about the axes of the body, shape (3,); None leaves it as it is.

        Raises:
            ValueError: The body has no free joint.
        """
        model, body_id = self.scene.model, self.scene.id("body", body)
        joint = int(model.body_jntadr[body_id])
        if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"body {body!r} has no free joint, so it cannot be placed")
        address, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self.qpos[address : address + 7] = [*position, *quaternion]
        for at, speed in ((dof, velocity), (dof + 3, spin)):
            if speed is not None:
                self.qvel[at : at + 3] = speed

    def ground(self, x: float, y: float) -> float:
        """Return the height of the ground at a place, metres: the highest plane, height field or other fixed geom.

        Poses are those of the start, and moving bodies do not count. So on uneven ground a robot starts at
        `start.place("robot/trunk", [x, y, start.ground(x, y) + 0.3])`.

        Raises:
            ValueError: There is no ground at this place.
        """
        model, data = self.scene.model, self.scene.data
        data.qpos[:] = self.qpos
        mujoco.mj_kinematics(model, data)
        above, down, hit = np.array([x, y, _SKY_M]), np.array([0.0, 0.0, -1.0]), np.full((1, 1), -1, dtype=np.int32)
        while (depth := mujoco.mj_ray(model, data, above, down, None, 1, -1, hit)) >= 0:
            above[2] -= depth
            if model.body_weldid[model.geom_bodyid[hit[0, 0]]] == 0:
                return float(above[2])
            above[2] -= 1e-6
        raise ValueError(f"there is no ground at x = {x:g}, y = {y:g}")

    def noise(self, rng: np.random.Generator, key: str, noise: ResetNoise) -> None:
        """Add random noise to the hinge and slide joints of an articulation, within their ranges."""
        model = self.scene.model
        noise.add(rng, model, self.scene.mapping.scalar_joints(key, model), self.qpos)


class Now(NamedTuple):
    """Positions, velocities, times and what is measured of n environments; see `States`."""

    qpos: Floats
    qvel: Floats
    time: Floats
    measured: Mapping[str, Floats]


class States:
    """The states of n environments, as passed to a task. Arrays have a leading axis of n.

    Poses always match `qpos`, also directly after a step. They are computed on first use.

    Attributes:
        scene: The scene.
        qpos: Positions of the whole scene, shape (n, nq).
        qvel: Velocities, shape (n, nv).
        time: Simulation time, seconds, shape (n,).
        goal: Values that `Task.reset` put into `Start.goal`, each with a leading axis. An environment without an
            episode so far repeats another's.
        index: Indices of the environments, shape (n,).
        last_action: Actions that led to the states, shape (n, n_actions), before delays; zeros after a reset. Those of
            all articulations are concatenated.
        previous_action: Actions before those, likewise.
        memory: What the task keeps, by name, each with a leading axis. Only `Task.update` may write it.
        measured: `sensordata`, `ctrl` and `act` of MuJoCo, with a leading axis, if `Task.measured` asks for them.
    """

    def __init__(
        self,
        scene: TaskScene,
        qpos: Floats,
        qvel: Floats,
        time: Floats,
        goal: Mapping[str, Floats],
        *,
        index: NDArray[np.intp] | None = None,
        last_action: Floats | None = None,
        previous_action: Floats | None = None,
        memory: Mapping[str, Floats] = MappingProxyType({}),
        measured: Mapping[str, Floats] = MappingProxyType({}),
    ):
        self.scene = scene
        self.qpos = qpos
        self.qvel = qvel
        self.time = time
        self.measured = measured
        self.goal = goal
        self.index: NDArray[np.intp] = np.arange(len(qpos)) if index is None else index
        shape = len(qpos), scene.mapping.n_actions
        self.last_action: Floats = np.zeros(shape) if last_action is None else last_action
        self.previous_action: Floats = np.zeros(shape) if previous_action is None else previous_action
        self.memory = memory

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

    def touching(self, one: str | Sequence[str], other: str | Sequence[str] | None = None) -> Bools:
        """Return whether two bodies or geoms touch, shape (n,), or (n, k) for a sequence of k names.

        Args:
            one: Name of a body or geom, as in `TaskScene.geoms`, or several, such as the feet.
            other: What they touch: a name, or several of which one suffices; anything by default.
        """
        return self._summed(one, other, self._contacts) > 0

    def contact_force(self, one: str | Sequence[str], other: str | Sequence[str] | None = None) -> Floats:
        """Return the sum of the normal forces where bodies or geoms touch, newtons, with the arguments of `touching`.

        This process computes them for the state after the step, from positions, velocities, controls and activations.
        They leave out pushes, and what `randomise` varies of the model.

        Raises:
            ValueError: The task does not set `measured`.
        """
        return self._summed(one, other, self._forces)

    def sensor(self, name: str) -> Floats:
        """Return the readings of a sensor, shape (n, length), as MuJoCo leaves them in the last physics step.

        Raises:
            KeyError: There is no such sensor, or it belongs to no articulation, so that servers do not send it.
            ValueError: The task does not set `measured`.
        """
        model, layouts = self.scene.model, map(self.scene.mapping.layout, self.scene.mapping.keys)
        sensor = self.scene.id("sensor", name)
        if not any(sensor in layout.sensors.values() for layout in layouts):
            raise KeyError(f"sensor {name!r} belongs to no articulation, so servers do not send it")
        start = int(model.sensor_adr[sensor])
        return self._measured("sensordata")[:, start : start + int(model.sensor_dim[sensor])]

    def _measured(self, name: str) -> Floats:
        if name not in self.measured:
            raise ValueError("sensors and contact forces are there only if the task sets measured = True")
        return self.measured[name]

    def _summed(self, one: str | Sequence[str], other: str | Sequence[str] | None, contacts: _Contacts) -> Floats:
        """Return the sum of the forces of the contacts between geoms, shape (n,), or (n, k) for k names in `one`."""
        if not isinstance(one, str):
            return np.stack([self._summed(name, other, contacts) for name in one], axis=-1)
        first, second = self._marked([one]), np.ones(self.scene.model.ngeom, dtype=bool)
        if other is not None:
            second = self._marked([other] if isinstance(other, str) else other)
        a, b = contacts.geoms.T
        which = (first[a] & second[b]) | (first[b] & second[a])
        return np.bincount(contacts.owner[which], contacts.force[which], len(self)).astype(np.float64)

    def _marked(self, names: Sequence[str]) -> Bools:
        """Return which geoms of the model have one of these names, shape (ngeom,)."""
        marked = np.zeros(self.scene.model.ngeom, dtype=bool)
        for name in names:
            marked[self.scene.geoms(name)] = True
        return marked

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
    def _contacts(self) -> _Contacts:
        return self._found(forces=False)

    @cached_property
    def _forces(self) -> _Contacts:
        return self._found(forces=True)

    def _found(self, *, forces: bool) -> _Contacts:
        model, data = self.scene.model, self.scene.data
        counts: list[int] = []
        geoms: list[NDArray[np.int32]] = []
        normal: list[float] = []
        wrench = np.ones(6)
        for i, qpos in enumerate(self.qpos):
            data.qpos[:] = qpos
            if forces:
                data.qvel[:], data.qacc_warmstart[:] = self.qvel[i], 0.0
                data.ctrl[:], data.act[:] = self._measured("ctrl")[i], self._measured("act")[i]
                mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_NONE, 1)
            else:
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_collision(model, data)
            counts.append(data.ncon)
            geoms.append(np.array(data.contact.geom).reshape(-1, 2))
            for contact in range(data.ncon):
                if forces:
                    mujoco.mj_contactForce(model, data, contact, wrench)
                normal.append(float(wrench[0]))
        return _Contacts(np.repeat(np.arange(len(self)), counts), np.concatenate(geoms), np.array(normal))


class _Contacts(NamedTuple):
    """The state of each contact, shape (c,), its geoms, shape (c, 2), and its normal force, newtons, or else 1."""

    owner: NDArray[np.intp]
    geoms: NDArray[np.int32]
    force: Floats


class Memory:
    """What a task keeps of each of n environments: goal, actions, and the arrays of `Task.memory`, reset with it."""

    def __init__(self, task: Task, scene: TaskScene, n: int) -> None:
        self._task = task
        self._scene = scene
        self._n = n
        self._goals: dict[str, NDArray[Any]] = {}
        self._kept = {name: np.zeros((n, *shape)) for name, shape in task.memory.items()}
        self._actions = np.zeros((2, n, scene.mapping.n_actions))

    def begin(self, i: int, rng: np.random.Generator, qpos: Floats, qvel: Floats) -> None:
        """Let the task change the start of an episode in place: positions, shape (nq,), velocities, shape (nv,)."""
        for values in (*self._kept.values(), *self._actions):
            values[i] = 0.0
        start = Start(self._scene, qpos, qvel, i, {name: values[i, ...] for name, values in self._kept.items()})
        self._task.reset(rng, start)
        qpos[:], qvel[:] = start.qpos, start.qvel  # other arrays may be there now
        for name, values in (("qpos", qpos), ("qvel", qvel)):
            if not np.isfinite(values).all():
                raise ValueError(f"{_of(self._task, 'reset')} left NaN or infinity in start.{name} of environment {i}")
        self._keep("reset", i, start.memory)
        self._note_goal(i, start.goal)

    def _note_goal(self, i: int, goal: Mapping[str, Any]) -> None:
        given = {name: np.asarray(value) for name, value in goal.items()}
        for name, value in given.items():
            if value.dtype.kind not in "biuf" or not np.isfinite(value).all():
                raise ValueError(f"{_of(self._task, 'reset')} set the goal {name!r} to {goal[name]!r:.80}")
        if not self._goals:
            self._goals = {name: np.repeat(value[None], self._n, axis=0) for name, value in given.items()}
        shapes, known = ({name: values.shape for name, values in of.items()} for of in (given, self.goal(i)))
        if shapes != known:
            raise ValueError(
                f"{_of(self._task, 'reset')} set goals of shapes {shapes} for environment {i}, and {known} before"
            )
        for name, value in given.items():
            self._goals[name] = self._goals[name].astype(np.result_type(self._goals[name], value), copy=False)
            self._goals[name][i] = value

    def goal(self, i: int) -> dict[str, NDArray[Any]]:
        """Return the goal of an environment's episode, by name."""
        return {name: np.array(values[i]) for name, values in self._goals.items()}

    def updated(self, rows: NDArray[np.intp], actions: Floats, now: Now) -> States:
        """Note actions, shape (n, n_actions), let the task update what it keeps, and return the states they led to."""
        last, previous = self._actions
        previous[rows] = last[rows]
        last[rows] = actions
        states = self.states(rows, now)
        states.memory = dict(zip(self._kept, taken(rows, *self._kept.values()), strict=True))
        self._task.update(states)
        self._keep("update", rows, states.memory)
        states.memory = self._shown(rows)
        return states

    def states(self, rows: NDArray[np.intp], now: Now) -> States:
        """Return the states of some environments, in the form that is passed to the task."""
        last, previous = taken(rows, *self._actions)
        goal = dict(zip(self._goals, taken(rows, *self._goals.values()), strict=True))
        return States(
            self._scene,
            now.qpos,
            now.qvel,
            now.time,
            goal,
            index=rows,
            last_action=last,
            previous_action=previous,
            memory=self._shown(rows),
            measured=now.measured,
        )

    def _keep(self, hook: str, rows: NDArray[np.intp] | int, given: Mapping[str, Any]) -> None:
        """Keep what a hook left in the memory of some environments, in place or as other arrays."""
        if unknown := given.keys() - self._kept.keys():
            raise ValueError(
                f"{_of(self._task, hook)} keeps {', '.join(sorted(unknown))}, which `memory` does not declare; it "
                f"declares {', '.join(self._kept) or 'nothing'}"
            )
        for name, values in self._kept.items():
            found, shape = np.shape(given[name]), (*np.shape(rows), *values.shape[1:])
            if found != shape:
                raise ValueError(
                    f"{_of(self._task, hook)} set the memory {name!r} to shape {found}; it must have shape {shape}"
                )
            values[rows] = given[name]

    def _shown(self, rows: NDArray[np.intp]) -> Mapping[str, Floats]:
        """Return what the task keeps of some environments, read-only: a write would be lost, except in `update`."""
        found = dict(zip(self._kept, taken(rows, *self._kept.values()), strict=True))
        for values in found.values():
            values.flags.writeable = False
        return MappingProxyType(found)


def taken(rows: NDArray[np.intp], *arrays: Floats) -> list[Floats]:
    """Return copies of different rows of arrays; copying all of them takes a third of the time that indexing takes."""
    return [values.copy() if len(rows) == len(values) else values[rows] for values in arrays]


@dataclass(frozen=True, slots=True)
class EpisodeEnd:
    """How an episode ended.

    Attributes:
        index: Index of the environment.
        success: Whether the last state was a success; False if the task defines none.
        terminated: Whether the task terminated it, rather than `max_episode_steps`.
        steps: Number of actions.
        total: Return of the episode: the sum of its rewards.
        goal: Its goal, by name.
    """

    index: int
    success: bool
    terminated: bool
    steps: int
    total: float
    goal: Mapping[str, Floats]


def judged(task: Task, states: States, actions: Any) -> tuple[Floats, Bools]:
    """Return the rewards and the terminations; refuse wrong shapes, NaN and infinity."""
    rewards = _numbers(task, "reward", task.reward(states, actions), states, (len(states),)).astype(np.float64)
    return rewards, _answers(task, "terminated", task.terminated(states), states)


def succeeded(task: Task, states: States) -> Bools | None:
    """Return which states are a success, shape (n,), or None if the task defines none."""
    success = task.success(states)
    return None if success is None else _answers(task, "success", success, states)


def observed(task: Task, states: States) -> Floats:
    """Return what a task observes, shape (n, n_observed)."""
    return _numbers(task, "observe", task.observe(states), states, (len(states), task.n_observed))


def _numbers(task: Task, hook: str, answer: Any, states: States, shape: tuple[int, ...]) -> Floats:
    found = np.asarray(answer)
    if found.shape != shape:
        raise ValueError(
            f"{_of(task, hook)} returned shape {found.shape} for {len(states)} environments; it must return shape "
            f"{shape}: {'(n,)' if len(shape) == 1 else '(n, n_observed)'}"
        )
    if found.dtype.kind not in "biuf":
        raise ValueError(f"{_of(task, hook)} returned {found.dtype}; it must return numbers")
    if not np.isfinite(found).all():
        row = int(np.argwhere(~np.isfinite(found))[0, 0])
        raise ValueError(f"{_of(task, hook)} returned {found[row]} for environment {states.index[row]}")
    return found


def _answers(task: Task, hook: str, answer: Any, states: States) -> Bools:
    found = _numbers(task, hook, answer, states, (len(states),))
    answers = found.astype(bool)
    if found.dtype != bool and (found != answers).any():
        raise ValueError(f"{_of(task, hook)} returned {found}; it must return true or false for each environment")
    return answers


def _of(task: Task, hook: str) -> str:
    return f"{type(task).__name__}.{hook}()"


def check_declared(task: Task) -> None:
    """Refuse a name that is nearly that of a hook or attribute of `Task`, other arguments of a hook, wrong shapes."""
    kind = type(task)
    at_least(f"{kind.__name__}.n_observed", task.n_observed, 0)
    for name, shape in mapping(f"{kind.__name__}.memory", task.memory, "names to shapes").items():
        for length in collection(f"{kind.__name__}.memory[{name!r}]", shape):
            at_least(f"{kind.__name__}.memory[{name!r}]", length, 0)
    own = {name for one in kind.__mro__ if issubclass(one, Task) and one is not Task for name in vars(one)}
    for name in sorted(own | vars(task).keys()):
        if name in _HOOKS:
            wanted = [*inspect.signature(getattr(Task, name)).parameters][1:]
            try:
                inspect.signature(getattr(task, name)).bind(*wanted)
            except TypeError:
                raise ValueError(f"{kind.__name__}.{name}() must take ({', '.join(wanted)})") from None
        elif not name.startswith("_") and name not in _ATTRIBUTES:
            known = _HOOKS if callable(inspect.getattr_static(task, name)) else _ATTRIBUTES
            if near := difflib.get_close_matches(name, known, 1, _SIMILAR):
                raise ValueError(
                    f"{kind.__name__}.{name} is not used by environments; did you mean {near[0]!r}? Give your own "
                    "attributes other names."
                )


def with_task(space: Space, task: Task | None) -> Space:
    """Return an observation space extended by what a task observes: at the end, or as `task` in a dictionary."""
    if task is None or not task.n_observed:
        return space
    if isinstance(space, spaces.Dict):
        by_name = cast("Mapping[str, Space]", space)
        if "task" in by_name.keys():  # noqa: SIM118  # `in` asks a space whether a value is in it
            raise ValueError(
                "an articulation is named 'task', the entry for what the task observes: give it another actor id"
            )
        return dict_space({**by_name, "task": unbounded(task.n_observed)})
    return unbounded(int(np.prod(space.shape or ())) + task.n_observed)


class Task:
    """What robots are to do. Derive a class from it and pass an instance to any of the environments.

    All methods except `reset` handle n environments at once and return arrays of length n; a single environment has
    n = 1. An instance serves one environment, single or vector, until its `close()`.

    Arguments of an environment override the attributes of the same name here.

    Attributes:
        scene_address: Address of the scene.
        observations: Observed fields, or an observation level; see `URLabEnv`. Rewards, terminations and success do
            not depend on them.
        n_observed: Length of what `observe` adds to an observation.
        actions: How actions become set-points, for all articulations or by key. None: actions are set-points.
        memory: Shape of each array that the task keeps of an environment, such as a phase, air times or contact
            timers, by name: `{"air_time": (4,), "phase": ()}`. They are zeros at a reset; `update` advances them.
        measured: Whether methods ask for `States.sensor` or `States.contact_force`. Servers then send with each step
            the readings, controls and activations.
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
    actions: ClassVar[Actions | Mapping[str, Actions] | None] = None
    memory: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType({})
    measured: ClassVar[bool] = False
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

    def update(self, states: States) -> None:
        """Advance the arrays in `states.memory`, in place or by setting others of the same shape.

        Called once after each action, before the methods below; not in teleoperation, which has no actions.
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

    def ended(self, episode: EpisodeEnd) -> None:
        """Handle the end of an episode. A curriculum can use it to adapt what `reset` draws.

        If something outside of the environment truncates episodes, as `gymnasium.make` does, this is called at the next
        reset without a seed.
        """


_HOOKS: Final = ("setup", "reset", "update", "observe", "reward", "terminated", "success", "ended")
_ATTRIBUTES: Final = tuple(Task.__annotations__)
_SIMILAR: Final = 0.76
