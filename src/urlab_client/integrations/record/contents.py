"""The contents of a recording: its summary, a table of its states, single states and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.messages import EpisodeMessage, OutcomeMessage
from urlab_client.protocol.base import Floats
from urlab_client.values.pictures import Pixels

_NS = 1e9
_GAP_FACTOR = 3.0


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
        columns: Columns by `ARTICULATION/FIELD`, with fields as in `client.articulations`: `qpos`, `qvel`, `ctrl`,
            `set_points`, `act`, `sensors`; plain entities have `pose` and `qvel`.
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
        """Return every value as a separate column: `time`, …, then `ARTICULATION/FIELD/NAME`."""
        flat: dict[str, NDArray[Any]] = {}
        for key, values in self.arrays().items():
            column = self.columns.get(key)
            if column is None:
                flat[key] = values
            else:
                flat.update({f"{key}/{name}": values[:, i] for i, name in enumerate(column.names)})
        return flat

    def with_arrays(self, arrays: Mapping[str, NDArray[Any]]) -> Table:
        """Return a table with the same columns and other rows, given in the form of `arrays`."""
        columns = {key: replace(column, values=arrays[key]) for key, column in self.columns.items()}
        return Table(
            arrays["time"], arrays["sim_time"], arrays["wall_ns"], arrays["step"], arrays["episode"], columns=columns
        )


@dataclass(frozen=True, slots=True)
class Camera:
    """One picture of a recording.

    Attributes:
        time: Time on the recording's clock, seconds.
        pixels: uint8 (H, W, 3) RGB, or (H, W, 4) RGBA for semantic and instance cameras; depth float32 (H, W), metres.
    """

    time: float
    pixels: Pixels


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


def describe_topic(name: str, schema: str, times: NDArray[np.int64]) -> Topic:
    """Describe a topic by the times of its messages, nanoseconds."""
    distances = np.diff(np.sort(times))
    distances = distances[distances > 0]
    if not len(distances):
        return Topic(name, schema, len(times), 0.0, 0, 0.0)
    median, longest = float(np.median(distances)), int(distances.max())
    gaps = int((distances > _GAP_FACTOR * median).sum())
    return Topic(name, schema, len(times), _NS / median, gaps, longest / _NS)
