"""State rows: one joint, sensor, free base, twist, action or entity each. No I/O.

For the streams of the client (which decodes) and for the simulated server (which encodes). Each layout goes both
ways. Decoded arrays are the caller's own and never alias the received buffer. `decode` raises `ProtocolError` for
anything but the exact layout; `encode` raises `ValueError` for arrays of the wrong shape.

The msgpack snapshot `state/full` is not a row: see `codec`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from struct import Struct as Layout
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.protocol.topics import SCENE_SIZES, StreamTopic, TopicKind
from urlab_client.values.layouts import INT32, BytesLike, check_size, damaged, floats32, vector
from urlab_client.values.plain import Serializable

_JOINT = Layout("<ifff")
_SENSOR = Layout("<ii")
_TWIST = Layout("<fff")


class JointRow(Serializable, Struct, frozen=True):
    """State of a hinge or slide joint. Of a ball joint it carries only the first components.

    Attributes:
        id: MuJoCo joint id; negative for a component that is not in the compiled model, whose row is to be dropped.
        position: `qpos` of the joint, radians or metres.
        velocity: `qvel` of the joint, per second.
        acceleration: `qacc` of the joint, per second squared; NaN where the server does not tell it.
    """

    id: int
    position: float
    velocity: float
    acceleration: float

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> JointRow:
        """Read a row; `where` names its source in errors."""
        check_size("joint row", where, payload, _JOINT.size)
        return cls(*_JOINT.unpack(payload))

    def encode(self) -> bytes:
        """Return the 16 bytes of the row."""
        try:
            return _JOINT.pack(self.id, self.position, self.velocity, self.acceleration)
        except OverflowError:
            return INT32.pack(self.id) + floats32([self.position, self.velocity, self.acceleration]).tobytes()


class BaseStateRow(Serializable, Struct, frozen=True, eq=False):
    """State of a free joint.

    Attributes:
        position: Shape (3,), metres, world frame.
        quat_xyzw: Shape (4,), unit quaternion (x, y, z, w), world frame.
        linear_velocity: Shape (3,), metres per second, world axes.
        angular_velocity: Shape (3,), radians per second, body axes as in MuJoCo's free joint.
    """

    position: NDArray[np.float32]
    quat_xyzw: NDArray[np.float32]
    linear_velocity: NDArray[np.float32]
    angular_velocity: NDArray[np.float32]

    @classmethod
    def from_free_joint(cls, qpos: NDArray[np.float64], qvel: NDArray[np.float64]) -> BaseStateRow:
        """Make the row from the free joint's `qpos`, shape (7,) with quaternion (w, x, y, z), and `qvel`, (6,)."""
        pose, velocity = vector("qpos", np.asarray(qpos), 7), vector("qvel", np.asarray(qvel), 6)
        values = floats32(np.concatenate((pose[:3], pose[4:], pose[3:4], velocity)))
        return cls(values[:3], values[3:7], values[7:10], values[10:])

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> BaseStateRow:
        """Read a row; `where` names its source in errors."""
        check_size("base state row", where, payload, 52)
        values = np.frombuffer(payload, "<f4").copy()
        return cls(values[:3], values[3:7], values[7:10], values[10:])

    def encode(self) -> bytes:
        """Return the 52 bytes of the row."""
        parts = (
            vector("position", np.asarray(self.position), 3),
            vector("quat_xyzw", np.asarray(self.quat_xyzw), 4),
            vector("linear_velocity", np.asarray(self.linear_velocity), 3),
            vector("angular_velocity", np.asarray(self.angular_velocity), 3),
        )
        return floats32(np.concatenate(parts)).tobytes()


class SensorRow(Serializable, Struct, frozen=True, eq=False):
    """Reading of one sensor.

    Attributes:
        id: MuJoCo sensor id; negative for a component that is not in the compiled model, whose row is to be dropped.
        values: Shape (dim,), raw `sensordata`: MuJoCo's frame and units, quaternions (w, x, y, z).
    """

    id: int
    values: NDArray[np.float32]

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> SensorRow:
        """Read a row; `where` names its source in errors."""
        if len(payload) < _SENSOR.size:
            raise damaged("sensor row", where, f"{len(payload)} bytes, expected 8 + 4*dim", payload)
        sensor_id, dim = _SENSOR.unpack_from(payload)
        if dim < 0:
            raise damaged("sensor row", where, f"dim is {dim}, expected 0 or more", payload)
        expected = _SENSOR.size + 4 * dim
        if len(payload) != expected:
            problem = f"{len(payload)} bytes, expected {expected} (8 + 4*dim with dim {dim})"
            raise damaged("sensor row", where, problem, payload)
        return cls(sensor_id, np.frombuffer(payload, "<f4", offset=_SENSOR.size).copy())

    def encode(self) -> bytes:
        """Return the 8 + 4*dim bytes of the row."""
        values = floats32(self.values)
        return _SENSOR.pack(self.id, values.size) + vector("values", values, values.size).tobytes()


class TwistRow(Serializable, Struct, frozen=True):
    """The twist commanded to an articulation by keyboard or `set_twist`, not a measurement.

    Attributes:
        vx: Forward, metres per second.
        vy: Left, metres per second.
        yaw_rate: Counter-clockwise, radians per second.
    """

    vx: float
    vy: float
    yaw_rate: float

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> TwistRow:
        """Read a row; `where` names its source in errors."""
        check_size("twist row", where, payload, _TWIST.size)
        return cls(*_TWIST.unpack(payload))

    def encode(self) -> bytes:
        """Return the 12 bytes of the row."""
        return floats32([self.vx, self.vy, self.yaw_rate]).tobytes()


class ActionsRow(Serializable, Struct, frozen=True):
    """Action keys held down. Sent only on ticks with at least one: a tick without the row means none.

    Attributes:
        mask: Bit i is set while key i (0 to 9) is down.
    """

    mask: int

    @property
    def bits(self) -> tuple[int, ...]:
        """Numbers of the keys that are down, ascending."""
        return tuple(bit for bit in range(32) if self.mask >> bit & 1)

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> ActionsRow:
        """Read a row; `where` names its source in errors."""
        check_size("actions row", where, payload, INT32.size)
        return cls(*INT32.unpack(payload))

    def encode(self) -> bytes:
        """Return the 4 bytes of the row."""
        return INT32.pack(self.mask)


class SceneRow(Serializable, Struct, frozen=True, eq=False):
    """One quantity of a body that belongs to no articulation, in MuJoCo's order and precision.

    Attributes:
        quantity: `XPOS`, `XQUAT`, `QPOS` or `QVEL`; the last two only for bodies with a free joint.
        values: Shape (3,), (4,), (7,) or (6,): metres, quaternions (w, x, y, z), metres and radians per second with
            the angular part in body axes.
    """

    quantity: TopicKind
    values: NDArray[np.float64]

    @classmethod
    def decode(cls, quantity: TopicKind, payload: BytesLike, where: object = "") -> SceneRow:
        """Read a row; `where` names its source in errors."""
        check_size(f"scene {quantity} row", where, payload, 8 * SCENE_SIZES[quantity])
        return cls(quantity, np.frombuffer(payload, "<f8").copy())

    def encode(self) -> bytes:
        """Return the bytes of the row, 8 per value."""
        return vector(self.quantity, np.asarray(self.values, dtype="<f8"), SCENE_SIZES[self.quantity]).tobytes()


Row: TypeAlias = JointRow | BaseStateRow | SensorRow | TwistRow | ActionsRow | SceneRow

_ROWS: Mapping[TopicKind, Callable[[BytesLike, object], Row]] = {
    TopicKind.JOINT: JointRow.decode,
    TopicKind.BASE_STATE: BaseStateRow.decode,
    TopicKind.SENSOR: SensorRow.decode,
    TopicKind.TWIST: TwistRow.decode,
    TopicKind.ACTIONS: ActionsRow.decode,
}


def decode_row(topic: StreamTopic, payload: BytesLike) -> Row:
    """Read the row that belongs to a topic of the state socket.

    Raises:
        ProtocolError: If the payload does not have the row's exact layout, or the topic carries no row.
    """
    if topic.kind in SCENE_SIZES:
        return SceneRow.decode(topic.kind, payload, topic)
    decode = _ROWS.get(topic.kind)
    if decode is None:
        raise damaged("state row", topic, f"a {topic.kind} topic carries none", payload)
    return decode(payload, topic)
