"""Messages of the control and info sockets: streamed set-points, gains, and descriptions of articulations."""

from __future__ import annotations

import json
from collections.abc import Mapping

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.values.layouts import INT32, BytesLike, damaged, floats32, vector

_BAD_JSON = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_SETPOINT = np.dtype([("id", "<i4"), ("value", "<f4")])


class ControlPayload(Struct, frozen=True, eq=False):
    """Setpoints streamed to the server on a control topic.

    Attributes:
        actuator_ids: Shape (n,), MuJoCo actuator ids. They are global and not limited to the topic's articulation.
        values: Shape (n,), setpoints in the actuators' own units.
    """

    actuator_ids: NDArray[np.int32]
    values: NDArray[np.float32]

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> ControlPayload:
        """Decode a payload; bytes beyond its n entries are ignored. `where` names its source in errors."""
        if len(payload) < INT32.size:
            raise damaged("control payload", where, f"{len(payload)} bytes, expected 4 + 8*n", payload)
        (n,) = INT32.unpack_from(payload)
        if n < 0:
            raise damaged("control payload", where, f"n is {n}, expected 0 or more", payload)
        expected = INT32.size + _SETPOINT.itemsize * n
        if len(payload) < expected:
            problem = f"{len(payload)} bytes, expected at least {expected} (4 + 8*n with n {n})"
            raise damaged("control payload", where, problem, payload)
        entries = np.frombuffer(payload, _SETPOINT, n, INT32.size)
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
        entries["value"] = floats32(values)
        return INT32.pack(ids.size) + entries.tobytes()


class JointGains(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """PD gains of one joint; None keeps the current value.

    Attributes:
        kp: Proportional gain.
        kv: Derivative gain.
        torque_limit: Limit of the output, newton metres or newtons.
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
    # Escaped to ASCII: the plugin truncates JSON text by its byte count.
    return json.dumps(msgspec.to_builtins(gains), separators=(",", ":"), allow_nan=False).encode("ascii")


def decode_gains(payload: BytesLike, where: object = "") -> dict[str, JointGains]:
    """Read the payload of a `set_gains` topic; `where` names its source in errors.

    Raises:
        ProtocolError: If it is not a JSON object of objects of numbers.
    """
    try:
        return _GAINS.decode(payload)
    except _BAD_JSON as exc:
        raise damaged("set_gains payload", where, str(exc), payload) from exc


def gains_by_parameter(gains: Mapping[str, JointGains]) -> dict[str, dict[str, float]]:
    """Return gains by parameter, then by joint, as the `configure_controller` op takes them."""
    by_parameter: dict[str, dict[str, float]] = {}
    for joint, values in gains.items():
        for parameter in ("kp", "kv", "torque_limit"):
            value: float | None = getattr(values, parameter)
            if value is not None:
                by_parameter.setdefault(parameter, {})[joint] = value
    return by_parameter


class CameraEndpoint(Struct, frozen=True):
    """Endpoint of a camera's stream.

    Attributes:
        name: Camera name.
        endpoint: ZMQ endpoint in bind form; see `resolve_endpoint`.
    """

    name: str
    endpoint: str


class _ActuatorList(Struct, tag_field="type", tag="actuator_list"):
    robot: str
    names: list[str]
    # Floats, because the format of whole numbers in the plugin's JSON is not known.
    ids: list[float]
    mins: list[float]
    maxs: list[float]
    camera_list: list[CameraEndpoint] = []


_INFO = msgspec.json.Decoder(_ActuatorList)


class ActuatorInfo(Struct, frozen=True, eq=False):
    """Description of one articulation on the info socket, a single JSON frame without a topic.

    Attributes:
        robot: Articulation key.
        names: Compiled actuator names, the articulation's prefix included.
        ids: Shape (n,), MuJoCo actuator ids, in the order of `names`.
        mins: Shape (n,), lower control limits in the actuators' own units; -100 if there is none.
        maxs: Shape (n,), upper control limits; 100 if there is none.
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
            raise damaged("info message", where, str(exc), payload) from exc
        sizes = {"names": len(info.names), "ids": len(info.ids), "mins": len(info.mins), "maxs": len(info.maxs)}
        if len(set(sizes.values())) != 1:
            listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise damaged("info message", where, f"arrays differ in length: {listed}", payload)
        limit = 2.0**31
        for value in info.ids:
            if not (value.is_integer() and -limit <= value < limit):
                raise damaged("info message", where, f"actuator id {value} is no 32-bit integer", payload)
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
                "ids": vector("ids", np.asarray(self.ids), size).tolist(),
                "mins": vector("mins", np.asarray(self.mins), size).tolist(),
                "maxs": vector("maxs", np.asarray(self.maxs), size).tolist(),
                "camera_list": self.cameras,
            }
        )
