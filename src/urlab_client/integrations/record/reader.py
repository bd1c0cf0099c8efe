"""Reading a recording: what is in it, its states as tables, its pictures. Also what a killed process left behind."""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from PIL import Image
from zstandard import ZstdError

from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CompressedImage,
    EntityMessage,
    EpisodeMessage,
    GapMessage,
    OutcomeMessage,
    RawImage,
    schema_name,
)
from urlab_client.integrations._feed.quantities import component_name, quantities
from urlab_client.integrations._feed.scene_messages import SceneLayout, from_metadata
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.protocol.base import Floats
from urlab_client.protocol.pixels import Pixels

__all__ = ["Camera", "Column", "Run", "Summary", "Table", "Topic", "describe_topic", "read_run"]

_NS = 1e9
_GAP_FACTOR = 3.0
_UNKNOWN = "neither an MCAP file nor a recording of the server."
_Number = float | Literal["NaN", "Infinity", "-Infinity"]


class _State(msgspec.Struct):
    """An articulation's message as it is read: numbers that JSON lacks are text."""

    sim_time: _Number
    sample: int
    step: int
    episode: int
    qpos: list[_Number]
    qvel: list[_Number]
    set_points: list[_Number] = []
    ctrl: list[_Number] = []
    act: list[_Number] = []
    sensors: dict[str, list[_Number]] = {}


class _Entity(msgspec.Struct):
    sim_time: _Number
    sample: int
    step: int
    episode: int
    position: list[_Number]
    orientation: list[_Number]
    qvel: list[_Number] = []


_state = msgspec.json.Decoder(_State).decode
_entity = msgspec.json.Decoder(_Entity).decode
_episode = msgspec.json.Decoder(EpisodeMessage).decode
_outcome = msgspec.json.Decoder(OutcomeMessage).decode
_gap = msgspec.json.Decoder(GapMessage).decode
_compressed = msgspec.json.Decoder(CompressedImage).decode
_raw = msgspec.json.Decoder(RawImage).decode
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


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

    def flat(self) -> dict[str, NDArray[Any]]:
        """Return every value as a column of its own: `time`, …, then `ARTICULATION/FIELD/NAME`."""
        flat: dict[str, NDArray[Any]] = {
            "time": self.time,
            "sim_time": self.sim_time,
            "wall_ns": self.wall_ns,
            "step": self.step,
            "episode": self.episode,
        }
        for key, column in self.columns.items():
            for i, name in enumerate(column.names):
                flat[f"{key}/{name}"] = column.values[:, i]
        return flat


@dataclass(frozen=True, slots=True)
class Camera:
    """One picture of a recording.

    Attributes:
        time: The recording's clock, seconds.
        pixels: uint8 (H, W, 3) RGB, of semantic and instance cameras (H, W, 4) RGBA; depth float32 (H, W), metres.
    """

    time: float
    pixels: Pixels


@dataclass(slots=True)
class _IndexEntry:
    topic: str
    schema: str
    layout: SceneLayout


@dataclass(slots=True)
class _Builder:
    """Rows of one articulation or entity."""

    layout: SceneLayout
    samples: list[int] = field(default_factory=list[int])
    fields: dict[str, list[list[_Number]]] = field(default_factory=dict[str, list[list[_Number]]])
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def add(self, sample: int, **fields: list[_Number]) -> None:
        row = len(self.samples)
        self.samples.append(sample)
        for name, values in fields.items():
            if values:
                rows = self.fields.setdefault(name, [])
                rows.extend([] for _ in range(row - len(rows)))
                rows.append(values)

    def drop_last(self) -> None:
        self.samples.pop()
        for rows in self.fields.values():
            del rows[len(self.samples) :]


class Run:
    """A recording on disk. Each method reads the file from its start."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str = ""

    def summary(self, progress: Callable[[int], None] | None = None) -> Summary:
        """Say what is in it.

        Args:
            progress: Told now and then how many bytes have been read.

        Raises:
            RecordingError: The file is not a recording.
        """
        times: dict[str, list[int]] = {}
        schemas: dict[str, str] = {}
        about: dict[str, str] = {}
        walls: list[int] = []
        varied: list[EpisodeMessage] = []
        outcomes: dict[int, OutcomeMessage] = {}
        dropped = [0, 0]
        episode = -1
        complete = False
        for record, entry in self._records(progress):
            if isinstance(record, Message) and entry is not None:
                times.setdefault(entry.topic, []).append(record.log_time)
                schemas[entry.topic] = entry.schema
                walls = [walls[0] if walls else record.publish_time, record.publish_time]
                if entry.schema == schema_name(GapMessage):
                    gap = _gap(record.data)
                    dropped = [dropped[0] + gap.states, dropped[1] + gap.frames]
                elif entry.schema == schema_name(EpisodeMessage):
                    varied.append(_episode(record.data))
                elif entry.schema == schema_name(OutcomeMessage):
                    outcome = _outcome(record.data)
                    outcomes[outcome.episode] = outcome
                elif entry.schema == schema_name(ArticulationMessage):
                    episode = _state(record.data).episode
            elif isinstance(record, Metadata) and record.name == "urlab":
                about = dict(record.metadata)
            elif isinstance(record, Footer):
                complete = True
        every = [time for topic in times.values() for time in (topic[0], topic[-1])]
        return Summary(
            path=self.path,
            complete=complete,
            damage=self.damage,
            about=about,
            duration_s=(max(every) - min(every)) / _NS if every else 0.0,
            wall_s=(walls[1] - walls[0]) / _NS if walls else 0.0,
            episodes=episode + 1,
            dropped_states=dropped[0],
            dropped_frames=dropped[1],
            topics={name: describe_topic(name, schemas[name], times[name]) for name in sorted(times)},
            varied=tuple(varied),
            outcomes=tuple(outcomes.values()),
        )

    def table(self, progress: Callable[[int], None] | None = None) -> Table:
        """Return all states.

        Args:
            progress: Told now and then how many bytes have been read.

        Raises:
            RecordingError: The file is not a recording, or holds two scenes, whose values do not fit one table.
        """
        rows: dict[int, tuple[float, float, int, int, int]] = {}
        builders: dict[str, _Builder] = {}
        for record, entry in self._records(progress):
            if not isinstance(record, Message) or entry is None:
                continue
            if entry.schema == schema_name(ArticulationMessage):
                self._take_state(record, entry, rows, builders)
            elif entry.schema == schema_name(EntityMessage):
                self._take_entity(record, entry, rows, builders)
        if self.damage:
            _drop_half_a_sample(rows, builders)
        order = {sample: row for row, sample in enumerate(rows)}
        columns: dict[str, Column] = {}
        for key, builder in builders.items():
            for name, values in builder.fields.items():
                columns[f"{key}/{name}"] = _column(builder, name, values, order)
        fixed = list(zip(*rows.values(), strict=True)) or [(), (), (), (), ()]
        return Table(
            time=np.array(fixed[0], dtype=np.float64),
            sim_time=np.array(fixed[1], dtype=np.float64),
            wall_ns=np.array(fixed[2], dtype=np.int64),
            step=np.array(fixed[3], dtype=np.int64),
            episode=np.array(fixed[4], dtype=np.int64),
            columns=columns,
        )

    def cameras(self) -> list[str]:
        """Return the names of the cameras that have pictures here."""
        kinds = {schema_name(CompressedImage), schema_name(RawImage)}
        return [name.removeprefix("/camera/") for name, topic in self.summary().topics.items() if topic.schema in kinds]

    def frames(self, camera: str, progress: Callable[[int], None] | None = None) -> Iterator[Camera]:
        """Iterate over the pictures of a camera, `ARTICULATION/CAMERA` or a scene-level name.

        Raises:
            KeyError: There are no pictures of it.
            RecordingError: The file is not a recording.
        """
        found = False
        for record, entry in self._records(progress):
            if not isinstance(record, Message) or entry is None or entry.topic != f"/camera/{camera}":
                continue
            found = True
            if entry.schema == schema_name(RawImage):
                raw = _raw(record.data)
                pixels: Pixels = np.frombuffer(raw.data, "<f4").astype(np.float32).reshape(raw.height, raw.width)
            else:
                pixels = np.array(Image.open(io.BytesIO(_compressed(record.data).data)))
            yield Camera(record.log_time / _NS, pixels)
        if not found:
            raise KeyError(
                f"no pictures of {camera!r} in {self.path}; there are: {', '.join(self.cameras()) or 'none'}"
            )

    def _take_state(
        self,
        record: Message,
        entry: _IndexEntry,
        rows: dict[int, tuple[float, float, int, int, int]],
        builders: dict[str, _Builder],
    ) -> None:
        state, key = _state(record.data), entry.topic.removeprefix("/state/")
        builder = builders.setdefault(key, _Builder(entry.layout))
        if builder.layout != entry.layout:
            raise RecordingError(
                f"{self.path}: {key} changes its joints or actuators in the middle, which fits no one table.",
                hint="Record each scene into a file of its own.",
            )
        times = record.log_time / _NS, float(state.sim_time), record.publish_time
        rows[state.sample] = (*times, state.step, state.episode)
        if state.sensors and "sensors" not in builder.names:
            builder.names["sensors"] = [
                name if len(reading) == 1 else f"{name}.{i}"
                for name, reading in state.sensors.items()
                for i in range(len(reading))
            ]
        builder.add(
            state.sample,
            qpos=state.qpos,
            qvel=state.qvel,
            set_points=state.set_points,
            ctrl=state.ctrl,
            act=state.act,
            sensors=[value for reading in state.sensors.values() for value in reading],
        )

    def _take_entity(
        self,
        record: Message,
        entry: _IndexEntry,
        rows: dict[int, tuple[float, float, int, int, int]],
        builders: dict[str, _Builder],
    ) -> None:
        entity, key = _entity(record.data), entry.topic.removeprefix("/entity/")
        builder = builders.setdefault(key, _Builder(entry.layout))
        builder.names["pose"] = list(_POSE)
        builder.names["qvel"] = ["vx", "vy", "vz", "wx", "wy", "wz"]
        times = record.log_time / _NS, float(entity.sim_time), record.publish_time
        rows.setdefault(entity.sample, (*times, entity.step, entity.episode))
        builder.add(entity.sample, pose=[*entity.position, *entity.orientation], qvel=entity.qvel)

    def _records(self, progress: Callable[[int], None] | None) -> Iterator[tuple[object, _IndexEntry | None]]:
        """Yield every record, up to where a file that was not finished breaks off; `damage` says why."""
        self.damage = ""
        schemas: dict[int, str] = {}
        entries: dict[int, _IndexEntry] = {}
        with self.path.open("rb") as file:
            reader = StreamReader(file, validate_crcs=True, record_size_limit=os.fstat(file.fileno()).st_size + 1)
            records, count = iter(reader.records), 0
            while True:
                try:
                    record = next(records, None)
                except InvalidMagic as error:
                    if not entries and not schemas and file.tell() <= 8:
                        raise RecordingError(f"{self.path}: {_UNKNOWN}") from error
                    self.damage = "the end of the file is missing"
                    return
                except (McapError, ZstdError, struct.error, ValueError, OverflowError) as error:
                    if file.tell() < 8:
                        raise RecordingError(f"{self.path}: {_UNKNOWN}") from error
                    self.damage = f"{type(error).__name__}: {error}" if str(error) else "the end of the file is missing"
                    return
                if record is None:
                    return
                count += 1
                if progress is not None and count % 500 == 0:
                    progress(file.tell())
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    layout = from_metadata(record.metadata)
                    entries[record.id] = _IndexEntry(record.topic, schemas.get(record.schema_id, ""), layout)
                yield record, entries.get(record.channel_id) if isinstance(record, Message) else None


def read_run(path: str | os.PathLike[str]) -> Run:
    """Open a recording, finished or not: an MCAP file, or the JSON file of joint states that a server saves.

    Raises:
        OSError: The file cannot be read.
        RecordingError: It is neither.
    """
    from urlab_client.integrations.record.joint_states import JointStatesRun, is_joint_states  # noqa: PLC0415

    file = Path(path)
    if is_joint_states(file):
        return JointStatesRun(file)
    run = Run(file)
    for _ in run._records(None):  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
        break
    return run


def _drop_half_a_sample(rows: dict[int, tuple[float, float, int, int, int]], builders: dict[str, _Builder]) -> None:
    """Drop the last sample if the file broke off before all of it was written."""
    last = max(rows, default=0)
    whole = [builder for builder in builders.values() if last - 1 in builder.samples[-2:]]
    if any(builder.samples[-1] != last for builder in whole):
        del rows[last]
        for builder in builders.values():
            if builder.samples[-1] == last:
                builder.drop_last()


def describe_topic(name: str, schema: str, times: list[int]) -> Topic:
    """Describe a topic by the times of its messages, nanoseconds."""
    distances = np.diff(np.sort(np.array(times, dtype=np.int64)))
    distances = distances[distances > 0]
    if not len(distances):
        return Topic(name, schema, len(times), 0.0, 0, 0.0)
    median, longest = float(np.median(distances)), int(distances.max())
    gaps = int((distances > _GAP_FACTOR * median).sum())
    return Topic(name, schema, len(times), _NS / median, gaps, longest / _NS)


def _column(builder: _Builder, name: str, rows: list[list[_Number]], order: dict[int, int]) -> Column:
    width = max(map(len, rows))
    values = np.full((len(order), width), np.nan)
    for sample, row in zip(builder.samples, rows, strict=False):
        values[order[sample], : len(row)] = [float(value) for value in row]
    layout = builder.layout
    known = {
        "qpos": layout.qpos,
        "qvel": layout.qvel,
        "ctrl": layout.ctrl,
        "set_points": layout.ctrl,
        "act": layout.act,
        **builder.names,
    }
    names = known.get(name, [])
    if len(names) != width:
        names = [str(i) for i in range(width)]
    labels = [component_name(layout, value) for value in names] if name == "sensors" else names
    return Column(names, values, quantities(layout, name, names), labels)
