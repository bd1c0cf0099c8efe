"""Maps a robot's state to network inputs, and network outputs to set-points.

All functions accept single robots and batches: arrays may have leading axes. Training and running use the same
functions, so a network sees the same numbers in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.articulation import URLabArticulation as AsyncArticulation
from urlab_client.aio.model.elements import Actuator, Joint
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabError
from urlab_client.integrations.policy.spec import (
    AngularVelocity,
    BaseHeight,
    CommandTerm,
    FieldTerm,
    GoalTerm,
    Gravity,
    JointPosition,
    JointVelocity,
    LastAction,
    LinearVelocity,
    Numbers,
    NumberTerm,
    PhaseClock,
    PictureTerm,
    PolicySpec,
    SensorTerm,
)
from urlab_client.protocol.base import Floats
from urlab_client.sync.articulation import URLabArticulation
from urlab_client.values.pictures import observed_pixels

T = TypeVar("T")

_SCALAR_JOINTS: Final = (2, 3)  # slide, hinge

_NONE: Final = np.zeros(0)

PolicyRobot: TypeAlias = AsyncArticulation | URLabArticulation
"""An articulation of either flavour."""


class PolicyMismatch(URLabError):
    """A policy does not fit the robot or the session. The message names what was found, what is required and a fix."""


_EYE: Final = np.eye(3)
_CROSS: Final = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]), [[0, 3, 2], [3, 0, 1], [2, 1, 0]]
"""Signs and components of a quaternion (w, x, y, z) in the matrix of the cross product with (x, y, z)."""


class RobotState(NamedTuple):
    """The state of one robot or of a batch.

    Attributes:
        qpos: Joint positions in the order of `qpos_array`, shape (…, nq).
        qvel: Joint velocities in the order of `qvel_array`, shape (…, nv).
        sensors: Readings by sensor name, shape (…, dim).
        ctrl: Set-points in force, shape (…, nu).
        act: Activations, likewise.
    """

    qpos: Floats
    qvel: Floats
    sensors: Mapping[str, Floats] = {}
    ctrl: Floats = _NONE
    act: Floats = _NONE

    @classmethod
    def of(cls, robot: PolicyRobot) -> RobotState:
        """Return the current state of an articulation."""
        return cls(robot.qpos_array, robot.qvel_array, robot.get_sensors(), robot.last_applied_ctrl, robot.act_array)

    @property
    def gravity(self) -> Floats:
        """Direction of gravity in the base frame, shape (…, 3)."""
        return -self._rotation()[..., 2, :]

    @property
    def linear_velocity(self) -> Floats:
        """Velocity of the base, m/s, base frame, shape (…, 3)."""
        return np.einsum("...ij,...i->...j", self._rotation(), self.qvel[..., :3])

    @property
    def angular_velocity(self) -> Floats:
        """Angular velocity of the base, rad/s, base frame, shape (…, 3)."""
        return self.qvel[..., 3:6]

    def _rotation(self) -> Floats:
        """Return the rotation from the base frame to the world frame, shape (…, 3, 3)."""
        quat = self.qpos[..., 3:7]
        cross = _CROSS[0] * quat[..., _CROSS[1]]
        return _EYE + 2 * (quat[..., :1, None] * cross + cross @ cross)


class _Moment(NamedTuple):
    """The values that terms can read."""

    state: RobotState
    command: Floats
    last_action: Floats
    time: float
    goal: Floats


_Read = Callable[[_Moment], Floats]

_PLAIN: Final[dict[type[NumberTerm], tuple[int, _Read]]] = {
    BaseHeight: (1, lambda moment: moment.state.qpos[..., 2:3]),
    Gravity: (3, lambda moment: moment.state.gravity),
    LinearVelocity: (3, lambda moment: moment.state.linear_velocity),
    AngularVelocity: (3, lambda moment: moment.state.angular_velocity),
    CommandTerm: (3, lambda moment: moment.command),
}
"""Size of the terms that are the same for every robot, and a function that reads them."""


class PolicyMapping:
    """A declaration bound to a robot's joints, actuators and sensors.

    Attributes:
        spec: The declaration.
        observation_size: Length of one observation, without pictures.
        action_size: Number of network outputs.
        joints: Joint of each output.
        actuators: Actuator of each output.
        ctrl: Index of each output in `ctrl_array`.
    """

    def __init__(self, spec: PolicySpec, robot: PolicyRobot, source: str) -> None:
        """Bind a declaration to a robot.

        Args:
            spec: The declaration.
            robot: An articulation of a discovered client with a local model.
            source: Name of the declaration in errors, usually its file.

        Raises:
            PolicyMismatch: The robot lacks a joint, an actuator, a sensor, a camera or a free base.
        """
        self.spec = spec
        self._source = source
        self._robot = robot.prefix
        self._has_base = robot.has_free_base
        if not robot.joints:
            raise PolicyMismatch(
                f"{source}: the joints of {self._robot!r} are not known.",
                hint="Make the client with local_model=True and call discover() during play.",
            )
        self.joints: list[Joint] = self._joints(robot, spec.action.joints, "action.joints")
        self.actuators: list[Actuator] = [_actuator(robot, joint, source) for joint in self.joints]
        self.ctrl: NDArray[np.intp] = np.array(
            [actuator.ctrl_local.start for actuator in self.actuators], dtype=np.intp
        )
        self.action_size: int = len(self.joints)
        self._qpos, self._qvel = _offsets(self.joints)
        self._scale, self._offset = _array(spec.action.scale), _array(spec.action.offset)
        self._goal_sensor = ""
        self._terms: list[tuple[_Read, NumberTerm]] = []
        self._columns: dict[str, list[int]] = {}
        self.observation_size: int = 0
        for index, term in enumerate(spec.observation):
            where = f"observation[{index}]"
            if isinstance(term, PictureTerm):
                self._check_picture(robot, term, where)
                continue
            size, read = self._term(robot, term, where)
            for name in ("scale", "offset"):
                value: Numbers = getattr(term, name)
                if isinstance(value, list) and len(value) != size:
                    raise self._misfit(f"{where}.{name}", f"has {len(value)} numbers; it takes one, or {size}")
            self._terms.append((read, term))
            columns = range(self.observation_size, self.observation_size + size)
            self._columns.setdefault(term.input, []).extend(columns)
            self.observation_size += size
        if (spec.fall or spec.reward) and not self._has_base:
            raise self._misfit("fall" if spec.fall else "reward", f"needs a free base; {self._robot!r} has none")
        spread = self._joints(robot, spec.reward.spread_joints if spec.reward else [], "reward.spread_joints")
        self._spread = _offsets(spread)[0]

    def observe(
        self, state: RobotState, command: Floats, last_action: Floats, time: float, goal: Floats | None = None
    ) -> Floats:
        """Return one observation, shape (…, observation_size).

        Args:
            state: State of the robot.
            command: (vx, vy, yaw rate), shape (…, 3).
            last_action: The last output after clipping, shape (…, action_size).
            time: Seconds since the start.
            goal: Goal, shape (…, n_goal), or None for the declared default.
        """
        moment = _Moment(state, command, last_action, time, self.default_goal if goal is None else goal)
        parts: list[Floats] = []
        for read, term in self._terms:
            part = (read(moment) - _array(term.offset)) * _array(term.scale)
            parts.append(part if term.clip is None else np.clip(part, *term.clip))
        leading = state.qpos.shape[:-1]
        return np.concatenate([np.broadcast_to(part, (*leading, part.shape[-1])) for part in parts], axis=-1)

    def named(self, observations: Sequence[Floats], robot: PolicyRobot) -> dict[str, NDArray[Any]]:
        """Return the values of the network inputs, by name.

        Args:
            observations: Results of `observe`, as many as `history` declares.
            robot: The articulation. Its cameras show the same moment as the last observation.

        Raises:
            PolicyMismatch: A camera has no picture.
        """
        inputs: dict[str, NDArray[Any]] = {
            name: np.concatenate([observation[columns] for observation in observations])
            for name, columns in self._columns.items()
        }
        for term in self.spec.pictures:
            frame = robot.cameras[term.camera].latest_frame
            if frame is None:
                raise PolicyMismatch(
                    f"{self._source}: camera {term.camera!r} of {robot.prefix!r} has no picture yet.",
                    hint=f"Step with include_cameras={{'{robot.prefix}/{term.camera}': 'sync'}}, or call capture().",
                )
            inputs[term.input] = observed_pixels(frame, term.mode)
        return inputs

    @property
    def inputs(self) -> dict[str, NDArray[Any]]:
        """Empty network inputs, by name, if the declaration names them: their shapes, without batch axis, and types."""
        numbers: dict[str, NDArray[Any]] = {
            name: np.empty(len(columns) * self.spec.history, dtype=np.float32)
            for name, columns in self._columns.items()
        }
        return numbers | {term.input: _picture(term) for term in self.spec.pictures}

    def clipped(self, output: Floats) -> Floats:
        """Return the network's outputs clipped to their limits."""
        return np.clip(output, *self.spec.action.clip)

    def targets(self, action: Floats) -> Floats:
        """Return the joint targets or torques for a clipped output, shape (…, action_size)."""
        return self._offset + self._scale * action

    def torques(self, targets: Floats, state: RobotState) -> Floats:
        """Return the torques of the PD law of `gains` for joint targets, shape (…, action_size)."""
        gains = self.spec.gains
        if gains is None:
            raise ValueError(f"{self._source} has no gains: its action.via is 'actuators'")
        limit = _array(gains.torque_limit)
        wanted = _array(gains.kp) * (targets - state.qpos[..., self._qpos])
        return np.clip(wanted - _array(gains.kv) * state.qvel[..., self._qvel], -limit, limit)

    def gains(self) -> dict[str, dict[str, float]]:
        """Return the gains in the format of `set_gains`: by gain, then by actuator."""
        gains, names = self.spec.gains, [actuator.name for actuator in self.actuators]
        if gains is None:
            return {}
        values = {"kp": gains.kp, "kv": gains.kv, "torque_limit": gains.torque_limit}
        return {
            name: dict(zip(names, np.broadcast_to(_array(value), self.action_size).tolist(), strict=True))
            for name, value in values.items()
        }

    @property
    def default_goal(self) -> Floats:
        """The declared goal, shape (n_goal,); empty without one."""
        return np.zeros(0) if self.spec.goal is None else np.array(self.spec.goal.default)

    def goal_error(self, state: RobotState, goal: Floats) -> Floats | None:
        """Return the distance from the goal in the first goal term with `relative_to`; None without such a term."""
        measured = self._goal_sensor
        return np.linalg.norm(goal - state.sensors[measured], axis=-1) if measured else None

    def fallen(self, state: RobotState) -> NDArray[np.bool_]:
        """Whether the robot has fallen, shape (…)."""
        fall = self.spec.fall
        if fall is None:
            return np.zeros(state.qpos.shape[:-1], dtype=bool)
        return (state.qpos[..., 2] < fall.height) | (-state.gravity[..., 2] < fall.upright)

    def reward(self, state: RobotState, command: Floats, action: Floats, last_action: Floats) -> Floats:
        """Return the reward of `TrackingReward` for an action and the state it led to, shape (…); 0 without one."""
        reward = self.spec.reward
        if reward is None:
            return np.zeros(state.qpos.shape[:-1])
        linear, angular = state.linear_velocity, state.angular_velocity
        gain = (
            reward.alive
            + reward.velocity * np.exp(-_squares(linear[..., :2] - command[..., :2]) / reward.velocity_width)
            + reward.yaw * np.exp(-((angular[..., 2] - command[..., 2]) ** 2) / reward.yaw_width)
            + reward.level * np.exp(-_squares(state.gravity[..., :2]) / reward.level_width)
        )
        cost = (
            reward.bounce * linear[..., 2] ** 2
            + reward.roll * _squares(angular[..., :2])
            + reward.change * _squares(action - last_action)
            + reward.spread * _squares(state.qpos[..., self._spread])
        )
        return np.where(self.fallen(state), 0.0, gain - cost)

    def _check_picture(self, robot: PolicyRobot, term: PictureTerm, where: str) -> None:
        camera = self._element("camera", term.camera, robot.cameras, f"{where}.camera")
        if camera.mode != term.mode:
            raise self._misfit(f"{where}.mode", f"{term.camera!r} shows {str(camera.mode)!r}, not {str(term.mode)!r}")
        if tuple(camera.resolution) != term.size:
            there, wanted = ("x".join(map(str, size)) for size in (camera.resolution, term.size))
            raise self._misfit(f"{where}.size", f"{term.camera!r} has {there} pixels, not {wanted}")

    def _term(self, robot: PolicyRobot, term: NumberTerm, where: str) -> tuple[int, _Read]:
        """Return the number of values of a term, and a function that reads them."""
        match term:
            case JointPosition() | JointVelocity():
                joints = self._joints(robot, term.joints, f"{where}.joints") or self.joints
                qpos, qvel = _offsets(joints)
                return len(joints), (
                    (lambda moment: moment.state.qpos[..., qpos])
                    if isinstance(term, JointPosition)
                    else (lambda moment: moment.state.qvel[..., qvel])
                )
            case SensorTerm():
                sensor = self._element("sensor", term.sensor, robot.sensors, f"{where}.sensor")
                return sensor.dim, lambda moment: moment.state.sensors[sensor.name]
            case FieldTerm() | GoalTerm():
                goal = isinstance(term, GoalTerm)
                return (
                    (len(self.default_goal), self._goal_term(robot, term, where)) if goal else _field(robot, term.field)
                )
            case PhaseClock():
                rate = 2 * math.pi * term.hz
                return 2, lambda moment: np.array([math.sin(rate * moment.time), math.cos(rate * moment.time)])
            case LastAction():
                return self.action_size, lambda moment: moment.last_action
            case _:
                if not self._has_base and not isinstance(term, CommandTerm):
                    raise self._misfit(where, f"needs a free base; {robot.prefix!r} has none")
                return _PLAIN[type(term)]

    def _goal_term(self, robot: PolicyRobot, term: GoalTerm, where: str) -> _Read:
        if not term.relative_to:
            return lambda moment: moment.goal
        where, size = f"{where}.relative_to", len(self.default_goal)
        sensor = self._element("sensor", term.relative_to, robot.sensors, where)
        if sensor.dim != size:
            raise self._misfit(where, f"{sensor.name!r} has {sensor.dim} numbers, the goal {size}")
        self._goal_sensor = self._goal_sensor or sensor.name
        return lambda moment: moment.goal - moment.state.sensors[sensor.name]

    def _joints(self, robot: PolicyRobot, names: Sequence[str], where: str) -> list[Joint]:
        found: list[Joint] = []
        for index, name in enumerate(names):
            joint = self._element("joint", name, robot.joints, f"{where}[{index}]")
            if joint.jnt_type not in _SCALAR_JOINTS:
                raise self._misfit(f"{where}[{index}]", f"{name!r} is neither a hinge nor a slide joint")
            found.append(joint)
        return found

    def _element(self, kind: str, name: str, known: Mapping[str, T], where: str) -> T:
        found = known.get(name)
        if found is None:
            there = ", ".join(known) or "none"
            raise self._misfit(where, f"{self._robot!r} has no {kind} {name!r}; it has {there}")
        return found

    def _misfit(self, where: str, problem: str) -> PolicyMismatch:
        return PolicyMismatch(f"{self._source}: {where}: {problem}.")


def _field(robot: PolicyRobot, name: str) -> tuple[int, _Read]:
    if name != "sensors":
        return len(getattr(RobotState.of(robot), name)), lambda moment: getattr(moment.state, name)
    dims = {sensor.name: sensor.dim for sensor in robot.sensors.values()}

    def read(moment: _Moment) -> Floats:
        return np.concatenate([moment.state.sensors[sensor] for sensor in dims], axis=-1)

    return sum(dims.values()), read


def _picture(term: PictureTerm) -> NDArray[Any]:
    width, height = term.size
    if term.mode is CameraMode.DEPTH:
        return np.empty((height, width), dtype=np.float32)
    return np.empty((height, width, 3 if term.mode is CameraMode.REAL else 4), dtype=np.uint8)


def _actuator(robot: PolicyRobot, joint: Joint, source: str) -> Actuator:
    found = [actuator for actuator in robot.actuators.values() if actuator.joint == joint.name]
    if len(found) != 1 or found[0].ctrl_local.stop - found[0].ctrl_local.start != 1:
        raise PolicyMismatch(
            f"{source}: action.joints: {len(found)} actuators of {robot.prefix!r} drive {joint.name!r}; "
            "it needs exactly one, with one input."
        )
    return found[0]


def _offsets(joints: Sequence[Joint]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of joints in `qpos_array` and in `qvel_array`."""
    return (
        np.array([joint.qpos_local_offset for joint in joints], dtype=np.intp),
        np.array([joint.qvel_local_offset for joint in joints], dtype=np.intp),
    )


def _array(value: Numbers) -> Floats:
    return np.asarray(value, dtype=np.float64)


def _squares(values: Floats) -> Floats:
    return np.sum(values**2, axis=-1)
