"""What is read from a recording: its summary, a table of its states, one state, one picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.messages import EpisodeMessage, OutcomeMessage
from urlab_client.protocol.base import Floats
from urlab_client.protocol.pixels import Pixels

__all__ = [
    "Camera",
    "Column",
    "RecordedArticulation",
    "RecordedEntity",
    "RecordedState",
    "Summary",
    "Table",
    "Topic",
    "describe_topic",
]

_NS = 1e9
_GAP_FACTOR = 3.0


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording.

    Attributes:
        name: Topic.
        schema: Name of its messages' schema.
        messages: How many there are.
        rate_hz: Messages per second of the recording's clock, by the median distance; 0 with fewer than two.
        gaps: Distances of more than three times the median.
        longest_gap_s: The longest distance, seconds.
    """

    name: str
    schema: str
    messages: int
    rate_hz: float
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Summary:
    """What is in a recording.

    Attributes:
        path: The file.
        complete: Whether it was finished; False after a crash.
        damage: Why reading ended early, empty for a complete file.
        about: What was noted at its start: versions, address, step mode, time.
        duration_s: Seconds of the recording's clock between the first message and the last.
        wall_s: Seconds of the server's clock between them.
        episodes: Resets, plus one; 0 without states.
        dropped_states: States that could not be written fast enough.
        dropped_frames: Likewise pictures.
        topics: By name.
        varied: What the server varied, by episode.
        outcomes: What became of the episodes that were marked.
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


@dataclass(frozen=True, slots=True)
class Column:
    """Values that belong together, such as all positions of an articulation.

    Attributes:
        names: Name of each value.
        values: Shape (samples, values); NaN where a sample has none.
        quantities: What each value measures, with its unit: `angle (rad)`, `linear acceleration (m/s²)`.
        labels: Names for people: as `names`, but `imu.x` where that has `imu.0`.
    """

    names: list[str]
    values: Floats
    quantities: list[str]
    labels: list[str]


@dataclass(frozen=True, slots=True)
class Table:
    """The states of a recording, one row per sample.

    Attributes:
        time: The recording's clock, seconds, shape (n,): simulation time that goes on where a reset sets it back.
        sim_time: `mjData.time`, seconds.
        wall_ns: The server's UTC clock, nanoseconds.
        step: Step counter.
        episode: Number of resets before.
        columns: By `ARTICULATION/FIELD`, fields as in `client.articulations`: `qpos`, `qvel`, `ctrl`, `set_points`,
            `act`, `sensors`; plain entities have `pose` and `qvel`.
    """

    time: Floats
    sim_time: Floats
    wall_ns: NDArray[np.int64]
    step: NDArray[np.int64]
    episode: NDArray[np.int64]
    columns: dict[str, Column]

    def __len__(self) -> int:
        return len(self.time)

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
        """Return every value as a column of its own: `time`, …, then `ARTICULATION/FIELD/NAME`."""
        flat: dict[str, NDArray[Any]] = {}
        for key, values in self.arrays().items():
            column = self.columns.get(key)
            if column is None:
                flat[key] = values
            else:
                flat.update({f"{key}/{name}": values[:, i] for i, name in enumerate(column.names)})
        return flat

    def with_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> Table:
        """Return a table with the same columns and other rows, from what `arrays` of it returns."""
        columns = {key: replace(column, values=arrays[key]) for key, column in self.columns.items()}
        return Table(
            arrays["time"], arrays["sim_time"], arrays["wall_ns"], arrays["step"], arrays["episode"], columns=columns
        )


@dataclass(frozen=True, slots=True)
class Camera:
    """One picture of a recording.

    Attributes:
        time: The recording's clock, seconds.
        pixels: uint8 (H, W, 3) RGB, of semantic and instance cameras (H, W, 4) RGBA; depth float32 (H, W), metres.
    """

    time: float
    pixels: Pixels


@dataclass(frozen=True, slots=True)
class RecordedArticulation:
    """One articulation at one moment: arrays as in `client.articulations`, empty where nothing was recorded.

    Attributes:
        qpos: Joint positions, radians or metres.
        qvel: Joint velocities, per second.
        set_points: What the client had set, before any controller.
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
        position: In the world, metres, shape (3,).
        orientation: Quaternion (w, x, y, z).
        qvel: Velocity of a free one's joint, linear and angular, shape (6,); else empty.
    """

    position: Floats
    orientation: Floats
    qvel: Floats


@dataclass(frozen=True, slots=True)
class RecordedState:
    """The state at one moment.

    Attributes:
        time: The recording's clock, seconds.
        sim_time: `mjData.time`, seconds.
        wall_ns: The server's UTC clock, nanoseconds.
        step: Step counter.
        episode: Number of resets before.
        articulations: By key.
        entities: Plain entities by name.
    """

    time: float
    sim_time: float
    wall_ns: int
    step: int
    episode: int
    articulations: dict[str, RecordedArticulation]
    entities: dict[str, RecordedEntity]


def describe_topic(name: str, schema: str, times: NDArray[np.int64]) -> Topic:
    """Describe a topic by the times of its messages, nanoseconds."""
    distances = np.diff(np.sort(times))
    distances = distances[distances > 0]
    if not len(distances):
        return Topic(name, schema, len(times), 0.0, 0, 0.0)
    median, longest = float(np.median(distances)), int(distances.max())
    gaps = int((distances > _GAP_FACTOR * median).sum())
    return Topic(name, schema, len(times), _NS / median, gaps, longest / _NS)
