"""The contents of a recording: its summary, a table of its states, single states and pictures."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from urlab_client.enums import CameraMode
from urlab_client.integrations._feed.messages import CompressedImage, EpisodeMessage, OutcomeMessage, RawImage
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import ArticulationState, Clock, EntityState
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.html import table
from urlab_client.values.pictures import Pixels, shown_png, without_alpha

CHOSEN: Final = "chosen"
"""Name of the column, `task/chosen/ARTICULATION`, with the set-points that an action meant if it took effect late."""

_NS = 1e9
_GAP_FACTOR = 3.0
_MOST_PIXELS = 8192 * 8192


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes:
        name: Topic.
        schema: Name of its messages' schema.
        messages: Number of messages.
        rate_hz: Messages per second of the recording's clock, from the median interval; 0 with fewer than two.
        gaps: Number of intervals longer than three times the median.
        longest_gap_s: The longest interval, seconds.
    """

    name: str
    schema: str
    messages: int
    rate_hz: float
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a recording.

    Attributes:
        path: The file.
        complete: Whether the recording was finished; False after a crash.
        damage: Why reading ended early; empty for a complete file.
        about: Metadata from its start: versions, address, step mode, time.
        duration_s: Time between the first and the last message on the recording's clock, seconds.
        wall_s: The same on the server's clock.
        episodes: Number of episodes: resets plus one; 0 without states.
        dropped_states: Number of states that could not be written fast enough.
        dropped_frames: Number of pictures that could not be written fast enough.
        topics: Topics by name.
        varied: The server's randomisation, by episode.
        outcomes: Outcomes of the marked episodes.
        positions: Quantity and unit of each value of `qpos` by its name, by articulation.
    """

    path: Path
    complete: bool
    damage: str
    about: dict[str, str]
    duration_s: float
    wall_s: float
    episodes: int
    dropped_states: int
    dropped_frames: int
    topics: dict[str, Topic]
    varied: tuple[EpisodeMessage, ...] = ()
    outcomes: tuple[OutcomeMessage, ...] = ()
    positions: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])


@dataclass(frozen=True, slots=True)
class Column:
    """A group of values, such as all positions of an articulation.

    Attributes:
        names: Name of each value.
        values: Shape (samples, values); NaN for missing values.
        quantities: Quantity and unit of each value: `angle (rad)`, `linear acceleration (m/s²)`.
        labels: Display names: like `names`, but `imu.x` instead of `imu.0`.
    """

    names: list[str]
    values: Floats
    quantities: list[str]
    labels: list[str]


@dataclass(frozen=True, slots=True)
class Table:
    """The states of a recording, one row per sample.

    Attributes:
        time: Time on the recording's clock, seconds, shape (n,): simulation time that continues across resets.
        sim_time: `mjData.time`, seconds.
        wall_ns: The server's UTC clock, nanoseconds.
        step: Step counter.
        episode: Number of preceding resets.
        columns: Columns by `ARTICULATION/FIELD`. An articulation whose key is a name of the engine is called by its
            actor id. Fields are those of `client.articulations`: `qpos`, `qvel`, `ctrl`,
            `set_points`, `act`, `sensors`; plain entities have `pose` and `qvel`. What an environment told about a
            state is in `task/actions`, `action`, `reward`, `terminated`, `truncated`, `success` and `goal/NAME`.
    """

    time: Floats
    sim_time: Floats
    wall_ns: NDArray[np.int64]
    step: NDArray[np.int64]
    episode: NDArray[np.int64]
    columns: dict[str, Column]

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        passed = f", {self.time[0]:.3f} to {self.time[-1]:.3f} s" if len(self) else ""
        return f"<Table states: {len(self)}{passed}, columns: {len(self.columns)}>"

    def _repr_html_(self) -> str:
        ends = [0, -1] if len(self) else []
        rows = [
            (key, column.values.shape[1], ", ".join(column.labels), *column.values[ends])
            for key, column in self.columns.items()
        ]
        return table(rows, heads=("column", "values", "names", "first", "last"), caption=repr(self)[1:-1])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays by name: `time`, …, then `ARTICULATION/FIELD`, shape (n, values)."""
        return {
            "time": self.time,
            "sim_time": self.sim_time,
            "wall_ns": self.wall_ns,
            "step": self.step,
            "episode": self.episode,
            **{key: column.values for key, column in self.columns.items()},
        }

    def flat(self) -> dict[str, NDArray[Any]]:
        """Return every value as a separate column: `time`, …, then `ARTICULATION/FIELD/NAME`."""
        flat: dict[str, NDArray[Any]] = {}
        for key, values in self.arrays().items():
            column = self.columns.get(key)
            if column is None:
                flat[key] = values
            else:
                flat.update({f"{key}/{name}": values[:, i] for i, name in enumerate(column.names)})
        return flat


@dataclass(frozen=True, slots=True)
class Camera:
    """One picture of a recording.

    Attributes:
        time: Time on the recording's clock, seconds.
        pixels: uint8 (H, W, 3) RGB, or (H, W, 4) RGBA for semantic and instance cameras; depth float32 (H, W), metres.
    """

    time: float
    pixels: Pixels

    @property
    def mode(self) -> CameraMode:
        """`depth` for depths, else `real`: segmentations, too, are stored as colours."""
        return CameraMode.DEPTH if self.pixels.ndim == 2 else CameraMode.REAL

    def __repr__(self) -> str:
        height, width = self.pixels.shape[:2]
        return f"<Camera {self.mode} {width}x{height} at {self.time:.3f} s>"

    def _repr_png_(self) -> bytes | None:
        return shown_png(self.pixels, self.mode)


@dataclass(frozen=True, slots=True)
class RecordedArticulation:
    """One articulation at one moment: arrays as in `client.articulations`, empty if not recorded.

    Attributes:
        qpos: Joint positions, radians or metres.
        qvel: Joint velocities, per second.
        set_points: Set-points of the client, before any controller.
        ctrl: `mjData.ctrl`, as applied.
        act: Activations.
        sensors: Readings by name.
    """

    qpos: Floats
    qvel: Floats
    set_points: Floats
    ctrl: Floats
    act: Floats
    sensors: dict[str, Floats]


@dataclass(frozen=True, slots=True)
class RecordedEntity:
    """One plain entity at one moment.

    Attributes:
        position: Position in the world frame, metres, shape (3,).
        orientation: Quaternion (w, x, y, z).
        qvel: Linear and angular velocity of the free joint, shape (6,); empty without one.
    """

    position: Floats
    orientation: Floats
    qvel: Floats


@dataclass(frozen=True, slots=True)
class RecordedState:
    """The state at one moment.

    Attributes:
        time: Time on the recording's clock, seconds.
        sim_time: `mjData.time`, seconds.
        wall_ns: The server's UTC clock, nanoseconds.
        step: Step counter.
        episode: Number of preceding resets.
        articulations: Articulations by key.
        entities: Plain entities by name.
    """

    time: float
    sim_time: float
    wall_ns: int
    step: int
    episode: int
    articulations: dict[str, RecordedArticulation]
    entities: dict[str, RecordedEntity]

    def snapshot(self, at: float, articulations: Mapping[str, RecordedArticulation]) -> StateSnapshot:
        """Return the state as a server publishes it, at this simulation time, with these instead of its own robots."""
        return StateSnapshot(
            time=at,
            step=self.step,
            sim_time=Clock(sec=int(at), nsec=int(at % 1.0 * 1e9)),
            wall_time=Clock(sec=0, nsec=0),
            recv_wall_time_ns=time.time_ns(),
            per_articulation={
                key: ArticulationState(
                    qpos=values.qpos,
                    qvel=values.qvel,
                    ctrl=values.ctrl if len(values.ctrl) else None,
                    act=values.act if len(values.act) else None,
                    sensors={name: reading.tolist() for name, reading in values.sensors.items()} or None,
                )
                for key, values in articulations.items()
            },
            entities={
                name: EntityState(
                    xpos=tuple(entity.position.tolist()),
                    xquat=tuple(entity.orientation.tolist()),
                    qpos=np.concatenate((entity.position, entity.orientation)),
                    qvel=entity.qvel if len(entity.qvel) else None,
                )
                for name, entity in self.entities.items()
            },
        )


def describe_topic(name: str, schema: str, times: NDArray[np.int64]) -> Topic:
    """Describe a topic by the times of its messages, nanoseconds."""
    distances = np.diff(np.sort(times))
    distances = distances[distances > 0]
    if not len(distances):
        return Topic(name, schema, len(times), 0.0, 0, 0.0)
    median, longest = float(np.median(distances)), int(distances.max())
    gaps = int((distances > _GAP_FACTOR * median).sum())
    return Topic(name, schema, len(times), _NS / median, gaps, longest / _NS)


class RecordedPicture(msgspec.Struct, frozen=True):
    """One encoded picture of the file.

    Attributes:
        time: Time on the recording's clock, seconds.
        mode: Mode of the camera: `real`, `depth` and so on.
        message: The encoded picture.
        unreadable: Makes the error for a picture that is not what it says.
    """

    time: float
    mode: str
    message: CompressedImage | RawImage
    unreadable: Callable[[object], RecordingError]

    def pixels(self) -> Pixels:
        """Return it as an array like `Camera.pixels`; raises `RecordingError` if it is not what it says."""
        message = self.message
        try:
            return _depths(message) if isinstance(message, RawImage) else _colours(message.data)
        except Exception as error:  # Pillow raises errors of many types
            raise self.unreadable(error) from error


def farthest(pixels: Pixels) -> float:
    """Return the largest finite depth of a depth picture, metres; 1 for other pictures, and without any depth."""
    depths = pixels[np.isfinite(pixels)] if pixels.dtype == np.float32 else np.zeros(0)
    return float(depths.max(initial=0.0)) or 1.0


def visible(pixels: Pixels, far: float) -> NDArray[np.uint8]:
    """Return pixels as RGB: depths in grey, from bright (near) to black (`far` and beyond)."""
    if pixels.dtype == np.float32:
        grey = 1.0 - np.clip(np.nan_to_num(pixels, nan=far), 0.0, far) / far
        return np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    return without_alpha(pixels)


def even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row and column if their number is odd, which H.264 and AV1 with 4:2:0 do not support."""
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else pixels


def _depths(message: RawImage) -> Pixels:
    height, width = message.height, message.width
    if message.encoding != "32FC1" or message.step != 4 * width or len(message.data) != 4 * height * width:
        raise ValueError(
            f"{len(message.data)} bytes of {message.encoding[:20]!r} in rows of {message.step} bytes "
            f"are not {width}x{height} depths"
        )
    _check_size(width, height)
    return np.frombuffer(message.data, "<f4").astype(np.float32).reshape(height, width)


def _colours(data: bytes) -> Pixels:
    with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
        _check_size(*image.size)
        return np.array(image if image.mode in {"RGB", "RGBA"} else image.convert("RGB"))


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > _MOST_PIXELS:
        raise ValueError(f"a picture of {width}x{height} pixels; it can have 1 to {_MOST_PIXELS}")
