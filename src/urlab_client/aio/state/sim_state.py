"""The client's view of the simulation: the handshake, the local model and the state of the last reply.

The client and its namespaces share one `SimState`. Users access it through the attributes of `URLabClient`.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client_types import ClientObserver
from urlab_client.aio.model.articulation_state import MirroredArticulation, MirroredEntity
from urlab_client.aio.model.mirror import Mirror, mirror_options
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.progress import Clocks, PendingOutcomes
from urlab_client.aio.state.scene_objects import SceneObjects
from urlab_client.aio.state.step_mode import ModeState
from urlab_client.aio.streams.live_state import LiveState
from urlab_client.aio.streams.pictures import LatestPicture, StepStreams
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.enums import CameraMode, CameraTiming, StepMode
from urlab_client.errors import NoActiveManager, NoSession, ProtocolError, SessionTakenOver, URLabRPCError
from urlab_client.events import PlayEnded, SessionLost, SessionOpened
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import (
    ArticulationState,
    CameraFrame,
    EntityState,
    HelloOk,
    Perturbation,
    StateReply,
    StepOk,
)
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.sim_options import check_sim_options
from urlab_client.values.pictures import Pixels, decode_camera
from urlab_client.values.types import SimOptions

log: logging.Logger = logging.getLogger("urlab_client.client")


_Parts = tuple[
    list[tuple[MirroredArticulation, ArticulationState]],
    list[tuple[MirroredEntity, EntityState]],
    list[tuple[URLabCameraView, Pixels, CameraFrame]],
]
"""The parts of a checked state, each with its target."""


class SimState:
    """State from `discover()` and the replies after it.

    Attributes:
        objects: Articulations, entities and cameras.
        recording: Whether this client has started a recording that nothing has ended since.
        hello: The last handshake, without the model's bytes.
        level: Observation level of the session.
        level_to_restore: The same if the server may have another level in force, so that the next step names it.
        located: Whether the state is known exactly: a reply or snapshot has brought it since the last handshake.
        reset_seed: Seed of the last reset, or None without one.
        user: Values of the scene's user channels.
        on_adopted: Callback invoked after each handshake and at the end of play.
        pending: Steps and resets whose replies were lost.
        switching_play: Whether this client is starting or ending play, so that it reports neither as news.
        observers: Observers of the client, such as recorders. Replaced, never modified: read from any thread.
        step_streams: Streams that deliver the pictures of steps if replies carry older ones.
    """

    def __init__(self, session: Session, publishers: Publishers, *, wanted_mode: StepMode, live_pictures: bool) -> None:
        self.session = session
        self.publishers = publishers
        self.step_streams: StepStreams = StepStreams(publishers)
        self.mirror: Mirror = Mirror()
        self.objects: SceneObjects = SceneObjects(session, publishers, self.mirror)
        self.mode: ModeState = ModeState(session, wanted_mode, self._receive_live)
        self.clocks: Clocks = Clocks()
        self.level: str = "standard"
        self.level_to_restore: str | None = None
        self.pending: PendingOutcomes = PendingOutcomes()
        self.recording: bool = False
        self.hello: HelloOk | None = None
        self.located: bool = False
        self.reset_seed: int | None = None
        self.user: dict[str, Any] = {}
        self.on_adopted: Callable[[], None] | None = None
        self.switching_play = False
        self.observers: tuple[ClientObserver, ...] = ()
        self._live = LiveState(publishers.state(), self._absorb_live, self.mirror.lock)
        self._live_pictures = live_pictures
        session.on_opened = self._note_session
        session.on_refusal = self._note_refusal
        session.control.resolve = self._articulation_key

    @property
    def playing(self) -> bool:
        """Whether a play session is running, as far as this client knows."""
        return self.hello is not None and self.hello.manager_present

    def _receive_live(self) -> None:
        """Start or stop receiving state in the background, which only live mode does."""
        live = self.mode.live and self.playing
        receivers: list[LiveState | LatestPicture] = [self._live]
        if self._live_pictures:
            receivers.extend(view.pictures for view in self.objects.views())
        for receiver in receivers:
            if live:
                receiver.start()
            else:
                receiver.stop()

    def tell_of_handshake(self) -> None:
        for observer in self.observers:
            try:
                observer.on_handshake()
            except Exception:
                log.exception("%r failed on a handshake", observer)

    def observed_cameras(self, n_steps: int) -> dict[str, str]:
        """Return the pictures that the observers want from the next step: camera to `sync` or `latest`."""
        wanted: dict[str, str] = {}
        for observer in self.observers:
            try:
                wanted |= {name: str(CameraTiming(how)) for name, how in observer.step_cameras(n_steps).items()}
            except Exception:
                log.exception("%r failed to return the pictures that it wants", observer)
        return wanted

    @property
    def live(self) -> bool:
        """Whether state is received in the background."""
        return self._live.running

    @property
    def live_received(self) -> int:
        return self._live.stats.received

    @property
    def local_time(self) -> float:
        """Simulation time of the local data or, without local data, of the last reply, seconds."""
        return self.clocks.sim_time if self.mirror.data is None else self.mirror.data.time

    def _articulation_key(self, name: str) -> str | None:
        articulation = self.objects.articulations.get(name)
        return None if articulation is None else articulation.prefix

    def require_handshake(self, op: str) -> None:
        """Raise `NoSession` for an op that depends on a handshake that was abandoned."""
        if self.hello is None and self.session.hello_sent:
            raise NoSession("discover() did not finish. Nothing was sent.", op=op)
        if self.pending.play:
            raise NoSession(
                "sim.start() was interrupted, so the client does not know what is playing. Nothing was sent.",
                op=op,
                hint="Call sim.start(), discover() or resync().",
            )

    def _note_session(self, hello: HelloOk) -> None:
        """Handle a new session, possibly from a handshake that its caller had abandoned."""
        self.pending.clear()  # the server rejects requests of the previous session
        self.clocks.step_count = 0
        self.level_to_restore = self.level
        self.publishers.events.publish(
            SessionOpened(
                session_id=hello.session_id, urlab_version=hello.urlab_version, mujoco_version=hello.mujoco_version
            )
        )

    def absorb_reset(self, reply: StateReply, keyframe: str | None) -> None:
        """Apply the state after a reset completely or not at all; raise the same errors as `absorb`."""
        received = time.time_ns()
        parts = self._checked(reply, "reset")
        with self.mirror.lock:
            self.mirror.reset(keyframe)
            for record in self.objects.entity_records.values():
                record.pose = None
            self._write(reply, parts, received, into_mirror=True)
        self.clocks.set_back = 0
        self._publish(reply)

    @property
    def _trusted(self) -> bool:
        """Whether published states belong to this session; a read-only client has no session to lose."""
        return self.session.confirmed or self.session.read_only

    def matches(self, snapshot: StateSnapshot) -> bool:
        """Return whether a published state fits the world that the handshake described."""
        if not self._trusted or snapshot.per_articulation.keys() != self.objects.records.keys():
            return False
        try:
            self._checked(snapshot, "state/full")
        except ProtocolError:
            return False
        return True

    def _absorb_live(self, snapshot: StateSnapshot) -> None:
        if self.clocks.overtook(snapshot):
            return
        if not self._trusted:
            return  # the connection was lost, so this may be from another server
        known = self.objects.records
        if snapshot.per_articulation.keys() != known.keys():
            raise ProtocolError(
                f"state/full: it has {_listed(snapshot.per_articulation)}, but the handshake has {_listed(known)}.",
                hint="The world changed on the server: call discover().",
            )
        self.absorb(snapshot, "state/full")

    def absorb(self, reply: StateReply | StateSnapshot, op: str, *, into_mirror: bool = True) -> None:
        """Apply the state in a reply completely, or raise `ProtocolError` and apply nothing."""
        received = time.time_ns()
        self._write(reply, self._checked(reply, op), received, into_mirror=into_mirror)
        self._publish(reply)

    def absorb_found(self, reply: StateReply | StateSnapshot, op: str) -> None:
        """Apply the state found after a handshake; raise the same errors as `absorb`.

        Do not notify observers: the simulation has not changed.
        """
        received = time.time_ns()
        self._write(reply, self._checked(reply, op), received, into_mirror=True)

    def _checked(self, reply: StateReply | StateSnapshot, op: str) -> _Parts:
        """Return each part of a state that fits the model and the cameras, with its target. Raises `ProtocolError`."""
        if not math.isfinite(reply.time):
            raise ProtocolError(f"{op}: the simulation time is {reply.time}.", op=op)
        records = self.objects.records
        articulations: list[tuple[MirroredArticulation, ArticulationState]] = []
        for key, state in reply.per_articulation.items():
            record = records.get(key)
            if record is not None:
                record.check(state, op)
                articulations.append((record, state))
        entities: list[tuple[MirroredEntity, EntityState]] = []
        if isinstance(reply, (StepOk, StateSnapshot)) and reply.entities:
            known = self.objects.entity_records
            entities = [(known[name], state) for name, state in reply.entities.items() if name in known]
            for entity, pose in entities:
                entity.check_pose(pose, op)
        pictures: list[tuple[URLabCameraView, Pixels, CameraFrame]] = []
        if isinstance(reply, StepOk):
            if reply.perturbation is not None:
                self._check_perturbation(reply.perturbation, op)
            if reply.cameras:
                pictures = [(view, _pixels(view, frame), frame) for view, frame in self._frames(reply.cameras)]
        return articulations, entities, pictures

    def _publish(self, reply: StateReply | StateSnapshot) -> None:
        """Pass a state that was applied to the readers of streams and the observers."""
        own = self.publishers.own_steps
        if own.handlers and isinstance(reply, StateReply) and not (self.live or self.session.features.publishes_steps):
            own.publish(reply)
        for observer in self.observers:
            try:
                observer.on_state(reply)
            except Exception:
                log.exception("%r failed on a state", observer)

    def _write(self, reply: StateReply | StateSnapshot, parts: _Parts, received: int, *, into_mirror: bool) -> None:
        articulations, entities, pictures = parts
        self.located = True
        with self.mirror.lock:
            for record, state in articulations:
                record.absorb(state, into_mirror=into_mirror)
            for entity, pose in entities:
                entity.absorb_pose(pose, into_mirror=into_mirror)
            for view, pixels, frame in pictures:
                taken = reply.time if frame.sim_time is None else frame.sim_time
                view.pictures.deliver(pixels, taken, frame.frame_id)
            data = self.mirror.data
            if into_mirror and data is not None:
                data.time = reply.time
            self.mirror.stale = True
            self.clocks.absorb(reply, received)
            if isinstance(reply, StateSnapshot):
                self.user = reply.user

    def _check_perturbation(self, drag: Perturbation, op: str) -> None:
        model = self.mirror.model
        if model is not None and not (
            0 < drag.body_id < model.nbody and len(drag.xfrc) == 6 and np.isfinite(drag.xfrc).all()
        ):
            raise ProtocolError(
                f"{op}: invalid perturbation of body {drag.body_id} by {drag.xfrc.tolist()}: "
                f"bodies are 1 to {model.nbody - 1}, and a wrench has six finite numbers.",
                op=op,
            )

    def mirror_qpos(self, key: str, qpos: Floats) -> None:
        """Mirror the leading joint positions that `set_qpos` wrote to an articulation, given by any of its names.

        Raises:
            ProtocolError: The positions cover neither the whole articulation nor its free base.
        """
        articulation = self.objects.articulations.get(key)
        if articulation is None:
            return
        record = self.objects.records[articulation.prefix]
        record.check_written(qpos)
        with self.mirror.lock:
            record.qpos = np.concatenate([qpos, record.qpos[len(qpos) :]])
            if self.mirror.data is not None:
                self.mirror.data.qpos[record.layout.qpos_adr[: len(qpos)]] = qpos
            self.mirror.stale = True

    def mirror_options(self, options: SimOptions) -> None:
        """Mirror the options that `set_sim_options` returned, all or none. Raises `ProtocolError`."""
        try:
            check_sim_options(options)
            if self.mirror.model is not None:
                with self.mirror.lock:
                    mirror_options(self.mirror.model.opt, options)
        except ValueError as error:
            raise ProtocolError(
                f"set_sim_options: the server returned an invalid option: {error}.", op="set_sim_options"
            ) from None

    def _note_refusal(self, refusal: URLabRPCError) -> None:
        if isinstance(refusal, NoActiveManager):
            self.on_play_ended("stopped by another client or in the editor")
        elif isinstance(refusal, SessionTakenOver):
            self.session.unsettled.clear()  # by a restart of the server, or another client changes what it likes
            self.publishers.events.publish(SessionLost(session_id=self.session.session_id, reason=refusal.message))

    def on_play_ended(self, reason: str = "") -> None:
        """Handle the end of play: the server is back in live mode and has no articulations."""
        played = self.playing
        if self.hello is not None:
            self.hello.manager_present = False
        self.publishers.release_regions()
        self.session.control.forget()
        self.publishers.camera_switch.forget()
        self.mode.end_play()
        self.recording = False
        self.session.unsettled.clear()
        if played:
            self.publishers.events.publish(PlayEnded(reason=reason))
            if self.on_adopted is not None:
                self.on_adopted()

    def _frames(self, cameras: Mapping[str, CameraFrame]) -> list[tuple[URLabCameraView, CameraFrame]]:
        found: list[tuple[URLabCameraView, CameraFrame]] = []
        for name, frame in cameras.items():
            view = self.objects.camera(name) or self.objects.announced_camera(name, frame)
            if view is None:
                raise ProtocolError(
                    f"step: the reply has a frame of camera {name!r}, which the handshake does not list.", op="step"
                )
            found.append((view, frame))
        return found


def _listed(keys: Iterable[str]) -> str:
    return ", ".join(keys) or "no articulation"


def _pixels(view: URLabCameraView, frame: CameraFrame) -> Pixels:
    mode = view.mode
    if isinstance(mode, CameraMode) and frame.dtype != ("float32" if mode is CameraMode.DEPTH else "bgra8"):
        raise ProtocolError(f"step: a frame of {mode} camera {view.name!r} has dtype {frame.dtype!r}.", op="step")
    size = frame.width, frame.height
    return decode_camera(frame.data, view.mode, *size, memory=view.camera.memory, where=view.name).pixels
