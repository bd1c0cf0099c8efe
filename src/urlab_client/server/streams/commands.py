"""The messages of the control and info sockets: streamed set-points and gains, and what an articulation accepts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, TypeAlias

import msgspec
import mujoco
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client._mujoco import actuator_count, control_counts, control_starts
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.values.layouts import INT32, BytesLike, damaged

NO_LIMIT: Final = 100.0
"""Control range of an actuator without one."""

_SETPOINT: Final = np.dtype([("id", "<i4"), ("value", "<f4")])


class StreamedSetPoints(Struct, frozen=True, eq=False):
    """Set-points of a control topic, by actuator ids of the model. They need not be those of the topic's robot."""

    actuator_ids: NDArray[np.int32]
    values: NDArray[np.float32]

    @classmethod
    def decode(cls, payload: BytesLike, where: object = "") -> StreamedSetPoints:
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


class _JointGains(Struct, frozen=True):
    kp: float | None = None
    kv: float | None = None
    torque_limit: float | None = None


_GAINS: Final = msgspec.json.Decoder(dict[str, _JointGains])

Gains: TypeAlias = Mapping[str, Mapping[str, float]]
"""Gains by parameter, then by joint, as the `configure_controller` op takes them."""


def decode_gains(payload: BytesLike, where: object = "") -> Gains:
    """Read the payload of a `set_gains` topic, a JSON object by joint; `where` names its source in errors."""
    try:
        gains = _GAINS.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as exc:
        raise damaged("set_gains payload", where, str(exc), payload) from exc
    by_parameter: dict[str, dict[str, float]] = {}
    for joint, values in gains.items():
        for parameter in _JointGains.__struct_fields__:
            value: float | None = getattr(values, parameter)
            if value is not None:
                by_parameter.setdefault(parameter, {})[joint] = value
    return by_parameter


class CameraEndpoint(Struct, frozen=True):
    """A camera, and the ZMQ endpoint of its stream in bind form."""

    name: str
    endpoint: str


class Actuators:
    """The actuators of all articulations by their ids in the model."""

    def __init__(self, model: mujoco.MjModel, controls: Iterable[ArticulationControl]) -> None:
        self._model = model
        self._controls = list(controls)
        self._owner = np.full(actuator_count(model), -1, dtype=np.intp)
        self._place = np.zeros(actuator_count(model), dtype=np.intp)
        for number, control in enumerate(self._controls):
            actuators = control.index.actuators
            widths = control_counts(model)[actuators]
            self._owner[actuators] = number
            self._place[actuators] = np.cumsum(widths) - widths

    def stage(self, command: StreamedSetPoints, owned: Callable[[ArticulationControl], bool]) -> None:
        """Store set-points. Unknown ids are ignored; an actuator with several inputs gets its first.

        Args:
            owned: Returns whether an articulation is owned by a client that drives it by requests; its set-points are
                ignored, too.
        """
        known = (command.actuator_ids >= 0) & (command.actuator_ids < len(self._owner))
        ids, values = command.actuator_ids[known], command.values[known]
        owners = self._owner[ids]
        for number, control in enumerate(self._controls):
            mine = owners == number
            if mine.any() and not owned(control):
                control.set_points.network[self._place[ids[mine]]] = values[mine]

    def info(self, control: ArticulationControl, cameras: Iterable[CameraEndpoint]) -> bytes:
        """Return the info message of an articulation, a single JSON frame. `cameras` are all of the scene."""
        model, index = self._model, control.index
        first = control_starts(model)[index.actuators]
        limited = model.actuator_ctrllimited[first].astype(bool)
        ranges = model.actuator_ctrlrange[first].astype(np.float32).astype(np.float64)
        return msgspec.json.encode(
            {
                "type": "actuator_list",
                "robot": index.key,
                "names": [f"{index.prefix}{name}" for name in index.actuator_names],
                "ids": index.actuators.tolist(),
                "mins": np.where(limited, ranges[:, 0], -NO_LIMIT).tolist(),
                "maxs": np.where(limited, ranges[:, 1], NO_LIMIT).tolist(),
                "camera_list": list(cameras),
            }
        )


StreamedCommand: TypeAlias = StreamedSetPoints | tuple[str, Gains]


def read_commands(frames: list[bytes]) -> Iterator[StreamedCommand]:
    """Read a message of the control socket; a frame without a partner is ignored.

    Raises:
        ProtocolError: A payload is malformed.
    """
    for topic, payload in zip(frames[::2], frames[1::2], strict=False):
        owner, is_gains, _ = topic.partition(b"/set_gains")
        where = topic.decode(errors="replace")
        yield (owner.decode(), decode_gains(payload, where)) if is_gains else StreamedSetPoints.decode(payload, where)
