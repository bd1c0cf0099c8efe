"""States, pictures, periodic timers and the clock of a run. No I/O."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import Struct

from urlab_client.enums import CameraMode
from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CompressedImage,
    ContactsMessage,
    EpisodeOutcome,
    FrameTransforms,
    JointStates,
    RawImage,
    Time,
    values,
)
from urlab_client.integrations._feed.scene import CameraLayout, FollowedScene, Simulation, calibration, to_metadata
from urlab_client.protocol.messages.session import CameraFrame, StateReply
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.pictures import PictureMemory, Pixels, decode_camera, encoded, jpeg, pillow_image

if TYPE_CHECKING:
    from urlab_client.randomise.variation import EpisodeDraws

_FALLBACK_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class State:
    """One state for a recording or view.

    `waits` means that it is the reply to a step of this client, so that the next step can wait for space. `seed` is
    that of the reset to which the state is the reply. `draws` are those of a new episode that an environment varies
    over the wire; a server's draws follow from `scene` and `seed`.
    """

    scene: FollowedScene
    reply: StateReply | StateSnapshot
    set_points: dict[str, list[float]]
    nanoseconds: int
    restarts: bool
    wall_ns: int
    waits: bool
    seed: int | None = None
    draws: EpisodeDraws | None = None


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """One picture for a recording or view; without its own time it belongs to the preceding state."""

    camera: CameraLayout
    frame: CameraFrame | Pixels
    nanoseconds: int | None
    wall_ns: int
    waits: bool = False

    def pixels(self, memory: PictureMemory | None = None) -> Pixels:
        """Return the picture as an array like `CameraSample.pixels`, converted in `memory` if necessary."""
        frame = self.frame
        if isinstance(frame, CameraFrame):
            mode = self.camera.view.mode
            return decode_camera(frame.data, mode, frame.width, frame.height, memory=memory).pixels
        return frame


@dataclass(frozen=True, slots=True)
class EpisodeMark:
    """Outcome of the episode of the preceding state."""

    outcome: EpisodeOutcome
    goal: dict[str, list[float]]
    wall_ns: int


class Schedule:
    """A timer that fires at most once in each period of simulation time."""

    def __init__(self, period_ns: int) -> None:
        self._period = period_ns
        self._slack = period_ns // 100  # times are rounded
        self._next = 0

    def is_due(self, now: int) -> bool:
        """Return whether it is due at `now`, nanoseconds."""
        return not self._next - self._period <= now + self._slack < self._next

    def done(self, now: int) -> None:
        """Start the next period: it fired at `now`, nanoseconds."""
        now += self._slack
        self._next = now - now % self._period + self._period  # also after a reset of time

    def due(self, now: int) -> bool:
        """Return whether it is due at `now`, nanoseconds, and start the next period if so."""
        due = self.is_due(now)
        if due:
            self.done(now)
        return due


@dataclass(slots=True)
class SampleClock:
    """The clock of a run: simulation time that continues across resets."""

    offset: int = 0
    last: int | None = None
    sim: int = 0
    step: int = _FALLBACK_NS
    episode: int = 0
    moved: bool = False

    def advance(self, sim: int, restarts: bool) -> int:
        """Update from the next state's simulation time, nanoseconds, and return the time of the run.

        Consecutive resets without a step in between start one episode.
        """
        if self.last is not None and (restarts or sim < self.sim):
            if self.moved or sim != self.sim:
                self.offset = self.last + self.step - sim
                self.episode += 1
            self.moved = False
        else:
            self.moved = self.moved or sim != self.sim
            if sim > self.sim:
                self.step = sim - self.sim
        self.sim, self.last = sim, self.offset + sim
        return self.last


class TopicMessage(NamedTuple):
    """A message of a topic, made only if somebody takes it, and the metadata of its channel."""

    topic: str
    make: Callable[[], Struct]
    metadata: Mapping[str, str] = {}


def state_messages(item: State, ns: int, *, sample: int, episode: int, sensors: bool = True) -> Iterator[TopicMessage]:
    """Yield the states of all articulations.

    Args:
        item: The state.
        ns: Time on the run's clock, nanoseconds.
        sample: Number of the sample.
        episode: Number of preceding resets.
        sensors: Whether to include readings.
    """
    reply = item.reply
    for key, state in reply.per_articulation.items():
        names = item.scene.names.get(key)
        make = partial(
            ArticulationMessage,
            timestamp=Time.of(ns),
            sim_time=reply.time,
            sample=sample,
            step=reply.step,
            episode=episode,
            wall_time=Time.of(item.wall_ns),
            qpos=state.qpos.tolist(),
            qvel=state.qvel.tolist(),
            set_points=item.set_points.get(key, []),
            ctrl=values(state.ctrl),
            act=values(state.act),
            sensors=(state.sensors or {}) if sensors else {},
        )
        yield TopicMessage(f"/state/{key}", make, to_metadata(names) if names else {})


def computed_messages(simulation: Simulation, ns: int, *, contacts: bool) -> Iterator[TopicMessage]:
    """Yield what a simulation computes of a state: poses, joint states, and on request contacts."""
    stamp = Time.of(ns)
    yield TopicMessage("/tf", lambda: FrameTransforms(simulation.transforms(stamp)))
    if joints := simulation.joints():
        yield TopicMessage("/joint_states", lambda: JointStates(stamp, joints))
    if contacts:
        yield TopicMessage("/contacts", lambda: ContactsMessage(stamp, simulation.contacts()))


def picture_messages(
    picture: CameraPicture, ns: int, jpeg_quality: int | None, memory: PictureMemory | None = None
) -> Iterator[TopicMessage]:
    """Yield a picture and the parameters of its camera; see `picture_message`."""
    stamp, topic = Time.of(ns), f"/camera/{picture.camera.name}"
    mode = {"mode": str(picture.camera.view.mode)}
    yield TopicMessage(topic, lambda: picture_message(picture, stamp, jpeg_quality, memory), mode)
    yield TopicMessage(f"{topic}/calibration", lambda: calibration(picture.camera, stamp))


def compressed(pixels: Pixels, mode: str, jpeg_quality: int | None) -> bytes:
    """Encode a picture of bytes as JPEG, or as PNG if there is no quality."""
    if jpeg_quality is not None:
        return jpeg(pixels, mode, jpeg_quality)
    return encoded(pillow_image(pixels, mode, alpha=mode != CameraMode.REAL), "PNG", compress_level=1)


def picture_message(
    picture: CameraPicture, stamp: Time, jpeg_quality: int | None, memory: PictureMemory | None = None
) -> CompressedImage | RawImage:
    """Return a picture as a message: depths unchanged, colours as JPEG if there is a quality, everything else as PNG.

    Args:
        picture: The picture.
        stamp: Time of the picture.
        jpeg_quality: 1 to 100, or None.
        memory: Memory of the camera's earlier pictures, to reuse for many messages.
    """
    pixels, name, mode = picture.pixels(memory), picture.camera.name, picture.camera.view.mode
    if pixels.dtype == np.float32:
        height, width = pixels.shape[:2]
        depths = np.ascontiguousarray(pixels, "<f4").tobytes()
        return RawImage(stamp, name, width, height, "32FC1", 4 * width, depths)
    quality = jpeg_quality if mode == CameraMode.REAL else None
    return CompressedImage(stamp, name, compressed(pixels, mode, quality), "png" if quality is None else "jpeg")
