"""Reading recordings: summary, states and pictures, also from the incomplete file of a killed process.

Opening a recording and seeking read only the file's index and a few blocks, so both are fast for overnight recordings.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import threading
import zlib
from array import array
from collections.abc import Collection, Generator, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, TypeVar, cast

import msgspec
import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from urlab_client.errors import URLabError
from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CompressedImage,
    EntityMessage,
    EpisodeMessage,
    GapMessage,
    OutcomeMessage,
    RawImage,
    TransitionMessage,
    schema_name,
)
from urlab_client.integrations._feed.scene import SceneLayout
from urlab_client.integrations.record.contents import (
    CHOSEN,
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
from urlab_client.integrations.record.tables import SampleTimes, Source, TableBuilder, quantities
from urlab_client.integrations.record.writer import GOAL, MODEL_NAME, TASK, RecordingError
from urlab_client.protocol.base import Floats
from urlab_client.values.html import curve, fields, number, table
from urlab_client.values.pictures import thumbnail

if TYPE_CHECKING:
    import mujoco

_NS = 1e9
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_STATES, _ENTITIES = schema_name(ArticulationMessage), schema_name(EntityMessage)
_TRANSITIONS = schema_name(TransitionMessage)
_PICTURES = schema_name(CompressedImage), schema_name(RawImage)
_CAMERA, _ARTICULATION, _ENTITY = "/camera/", "/state/", "/entity/"
_MESSAGE_BYTES = 32 << 20
_KEPT_BYTES = 32 << 20
_MOST_VALUES = 8 << 20
_VALUES_PER_BYTE = 200  # states of a robot at rest are packed this well
_NAMES_CHARS = 32 << 20
_CURVE_POINTS = 100
_MODEL_BYTES = 1 << 30
S = TypeVar("S", bound=msgspec.Struct)


# Lax, because numbers that JSON cannot represent are text.
_DECODERS: Final = {
    schema_name(kind): msgspec.json.Decoder(kind, strict=False).decode
    for kind in (
        ArticulationMessage, CompressedImage, EntityMessage, EpisodeMessage, GapMessage, OutcomeMessage, RawImage,
        TransitionMessage,
    )
}  # fmt: skip


class Run:
    """A recording on disk. Opening it reads only its index. Several threads may read.

    Every method raises `OSError` if the file cannot be read, and `RecordingError` if it has been replaced by something
    else. Methods for a single state or picture also raise `RecordingError` if the file is damaged there.

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
        gaps = self._contents(index, GapMessage)
        ends = [time for stamps in stamps_of.values() for time in (stamps[0], stamps[-1])]
        ends_of = [(index.first(one), index.newest(one)) for one in index.channels]
        walls = [end.publish_time for pair in ends_of for end in pair if end is not None]
        layouts = {one.topic.removeprefix(_ARTICULATION): one.layout for one in reversed(index.channels_of(_STATES))}
        return Summary(
            path=self.path,
            complete=index.complete and not self.damage,
            damage=self.damage,
            about=dict(index.metadata.get("urlab", {})),
            duration_s=int(max(ends) - min(ends)) / _NS if ends else 0.0,
            wall_s=(max(walls) - min(walls)) / _NS if walls else 0.0,
            episodes=max((_decoded(index, message, ArticulationMessage).episode for message in states), default=-1) + 1,
            dropped_states=sum(gap.states for gap in gaps),
            dropped_frames=sum(gap.frames for gap in gaps),
            topics={topic: describe_topic(topic, schemas[topic], stamps) for topic, stamps in stamps_of.items()},
            varied=tuple(self._contents(index, EpisodeMessage)),
            outcomes=self.outcomes(),
            positions={
                owner: dict(zip(names, quantities(layouts[owner], "qpos", names), strict=True))
                for owner, names in self.positions().items()
            },
        )

    def table(self, progress: Progress | None = None, *, fields: Collection[str] | None = None) -> Table:
        """Return all states. They must fit into memory, at 8 bytes for each value of each state.

        Args:
            progress: Called occasionally with the number of bytes read so far.
            fields: Fields of states to return, such as `qpos`; None returns all.

        Raises:
            RecordingError: The file contains two scenes, which do not fit into one table.
        """
        return self._read_states(self._builder(None), fields, progress)

    @contextlib.contextmanager
    def stored_table(
        self, folder: Path, progress: Progress | None = None, *, fields: Collection[str] | None = None
    ) -> Generator[Table]:
        """Yield all states as a table that may be larger than memory: its arrays are maps of a temporary file.

        Args:
            folder: Folder of the temporary file, which has 8 bytes for each value of each state.
            progress: Called occasionally with the number of bytes read so far.
            fields: Fields of states to return, such as `qpos`; None returns all.

        Raises:
            OSError: The temporary file cannot be written.
            RecordingError: The file contains two scenes, which do not fit into one table.
        """
        with contextlib.closing(self._builder(folder)) as builder:
            yield self._read_states(builder, fields, progress)

    def outcomes(self) -> tuple[OutcomeMessage, ...]:
        """Return the marked outcomes of episodes; if an episode has several marks, the last one."""
        outcomes = self._contents(self._index(), OutcomeMessage)
        return tuple({outcome.episode: outcome for outcome in outcomes}.values())

    def time_range(self) -> tuple[float, float]:
        """Return the times of the first and the last state, seconds on the recording's clock; 0, 0 without states."""
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
            ValueError: The time is NaN.
        """
        index = self._index()
        messages = [_newest(index, [channel], time) for channel in index.channels_of(_STATES, _ENTITIES)]
        every = [(one, _decoded(index, one, ArticulationMessage, EntityMessage)) for one in messages if one is not None]
        if not every:
            return None
        message, newest = max(every, key=lambda one: one[1].sample)
        found = RecordedState(
            time=message.log_time / _NS,
            sim_time=newest.sim_time,
            wall_ns=message.publish_time,
            step=newest.step,
            episode=newest.episode,
            articulations={},
            entities={},
        )
        for one, state in every:
            if state.sample != newest.sample:
                continue  # it had left the scene by then
            if isinstance(state, ArticulationMessage):
                found.articulations[one.channel.topic.removeprefix(_ARTICULATION)] = RecordedArticulation(
                    *map(np.array, (state.qpos, state.qvel, state.set_points, state.ctrl, state.act)),
                    sensors={name: np.array(reading) for name, reading in state.sensors.items()},
                )
            else:
                found.entities[one.channel.topic.removeprefix(_ENTITY)] = RecordedEntity(
                    *map(np.array, (state.position, state.orientation, state.qvel))
                )
        return found

    def positions(self) -> dict[str, list[str]]:
        """Return the names of the values of `qpos` by articulation, from its first state."""
        index = self._index()
        found: dict[str, list[str]] = {}
        for channel in index.channels_of(_STATES):
            first = index.first(channel.id)
            if first is not None:
                count, names = len(_decoded(index, first, ArticulationMessage).qpos), channel.layout.qpos
                names = names if len(names) == count else [str(i) for i in range(count)]
                found.setdefault(channel.topic.removeprefix(_ARTICULATION), names)
        return found

    def prefixes(self) -> dict[str, str]:
        """Return what the names of each articulation begin with in `model()`; files of earlier releases do not say."""
        channels = self._index().channels_of(_STATES)
        keys = {channel.topic.removeprefix(_ARTICULATION): channel.layout.prefix for channel in reversed(channels)}
        return {key: prefix or key for key, prefix in reversed(keys.items())}

    def model(self) -> mujoco.MjModel:
        """Return the compiled model of the first scene.

        MuJoCo does not check binary models, so call this only for recordings from sources that you trust.

        Raises:
            RecordingError: The file has no model, or one of another version of MuJoCo.
        """
        import mujoco

        with self.path.open("rb") as file:
            try:
                found = _first_model(file)
                data = None if found is None else zlib.decompressobj().decompress(found, _MODEL_BYTES)
            except (McapError, OSError, zlib.error, struct.error) as error:
                raise RecordingError(f"{self.path}: the model in it cannot be read: {error}.") from error
        if data is None:
            raise RecordingError(
                f"{self.path}: the recording has no model.",
                hint="A client without a local model records none; neither does a server.",
            )
        try:
            return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": data})
        except ValueError as error:
            raise RecordingError(
                f"{self.path}: this MuJoCo ({mujoco.__version__}) does not read the model in it: {error}.",
                hint="Install the MuJoCo with which it was recorded; `urlab info` names it.",
            ) from error

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
        """
        channels = [channel.id for channel in self._camera(camera)]
        times = array("q", (one.log_time for one in self._messages(self._index(progress), channels, progress)))
        return np.array(times, dtype=np.int64) / _NS

    def frames(self, camera: str, progress: Progress | None = None) -> Iterator[Camera]:
        """Iterate over the pictures of a camera, `ARTICULATION/CAMERA` or a scene-level name.

        Raises:
            KeyError: The file has no pictures of this camera.
        """
        for picture in self.encoded_pictures(camera, progress):
            yield Camera(picture.time, picture.pixels())

    def encoded_pictures(self, camera: str, progress: Progress | None = None) -> Iterator[RecordedPicture]:
        """Iterate over the encoded pictures of a camera.

        Raises:
            KeyError: The file has no pictures of this camera.
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

    def _contents(self, index: RecordingIndex, kind: type[S]) -> list[S]:
        """Return all messages of a kind that is rare in recordings."""
        found: list[S] = []
        left = max(_KEPT_BYTES, 4 * self.path.stat().st_size)
        for message in self._messages(index, [channel.id for channel in index.channels_of(schema_name(kind))]):
            left -= len(message.data)
            if left < 0:
                raise index.unreadable(message, "with those before it, it is larger than the file can be")
            found.append(_decoded(index, message, kind))
        return found

    def _builder(self, folder: Path | None) -> TableBuilder:
        return TableBuilder(folder, most=max(_MOST_VALUES, _VALUES_PER_BYTE * self.path.stat().st_size))

    def _read_states(self, builder: TableBuilder, only: Collection[str] | None, progress: Progress | None) -> Table:
        index = self._index(progress)
        channels = [channel.id for channel in index.channels_of(_STATES, _ENTITIES, _TRANSITIONS)]
        for message in self._messages(index, channels, progress):
            state = _decoded(index, message, ArticulationMessage, EntityMessage, TransitionMessage)
            if isinstance(state, TransitionMessage):
                try:
                    _add_transition(builder, message.channel.layout, state)
                except ValueError as error:
                    raise index.unreadable(message, error) from None
                continue
            prefix = _ARTICULATION if isinstance(state, ArticulationMessage) else _ENTITY
            key = message.channel.topic.removeprefix(prefix)
            source = builder.source(key, message.channel.layout)
            if source.layout != message.channel.layout:
                raise RecordingError(
                    f"{self.path}: {key} changes its joints or actuators in the middle, which fits no one table.",
                    hint="Record each scene into a file of its own.",
                )
            times = SampleTimes(message.log_time, state.sim_time, message.publish_time, state.step, state.episode)
            try:
                own = {name: found for name, found in _fields(source, state).items() if only is None or name in only}
                builder.add(source, state.sample, times, **own)
            except ValueError as error:  # it does not fit those before it
                raise index.unreadable(message, error) from None
        return builder.finish(broken_off=bool(self.damage))


def _add_transition(builder: TableBuilder, layout: SceneLayout, led: TransitionMessage) -> None:
    """Add what an environment tells about a state to its sample, which must be the last one."""
    if led.sample != builder.sample:
        raise ValueError(f"it is about sample {led.sample} and follows sample {builder.sample}")
    success = [] if led.success is None else [float(led.success)]
    numbers = {"actions": [float(led.actions)], "action": led.action, "success": success}
    if led.actions:
        ends = {"terminated": [float(led.terminated)], "truncated": [float(led.truncated)]}
        numbers |= {"reward": [led.reward], **ends, **{f"{CHOSEN}/{key}": each for key, each in led.chosen.items()}}
    builder.add_to_last(Source(TASK, layout), **numbers)
    builder.add_to_last(Source(GOAL, layout), **led.goal)


def _fields(source: Source, state: ArticulationMessage | EntityMessage) -> dict[str, list[float]]:
    """Return the values of a state by field, and name those that the layout does not."""
    if isinstance(state, EntityMessage):
        source.names["pose"] = list(_POSE)
        source.names["qvel"] = ["vx", "vy", "vz", "wx", "wy", "wz"]
        return {"pose": [*state.position, *state.orientation], "qvel": state.qvel}
    if state.sensors and "sensors" not in source.names:
        if sum(len(name) * len(reading) for name, reading in state.sensors.items()) > _NAMES_CHARS:
            raise ValueError("the names of its sensors are too long")
        source.names["sensors"] = [
            name if len(reading) == 1 else f"{name}.{i}"
            for name, reading in state.sensors.items()
            for i in range(len(reading))
        ]
    sensors = [value for reading in state.sensors.values() for value in reading]
    own = {name: getattr(state, name) for name in ("qpos", "qvel", "set_points", "ctrl", "act")}
    return own | {"sensors": sensors}


def _first_model(file: BinaryIO) -> bytes | None:
    """Return the first attached model as it is stored; also from a file that was cut short, which has no index."""
    try:
        attachments = make_reader(file).iter_attachments()
        return next((one.data for one in attachments if one.name == MODEL_NAME), None)
    except (McapError, struct.error):
        file.seek(0)
        records = StreamReader(file, emit_chunks=True).records
        return next((one.data for one in records if isinstance(one, Attachment) and one.name == MODEL_NAME), None)


def _shown(run: Run) -> str:
    """Return a recording for a notebook: its summary, a picture from the middle, and curves of joint positions."""
    try:
        summary, (start, end) = run.summary(), run.time_range()
        states = [run.state_at(float(time)) for time in np.linspace(start, end, _CURVE_POINTS)]
        curves = [
            (f"{owner}/{name}", f"{number(float(values.min()))} to {number(float(values.max()))}", what, curve(values))
            for owner, names in summary.positions.items()
            for (name, what), values in zip(names.items(), _positions(states, owner, len(names)), strict=False)
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
    return fields(repr(run)[1:-1], said) + table(curves, caption=f"joint positions from {start:.2f} to {end:.2f} s")


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
    run = Run(Path(path))
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


def _decoded(index: RecordingIndex, message: RecordedMessage, *kinds: type[S]) -> S:
    """Return the contents of a message, which has the schema of one of these kinds."""
    if len(message.data) > _MESSAGE_BYTES and message.channel.schema not in _PICTURES:
        raise index.unreadable(message, f"it has {len(message.data)} bytes, more than {_MESSAGE_BYTES}")
    try:
        return cast("S", _DECODERS[message.channel.schema](message.data))
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise index.unreadable(message, error) from None


def _picture(index: RecordingIndex, message: RecordedMessage) -> RecordedPicture:
    place = message._replace(data=b"")
    return RecordedPicture(
        message.log_time / _NS,
        message.channel.metadata.get("mode", ""),
        _decoded(index, message, CompressedImage, RawImage),
        lambda reason: index.unreadable(place, reason),
    )
