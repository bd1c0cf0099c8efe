"""Dynamic bodies of the scene: plain entities, and articulations with joints, actuators and sensors."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence, Sized
from typing import Any, TypeAlias

import numpy as np

from urlab_client.aio.arguments import finite, finite_array, mapping, require, text
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.controllers import URLabController, make_controller
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.model.articulation_state import MirroredArticulation, MirroredEntity
from urlab_client.aio.model.elements import Actuator, Body, Joint, Sensor, elements_of
from urlab_client.aio.model.mirror import require_local
from urlab_client.aio.session.control import CLAIM_S
from urlab_client.aio.session.session import Session
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.enums import ControlMode, OutOfRange
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.runtime import ClaimControl
from urlab_client.protocol.messages.session import ControllerInfo
from urlab_client.values.descriptions import ArticulationDescription, ControllerDescription, EntityDescription, Pose
from urlab_client.values.html import fields
from urlab_client.values.names import Local, NameMap
from urlab_client.values.rotation import rotate

Move: TypeAlias = Callable[["URLabArticulation", Mapping[str, float], float, float], Awaitable[float]]
"""See `URLabArticulation.move_to`."""

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_DOWN = np.array([0.0, 0.0, -1.0])


class URLabEntity(Local):
    """A dynamic body, or the root of an articulation.

    The state is that of the last reply. Each array is a fresh copy. To read several consistent values from a thread
    other than the one that steps, hold `client._data_lock`.
    """

    __slots__ = ()

    _state: MirroredEntity

    @property
    def name(self) -> str:
        """Key in `client.entities`."""
        return self._state.name

    @property
    def body_id(self) -> int:
        """Global MuJoCo id of the body (of the root body for an articulation, -1 without a local model)."""
        return self._state.body_id

    @property
    def has_free_base(self) -> bool:
        """True if the body or root body has a free joint; False for an articulation without a local model."""
        return self._state.has_free_base

    @property
    def free_joint(self) -> str | None:
        """Compiled name of the free joint, or None."""
        return self._state.free_joint

    @property
    def qpos_offset(self) -> int | None:
        """Start of the 7 free-joint positions in `client.data.qpos`, or None without a free joint."""
        return self._state.qpos_offset

    @property
    def qvel_offset(self) -> int | None:
        """Start of the 6 free-joint velocities in `client.data.qvel`, or None without a free joint."""
        return self._state.qvel_offset

    @property
    def root_pos_w(self) -> Floats:
        """Position of the body frame's origin, shape (3,), metres, world frame."""
        return self._pose()[0]

    @property
    def root_quat_w(self) -> Floats:
        """Orientation (w, x, y, z), shape (4,), world frame."""
        return self._pose()[1]

    @property
    def root_quat_xyzw(self) -> Floats:
        """Orientation (x, y, z, w) as SciPy and ROS order it, shape (4,), world frame."""
        return np.roll(self.root_quat_w, -1)

    @property
    def root_lin_vel_w(self) -> Floats:
        """Velocity of the body frame's origin, shape (3,), m/s, world frame."""
        with self._state.mirror.lock:
            qvel = self._state.root_qvel()
            return qvel[:3] if qvel is not None else self._derived_velocity()[3:]

    @property
    def root_lin_vel_b(self) -> Floats:
        """Velocity of the body frame's origin, shape (3,), m/s, body frame."""
        with self._state.mirror.lock:
            return _to_body(self.root_quat_w, self.root_lin_vel_w)

    @property
    def projected_gravity_b(self) -> Floats:
        """Unit vector in the direction of gravity, shape (3,), body frame; (0, 0, -1) when upright."""
        with self._state.mirror.lock:
            model = self._state.mirror.model
            gravity = _DOWN if model is None else model.opt.gravity
            strength = float(np.linalg.norm(gravity))
            return _to_body(self.root_quat_w, gravity / strength if strength > 0 else _DOWN)

    def apply_xfrc(self, *, force: Sequence[float] = (0, 0, 0), torque: Sequence[float] = (0, 0, 0)) -> None:
        """Buffer a wrench at the body's centre of mass for the next `step()`, which clears it.

        Inert in puppet mode, and in live mode, where the server ignores wrenches.

        Args:
            force: (fx, fy, fz), N, world frame.
            torque: (tx, ty, tz), N m, world frame.

        Raises:
            TypeError: A component is not a number.
            ValueError: A vector does not have three finite components.
        """
        self._state.apply_wrench(self._state.name, _wrench(force, torque))

    def _place(self) -> Pose | None:
        try:
            position, quaternion = self._pose()
        except URLabError:
            return None
        (x, y, z), (qw, qx, qy, qz) = position.tolist(), quaternion.tolist()
        return Pose(position=(x, y, z), quaternion=(qw, qx, qy, qz))

    def describe(self) -> EntityDescription | ArticulationDescription:
        """Return name, kind and pose as of the last reply, in a form that encodes directly to JSON."""
        return EntityDescription(name=self.name, free_base=self.has_free_base, pose=self._place())

    def _pose(self) -> tuple[Floats, Floats]:
        state = self._state
        with state.mirror.lock:
            qpos = state.root_qpos()
            if qpos is not None:
                return qpos[:3], qpos[3:7]
            if state.pose is not None:
                return np.array(state.pose.xpos), np.array(state.pose.xquat)
            derived = state.mirror.derived()
            _, data = require_local(derived, f"The pose of {self.name!r}, which joint positions determine,")
            return data.xpos[state.body_id].copy(), data.xquat[state.body_id].copy()

    def _derived_velocity(self) -> Floats:
        velocity = self._state.mirror.body_velocity(self._state.body_id)
        return require_local(velocity, f"The velocity of {self.name!r}, which joint velocities determine,")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r}>"

    def _repr_html_(self) -> str | None:
        return fields(repr(self)[1:-1], self.describe().to_dict())


class LocalArticulation(URLabEntity):
    """What both clients share of `URLabArticulation`: everything that sends nothing."""

    __slots__ = ()

    _state: MirroredArticulation  # pyright: ignore[reportIncompatibleVariableOverride]  # never assigned after construction

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name!r} {len(self.joints)} joints, {len(self.actuators)} actuators>"

    @property
    def prefix(self) -> str:
        """Articulation key."""
        return self._state.name

    @property
    def compiled_prefix(self) -> str:
        """Prefix of its compiled names, without the underscore: the key, or the engine's name of the actor."""
        return self._state.info.compiled_prefix

    @property
    def user(self) -> dict[str, Any]:
        """Values of the user channels that the level declares for it, by name; empty if the server has none."""
        return dict(self._state.user)

    @property
    def actor_id(self) -> str:
        """Stable id given when it was spawned; empty if none was given."""
        return self._state.info.actor_id

    @property
    def actuators(self) -> NameMap[Actuator]:
        """Actuators in id order."""
        return elements_of(self._state).actuators

    @property
    def joints(self) -> NameMap[Joint]:
        """Joints in id order."""
        return elements_of(self._state).joints

    @property
    def sensors(self) -> NameMap[Sensor]:
        """Sensors in id order."""
        return elements_of(self._state).sensors

    @property
    def bodies(self) -> NameMap[Body]:
        """Bodies in id order."""
        return elements_of(self._state).bodies

    @property
    def control_mode(self) -> ControlMode:
        """Whether the controller turns set-points into actuator signals. Assign it before `step()`.

        Raises:
            ValueError: On assigning anything but `ue_controller` or `raw`.
        """
        return self._state.control_mode

    @control_mode.setter
    def control_mode(self, mode: ControlMode | str) -> None:
        self._state.control_mode = ControlMode(mode)
        self._state.drive()

    @property
    def ctrl_array(self) -> Floats:
        """Set-points that the next step sends, shape (n_actuators,). A live view: write to it in place.

        Writing makes this client control the robot, and reading does not. Assigning to the property checks the values;
        `step()` refuses NaN and infinities that were written in place.

        Raises:
            TypeError: On assigning values that are not numbers.
            ValueError: On assigning NaN, infinities or the wrong number of values.
        """
        return self._state.set_points

    @ctrl_array.setter
    def ctrl_array(self, values: Sequence[float] | Floats) -> None:
        checked = finite_array(f"ctrl_array of {self.prefix!r}", values)
        self._state.drive()
        self._state.ctrl[:] = checked

    @property
    def last_applied_ctrl(self) -> Floats:
        """`mjData.ctrl` that the server applied last, after any controller, shape (n_actuators,)."""
        return self._state.applied.copy()

    @property
    def act_array(self) -> Floats:
        """Activation per actuator, shape (n_actuators,); 0 for stateless ones."""
        return self._state.act.copy()

    @property
    def qpos_array(self) -> Floats:
        """Joint positions, shape (nq,), in joint order: radians, metres, quaternions (w, x, y, z)."""
        return self._state.qpos.copy()

    @property
    def qvel_array(self) -> Floats:
        """Joint velocities, shape (nv,), in joint order: rad/s, m/s; a free base's linear in world, angular in body."""
        return self._state.qvel.copy()

    @property
    def dof_qpos(self) -> Floats:
        """Joint positions without the free base, shape (nq,) or (nq - 7,)."""
        return self._state.qpos[7 if self.has_free_base else 0 :].copy()

    @property
    def dof_qvel(self) -> Floats:
        """Joint velocities without the free base, shape (nv,) or (nv - 6,)."""
        return self._state.qvel[6 if self.has_free_base else 0 :].copy()

    @property
    def twist_linear(self) -> Floats:
        """Commanded linear velocity, shape (3,), m/s, base frame (ROS Twist)."""
        twist = self._state.twist
        return np.zeros(3) if twist is None else np.array(twist.linear)

    @property
    def twist_angular(self) -> Floats:
        """Commanded angular velocity, shape (3,), rad/s, base frame (ROS Twist)."""
        twist = self._state.twist
        return np.zeros(3) if twist is None else np.array(twist.angular)

    @property
    def root_ang_vel_w(self) -> Floats:
        """Angular velocity of the root, shape (3,), rad/s, world frame."""
        with self._state.mirror.lock:
            qvel = self._state.root_qvel()
            return _to_world(self.root_quat_w, qvel[3:6]) if qvel is not None else self._derived_velocity()[:3]

    @property
    def root_ang_vel_b(self) -> Floats:
        """Angular velocity of the root, shape (3,), rad/s, body frame (as MuJoCo stores it)."""
        with self._state.mirror.lock:
            qvel = self._state.root_qvel()
            return qvel[3:6] if qvel is not None else _to_body(self.root_quat_w, self.root_ang_vel_w)

    def set_ctrl(self, values: Mapping[str, float], *, out_of_range: str | OutOfRange = "allow") -> None:
        """Set some set-points by actuator name; the others keep their last value.

        Args:
            values: Actuator name to set-point; the first input of an actuator with several.
            out_of_range: Handling of a value outside its actuator's range; see `Actuator.set_control`.

        Raises:
            KeyError: A name is unknown; nothing was set.
            TypeError: A value is not a number; nothing was set.
            ValueError: A value is NaN or infinite or, with `error`, out of range; nothing was set.
        """
        rule = OutOfRange(out_of_range)
        given = mapping("set_ctrl", values, "actuator names to numbers")
        found = [(self.actuators[name], value) for name, value in given.items()]
        checked = [actuator.checked(value, rule) for actuator, value in found]
        if checked:
            self._state.drive()
        for where, value in checked:
            self._state.ctrl[where] = value

    def get_ctrl(self) -> dict[str, float]:
        """Return the set-points that the next step sends, by actuator name."""
        return {name: actuator.value for name, actuator in self.actuators.items()}

    def get_qpos(self) -> dict[str, float]:
        """Return the first component of each joint's position, by joint name."""
        values = self._state.qpos.tolist()
        return {name: values[joint.qpos_local_offset] for name, joint in self.joints.items()}

    def get_sensors(self) -> dict[str, Floats]:
        """Return the last readings by sensor name, each a fresh array of shape (dim,)."""
        return {name: np.asarray(reading) for name, reading in self._state.sensors.items()}

    def resolve_joint(self, name: str) -> str | None:
        """Return the live key of a joint for its live, compiled or original MJCF name, or None."""
        joint = self.joints.get(name)
        return None if joint is None else joint.name

    def resolve_actuator(self, name: str) -> str | None:
        """Return the live key of an actuator for its live, compiled or original MJCF name, or None."""
        actuator = self.actuators.get(name)
        return None if actuator is None else actuator.name

    def apply_xfrc(
        self, body: str = "", *, force: Sequence[float] = (0, 0, 0), torque: Sequence[float] = (0, 0, 0)
    ) -> None:
        """Buffer a wrench on one of its bodies for the next `step()`, which clears it.

        The wrench acts at the body's centre of mass during all sub-steps. Inert in puppet mode, and in live mode, where
        the server ignores wrenches.

        Args:
            body: Short body name; the root body if empty.
            force: (fx, fy, fz), N, world frame.
            torque: (tx, ty, tz), N m, world frame.

        Raises:
            KeyError: The articulation has no such body.
            TypeError: A component is not a number.
            ValueError: A vector does not have three finite components, or `body` is empty and the root is not known.
        """
        bodies = self.bodies
        if body and bodies:
            body = bodies[text("apply_xfrc: body", body)].name
        elif not body:
            body = next((name for name, handle in bodies.items() if handle.id == self.body_id), "")
        if not body:
            raise ValueError(f"{self.prefix}: the root body is not known without a local model; name the body")
        self._state.apply_wrench(body, _wrench(force, torque))
        self._state.drive()


def compiled_prefixes(robots: NameMap[Any]) -> NameMap[str]:
    """Return the `compiled_prefix` of each articulation, to look up elements of the compiled model."""
    return robots.over({key: robot.compiled_prefix for key, robot in robots.items()})


class URLabArticulation(LocalArticulation):
    """A robot imported from MJCF.

    Dictionaries are keyed by short names, without the articulation's prefix. Lookups also accept compiled names and
    original MJCF names. Without a local model only actuators and cameras are known.
    """

    def __init__(self, record: MirroredArticulation, session: Session, publishers: Publishers, move: Move) -> None:
        super().__init__(record)
        self._session = session
        self._publishers = publishers
        self._move = move
        self._controller: tuple[ControllerInfo, URLabController] | None = None
        self._cameras: NameMap[URLabCameraView] = NameMap()

    @property
    def cameras(self) -> NameMap[URLabCameraView]:
        """Cameras by name."""
        topics = {name.removeprefix(f"{self.prefix}/"): info for name, info in self._state.info.camera_topics.items()}
        if any(name not in self._cameras or self._cameras[name].info is not info for name, info in topics.items()):
            views = {
                name: self._cameras.get(name) or URLabCameraView(name, info, self._publishers)
                for name, info in topics.items()
            }
            for name, info in topics.items():
                views[name].camera.info = info
            self._cameras = NameMap(views, kind="camera", owner=self.prefix)
        return self._cameras

    @property
    def controller(self) -> URLabController | None:
        """The controller, or None if the set-points go directly to the actuators."""
        info = self._state.controller
        if info is None:
            return None
        if self._controller is None or self._controller[0] is not info:
            self._controller = info, make_controller(self._session, self.prefix, info)
        return self._controller[1]

    def describe(self) -> ArticulationDescription:
        """Return its parts, state and set-points as of the last reply.

        `to_dict()` and `to_json()` of the result return plain data.
        """
        controller = self._state.controller
        with self._state.mirror.lock:
            return ArticulationDescription(
                name=self.prefix,
                actor_id=self.actor_id,
                free_base=self.has_free_base,
                pose=self._place(),
                joints=[joint.describe() for joint in self.joints.values()],
                actuators=[actuator.describe() for actuator in self.actuators.values()],
                sensors=[sensor.describe() for sensor in self.sensors.values()],
                cameras=[camera.describe() for camera in self.cameras.values()],
                controller=None
                if controller is None
                else ControllerDescription(
                    kind=controller.kind, in_force=self.control_mode is ControlMode.UE_CONTROLLER
                ),
                control_owner=self.control_owner,
            )

    async def move_to(self, targets: Mapping[str, float], *, tolerance: float = 0.01, timeout: float = 10.0) -> float:
        """Move joints to positions with their position servos, and return when they have settled.

        Sets the set-points immediately, without an intermediate path, and then steps in `direct` and `puppet` or waits
        in `live`. A joint has settled when it is within the tolerance and so slow that it would stay there for 0.1 s.
        Other set-points do not change, and the new ones stay in force afterwards.

        Args:
            targets: Joint name to position, radians or metres.
            tolerance: Largest distance of a joint from its target, in the unit of the joint.
            timeout: Seconds of simulation time after which to give up.

        Returns:
            Simulation time that passed, seconds.

        Raises:
            NotSettled: The joints did not settle in time; `.remaining` has the remaining distance of each joint, and
                the message contains the findings of `explain()`. A servo that works against gravity may need a larger
                tolerance.
            KeyError: The articulation has no such joint; nothing was set.
            ValueError: A target is not finite or outside the range of its joint or actuator, or the joint has no
                position servo; nothing was set.
            URLabTimeoutError: Simulation time does not advance, for example while paused in live mode.
        """
        return await self._move(self, targets, tolerance, timeout)

    async def claim(self, *, force: bool = False, ttl: float = CLAIM_S, timeout: Timeout = DEFAULT) -> None:
        """Become the only client that controls the articulation, before the first write does so automatically.

        The client renews the claim until `release()` or `close()`. Does nothing on a server whose robots have no owner.

        Args:
            force: Take the articulation from the client that controls it; the next write of that client is refused.
            ttl: Seconds after which the claim expires if this process has died; 0 for never.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            ControlClaimed: Another client controls the articulation; `.owner` names that client.
            ValueError: `ttl` is negative or not a number.
        """
        if finite("claim: ttl", ttl) < 0:
            raise ValueError(f"claim: ttl takes 0 seconds or more, got {ttl}.")
        if self._session.features.claims:
            request = ClaimControl(articulation=self.prefix, ttl_s=ttl, force=force)
            await self._session.call(request, timeout=timeout)
        self._state.drive()

    async def release(self, *, timeout: Timeout = DEFAULT) -> None:
        """Let other clients control the articulation. The next write claims it again.

        Args:
            timeout: Seconds to wait; None waits without limit.
        """
        self._state.leave()
        await self._session.control.release(self.prefix, timeout=timeout)

    @property
    def control_owner(self) -> str | None:
        """The client that controls it: `HOST/PROCESS/…` for this process, otherwise the name of the other client.

        None if no client controls it, if the owner is not known, and on servers whose robots have no owner.
        """
        return self._session.control.owner_of(self.prefix)


def _wrench(force: Sequence[float], torque: Sequence[float]) -> list[float]:
    values: list[float] = []
    for what, vector in (("force", force), ("torque", torque)):
        require(f"apply_xfrc: {what}", vector, Sized, "3 numbers")
        if len(vector) != 3:
            raise ValueError(f"apply_xfrc: {what} takes 3 numbers, got {len(vector)}.")
        values += [finite(f"apply_xfrc: {what}[{i}]", v) for i, v in enumerate(vector)]
    return values


def _to_world(quat: Floats, vector: Floats) -> Floats:
    """Rotate a vector from the body frame into the world frame; `quat` is (w, x, y, z)."""
    w, x, y, z = quat.tolist()
    a, b, c = vector.tolist()
    return np.array(rotate((x, y, z, w), (a, b, c)))


def _to_body(quat: Floats, vector: Floats) -> Floats:
    """Rotate a vector from the world frame into the body frame; `quat` is (w, x, y, z)."""
    return _to_world(quat * _CONJUGATE, vector)
