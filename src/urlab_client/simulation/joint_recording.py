"""Recorded joint states: sessions, the files they are kept in, and what records them.

For the `recording` and `replay` handlers. The file format is the plugin's; playing a session is in `replay`.
"""

from __future__ import annotations

import codecs
import csv
import io
import logging
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, cast

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

logger: logging.Logger = logging.getLogger("urlab_client.server")

Floats = NDArray[np.float64]

LIVE_SESSION: Final = "Live Recording"

FRAME_OVERHEAD: Final = 500
"""About the bytes a frame takes besides its numbers."""

CSV_PERIOD_S: Final = 0.002

_READ_BYTES: Final = 1 << 30
_SMALL_BYTES: Final = 64 << 20
_BYTES_PER_BYTE: Final = 16  # a frame of one joint takes 8 times as much memory as its text
_FRAME_BYTES: Final = 2 << 20  # as text; decoded, a frame takes up to 70 times as much memory
_RAW_BYTES: Final = 64  # about what a frame takes that is found, but not decoded
_COMMA_BYTES: Final = 40  # for other values, of which a file may have more; of frames, a comma has 10 bytes and more
_TOO_MANY: Final = "its frames take more than {} bytes of memory"
_LAYOUT_OVERHEAD: Final = 600  # about the bytes of a joint in a layout
_NAME_CHARS: Final = 4096


@dataclass(frozen=True)
class JointLayout:
    """Which part of a frame's arrays belongs to which joint; shared by frames.

    Attributes:
        joints: Joint name to its slices of `qpos` and `qvel`; a velocity slice is empty if none was recorded.
    """

    joints: Mapping[str, tuple[slice, slice]]

    @staticmethod
    def of(widths: Iterable[tuple[str, int, int]]) -> JointLayout:
        """Lay joints out one after the other, given their names and numbers of coordinates and velocities."""
        joints: dict[str, tuple[slice, slice]] = {}
        qpos = qvel = 0
        for name, coordinates, velocities in widths:
            joints[name] = (slice(qpos, qpos + coordinates), slice(qvel, qvel + velocities))
            qpos, qvel = qpos + coordinates, qvel + velocities
        return JointLayout(joints)


@dataclass(frozen=True, slots=True)
class Frame:
    """The joints of a scene at one time.

    Attributes:
        time: Simulation time, seconds.
        layout: Where each joint's numbers are.
        qpos: Coordinates, m or rad or quaternion (w, x, y, z).
        qvel: Velocities, m/s or rad/s.
    """

    time: float
    layout: JointLayout
    qpos: Floats
    qvel: Floats


def joint_name(model: mujoco.MjModel, joint: int) -> str:
    """Return the name a joint has in recordings."""
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"Joint_{joint}"


class LiveRecording:
    """The session that recording writes to. The caller holds the engine's lock.

    Attributes:
        frames: What was recorded, oldest first.
        max_duration_s: Length of the rolling window, seconds of simulation time; 0 or less is unlimited.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, most_bytes: int) -> None:
        """Prepare for a scene.

        Args:
            most_bytes: Memory for frames; beyond it the oldest go, as if the window were shorter.
        """
        self._most_bytes = most_bytes
        self.frames: deque[Frame] = deque()
        self.max_duration_s: float = 0.0
        self._data = data
        coordinates = np.diff(np.append(model.jnt_qposadr, model.nq))
        velocities = np.diff(np.append(model.jnt_dofadr, model.nv))
        self._layout = JointLayout.of(
            (joint_name(model, joint), int(coordinates[joint]), int(velocities[joint])) for joint in range(model.njnt)
        )
        self._max_frames = most_bytes // (8 * (model.nq + model.nv) + FRAME_OVERHEAD)
        self._trimmed = False

    def start(self, max_duration_s: float) -> None:
        """Begin a new recording in place of the old one."""
        self.clear()
        self.max_duration_s = max_duration_s

    def clear(self) -> None:
        """Forget the frames."""
        self.frames.clear()
        self._trimmed = False

    def capture(self) -> None:
        """Append the present state and drop what has left the window."""
        data, frames = self._data, self.frames
        now = float(data.time)
        frames.append(Frame(now, self._layout, data.qpos.copy(), data.qvel.copy()))
        if self.max_duration_s > 0.0:
            while frames[0].time < now - self.max_duration_s:
                frames.popleft()
        if len(frames) > self._max_frames:
            frames.popleft()
            if not self._trimmed:
                self._trimmed = True
                logger.warning(
                    "the recording has reached the limit recording_bytes, %d (%d frames): the oldest are dropped",
                    self._most_bytes,
                    self._max_frames,
                )


# Files.


class _Joint(msgspec.Struct, forbid_unknown_fields=True):
    qPos: list[float] = []  # noqa: N815 - as in the file
    qVel: list[float] = []  # noqa: N815


class _Position(msgspec.Struct, forbid_unknown_fields=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _Rotation(msgspec.Struct, forbid_unknown_fields=True):
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


class _RecordedFrame(msgspec.Struct, forbid_unknown_fields=True):
    timestamp: float = 0.0
    jointStates: dict[str, _Joint] = {}  # noqa: N815
    cameraPosition: _Position = msgspec.field(default_factory=_Position)  # noqa: N815
    cameraRotation: _Rotation = msgspec.field(default_factory=_Rotation)  # noqa: N815
    bHasCameraData: bool = False  # noqa: N815


def encode_json(frames: Iterable[Frame]) -> bytes:
    """Return the content of a recording file."""
    # Frame by frame: one call for all of them would keep physics from running for as long as it takes.
    encode = msgspec.json.Encoder().encode
    return b"".join((b'{"Frames":[', b",".join(encode(_to_file(frame)) for frame in frames), b"]}"))


def _to_file(frame: Frame) -> _RecordedFrame:
    qpos, qvel = frame.qpos.tolist(), frame.qvel.tolist()
    joints = {name: _Joint(qpos[where], qvel[rates]) for name, (where, rates) in frame.layout.joints.items()}
    return _RecordedFrame(timestamp=frame.time, jointStates=joints)


def decode_json(content: bytes) -> list[Frame]:
    """Read a recording file: keys in any case, missing ones at their defaults, unknown ones ignored.

    Raises:
        ValueError: It is not JSON, has no list of frames, has a frame of more than 2 MiB, or its frames take more
            memory than it may take: 16 times its size, at least 64 MiB and at most 1 GiB.
    """
    made: dict[tuple[tuple[str, int, int], ...], JointLayout] = {}
    text = _utf8(content)
    most = min(_READ_BYTES, max(_SMALL_BYTES, _BYTES_PER_BYTE * len(content)))
    # Before even the places in the text, of frames or of whatever is in their place, need that much:
    if max(text.count(b"{") * _RAW_BYTES, text.count(b",") * _COMMA_BYTES) > most:
        raise ValueError(_TOO_MANY.format(most))
    try:
        return _kept((_from_file(_read(frame), made) for frame in _frames(text)), most)
    except (RecursionError, OverflowError) as error:
        raise ValueError(f"it is not a recording: {error}") from None


def _frames(text: bytes) -> list[msgspec.Raw]:
    """Return the text of each frame: decoded, all of them would take much more memory."""
    for key, value in msgspec.json.decode(text, type=dict[str, msgspec.Raw]).items():
        if key.casefold() == "frames":
            return msgspec.json.decode(value, type=list[msgspec.Raw])
    raise ValueError("the list 'Frames' is missing")


def _kept(frames: Iterable[Frame], most: int) -> list[Frame]:
    kept: list[Frame] = []
    layouts: set[int] = set()
    size = 0
    for frame in frames:
        size += FRAME_OVERHEAD + frame.qpos.nbytes + frame.qvel.nbytes
        if id(frame.layout) not in layouts:
            layouts.add(id(frame.layout))
            size += _LAYOUT_OVERHEAD * len(frame.layout.joints)
        if size > most:
            raise ValueError(_TOO_MANY.format(most))
        kept.append(frame)
    return kept


def _utf8(content: bytes) -> bytes:
    """Return a text file in UTF-8: Unreal writes UTF-16 with a mark as soon as a name is not ASCII."""
    if content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return content.decode("utf-16").encode()
    return content.removeprefix(codecs.BOM_UTF8)


def _from_file(frame: _RecordedFrame, made: dict[tuple[tuple[str, int, int], ...], JointLayout]) -> Frame:
    states = frame.jointStates
    widths = tuple((name, len(state.qPos), len(state.qVel)) for name, state in states.items())
    if any(len(name) > _NAME_CHARS for name in states):
        raise ValueError(f"a joint's name has more than {_NAME_CHARS} characters")
    layout = made.get(widths) or made.setdefault(widths, JointLayout.of(widths))
    qpos = [value for state in states.values() for value in state.qPos]
    qvel = [value for state in states.values() for value in state.qVel]
    if not all(map(math.isfinite, (frame.timestamp, *qpos, *qvel))):
        raise ValueError(f"the frame at {frame.timestamp} s contains a number that is not finite")
    return Frame(frame.timestamp, layout, np.array(qpos, dtype=np.float64), np.array(qvel, dtype=np.float64))


def _read(frame: msgspec.Raw) -> _RecordedFrame:
    if len(memoryview(frame)) > _FRAME_BYTES:
        raise ValueError(f"a frame has more than {_FRAME_BYTES} bytes")
    try:
        return msgspec.json.decode(frame, type=_RecordedFrame)
    except msgspec.ValidationError:
        fields = _folded(msgspec.json.decode(frame))
    stamp, states = fields.get("timestamp"), fields.get("jointstates")
    joints: dict[str, _Joint] = {}
    for name, state in cast("dict[str, object]", states if isinstance(states, dict) else {}).items():
        values = _folded(state)
        joints[name] = _Joint(_numbers(values.get("qpos")), _numbers(values.get("qvel")))
    return _RecordedFrame(timestamp=float(stamp) if isinstance(stamp, int | float) else 0.0, jointStates=joints)


def _folded(value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        return {}
    return {key.casefold(): item for key, item in cast("dict[str, object]", value).items()}


def _numbers(value: object) -> list[float]:
    try:
        return msgspec.convert(value, list[float])
    except msgspec.ValidationError:
        return []


def decode_csv(content: bytes) -> list[Frame]:
    """Read a table of joint positions: a column per scalar joint, `name[k]` for the others, and `time` or `timestamp`.

    Without a time column the rows are 0.002 s apart. There are no velocities. Camera columns are ignored.

    Raises:
        ValueError: It has no header, or a cell is not a number.
    """
    try:
        return _kept(_from_table(row for row in csv.reader(io.StringIO(_utf8(content).decode())) if row), _READ_BYTES)
    except csv.Error as error:
        raise ValueError(f"it is not a table: {error}") from None


def _from_table(rows: Iterator[list[str]]) -> Iterator[Frame]:
    header = [name.strip() for name in next(rows, list[str]())]
    if not header:
        raise ValueError("the table is empty")
    clock = next((at for at, name in enumerate(header) if name.casefold() in ("time", "timestamp")), None)
    columns: dict[str, dict[int, int]] = {}
    for at, name in enumerate(header):
        if at != clock and name and not name.casefold().startswith("cam_"):
            stem, bracket, index = name.removesuffix("]").partition("[")
            place = int(index) if bracket else 0
            columns.setdefault(stem, {})[place] = at
    joints = {name: [places[at] for at in sorted(places)] for name, places in columns.items()}
    layout = JointLayout.of((name, len(places), 0) for name, places in joints.items())
    order = [at for places in joints.values() for at in places]
    for number, row in enumerate(rows):
        if len(row) < len(header):
            raise ValueError(f"row {number + 2} has {len(row)} cells, the header has {len(header)}")
        time = float(row[clock]) if clock is not None else number * CSV_PERIOD_S
        qpos = np.array([float(row[at]) for at in order], dtype=np.float64)
        if not (math.isfinite(time) and np.isfinite(qpos).all()):
            raise ValueError(f"row {number + 2} contains a number that is not finite")
        yield Frame(time, layout, qpos, np.empty(0))


def duration(frames: Sequence[Frame] | deque[Frame]) -> float:
    """Return the seconds from the first frame to the last; 0 with fewer than two, or when time ran back in between."""
    return max(0.0, frames[-1].time - frames[0].time) if len(frames) > 1 else 0.0
