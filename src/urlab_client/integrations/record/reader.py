"""Reading recordings: summary, states and pictures, also from the incomplete file of a killed process.

Opening a recording and seeking read only the file's index and a few blocks, so both are fast for overnight recordings.
"""

from __future__ import annotations

import contextlib
import math
import os
import threading
from array import array
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from urlab_client.errors import URLabError
from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CompressedImage,
    Count,
    EntityMessage,
    EpisodeMessage,
    GapMessage,
    OutcomeMessage,
    RawImage,
    schema_name,
)
from urlab_client.integrations.record.contents import (
    Camera,
    RecordedArticulation,
    RecordedEntity,
    RecordedPicture,
    RecordedState,
    Summary,
    Table,
    describe_topic,
)
from urlab_client.integrations.record.index import LATEST_NS, IndexedChannel, Progress, RecordedMessage, RecordingIndex
from urlab_client.integrations.record.tables import Number, SampleTimes, TableBuilder
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.protocol.base import Floats
from urlab_client.values.html import curve, fields, table
from urlab_client.values.pictures import thumbnail

_NS = 1e9
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_STATES, _ENTITIES = schema_name(ArticulationMessage), schema_name(EntityMessage)
_PICTURES = schema_name(CompressedImage), schema_name(RawImage)
_CAMERA, _ARTICULATION, _ENTITY = "/camera/", "/state/", "/entity/"
_MESSAGE_BYTES = 32 << 20
_KEPT_BYTES = 32 << 20
_MOST_VALUES = 8 << 20
_VALUES_PER_BYTE = 200  # states of a robot at rest are packed this well
_NAMES_CHARS = 32 << 20
_CURVE_POINTS = 100
_T = TypeVar("_T")


class _Sample(msgspec.Struct):
    """A part of a sample as decoded; numbers that JSON cannot represent are text."""

    sim_time: Number
    sample: Count
    step: Count
    episode: Count


class _State(_Sample):
    qpos: list[Number]
    qvel: list[Number]
    set_points: list[Number] = []
    ctrl: list[Number] = []
    act: list[Number] = []
    sensors: dict[str, list[Number]] = {}


class _Entity(_Sample):
    position: Annotated[list[Number], msgspec.Meta(min_length=3, max_length=3)]
    orientation: Annotated[list[Number], msgspec.Meta(min_length=4, max_length=4)]
    qvel: Annotated[list[Number], msgspec.Meta(max_length=6)] = []


_state = msgspec.json.Decoder(_State).decode
_entity = msgspec.json.Decoder(_Entity).decode
_episode = msgspec.json.Decoder(EpisodeMessage).decode
_outcome = msgspec.json.Decoder(OutcomeMessage).decode
_gap = msgspec.json.Decoder(GapMessage).decode
_compressed = msgspec.json.Decoder(CompressedImage).decode
_raw = msgspec.json.Decoder(RawImage).decode


class Run:
    """A recording on disk. Opening it reads only its index. Several threads may read.

    Attributes:
        path: The file.
        damage: Why the last read ended early; empty if it did not.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: str = ""
        self._indexed: tuple[tuple[int, int], RecordingIndex] | None = None
        self._lock = threading.Lock()

    def summary(self, progress: Progress | None = None, *, verify: bool = False) -> Summary:
        """Return a summary of the contents.

        Args:
            progress: Called occasionally with the number of bytes read so far.
            verify: Read everything and compare checksums, to detect damage in the middle of a finished file.

        Raises:
            RecordingError: The file is not a recording.
        """
        index = self._index(progress)
        if verify:
            for _ in self._messages(index, index.channels, progress):
                pass
        times: dict[str, list[NDArray[np.int64]]] = {}
        for channel, stamps in index.times().items():
            times.setdefault(index.channels[channel].topic, []).append(stamps)
        stamps_of = {topic: np.concatenate(parts) for topic, parts in sorted(times.items())}
        schemas = {channel.topic: channel.schema for channel in index.channels.values()}
        states = [found for one in index.channels_of(_STATES) if (found := index.newest(one.id)) is not None]
        gaps = self._contents(index, GapMessage, _gap)
        ends = [time for stamps in stamps_of.values() for time in (stamps[0], stamps[-1])]
        ends_of = [(index.first(one), index.newest(one)) for one in index.channels]
        walls = [end.publish_time for pair in ends_of for end in pair if end is not None]
        return Summary(
            path=self.path,
            complete=index.complete and not self.damage,
            damage=self.damage,
            about=dict(index.metadata.get("urlab", {})),
            duration_s=int(max(ends) - min(ends)) / _NS if ends else 0.0,
            wall_s=(max(walls) - min(walls)) / _NS if walls else 0.0,
            episodes=max((_decoded(index, message, _state).episode for message in states), default=-1) + 1,
            dropped_states=sum(gap.states for gap in gaps),
            dropped_frames=sum(gap.frames for gap in gaps),
            topics={topic: describe_topic(topic, schemas[topic], stamps) for topic, stamps in stamps_of.items()},
            varied=tuple(self._contents(index, EpisodeMessage, _episode)),
            outcomes=self.outcomes(),
        )

    def table(self, progress: Progress | None = None, *, fields: Collection[str] | None = None) -> Table:
        """Return all states. They must fit into memory, at 8 bytes for each value of each state.

        Args:
            progress: Called occasionally with the number of bytes read so far.
            fields: Fields to return, such as `qpos`; None returns all.

        Raises:
            RecordingError: The file is not a recording, or contains two scenes, which do not fit into one table.
        """
        return self._read_states(self._builder(None, fields), progress)

    @contextlib.contextmanager
    def stored_table(
        self, folder: Path, progress: Progress | None = None, *, fields: Collection[str] | None = None
    ) -> Generator[Table]:
        """Yield all states as a table that may be larger than memory: its arrays are maps of a temporary file.

        Args:
            folder: Folder of the temporary file, which has 8 bytes for each value of each state.
            progress: Called occasionally with the number of bytes read so far.
            fields: Fields to return, such as `qpos`; None returns all.

        Raises:
            OSError: The temporary file cannot be written.
            RecordingError: The file is not a recording, or contains two scenes, which do not fit into one table.
        """
        with contextlib.closing(self._builder(folder, fields)) as builder:
            yield self._read_states(builder, progress)

    def outcomes(self) -> tuple[OutcomeMessage, ...]:
        """Return the marked outcomes of episodes; if an episode has several marks, the last one.

        Raises:
            RecordingError: The file is not a recording.
        """
        outcomes = self._contents(self._index(), OutcomeMessage, _outcome)
        return tuple({outcome.episode: outcome for outcome in outcomes}.values())

    def time_range(self) -> tuple[float, float]:
        """Return the times of the first and the last state, seconds on the recording's clock; 0, 0 without states.

        Raises:
            RecordingError: The file is not a recording.
        """
        index = self._index()
        channels = index.channels_of(_STATES, _ENTITIES)
        ends = [end for channel in channels for end in (index.first(channel.id), index.newest(channel.id))]
        times = [end.log_time for end in ends if end is not None]
        return min(times, default=0) / _NS, max(times, default=0) / _NS

    def state_at(self, time: float) -> RecordedState | None:
        """Return the newest state at or before a time; None if there is none.

        Args:
            time: Time on the recording's clock, seconds.

        Raises:
            RecordingError: The file is not a recording, or is damaged there.
            ValueError: The time is NaN.
        """
        index = self._index()
        found = [_newest(index, [channel], time) for channel in index.channels_of(_STATES, _ENTITIES)]
        every = [
            (one, _decoded(index, one, _state if one.channel.schema == _STATES else _entity))
            for one in found
            if one is not None
        ]
        if not every:
            return None
        message, newest = max(every, key=lambda one: one[1].sample)
        # Elements from an earlier sample had left the scene by then.
        present = [(one.channel.topic, state) for one, state in every if state.sample == newest.sample]
        return RecordedState(
            time=message.log_time / _NS,
            sim_time=float(newest.sim_time),
            wall_ns=message.publish_time,
            step=newest.step,
            episode=newest.episode,
            articulations={
                topic.removeprefix(_ARTICULATION): _articulation(state)
                for topic, state in present
                if isinstance(state, _State)
            },
            entities={
                topic.removeprefix(_ENTITY): RecordedEntity(
                    _floats(state.position), _floats(state.orientation), _floats(state.qvel)
                )
                for topic, state in present
                if isinstance(state, _Entity)
            },
        )

    def positions(self) -> dict[str, list[str]]:
        """Return the names of the values of `qpos` by articulation, from its first state.

        Raises:
            RecordingError: The file is not a recording.
        """
        index = self._index()
        found: dict[str, list[str]] = {}
        for channel in index.channels_of(_STATES):
            first = index.first(channel.id)
            if first is not None:
                count, names = len(_decoded(index, first, _state).qpos), channel.layout.qpos
                names = names if len(names) == count else [str(i) for i in range(count)]
                found.setdefault(channel.topic.removeprefix(_ARTICULATION), names)
        return found

    def cameras(self) -> list[str]:
        """Return the names of the cameras with pictures in the file."""
        index = self._index()
        pictures = [channel for channel in index.channels_of(*_PICTURES) if channel.topic.startswith(_CAMERA)]
        cameras = [channel for channel in pictures if index.first(channel.id) is not None]
        return list(dict.fromkeys(channel.topic.removeprefix(_CAMERA) for channel in cameras))

    def picture_times(self, camera: str, progress: Progress | None = None) -> Floats:
        """Return the times of the pictures of `frames`, in its order, seconds on the recording's clock.

        Raises:
            KeyError: The file has no pictures of this camera.
            RecordingError: The file is not a recording.
        """
        channels = [channel.id for channel in self._camera(camera)]
        times = array("q", (one.log_time for one in self._messages(self._index(progress), channels, progress)))
        return np.array(times, dtype=np.int64) / _NS

    def frames(self, camera: str, progress: Progress | None = None) -> Iterator[Camera]:
        """Iterate over the pictures of a camera, `ARTICULATION/CAMERA` or a scene-level name.

        Raises:
            KeyError: The file has no pictures of this camera.
            RecordingError: The file is not a recording.
        """
        for picture in self.encoded_pictures(camera, progress):
            yield Camera(picture.time, picture.pixels())

    def encoded_pictures(self, camera: str, progress: Progress | None = None) -> Iterator[RecordedPicture]:
        """Iterate over the encoded pictures of a camera.

        Raises:
            KeyError: The file has no pictures of this camera.
            RecordingError: The file is not a recording.
        """
        channels = [channel.id for channel in self._camera(camera)]
        index = self._index(progress)
        for message in self._messages(index, channels, progress):
            yield _picture(index, message)

    def picture_at(self, camera: str, time: float) -> Camera | None:
        """Return the newest picture of a camera at or before a time; None if there is none.

        Args:
            camera: `ARTICULATION/CAMERA` or a scene-level name.
            time: Time on the recording's clock, seconds.

        Raises:
            KeyError: The file has no pictures of this camera.
            RecordingError: The file is not a recording, or is damaged there.
            ValueError: The time is NaN.
        """
        channels, index = self._camera(camera), self._index()
        found = _newest(index, channels, time)
        if found is None:
            return None
        picture = _picture(index, found)
        return Camera(picture.time, picture.pixels())

    def encoded_picture_at(self, camera: str, time: float) -> RecordedPicture:
        """Return the encoded picture at a time; before the camera's first picture, the first one.

        Raises:
            KeyError: The file has no pictures of this camera.
            RecordingError: The file is not a recording, or is damaged there.
            ValueError: The time is NaN.
        """
        channels, index = self._camera(camera), self._index()
        found = _newest(index, channels, time)
        if found is None:
            firsts = [first for channel in channels if (first := index.first(channel.id)) is not None]
            found = min(firsts, key=lambda one: one.log_time)
        return _picture(index, found)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {str(self.path)!r}>"

    def _repr_html_(self) -> str:
        return _shown(self)

    def _camera(self, name: str) -> list[IndexedChannel]:
        index = self._index()
        channels = [one for one in index.channels_of(*_PICTURES) if one.topic == _CAMERA + name]
        channels = [one for one in channels if index.first(one.id) is not None]
        if not channels:
            raise KeyError(f"no pictures of {name!r} in {self.path}; there are: {', '.join(self.cameras()) or 'none'}")
        return channels

    def _index(self, progress: Progress | None = None) -> RecordingIndex:
        """Return the file's index, which is read again if the file has changed, for example while it is being
        written."""
        status = self.path.stat()
        now = status.st_size, status.st_mtime_ns
        with self._lock:
            if self._indexed is None or self._indexed[0] != now:
                self._indexed = now, RecordingIndex(self.path, progress)
            index = self._indexed[1]
        self.damage = index.damage
        return index

    def _messages(
        self, index: RecordingIndex, channels: Collection[int], progress: Progress | None = None
    ) -> Iterator[RecordedMessage]:
        """Iterate over the messages of channels, up to the first damage, which is then stored in `damage`."""
        yield from index.messages(channels, progress)
        self.damage = index.damage

    def _contents(self, index: RecordingIndex, kind: type[msgspec.Struct], decode: Callable[[bytes], _T]) -> list[_T]:
        """Return all messages of a kind that is rare in recordings."""
        found: list[_T] = []
        left = max(_KEPT_BYTES, 4 * self.path.stat().st_size)
        for message in self._messages(index, [channel.id for channel in index.channels_of(schema_name(kind))]):
            left -= len(message.data)
            if left < 0:
                raise index.unreadable(message, "with those before it, it is larger than the file can be")
            found.append(_decoded(index, message, decode))
        return found

    def _builder(self, folder: Path | None, fields: Collection[str] | None) -> TableBuilder:
        most = max(_MOST_VALUES, _VALUES_PER_BYTE * self.path.stat().st_size)
        return TableBuilder(folder, fields, most=most)

    def _read_states(self, builder: TableBuilder, progress: Progress | None) -> Table:
        index = self._index(progress)
        channels = [channel.id for channel in index.channels_of(_STATES, _ENTITIES)]
        for message in self._messages(index, channels, progress):
            take = self._take_state if message.channel.schema == _STATES else _take_entity
            try:
                take(builder, index, message)
            except ValueError as error:  # it does not fit those before it
                raise index.unreadable(message, error) from None
        return builder.finish(broken_off=bool(self.damage))

    def _take_state(self, builder: TableBuilder, index: RecordingIndex, message: RecordedMessage) -> None:
        state, key = _decoded(index, message, _state), message.channel.topic.removeprefix(_ARTICULATION)
        source = builder.source(key, message.channel.layout)
        if source.layout != message.channel.layout:
            raise RecordingError(
                f"{self.path}: {key} changes its joints or actuators in the middle, which fits no one table.",
                hint="Record each scene into a file of its own.",
            )
        builder.add(
            source,
            state.sample,
            _times(message, state),
            qpos=state.qpos,
            qvel=state.qvel,
            set_points=state.set_points,
            ctrl=state.ctrl,
            act=state.act,
            sensors=[value for reading in state.sensors.values() for value in reading],
        )
        if state.sensors and "sensors" not in source.names:
            if sum(len(name) * len(reading) for name, reading in state.sensors.items()) > _NAMES_CHARS:
                raise ValueError("the names of its sensors are too long")
            source.names["sensors"] = [
                name if len(reading) == 1 else f"{name}.{i}"
                for name, reading in state.sensors.items()
                for i in range(len(reading))
            ]


def _shown(run: Run) -> str:
    """Return a recording for a notebook: its summary, a picture from the middle, and curves of joint positions."""
    try:
        summary, (start, end) = run.summary(), run.time_range()
        states = [run.state_at(float(time)) for time in np.linspace(start, end, _CURVE_POINTS)]
        curves = [
            (f"{owner}/{name}", f"{values.min():.4g} to {values.max():.4g}", curve(values))
            for owner, names in run.positions().items()
            for name, values in zip(names, _positions(states, owner, len(names)), strict=False)
        ]
        camera = next(iter(run.cameras()), None)
        middle = None if camera is None else run.picture_at(camera, (start + end) / 2)
        pictures = {} if middle is None else {str(camera): thumbnail(middle.pixels, middle.mode, str(camera))}
    except (OSError, URLabError) as error:  # for example a file that is gone
        return fields(repr(run)[1:-1], {"problem": str(error)})
    said = {
        "duration": f"{summary.duration_s:.2f} s",
        "episodes": summary.episodes,
        "damage": summary.damage,
        **pictures,
    }
    return fields(repr(run)[1:-1], said) + table(curves, caption="joint positions")


def _positions(states: Sequence[RecordedState | None], owner: str, count: int) -> Floats:
    """Return the positions of a robot at several times, shape (values, times); times without them are left out."""
    there = [state.articulations[owner].qpos for state in states if state is not None and owner in state.articulations]
    return np.array([qpos for qpos in there if len(qpos) == count]).reshape((-1, count)).T


def phases(size: int, progress: Progress | None, count: int) -> list[Progress]:
    """Return a progress callback for each phase, which report the total to `progress`.

    Args:
        size: Size of the recording, bytes, which is the end of each phase and of the total.
        progress: Callback for the total; None for none.
        count: Number of phases.
    """

    def phase(number: int) -> Progress:
        def tell(done: int) -> None:
            if progress is not None:
                progress((number * size + min(done, size)) // count)

        return tell

    return [phase(number) for number in range(count)]


def read_run(path: str | os.PathLike[str]) -> Run:
    """Open a recording, complete or not: an MCAP file, or a JSON file of joint states saved by a server.

    Raises:
        OSError: The file cannot be read.
        RecordingError: The file is neither.
    """
    from urlab_client.integrations.record.joint_states import JointStatesRun, is_joint_states

    file = Path(path)
    if is_joint_states(file):
        return JointStatesRun(file)
    run = Run(file)
    run._index()  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
    return run


def _newest(index: RecordingIndex, channels: Sequence[IndexedChannel], time: float) -> RecordedMessage | None:
    if math.isnan(time):
        raise ValueError("the time is NaN")
    if time < 0:
        return None
    at = LATEST_NS if time * _NS >= LATEST_NS else round(time * _NS)
    found = [index.newest(channel.id, at) for channel in channels]
    return max((one for one in found if one is not None), key=lambda one: one.log_time, default=None)


def _decoded(index: RecordingIndex, message: RecordedMessage, decode: Callable[[bytes], _T]) -> _T:
    """Return the contents of a message."""
    if len(message.data) > _MESSAGE_BYTES and message.channel.schema not in _PICTURES:
        raise index.unreadable(message, f"it has {len(message.data)} bytes, more than {_MESSAGE_BYTES}")
    try:
        return decode(message.data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise index.unreadable(message, error) from None


def _picture(index: RecordingIndex, message: RecordedMessage) -> RecordedPicture:
    decode = _raw if message.channel.schema == schema_name(RawImage) else _compressed
    found: CompressedImage | RawImage = _decoded(index, message, decode)
    place = message._replace(data=b"")
    return RecordedPicture(
        message.log_time / _NS,
        message.channel.metadata.get("mode", ""),
        found,
        lambda reason: index.unreadable(place, reason),
    )


def _times(message: RecordedMessage, state: _Sample) -> SampleTimes:
    return SampleTimes(message.log_time, float(state.sim_time), message.publish_time, state.step, state.episode)


def _take_entity(builder: TableBuilder, index: RecordingIndex, message: RecordedMessage) -> None:
    entity, key = _decoded(index, message, _entity), message.channel.topic.removeprefix(_ENTITY)
    source = builder.source(key, message.channel.layout)
    source.names["pose"] = list(_POSE)
    source.names["qvel"] = ["vx", "vy", "vz", "wx", "wy", "wz"]
    pose: list[Number] = [*entity.position, *entity.orientation]
    builder.add(source, entity.sample, _times(message, entity), pose=pose, qvel=entity.qvel)


def _articulation(state: _State) -> RecordedArticulation:
    return RecordedArticulation(
        qpos=_floats(state.qpos),
        qvel=_floats(state.qvel),
        set_points=_floats(state.set_points),
        ctrl=_floats(state.ctrl),
        act=_floats(state.act),
        sensors={name: _floats(reading) for name, reading in state.sensors.items()},
    )


def _floats(values: Sequence[Number]) -> Floats:
    return np.array([float(value) for value in values])
