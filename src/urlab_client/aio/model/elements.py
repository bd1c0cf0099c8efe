"""Handles to the elements of an articulation: plain local objects that both flavours of the client share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from urlab_client._mujoco import (
    QPOS_WIDTH,
    QVEL_WIDTH,
    acting_kind,
    control_counts,
    control_starts,
    force_counts,
    servo_damping,
)
from urlab_client.aio.arguments import finite, finite_array, is_array
from urlab_client.aio.model.articulation_state import MirroredArticulation
from urlab_client.aio.model.layout import (
    JOINT_KINDS,
    JOINT_TRANSMISSIONS,
    joint_unit,
    sensor_kind,
    sensor_unit,
    set_point_meaning,
)
from urlab_client.enums import ActuatorType, OutOfRange, known
from urlab_client.protocol.base import Floats
from urlab_client.values.descriptions import (
    ActuatorDescription,
    JointDescription,
    JointKind,
    SensorDescription,
    SetPointMeaning,
)
from urlab_client.values.html import fields
from urlab_client.values.names import NameMap, PublicDir, own_aliases
from urlab_client.values.plain import Serializable

if TYPE_CHECKING:
    import mujoco

_UNSPECIFIC = {"motor", "general"}  # what servers report for a `<general>`


class _Described(Protocol):
    def describe(self) -> Serializable: ...


class _Element(PublicDir):
    """An element that a notebook shows as its description."""

    __slots__ = ()

    def _repr_html_(self: _Described) -> str:
        return fields(repr(self)[1:-1], self.describe().to_dict())


@dataclass(slots=True, eq=False, repr=False, kw_only=True)
class Actuator(_Element):
    """One actuator of an articulation.

    Attributes:
        name: Short name, without the articulation's prefix.
        id: Global MuJoCo actuator id.
        type: Kind as authored. For a `<general>`, the kind with the same gain and bias, so an affine one is a servo. A
            plain string if this client does not know the kind that the server names; None if unknown.
        joint: Short name of the driven joint, or None for other transmissions.
        ctrlrange: (low, high) of the control, or None if unlimited.
        forcerange: (low, high) of the force, or None if unlimited.
        kp: `gainprm[0]`, or None without a local model.
        kv: Damping of a servo, `-biasprm[2]`; `gainprm[1]` of other actuators; None without a local model.
        ctrl_local: Slice of the articulation's `ctrl_array` that holds its inputs; length 1 for ordinary actuators.
    """

    _record: MirroredArticulation = field(kw_only=False)
    name: str
    id: int
    type: ActuatorType | str | None
    ctrl_local: slice
    _first_out: int
    joint: str | None = None
    ctrlrange: tuple[float, float] | None = None
    forcerange: tuple[float, float] | None = None
    kp: float | None = None
    kv: float | None = None

    @property
    def force(self) -> float | None:
        """Force in N or N m from the last reply; the first output of an actuator with several.

        None below observation level `full`, or if the outputs cannot be assigned to actuators without a local model.
        """
        force = self._record.force
        if force is None or (self.id < 0 and len(force) != len(self._record.ctrl)):
            return None
        return float(force[self._first_out])

    @property
    def value(self) -> float:
        """The set-point (first input) that the next step sends."""
        return float(self._record.ctrl[self.ctrl_local.start])

    def set_control(self, v: float | Sequence[float] | Floats, *, out_of_range: str | OutOfRange = "allow") -> None:
        """Set the set-point that the next step sends.

        Args:
            v: The set-point. For an actuator with several inputs, a number sets the first input, which `value`
                returns, and leaves the others unchanged; a sequence sets all of them.
            out_of_range: What to do with a value outside the actuator's range: `error` rejects it, `clamp` uses the
                nearest value in range, `allow` sends it unchanged. The range is the control range or, while a PD
                controller is active, the range of the driven joint. Without a local model no range is known.

        Raises:
            TypeError: The value is not a number.
            ValueError: The value is NaN or infinite, the sequence does not have one number per input, or, with
                `error`, the value is out of range. Nothing was set.
        """
        where, value = self.checked(v, OutOfRange(out_of_range))
        self._record.drive()
        self._record.ctrl[where] = value

    def checked(self, v: object, out_of_range: OutOfRange) -> tuple[slice, float | Floats]:
        """Return the slice and value that `set_control` would set; raise the same errors."""
        what = f"actuator {self.name!r} of {self._record.name!r}"
        where = self.ctrl_local
        value: float | Floats
        if is_array(v):
            value = finite_array(what, v)
            inputs = where.stop - where.start
            if value.shape != (inputs,):
                raise ValueError(
                    f"{what} takes {inputs} numbers, got an array of shape {value.shape}. Nothing was set."
                )
        else:
            value = finite(what, v)
            where = slice(where.start, where.start + 1)
        if out_of_range is OutOfRange.ALLOW:
            return where, value
        low, high = (bounds[where] for bounds in self._record.ranges())
        inside = np.clip(value, low, high)
        if out_of_range is OutOfRange.ERROR and np.any(inside != value):
            raise ValueError(f"{what} takes {_listed(low)} to {_listed(high)}, got {v}. Nothing was set.")
        return where, inside

    def set_point_for(self, position: float) -> float:
        """Return the set-point with which a position servo holds its joint at a position if no other force acts.

        Args:
            position: Position in the joint's unit, radians or metres.

        Raises:
            ValueError: The actuator is not a position servo, or there is no local model.
        """
        record, model = self._record, self._record.mirror.model
        position = finite("set_point_for", position)
        if record.takes_positions:
            return position
        if model is None or set_point_meaning(model, self.id)[0] != "position":
            raise ValueError(f"actuator {self.name!r} of {record.name!r} is not known to be a position servo.")
        gain, bias = float(model.actuator_gainprm[self.id][0]), float(model.actuator_biasprm[self.id][1])
        return position * float(model.actuator_gear[self.id][0]) * (-bias / gain if gain else 1.0)

    def describe(self) -> ActuatorDescription:
        """Return a description of the actuator and its set-point."""
        record, model = self._record, self._record.mirror.model
        takes: SetPointMeaning = ""
        unit = ""
        if model is not None:
            takes, unit = set_point_meaning(model, self.id)
        if record.takes_positions:
            takes, unit = "position", "" if model is None or self.joint is None else _unit_of(record, model, self.joint)
        low, high = (float(bounds[self.ctrl_local.start]) for bounds in record.ranges())
        return ActuatorDescription(
            name=self.name,
            kind=None if self.type is None else str(self.type),
            joint=self.joint,
            takes=takes,
            unit=unit,
            limits=(low, high) if np.isfinite((low, high)).all() else None,
            force_limits=self.forcerange,
            gear=float(model.actuator_gear[self.id][0]) if model is not None and self.joint else None,
            set_point=self.value,
        )

    def __repr__(self) -> str:
        return f"<Actuator {self.name!r}{f' {self.type}' if self.type else ''} id={self.id}>"


@dataclass(slots=True, eq=False, repr=False, kw_only=True)
class Joint(_Element):
    """One joint of an articulation.

    Attributes:
        name: Short name, without the articulation's prefix.
        id: Global MuJoCo joint id.
        jnt_type: 0 free, 1 ball, 2 slide, 3 hinge.
        qpos_offset: Start in `client.data.qpos`.
        qpos_local_offset: Start in the articulation's `qpos_array`.
        qvel_offset: Start in `client.data.qvel`.
        qvel_local_offset: Start in the articulation's `qvel_array`.
        range: (low, high) in radians or metres, or None if unlimited.
    """

    _record: MirroredArticulation = field(kw_only=False)
    name: str
    id: int
    jnt_type: int
    qpos_offset: int
    qpos_local_offset: int
    qvel_offset: int
    qvel_local_offset: int
    range: tuple[float, float] | None

    @property
    def kind(self) -> JointKind:
        """`hinge`, `slide`, `ball` or `free`."""
        return JOINT_KINDS[self.jnt_type]

    @property
    def unit(self) -> str:
        """Unit of the position, `rad` or `m`; empty if it is not a single number. Velocities are per second."""
        return joint_unit(self.kind)

    @property
    def limits(self) -> tuple[float, float] | None:
        """(low, high) in the joint's unit, or None if unlimited; the same as `range`."""
        return self.range

    @property
    def position(self) -> float | Floats:
        """Position in the joint's unit, from the last reply; a number for a `ScalarJoint`.

        A ball joint has a quaternion (w, x, y, z), shape (4,). A free joint has (x, y, z) in metres followed by the
        quaternion, shape (7,). Arrays are fresh copies.
        """
        start = self.qpos_local_offset
        return self._record.qpos[start : start + int(QPOS_WIDTH[self.jnt_type])].copy()

    @property
    def velocity(self) -> float | Floats:
        """Velocity in the joint's unit per second, from the last reply; a number for a `ScalarJoint`.

        A ball joint has an angular velocity in the body frame, shape (3,). A free joint has a linear velocity in the
        world frame followed by an angular velocity in the body frame, shape (6,). Arrays are fresh copies.
        """
        start = self.qvel_local_offset
        return self._record.qvel[start : start + int(QVEL_WIDTH[self.jnt_type])].copy()

    def describe(self) -> JointDescription:
        """Return a description of the joint with its position and velocity."""
        return JointDescription(
            name=self.name,
            kind=self.kind,
            unit=self.unit,
            limits=self.limits,
            position=np.asarray(self.position).tolist(),
            velocity=np.asarray(self.velocity).tolist(),
        )

    def __repr__(self) -> str:
        return f"<Joint {self.name!r} {self.kind} id={self.id}>"


class ScalarJoint(Joint):
    """A hinge or slide joint, whose position and velocity are single numbers.

    Type checkers know that after `isinstance(joint, ScalarJoint)`.
    """

    __slots__ = ()

    @property
    def position(self) -> float:
        """Position in the joint's unit, from the last reply."""
        return float(self._record.qpos[self.qpos_local_offset])

    @property
    def velocity(self) -> float:
        """Velocity in the joint's unit per second, from the last reply."""
        return float(self._record.qvel[self.qvel_local_offset])


@dataclass(slots=True, eq=False, repr=False, kw_only=True)
class Sensor(_Element):
    """One sensor of an articulation.

    Attributes:
        name: Short name, without the articulation's prefix.
        id: Global MuJoCo sensor id; -1 without a local model.
        dim: Length of the reading.
    """

    _record: MirroredArticulation = field(kw_only=False)
    name: str
    id: int
    dim: int

    @property
    def latest(self) -> Floats | None:
        """Reading from the last reply as a fresh array, shape (dim,), in the sensor's own unit and frame; or None."""
        reading = self._record.sensors.get(self.name)
        return None if reading is None else np.asarray(reading, dtype=np.float64)

    @property
    def kind(self) -> str:
        """MJCF element, such as `accelerometer` or `framepos`; empty without a local model."""
        model = self._record.mirror.model
        return "" if model is None else sensor_kind(model, self.id)

    @property
    def unit(self) -> str:
        """Unit of the reading; empty for directions, quaternions and sensors of unknown meaning."""
        model = self._record.mirror.model
        return "" if model is None else sensor_unit(model, self.id)

    def describe(self) -> SensorDescription:
        """Return a description of the sensor and its reading."""
        reading = self._record.sensors.get(self.name)
        return SensorDescription(
            name=self.name,
            kind=self.kind,
            unit=self.unit,
            dim=self.dim,
            reading=None if reading is None else [*map(float, reading)],
        )

    def __repr__(self) -> str:
        return f"<Sensor {self.name!r}{f' {self.kind}' if self.kind else ''} id={self.id} dim={self.dim}>"


@dataclass(slots=True, eq=False, repr=False, kw_only=True)
class Body(PublicDir):
    """One body of an articulation.

    Attributes:
        name: Short name, without the articulation's prefix.
        id: Global MuJoCo body id.
    """

    _record: MirroredArticulation = field(kw_only=False)
    name: str
    id: int

    @property
    def xpos(self) -> Floats | None:
        """World position in metres as a fresh array, shape (3,); None without a local model below level `full`."""
        pose = self._record.body_pose(self.name, self.id)
        return None if pose is None else pose[0]

    @property
    def xquat(self) -> Floats | None:
        """World orientation (w, x, y, z), a fresh array, shape (4,); None without a local model below level `full`."""
        pose = self._record.body_pose(self.name, self.id)
        return None if pose is None else pose[1]

    def __repr__(self) -> str:
        return f"<Body {self.name!r} id={self.id}>"


@dataclass(frozen=True, slots=True)
class ArticulationElements:
    """All handles of one articulation, created from one model."""

    joints: NameMap[Joint]
    actuators: NameMap[Actuator]
    sensors: NameMap[Sensor]
    bodies: NameMap[Body]


def elements_of(record: MirroredArticulation) -> ArticulationElements:
    """Return the handles of an articulation. Without a local model, only names and types of its actuators are known."""
    if record.elements is not None:
        return record.elements
    model, layout, original = record.mirror.model, record.layout, record.info.original_names
    bodies = [Body(record, name=name, id=i) for name, i in layout.bodies.items()]
    record.elements = ArticulationElements(
        joints=_named(record, "joint", _joints(record, model), original.joints),
        actuators=_named(record, "actuator", _actuators(record, model), original.actuators),
        sensors=_named(record, "sensor", _sensors(record, model), original.sensors),
        bodies=_named(record, "body", bodies, original.bodies),
    )
    return record.elements


H = TypeVar("H", Actuator, Joint, Sensor, Body)


def _named(record: MirroredArticulation, kind: str, items: Sequence[H], original: Mapping[str, str]) -> NameMap[H]:
    by_name: dict[str, H] = {item.name: item for item in items}
    aliases = own_aliases([*by_name], record.info.compiled_prefix, record.mirror.prefixes)
    for live, authored in original.items():
        if live in by_name:
            aliases.setdefault(authored, []).append(live)
    return NameMap(by_name, aliases, kind=kind, owner=record.name)


def _joints(record: MirroredArticulation, model: mujoco.MjModel | None) -> list[Joint]:
    if model is None:
        return []
    joints: list[Joint] = []
    qpos_local = qvel_local = 0
    for name, i in record.layout.joints.items():
        kind = int(model.jnt_type[i])
        joints.append(
            (ScalarJoint if QPOS_WIDTH[kind] == 1 else Joint)(
                record,
                name=name,
                id=i,
                jnt_type=kind,
                qpos_offset=int(model.jnt_qposadr[i]),
                qpos_local_offset=qpos_local,
                qvel_offset=int(model.jnt_dofadr[i]),
                qvel_local_offset=qvel_local,
                range=_interval(model.jnt_range[i]) if model.jnt_limited[i] else None,
            )
        )
        qpos_local += int(QPOS_WIDTH[kind])
        qvel_local += int(QVEL_WIDTH[kind])
    return joints


def _actuators(record: MirroredArticulation, model: mujoco.MjModel | None) -> list[Actuator]:
    types = record.info.actuator_types
    if model is None:
        return [
            Actuator(record, name=name, id=-1, type=known(ActuatorType, kind), ctrl_local=slice(i, i + 1), _first_out=i)
            for i, (name, kind) in enumerate(types.items())
        ]
    joint_of = {joint_id: name for name, joint_id in record.layout.joints.items()}
    actuators: list[Actuator] = []
    start = first_out = 0
    controls, starts, forces = control_counts(model), control_starts(model), force_counts(model)
    for name, i in record.layout.actuators.items():
        kind = types.get(name)
        if kind in _UNSPECIFIC:
            kind = acting_kind(model, i)
        driven = int(model.actuator_trnid[i][0]) if model.actuator_trntype[i] in JOINT_TRANSMISSIONS else -1
        width, first = int(controls[i]), int(starts[i])
        actuators.append(
            Actuator(
                record,
                name=name,
                id=i,
                type=None if kind is None else known(ActuatorType, kind),
                ctrl_local=slice(start, start + width),
                _first_out=first_out,
                joint=joint_of.get(driven),
                ctrlrange=_interval(model.actuator_ctrlrange[first]) if model.actuator_ctrllimited[first] else None,
                forcerange=_interval(model.actuator_forcerange[i]) if model.actuator_forcelimited[i] else None,
                kp=float(model.actuator_gainprm[i][0]),
                kv=servo_damping(model, i),
            )
        )
        start += width
        first_out += int(forces[i])
    return actuators


def _sensors(record: MirroredArticulation, model: mujoco.MjModel | None) -> list[Sensor]:
    if model is None:
        return []
    return [Sensor(record, name=name, id=i, dim=int(model.sensor_dim[i])) for name, i in record.layout.sensors.items()]


def _unit_of(record: MirroredArticulation, model: mujoco.MjModel, joint: str) -> str:
    return joint_unit(JOINT_KINDS[int(model.jnt_type[record.layout.joints[joint]])])


def _interval(bounds: Floats) -> tuple[float, float]:
    return float(bounds[0]), float(bounds[1])


def _listed(bounds: Floats) -> str:
    return ", ".join(f"{bound:g}" for bound in bounds)
