"""The thread that turns states and pictures into an MCAP file, and the bounded queue in front of it."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import threading
import time
import zlib
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import IO, Final, cast

from mcap.writer import CompressionType, Writer
from msgspec import Struct
from msgspec.structs import asdict

from urlab_client._mujoco import saved_model
from urlab_client.aio.background import background_thread
from urlab_client.errors import URLabError
from urlab_client.integrations._feed.geometry import scene_update, shapes_of
from urlab_client.integrations._feed.messages import (
    EntityMessage,
    EpisodeMessage,
    GapMessage,
    OutcomeMessage,
    Time,
    Transition,
    TransitionMessage,
    VariedQuantity,
    encode,
    schema_name,
    schema_of,
    values,
)
from urlab_client.integrations._feed.samples import (
    CameraPicture,
    EpisodeMark,
    SampleClock,
    Schedule,
    State,
    TopicMessage,
    computed_messages,
    picture_messages,
    state_messages,
)
from urlab_client.integrations._feed.scene import FollowedScene, Simulation
from urlab_client.protocol.messages.session import CameraFrame, EntityState, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.pictures import PictureMemory
from urlab_client.values.plain import Serializable

log: logging.Logger = logging.getLogger("urlab_client.record")

FORMAT = "1"
"""Version of the recording format."""

MODEL_NAME, MODEL_TYPE = "model.mjb.zlib", "application/zlib"
"""Attachment with the compiled model, as MuJoCo saves it; the last one before a state applies to it."""

TASK: Final = "task"
"""First part of the names of the columns with what an environment told about a state."""

GOAL: Final = "goal"
"""First part of the names of the columns with an episode's goal: `goal/NAME`."""

_WAKE_S = 0.02  # in batches: waking for each state would take the interpreter lock from the stepping thread
_STALL_S = 30.0
_CHUNK_BYTES = 1 << 20
_STATE_BYTES = 1 << 10  # assumed size of a state without its arrays


class RecordingError(URLabError):
    """A recording could not be written completely, or a file is not a recording."""


@dataclass(frozen=True, slots=True)
class WriterOptions:
    """Options for writing."""

    image_format: str  # of colour pictures: jpeg or png
    jpeg_quality: int
    pose_ns: int  # shortest time between two sets of poses; 0 for none
    contacts: bool
    buffer_bytes: int
    flush_s: float  # after which a chunk is written even if it is not full
    overwrite: bool
    lossless: bool  # whether senders that can wait for space do so


class RecorderStats(Serializable, Struct, kw_only=True, frozen=True):
    """Counters of a recording.

    Attributes:
        states: States written.
        frames: Pictures written.
        duration_s: Time between the first and the last state on the recording's clock, seconds.
        dropped_states: States dropped because the queue was full, or after a failure.
        dropped_frames: Pictures dropped likewise, and pictures that were due but not sent by the server.
        waiting_bytes: Approximate size of the queue's contents.
        file_bytes: Bytes written to the file.
    """

    states: int
    frames: int
    duration_s: float
    dropped_states: int
    dropped_frames: int
    waiting_bytes: int
    file_bytes: int


class WriterThread:
    """Creates and writes one file. `put` may be called from one thread, `close` from any.

    Args:
        path: The file.
        options: Options for writing.
        about: Metadata of the file.
    """

    def __init__(self, path: Path, options: WriterOptions, about: Mapping[str, str]) -> None:
        self.path = path
        self.error: OSError | RecordingError | None = None
        self._options = options
        self._queue: deque[tuple[State | CameraPicture | EpisodeMark | Transition, int]] = deque()
        # No lock needed, because each counter has one writer.
        self._put_bytes = self._taken_bytes = 0
        self._dropped_states = self._dropped_frames = 0
        self._stalled = self._dropped_last = False
        self._stop = threading.Event()
        self._file = _McapFile(path, "wb" if options.overwrite else "xb")
        try:
            self._sink = _Sink(self._file, options, about)
        except BaseException:
            self._file.close()
            raise
        self._thread = background_thread(
            "urlab-record", self._run, failed=lambda error: self._fail(self._broken_off(error))
        )
        self._thread.start()

    @property
    def stats(self) -> RecorderStats:
        """Current counters."""
        return RecorderStats(
            states=self._sink.states,
            frames=self._sink.frames,
            duration_s=self._sink.duration_s,
            dropped_states=self._dropped_states,
            dropped_frames=self._dropped_frames,
            waiting_bytes=self._put_bytes - self._taken_bytes,
            file_bytes=self._file.written,
        )

    @property
    def cameras(self) -> frozenset[str]:
        """Names of the cameras with a picture in the file."""
        return frozenset(self._sink.cameras)

    def put(self, item: State | CameraPicture) -> None:
        """Queue an item, or drop it. Pictures are dropped from half of the queue's size, to leave space for states.

        In lossless mode, an item whose sender waits for space is always queued.
        """
        size = _size(item)
        limit, waiting = self._options.buffer_bytes, self._put_bytes - self._taken_bytes
        kept = self._options.lossless and item.waits and not self._stalled
        if isinstance(item, State):
            self._dropped_last = self.error is not None or (not kept and waiting + size > limit)
            if self._dropped_last:
                self._dropped_states += 1
                return
        elif self.error is not None or (not kept and waiting + size > limit // 2):
            self._dropped_frames += 1
            return
        self._put_bytes += size
        self._queue.append((item, size))

    def mark(self, item: EpisodeMark) -> None:
        """Queue the outcome of the episode, which is never dropped."""
        self._queue.append((item, 0))

    def note(self, item: Transition) -> None:
        """Queue what led to the last state, unless that was dropped."""
        if not self._dropped_last:
            self._queue.append((item, 0))

    def lose_frames(self, count: int) -> None:
        """Count pictures that did not arrive. Call from the thread that calls `put`."""
        self._dropped_frames += count

    async def room(self) -> None:
        """Wait until half of the queue is free, but no longer if the disk has accepted nothing for 30 s."""
        if not self._options.lossless or self._stalled:
            return
        half, taken, rest = self._options.buffer_bytes // 2, self._taken_bytes, _STALL_S
        while self.error is None and self._put_bytes - self._taken_bytes > half:
            await asyncio.sleep(_WAKE_S)
            rest = _STALL_S if self._taken_bytes != taken else rest - _WAKE_S
            taken = self._taken_bytes
            if rest <= 0:
                self._stalled = True
                log.warning(
                    "%s: nothing could be written for %g s: from now on states are dropped", self.path, _STALL_S
                )
                return

    def give_up(self, error: URLabError) -> None:
        """Take nothing more, because states or pictures are missing from now on; `close` raises the reason."""
        self.error = self._broken_off(error)

    def end(self) -> None:
        """Tell the thread to write the queue and finish the file, without waiting."""
        self._stop.set()

    def close(self) -> None:
        """Write the queue, finish the file, and wait until that is done; raise if writing failed. Idempotent."""
        self.end()
        self._thread.join()
        if self.error is not None:
            stats = self.stats
            raise RecordingError(
                f"{self.path}: the recording broke off: {self.error.strerror or self.error}"
                if isinstance(self.error, OSError)
                else str(self.error),
                hint=f"{stats.states} states were received before; what was written of them can be read.",
            ) from self.error

    def _run(self) -> None:
        sink = self._sink
        try:
            while not self._stop.wait(_WAKE_S):
                self._drain()
                sink.flush_if_due(self._dropped_states, self._dropped_frames)
            self._drain()
            sink.finish(self._dropped_states, self._dropped_frames)
        except (OSError, RecordingError) as error:
            self._fail(error)
        finally:
            with contextlib.suppress(OSError):  # already reported if writing failed
                self._file.close()

    def _broken_off(self, error: URLabError) -> RecordingError:
        broken = RecordingError(f"{self.path}: the recording broke off: {error.__cause__!r}")
        broken.__cause__ = error.__cause__
        return broken

    def _drain(self) -> None:
        while self._queue:
            item, size = self._queue.popleft()
            self._sink.write(item)
            self._taken_bytes += size

    def _fail(self, error: OSError | RecordingError) -> None:
        self.error = error
        log.warning("%s: recording stopped: %s", self.path, error)
        while self._queue:
            item, size = self._queue.popleft()
            self._taken_bytes += size
            if isinstance(item, State):
                self._dropped_states += 1
            elif isinstance(item, CameraPicture):
                self._dropped_frames += 1


class _McapFile:
    """An unbuffered file: a forked child would write a buffer a second time. The library buffers a raw file."""

    def __init__(self, path: Path, mode: str) -> None:
        self.written = 0
        try:
            self._raw = io.FileIO(path, mode)
        except FileExistsError as error:
            raise FileExistsError(error.errno, "The file exists; overwrite=True replaces it", str(path)) from None

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            count = self._raw.write(rest) or 0
            self.written += count
            rest = rest[count:]
        return len(data)

    def tell(self) -> int:
        return self.written

    def flush(self) -> None:
        """Do nothing, because there is no buffer."""

    def close(self) -> None:
        """Close it."""
        self._raw.close()


@dataclass(slots=True)
class _Topic:
    channel: int
    sequence: int = 0


class _Sink:
    """Encodes and writes items. Used only in the writing thread, except for the constructor."""

    def __init__(self, file: _McapFile, options: WriterOptions, about: Mapping[str, str]) -> None:
        self.options = options
        self.states = self.frames = 0
        self._began = 0
        self.cameras: dict[str, PictureMemory] = {}
        self._clock = SampleClock()
        self._poses = Schedule(options.pose_ns)
        self._schemas: dict[type[Struct], int] = {}
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._scene: FollowedScene | None = None
        self._simulation: Simulation | None = None
        self._reported = 0, 0
        self._dirty_since: float | None = None
        self._varied: tuple[int, int] | None = None
        self._noted = -1
        self._writer = Writer(cast("IO[bytes]", file), chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"urlab-client {version('urlab-client')}")
        started = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._writer.add_metadata("urlab", {"format": FORMAT, "started": started, **about})

    @property
    def duration_s(self) -> float:
        """Seconds between the first and the last state."""
        return ((self._clock.last or 0) - self._began) / 1e9

    def write(self, item: State | CameraPicture | EpisodeMark | Transition) -> None:
        match item:
            case State():
                self._write_state(item)
            case CameraPicture():
                self._write_picture(item)
            case EpisodeMark():
                now = self._clock.last or 0
                outcome = OutcomeMessage(Time.of(now), self._clock.episode, item.outcome, item.goal)
                self._add("/recording/outcomes", outcome, now, item.wall_ns)
            case Transition() if self.states - 1 > self._noted:
                self._refuse_names_of_columns()
                now, self._noted = self._clock.last or 0, self.states - 1
                led = TransitionMessage(timestamp=Time.of(now), sample=self._noted, **asdict(item))
                self._add("/recording/transitions", led, now, time.time_ns())
            case _:
                pass  # of a state that is not in the file, or has one already

    def _refuse_names_of_columns(self) -> None:
        scene = self._scene
        for name in (TASK, GOAL):
            if scene is not None and (name in scene.layouts or name in scene.entities):
                raise RecordingError(
                    f"{name!r} cannot be the name of a robot or entity in a recording of an environment, whose own "
                    f"columns begin with {name}/: give it another actor id"
                )

    def flush_if_due(self, dropped_states: int, dropped_frames: int) -> None:
        """Write the chunk if its oldest message is old enough, which limits the loss in a crash."""
        self._report(dropped_states, dropped_frames)
        now = time.monotonic()
        if self._dirty_since is not None and now - self._dirty_since >= self.options.flush_s:
            self._writer.flush()
            self._dirty_since = None

    def finish(self, dropped_states: int, dropped_frames: int) -> None:
        self._report(dropped_states, dropped_frames)
        totals = {
            "states": self.states,
            "frames": self.frames,
            "dropped_states": dropped_states,
            "dropped_frames": dropped_frames,
        }
        self._writer.flush()  # metadata is outside of chunks, and would precede the last one
        self._writer.add_metadata("urlab.end", {name: str(count) for name, count in totals.items()})
        self._writer.finish()

    def _write_state(self, item: State) -> None:
        reply = item.reply
        now = self._clock.advance(item.nanoseconds, item.restarts)
        if not self.states:
            self._began = now
        if item.scene is not self._scene:
            self._use(item.scene, now, item.wall_ns)
        episode = self._clock.episode
        self._write_episode(item, now)
        self._add_all(state_messages(item, now, sample=self.states, episode=episode), now, item.wall_ns)
        entities: Mapping[str, EntityState] = {}
        if isinstance(reply, StepOk | StateSnapshot):
            entities = reply.entities or {}
        for name, entity in entities.items():
            pose = EntityMessage(
                timestamp=Time.of(now),
                sim_time=reply.time,
                sample=self.states,
                step=reply.step,
                episode=episode,
                position=list(entity.xpos),
                orientation=list(entity.xquat),
                qvel=values(entity.qvel),
            )
            self._add(f"/entity/{name}", pose, now, item.wall_ns)
        self.states += 1
        if self._simulation is not None and (self._poses.due(now) or item.restarts):
            self._simulation.take(reply.per_articulation, entities, forces=self.options.contacts)
            computed = computed_messages(self._simulation, now, contacts=self.options.contacts)
            self._add_all(computed, now, item.wall_ns)

    def _write_episode(self, item: State, now: int) -> None:
        """Write an episode's randomisation once, because an environment may reset several times at its start."""
        variation, seed, episode = item.scene.variation, item.seed, self._clock.episode
        if seed is None or self._varied == (episode, seed):
            return
        draws = item.draws if variation is None else variation.draw(seed)
        if draws is None:
            return
        self._varied = (episode, seed)
        varied = [
            VariedQuantity(vary.what, vary.by, dict(zip(elements.names, drawn.tolist(), strict=True)))
            for vary, elements, drawn in draws.varied
        ]
        self._add("/recording/episodes", EpisodeMessage(Time.of(now), episode, seed, varied), now, item.wall_ns)

    def _write_picture(self, item: CameraPicture) -> None:
        sim = self._clock.sim if item.nanoseconds is None else item.nanoseconds
        now = max(0, self._clock.offset + sim)
        quality = self.options.jpeg_quality if self.options.image_format == "jpeg" else None
        memory = self.cameras.setdefault(item.camera.name, PictureMemory())
        self._add_all(picture_messages(item, now, quality, memory), now, item.wall_ns)
        self.frames += 1

    def _use(self, scene: FollowedScene, now: int, wall_ns: int) -> None:
        """Write a scene once: its model, and the geometry to which the poses belong."""
        self._scene, self._simulation = scene, None
        if scene.model is None:
            return
        self._writer.flush()  # attachments are outside of chunks
        self._writer.add_attachment(wall_ns, now, MODEL_NAME, MODEL_TYPE, zlib.compress(saved_model(scene.model)))
        if self.options.pose_ns > 0:
            self._simulation = Simulation(scene, scene.model)
            shapes = shapes_of(scene.model, self._simulation.bodies)
            self._add("/scene", scene_update(shapes, Time.of(now)), now, wall_ns)

    def _report(self, dropped_states: int, dropped_frames: int) -> None:
        if (dropped_states, dropped_frames) != self._reported:
            before, self._reported = self._reported, (dropped_states, dropped_frames)
            now = self._clock.last or 0
            gap = GapMessage(Time.of(now), dropped_states - before[0], dropped_frames - before[1])
            self._add("/recording/gaps", gap, now, time.time_ns())

    def _add_all(self, messages: Iterable[TopicMessage], now: int, wall_ns: int) -> None:
        for topic, make, metadata in messages:
            self._add(topic, make(), now, wall_ns, metadata)

    def _add(
        self, name: str, message: Struct, now: int, wall_ns: int, metadata: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        key, kind = (name, metadata.get("layout", "")), type(message)
        topic = self._topics.get(key)
        if topic is None:
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(schema_name(kind), "jsonschema", schema_of(kind))
            channel = self._writer.register_channel(name, "json", self._schemas[kind], dict(metadata))
            topic = self._topics[key] = _Topic(channel)
        self._writer.add_message(topic.channel, now, encode(message), wall_ns, topic.sequence)
        topic.sequence += 1
        if self._dirty_since is None:
            self._dirty_since = time.monotonic()


def _size(item: State | CameraPicture) -> int:
    if isinstance(item, CameraPicture):
        return len(item.frame.data) if isinstance(item.frame, CameraFrame) else item.frame.nbytes
    states = item.reply.per_articulation.values()
    return _STATE_BYTES * (1 + sum(1 for _ in states)) + sum(8 * (len(s.qpos) + len(s.qvel)) for s in states)
