"""Messages of the publish/subscribe sockets: topics, state rows, streamed control, camera pixels. No I/O.

For the streams of the client (which decodes) and for the simulated server (which encodes). Each layout goes both
ways. Numbers are little-endian; decoded arrays are the caller's own and never alias the received buffer. `decode`
raises `ProtocolError` for anything but the exact layout; `encode` raises `ValueError` for arrays of the wrong shape.

The msgpack snapshot `state/full` is not a row: see `codec`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import lru_cache
from struct import Struct as Layout
from typing import TypeAlias, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import ProtocolError

__all__ = [
    "STATE_FULL",
    "ActionsRow",
    "ActuatorInfo",
    "BaseStateRow",
    "BytesLike",
    "CameraEndpoint",
    "CameraImage",
    "ControlPayload",
    "JointGains",
    "JointRow",
    "Pixels",
    "Row",
    "SceneRow",
    "SensorRow",
    "StreamTopic",
    "TopicKind",
    "TwistRow",
    "articulation_filter",
    "camera_filter",
    "camera_header",
    "check_picture_size",
    "decode_camera",
    "decode_gains",
    "decode_row",
    "encode_camera",
    "encode_gains",
    "gains_by_parameter",
    "resolve_endpoint",
    "scene_filter",
]

BytesLike: TypeAlias = bytes | bytearray | memoryview
"""A received frame; a memoryview must be one of bytes (format `B`)."""

Pixels: TypeAlias = NDArray[np.uint8] | NDArray[np.float32]

T = TypeVar("T", bound=np.generic)


def _error(what: str, where: object, problem: str, payload: BytesLike) -> ProtocolError:
    at = f" on {str(where)!r}" if where else ""
    return ProtocolError(f"{what}{at}: {problem}.", raw=bytes(payload[:256]))


def _check_size(what: str, where: object, payload: BytesLike, expected: int) -> None:
    if len(payload) != expected:
        raise _error(what, where, f"{len(payload)} bytes, expected {expected}", payload)


_INT32 = Layout("<i")


def _floats32(values: ArrayLike) -> NDArray[np.float32]:
    # A state that blew up beyond float32 travels as infinity, as the plugin's cast does; it must not stop the stream.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values, dtype="<f4")


def _vector(what: str, values: NDArray[T], size: int) -> NDArray[T]:
    if values.shape != (size,):
        raise ValueError(f"{what} has shape {values.shape}, expected ({size},)")
    return values


# Topics


class TopicKind(StrEnum):
    """What a topic carries; the value is the topic's fixed part."""

    JOINT = "joint"
    BASE_STATE = "base_state"
    SENSOR = "sensor"
    TWIST = "twist"
    ACTIONS = "actions"
    CONTROL = "control"
    SET_GAINS = "set_gains"
    CAMERA = "camera"
    XPOS = "xpos"
    XQUAT = "xquat"
    QPOS = "qpos"
    QVEL = "qvel"
    STATE_FULL = "state/full"


STATE_FULL = b"state/full"
"""Topic of the msgpack snapshot that closes each tick."""

_SCENE = "scene"
_SCENE_SIZES = {TopicKind.XPOS: 3, TopicKind.XQUAT: 4, TopicKind.QPOS: 7, TopicKind.QVEL: 6}
_OF_COMPONENT = frozenset({TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR, TopicKind.CAMERA})
_OF_ARTICULATION = frozenset({TopicKind.TWIST, TopicKind.ACTIONS, TopicKind.CONTROL, TopicKind.SET_GAINS})
_SPACED = frozenset({TopicKind.CONTROL, TopicKind.SET_GAINS, TopicKind.CAMERA})
_COMPONENT_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in _OF_COMPONENT}
_ARTICULATION_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in _OF_ARTICULATION}
_SCENE_KINDS: Mapping[str, TopicKind] = {kind.value: kind for kind in _SCENE_SIZES}


class StreamTopic(Struct, frozen=True):
    """Address of a message on the publish/subscribe sockets.

    An articulation may itself be called `scene`; a topic that reads as `scene/<entity>/xpos` (or `xquat`, `qpos`,
    `qvel`) is always a scene row.

    Attributes:
        kind: What the message carries.
        owner: Articulation key, or the entity of a scene row; empty for `state/full`.
        name: Component name for joint, base state, sensor and camera topics, else empty. Here, as in the name of an
            entity, `/` is part of the name: models made of attached parts have such names.
    """

    kind: TopicKind
    owner: str = ""
    name: str = ""

    def __str__(self) -> str:
        if self.kind is TopicKind.STATE_FULL:
            return self.kind.value
        if self.kind in _SCENE_SIZES:
            return f"{_SCENE}/{self.owner}/{self.kind}"
        text = f"{self.owner}/{self.kind}/{self.name}" if self.name else f"{self.owner}/{self.kind}"
        return f"{text} " if self.kind in _SPACED else text

    def encode(self) -> bytes:
        """Return the topic frame, with the trailing space that control, gains and camera topics carry.

        Raises:
            ValueError: If a name is missing, superfluous or ends in a space, or an articulation key contains `/`.
        """
        if bool(self.owner) == (self.kind is TopicKind.STATE_FULL):
            raise ValueError(f"a {self.kind} topic needs {'no owner' if self.owner else 'an owner'}")
        if bool(self.name) != (self.kind in _OF_COMPONENT):
            raise ValueError(f"a {self.kind} topic needs {'no name' if self.name else 'a component name'}")
        if self.kind not in _SCENE_SIZES:
            _check_key(self.owner)
        for name in (self.owner, self.name):
            if name.endswith(" "):
                raise ValueError(f"{name!r} cannot stand in a topic: it ends in a space")
        return str(self).encode()

    @staticmethod
    def parse(frame: BytesLike) -> StreamTopic:
        """Read a topic frame.

        Raises:
            ProtocolError: If it is not one of the wire's topics, including a missing or extra trailing space.
        """
        return _parse_topic(bytes(frame))


def _check_key(key: str) -> None:
    if "/" in key:
        raise ValueError(f"articulation key {key!r} cannot stand in a topic: it contains '/'")


# A stream repeats a few hundred topics for ever.
@lru_cache(maxsize=4096)
def _parse_topic(frame: bytes) -> StreamTopic:
    if frame == STATE_FULL:
        return StreamTopic(TopicKind.STATE_FULL)
    try:
        text = frame.decode()
    except UnicodeDecodeError as exc:
        raise ProtocolError(f"topic {frame[:64]!r}: not UTF-8 text.", raw=frame) from exc
    topic = _split_topic(text.removesuffix(" "))
    if topic is None:
        problem = "expected <articulation>/<kind>[/<component>], scene/<entity>/<quantity> or state/full"
        raise ProtocolError(f"topic {text[:64]!r}: {problem}.", raw=frame)
    if text.endswith(" ") != (topic.kind in _SPACED):
        problem = "must end in one space" if topic.kind in _SPACED else "must not end in a space"
        raise ProtocolError(f"topic {text[:64]!r}: a {topic.kind} topic {problem}.", raw=frame)
    if topic.owner.endswith(" ") or topic.name.endswith(" "):
        raise ProtocolError(f"topic {text[:64]!r}: a name ends in a space.", raw=frame)
    return topic


def _split_topic(text: str) -> StreamTopic | None:
    head, _, quantity = text.rpartition("/")
    entity = head.removeprefix(f"{_SCENE}/")
    if quantity in _SCENE_KINDS and entity and entity != head:
        return StreamTopic(_SCENE_KINDS[quantity], entity)
    match text.split("/", 2):
        case [owner, kind] if owner and kind in _ARTICULATION_KINDS:
            return StreamTopic(_ARTICULATION_KINDS[kind], owner)
        case [owner, kind, name] if owner and name and kind in _COMPONENT_KINDS:
            return StreamTopic(_COMPONENT_KINDS[kind], owner, name)
        case _:
            return None


def articulation_filter(key: str, kind: TopicKind | None = None) -> bytes:
    """Return the subscription for all topics of one articulation, or for those of one kind.

    ZMQ matches by prefix. These filters end where a name ends, so `g1` does not bring in `g10`. A filter for a single
    joint or sensor row cannot be exact (`g1/joint/knee` also brings in `knee2`): compare the whole topic on receipt.

    Raises:
        ValueError: If `key` cannot stand in a topic, or `kind` is not one that belongs to an articulation.
    """
    _check_key(key)
    if not key:
        raise ValueError("an articulation key is never empty")
    if kind is None:
        return f"{key}/".encode()
    if kind in _OF_COMPONENT:
        return f"{key}/{kind}/".encode()
    if kind in _OF_ARTICULATION:
        return StreamTopic(kind, key).encode()
    raise ValueError(f"an articulation has no {kind} topic")


def scene_filter(entity: str = "") -> bytes:
    """Return the subscription for the scene rows of one entity, or of all."""
    return f"{_SCENE}/{entity}/".encode() if entity else f"{_SCENE}/".encode()


def camera_filter(zmq_topic: str) -> bytes:
    """Return the subscription for one camera from the `zmq_topic` of the handshake.

    That string lacks the trailing space which the published topic has; without it `wrist` also brings in `wrist2`.
    """
    return f"{zmq_topic.removesuffix(' ')} ".encode()


_UNSPECIFIED_HOSTS = frozenset({"", "*", "0.0.0.0", "::", "[::]"})  # noqa: S104  (recognised, never bound)


def resolve_endpoint(endpoint: str, host: str) -> str:
    """Return an endpoint to connect to, from one that may be in bind form.

    Args:
        endpoint: As the server reports it, for example `tcp://0.0.0.0:5558`.
        host: Name or address under which the server was reached; takes the place of an unspecified host.

    Raises:
        ProtocolError: If a TCP endpoint has no usable port, or there is no scheme.
        ValueError: If `host` is itself unspecified.
    """
    if host in _UNSPECIFIED_HOSTS:
        raise ValueError(f"host {host!r} is not an address to connect to")
    scheme, separator, address = endpoint.partition("://")
    if not separator:
        raise ProtocolError(f"endpoint {endpoint!r}: no scheme, expected tcp://HOST:PORT.")
    if scheme != "tcp":
        return endpoint
    bound, colon, port = address.rpartition(":")
    if not (colon and port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise ProtocolError(f"endpoint {endpoint!r}: no port in 1..65535, expected tcp://HOST:PORT.")
    if bound not in _UNSPECIFIED_HOSTS:
        return endpoint
    return f"tcp://[{host}]:{port}" if ":" in host and not host.startswith("[") else f"tcp://{host}:{port}"


# State rows

_JOINT = Layout("<ifff")
_SENSOR = Layout("<ii")
_TWIST = Layout("<fff")


class JointRow(Struct, frozen=True):
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
        _check_size("joint row", where, payload, _JOINT.size)
        return cls(*_JOINT.unpack(payload))

    def encode(self) -> bytes:
        """Return the 16 bytes of the row."""
        try:
            return _JOINT.pack(self.id, self.position, self.velocity, self.acceleration)
        except OverflowError:
            return _INT32.pack(self.id) + _floats32([self.position, self.velocity, self.acceleration]).tobytes()


class BaseStateRow(Struct, frozen=True, eq=False):
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
        pose, velocity = _vector("qpos", np.asarray(qpos), 7), _vector("qvel", np.asarray(qvel), 6)
        values = _floats32(np.concatenate((pose[:3], pose[4:], pose[3:4], velocity)))
        return cls(values[:3], values[3:7], values[7:10], values[10:])

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> BaseStateRow:
        """Read a row; `where` names its source in errors."""
        _check_size("base state row", where, payload, 52)
        values = np.frombuffer(payload, "<f4").copy()
        return cls(values[:3], values[3:7], values[7:10], values[10:])

    def encode(self) -> bytes:
        """Return the 52 bytes of the row."""
        parts = (
            _vector("position", np.asarray(self.position), 3),
            _vector("quat_xyzw", np.asarray(self.quat_xyzw), 4),
            _vector("linear_velocity", np.asarray(self.linear_velocity), 3),
            _vector("angular_velocity", np.asarray(self.angular_velocity), 3),
        )
        return _floats32(np.concatenate(parts)).tobytes()


class SensorRow(Struct, frozen=True, eq=False):
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
            raise _error("sensor row", where, f"{len(payload)} bytes, expected 8 + 4*dim", payload)
        sensor_id, dim = _SENSOR.unpack_from(payload)
        if dim < 0:
            raise _error("sensor row", where, f"dim is {dim}, expected 0 or more", payload)
        expected = _SENSOR.size + 4 * dim
        if len(payload) != expected:
            problem = f"{len(payload)} bytes, expected {expected} (8 + 4*dim with dim {dim})"
            raise _error("sensor row", where, problem, payload)
        return cls(sensor_id, np.frombuffer(payload, "<f4", offset=_SENSOR.size).copy())

    def encode(self) -> bytes:
        """Return the 8 + 4*dim bytes of the row."""
        values = _floats32(self.values)
        return _SENSOR.pack(self.id, values.size) + _vector("values", values, values.size).tobytes()


class TwistRow(Struct, frozen=True):
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
        _check_size("twist row", where, payload, _TWIST.size)
        return cls(*_TWIST.unpack(payload))

    def encode(self) -> bytes:
        """Return the 12 bytes of the row."""
        return _floats32([self.vx, self.vy, self.yaw_rate]).tobytes()


class ActionsRow(Struct, frozen=True):
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
        _check_size("actions row", where, payload, _INT32.size)
        return cls(*_INT32.unpack(payload))

    def encode(self) -> bytes:
        """Return the 4 bytes of the row."""
        return _INT32.pack(self.mask)


class SceneRow(Struct, frozen=True, eq=False):
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
        _check_size(f"scene {quantity} row", where, payload, 8 * _SCENE_SIZES[quantity])
        return cls(quantity, np.frombuffer(payload, "<f8").copy())

    def encode(self) -> bytes:
        """Return the bytes of the row, 8 per value."""
        return _vector(self.quantity, np.asarray(self.values, dtype="<f8"), _SCENE_SIZES[self.quantity]).tobytes()


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
    if topic.kind in _SCENE_SIZES:
        return SceneRow.decode(topic.kind, payload, topic)
    decode = _ROWS.get(topic.kind)
    if decode is None:
        raise _error("state row", topic, f"a {topic.kind} topic carries none", payload)
    return decode(payload, topic)


# Streamed control and gains

_BAD_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_SETPOINT = np.dtype([("id", "<i4"), ("value", "<f4")])


class ControlPayload(Struct, frozen=True, eq=False):
    """Setpoints streamed to the server on a control topic.

    Attributes:
        actuator_ids: Shape (n,), MuJoCo actuator ids. They are global: the topic's articulation does not limit them.
        values: Shape (n,), setpoints in the actuators' own units.
    """

    actuator_ids: NDArray[np.int32]
    values: NDArray[np.float32]

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> ControlPayload:
        """Read a payload; bytes beyond its n entries are ignored. `where` names its source in errors."""
        if len(payload) < _INT32.size:
            raise _error("control payload", where, f"{len(payload)} bytes, expected 4 + 8*n", payload)
        (n,) = _INT32.unpack_from(payload)
        if n < 0:
            raise _error("control payload", where, f"n is {n}, expected 0 or more", payload)
        expected = _INT32.size + _SETPOINT.itemsize * n
        if len(payload) < expected:
            problem = f"{len(payload)} bytes, expected at least {expected} (4 + 8*n with n {n})"
            raise _error("control payload", where, problem, payload)
        entries = np.frombuffer(payload, _SETPOINT, n, _INT32.size)
        return cls(entries["id"].copy(), entries["value"].copy())

    def encode(self) -> bytes:
        """Return the 4 + 8*n bytes of the payload."""
        ids = np.asarray(self.actuator_ids)
        values = np.asarray(self.values)
        if ids.ndim != 1 or ids.shape != values.shape:
            raise ValueError(f"actuator_ids {ids.shape} and values {values.shape} must both have shape (n,)")
        if ids.size and (ids.dtype.kind not in "iu" or ids.min() < -(2**31) or ids.max() >= 2**31):
            raise ValueError("actuator_ids are not all 32-bit integers")
        entries = np.empty(ids.size, _SETPOINT)
        entries["id"] = ids
        entries["value"] = _floats32(values)
        return _INT32.pack(ids.size) + entries.tobytes()


class JointGains(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """PD gains of one joint; what is None stays as it is.

    Attributes:
        kp: Proportional gain.
        kv: Derivative gain.
        torque_limit: Bound of the output, newton metres or newtons.
    """

    kp: float | None = None
    kv: float | None = None
    torque_limit: float | None = None


_GAINS = msgspec.json.Decoder(dict[str, JointGains])


def encode_gains(gains: Mapping[str, JointGains]) -> bytes:
    """Return the payload of a `set_gains` topic: gains by joint name.

    Raises:
        ValueError: If a gain is NaN or infinite, which JSON cannot carry.
    """
    # Escaped to ASCII: the plugin cuts JSON text by its byte count.
    return json.dumps(msgspec.to_builtins(gains), separators=(",", ":"), allow_nan=False).encode("ascii")


def decode_gains(payload: BytesLike, where: object = "") -> dict[str, JointGains]:
    """Read the payload of a `set_gains` topic; `where` names its source in errors.

    Raises:
        ProtocolError: If it is not a JSON object of objects of numbers.
    """
    try:
        return _GAINS.decode(payload)
    except _BAD_JSON as exc:
        raise _error("set_gains payload", where, str(exc), payload) from exc


def gains_by_parameter(gains: Mapping[str, JointGains]) -> dict[str, dict[str, float]]:
    """Return gains by parameter, then by joint, as the `configure_controller` op takes them."""
    by_parameter: dict[str, dict[str, float]] = {}
    for joint, values in gains.items():
        for parameter in ("kp", "kv", "torque_limit"):
            value: float | None = getattr(values, parameter)
            if value is not None:
                by_parameter.setdefault(parameter, {})[joint] = value
    return by_parameter


# The info socket


class CameraEndpoint(Struct, frozen=True):
    """Where a camera publishes.

    Attributes:
        name: Camera name.
        endpoint: ZMQ endpoint in bind form; see `resolve_endpoint`.
    """

    name: str
    endpoint: str


class _ActuatorList(Struct, tag_field="type", tag="actuator_list"):
    robot: str
    names: list[str]
    # Floats: how the plugin's JSON writer prints whole numbers is not known.
    ids: list[float]
    mins: list[float]
    maxs: list[float]
    camera_list: list[CameraEndpoint] = []


_INFO = msgspec.json.Decoder(_ActuatorList)


class ActuatorInfo(Struct, frozen=True, eq=False):
    """What the info socket says about one articulation, a single JSON frame without topic.

    Attributes:
        robot: Articulation key.
        names: Compiled actuator names, the articulation's prefix included.
        ids: Shape (n,), MuJoCo actuator ids, in the order of `names`.
        mins: Shape (n,), lower control limits in the actuators' own units; -100 where there is none.
        maxs: Shape (n,), upper control limits; 100 where there is none.
        cameras: All cameras of the scene, not only this robot's.
    """

    robot: str
    names: tuple[str, ...]
    ids: NDArray[np.int32]
    mins: NDArray[np.float64]
    maxs: NDArray[np.float64]
    cameras: tuple[CameraEndpoint, ...] = ()

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "info socket") -> ActuatorInfo:
        """Read a message; `where` names its source in errors.

        Raises:
            ProtocolError: If it is not such a JSON object, its arrays differ in length, or an id is not an int32.
        """
        try:
            info = _INFO.decode(payload)
        except _BAD_JSON as exc:
            raise _error("info message", where, str(exc), payload) from exc
        sizes = {"names": len(info.names), "ids": len(info.ids), "mins": len(info.mins), "maxs": len(info.maxs)}
        if len(set(sizes.values())) != 1:
            listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise _error("info message", where, f"arrays differ in length: {listed}", payload)
        limit = 2.0**31
        for value in info.ids:
            if not (value.is_integer() and -limit <= value < limit):
                raise _error("info message", where, f"actuator id {value} is no 32-bit integer", payload)
        return cls(
            info.robot,
            tuple(info.names),
            np.array(info.ids, dtype=np.int32),
            np.array(info.mins, dtype=np.float64),
            np.array(info.maxs, dtype=np.float64),
            tuple(info.camera_list),
        )

    def encode(self) -> bytes:
        """Return the JSON frame."""
        size = len(self.names)
        return msgspec.json.encode(
            {
                "type": "actuator_list",
                "robot": self.robot,
                "names": self.names,
                "ids": _vector("ids", np.asarray(self.ids), size).tolist(),
                "mins": _vector("mins", np.asarray(self.mins), size).tolist(),
                "maxs": _vector("maxs", np.asarray(self.maxs), size).tolist(),
                "camera_list": self.cameras,
            }
        )


# Camera pixels

_FRAME_MAGIC = 0x314D4355
_FRAME_HEADERS = {1: Layout("<IIQdII"), 2: Layout("<IIQdIId")}
_OPAQUE = np.uint32(0xFF000000)
_MAX_SIDE = 16_384  # what graphics cards render at most
_CENTIMETRES = np.float32(100)


class CameraImage(Struct, frozen=True, eq=False):
    """One picture.

    Attributes:
        pixels: Top row first. Mode `real`: uint8 (H, W, 4) RGBA with alpha 255. `depth`: float32 (H, W), metres along
            the optical axis. `semantic`, `instance` and modes unknown here: uint8 (H, W, 4) BGRA as sent.
        frame_id: The server's number of the frame; None where the server sends no header.
        sim_time: Simulation time of the frame, seconds; None where the server does not say.
        capture_time: Unix time of the capture, seconds; None where the server does not say.
    """

    pixels: Pixels
    frame_id: int | None = None
    sim_time: float | None = None
    capture_time: float | None = None


def check_picture_size(width: int, height: int) -> None:
    """Check the size of a picture as a peer gives it.

    Raises:
        ValueError: No camera has pictures of this size.
    """
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise ValueError(f"pictures of {width}x{height} pixels; each side has 1 to {_MAX_SIDE}")


def decode_camera(
    payload: BytesLike,
    mode: CameraMode | str,
    width: int,
    height: int,
    *,
    out: Pixels | None = None,
    where: object = "",
) -> CameraImage:
    """Read a picture: a camera message, a slot of a camera region or the `data` of a step reply's camera block.

    Newer servers put a header before the pixels. It is recognised by its magic number and by the length together, so
    that pixels cannot be mistaken for one.

    Args:
        payload: Pixels, with or without header.
        mode: Mode of the camera; decides what the pixels mean.
        width: Columns, as the handshake or the camera block says.
        height: Rows.
        out: C-contiguous array of the result's shape and type to fill and return instead of a new one.
        where: Names the camera in errors.

    Raises:
        ProtocolError: If the payload does not have the size of such a picture, or there is no picture of this size.
        ValueError: If `out` does not fit.
    """
    try:
        check_picture_size(width, height)
    except ValueError as error:
        raise _error("camera frame", where, str(error), payload) from None
    size = width * height * 4
    header = _frame_header(payload, width, height, where)
    if header is None and len(payload) != size:
        problem = f"{len(payload)} bytes, expected {size} ({width}x{height} pixels of 4 bytes)"
        raise _error("camera frame", where, problem, payload)
    start = header.size if header else 0
    if out is None and mode == CameraMode.REAL:
        pixels: Pixels = _rgba(np.frombuffer(payload, np.uint8, size, start), width, height)
    else:
        pixels = _target(mode, width, height, out)
        _convert(np.frombuffer(payload, np.uint8, size, start), mode, pixels)
    if header is None:
        return CameraImage(pixels)
    _, _, frame_id, sim_time, _, _, *capture_time = header.unpack_from(payload)
    return CameraImage(pixels, frame_id, sim_time, *capture_time)


def _target(mode: CameraMode | str, width: int, height: int, out: Pixels | None) -> Pixels:
    depth = mode == CameraMode.DEPTH
    if out is None:
        return np.empty((height, width), np.float32) if depth else np.empty((height, width, 4), np.uint8)
    shape = (height, width) if depth else (height, width, 4)
    dtype = np.dtype(np.float32 if depth else np.uint8)
    if out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous:
        raise ValueError(f"out is {out.dtype} {out.shape}, expected C-contiguous {dtype} {shape}")
    return out


def camera_header(frame_id: int, sim_time: float, width: int, height: int, captured: float) -> bytes:
    """Return what newer servers put before the pixels of a streamed picture.

    Args:
        frame_id: Number of the snapshot that it shows.
        sim_time: Simulation time of that, seconds.
        width: Columns.
        height: Rows.
        captured: When it was taken, Unix seconds.
    """
    return _FRAME_HEADERS[2].pack(_FRAME_MAGIC, 2, frame_id, sim_time, width, height, captured)


def _frame_header(payload: BytesLike, width: int, height: int, where: object) -> Layout | None:
    for version, layout in _FRAME_HEADERS.items():
        if len(payload) != width * height * 4 + layout.size:
            continue
        magic, said, _, _, columns, rows, *_ = layout.unpack_from(payload)
        if magic != _FRAME_MAGIC or said != version:
            continue
        if (columns, rows) != (width, height):
            problem = f"header says {columns}x{rows} pixels, the handshake {width}x{height}"
            raise _error("camera frame", where, problem, payload)
        return layout
    return None


def _rgba(source: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    # BGRA read big-endian is ARGB written little-endian; beginning one byte later, RGB and the next pixel's alpha. At
    # the speed of two copies, against four for shifting each pixel into its place.
    words = np.empty(width * height + 1, "<u4")
    words[:-1] = source.view(">u4")
    words |= np.uint32(0xFF)
    return words.view(np.uint8)[1:-3].reshape(height, width, 4)


def _convert(source: NDArray[np.uint8], mode: CameraMode | str, out: Pixels) -> None:
    flat = out.reshape(-1)
    if mode == CameraMode.DEPTH:
        with np.errstate(invalid="ignore"):
            np.divide(source.view("<f4"), _CENTIMETRES, out=flat)
    elif mode == CameraMode.REAL:
        # BGRA read big-endian and shifted by one byte is RGB0 written little-endian: five times faster than by channel.
        words = flat.view("<u4")
        words[:] = source.view(">u4")
        words >>= np.uint32(8)
        words |= _OPAQUE
    else:
        flat[:] = source


def encode_camera(pixels: Pixels, mode: CameraMode | str) -> bytes:
    """Return the bare pixels of a picture, the inverse of `decode_camera`.

    Args:
        pixels: As in `CameraImage`, top row first; mode `real` also takes RGB, shape (H, W, 3). Alpha is sent as 255.
        mode: Mode of the camera.

    Raises:
        ValueError: If the array has not the shape and type of the mode.
    """
    if mode == CameraMode.DEPTH:
        if pixels.ndim != 2 or pixels.dtype != np.float32:
            raise ValueError(f"depth pixels are {pixels.dtype} {pixels.shape}, expected float32 (H, W)")
        with np.errstate(over="ignore", invalid="ignore"):
            return np.multiply(pixels, _CENTIMETRES, dtype="<f4").tobytes()
    channels = (3, 4) if mode == CameraMode.REAL else (4,)
    if pixels.ndim != 3 or pixels.shape[2] not in channels or pixels.dtype != np.uint8:
        expected = "(H, W, 3) or (H, W, 4)" if len(channels) == 2 else "(H, W, 4)"
        raise ValueError(f"{mode} pixels are {pixels.dtype} {pixels.shape}, expected uint8 {expected}")
    if mode != CameraMode.REAL:
        return pixels.tobytes()
    bgra = np.empty((*pixels.shape[:2], 4), np.uint8)
    bgra[..., 0] = pixels[..., 2]
    bgra[..., 1] = pixels[..., 1]
    bgra[..., 2] = pixels[..., 0]
    bgra[..., 3] = 255
    return bgra.tobytes()
