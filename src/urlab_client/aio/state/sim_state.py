"""What the client knows of the simulation: the handshake, the local model, and the state of the last reply.

The client and its namespaces share one `SimState`; users see it through the attributes of `URLabClient`.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.live.live_state import LatestPicture, LiveState
from urlab_client.aio.live.publishers import Publishers
from urlab_client.aio.live.step_streams import StepStreams
from urlab_client.aio.model.articulation_state import MirroredArticulation, MirroredEntity
from urlab_client.aio.model.mirror import Mirror, write_options
from urlab_client.aio.motion import Motion
from urlab_client.aio.session import Session
from urlab_client.aio.state.pending_outcomes import PendingOutcomes
from urlab_client.aio.state.scene_objects import SceneObjects
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import CameraMode, CameraTiming, StepMode
from urlab_client.protocol.errors import (
    NoActiveManager,
    NoSession,
    ProtocolError,
    SessionTakenOver,
    URLabRPCError,
)
from urlab_client.protocol.messages.session import (
    ArticulationState,
    CameraFrame,
    EntityState,
    HelloOk,
    Perturbation,
    StateReply,
    StepOk,
)
from urlab_client.protocol.messages.streams import PlayEnded, SessionLost, SessionOpened, StateSnapshot
from urlab_client.protocol.observer import ClientObserver
from urlab_client.protocol.pixels import Pixels, decode_camera
from urlab_client.protocol.sim_options import check_sim_options
from urlab_client.protocol.types import SimOptions

__all__ = ["SimState"]

log: logging.Logger = logging.getLogger("urlab_client.client")

# By the server's clock. More than this means that the clock was set, not that a message was overtaken.
_OVERTAKEN_S = 1.0


_Parts = tuple[
    list[tuple[MirroredArticulation, ArticulationState]],
    list[tuple[MirroredEntity, EntityState]],
    list[tuple[URLabCameraView, Pixels, CameraFrame]],
]
"""The parts of a state that fits, each with what it is about."""


class SimState:
    """Everything that `discover()` and the replies after it say.

    Attributes:
        session: The RPC session.
        publishers: What the server publishes.
        mirror: Local model and data.
        objects: Articulations, entities and cameras.
        wanted_mode: Step mode the user asked for.
        mode_assumed: Whether nothing the server said shows yet that `mode` is in force.
        promoted_from: Mode to go back to on close, after a promotion of our own; maybe one that only the server knows.
        mode_word: What the server called the step mode when it last told it.
        level: Observation level of the session.
        paused: Whether this client has paused physics, as far as that lasts.
        sent_level: Observation level the server has, which an earlier step may have changed.
        hello: The last handshake, without the model's bytes.
        step_count: Steps since the last handshake or reset.
        reset_seed: Seed of the last reset, None without one.
        sim_time: Simulation time of the last reply, seconds.
        on_adopted: Told of each handshake taken over, and of the end of play.
        pending: Requests whose replies were lost.
        switching_play: Whether this client is starting or ending play, so that neither is news.
        observers: Who looks on, such as recorders.
        step_streams: Where the pictures of steps are looked for if replies bring older ones.
    """

    def __init__(
        self,
        session: Session,
        publishers: Publishers,
        motion: Motion,
        *,
        wanted_mode: StepMode,
        live_pictures: bool,
    ) -> None:
        self.session = session
        self.publishers = publishers
        self.step_streams: StepStreams = StepStreams(publishers)
        self.mirror: Mirror = Mirror()
        self.objects: SceneObjects = SceneObjects(session, publishers, self.mirror, motion)
        self.wanted_mode = wanted_mode
        self._mode = StepMode.LIVE
        self.mode_assumed: bool = False
        self._live = LiveState(publishers.state(), self._absorb_live, self.mirror.lock)
        self.promoted_from: StepMode | str | None = None
        self.mode_word = ""
        self.level = "standard"
        self.paused: bool = False
        self.sent_level: str = "standard"
        self.hello: HelloOk | None = None
        self.step_count: int = 0
        self.reset_seed: int | None = None
        self.sim_time: float = 0.0
        self.sim_time_sec: int = 0
        self.sim_time_nsec: int = 0
        self.wall_time_sec: int = 0
        self.wall_time_nsec: int = 0
        self.recv_wall_time_ns: int = 0
        self.user: dict[str, Any] = {}
        session.on_opened = self._note_session
        session.on_refusal = self._note_refusal
        session.control.resolve = self._articulation_key
        self._live_pictures = live_pictures
        self.pending: PendingOutcomes = PendingOutcomes()
        self.on_adopted: Callable[[], None] | None = None
        self.switching_play = False
        self.observers: tuple[ClientObserver, ...] = ()  # replaced, never changed: from any thread

    @property
    def mode(self) -> StepMode:
        """Step mode in force, as far as this client knows. In live mode, and no other, state is received by itself."""
        return self._mode

    @mode.setter
    def mode(self, mode: StepMode) -> None:
        self.mode_assumed = False
        self._mode = mode
        live = mode is StepMode.LIVE and self.hello is not None and self.hello.manager_present
        receivers: list[LiveState | LatestPicture] = [self._live]
        if self._live_pictures:
            receivers.extend(view.pictures for view in self.objects.views())
        for receiver in receivers:
            if live:
                receiver.start()
            else:
                receiver.stop()

    def tell_of_handshake(self) -> None:
        """Let the observers know that a handshake was taken over."""
        for observer in self.observers:
            try:
                observer.on_handshake()
            except Exception:
                log.exception("%r failed on a handshake", observer)

    def observed_cameras(self, n_steps: int) -> dict[str, str]:
        """Return the pictures that the observers want of the next step: camera to `sync` or `latest`."""
        wanted: dict[str, str] = {}
        for observer in self.observers:
            try:
                wanted |= {name: str(CameraTiming(how)) for name, how in observer.step_cameras(n_steps).items()}
            except Exception:
                log.exception("%r failed to say which pictures it wants", observer)
        return wanted

    def assume_mode(self, mode: StepMode) -> None:
        """Go by a step mode until a reply shows which one is in force: no op tells it without changing it."""
        self.mode = mode
        self.mode_assumed = True

    @property
    def live(self) -> bool:
        """Whether state is received by itself."""
        return self._live.running

    @property
    def live_received(self) -> int:
        """Snapshots that arrived by themselves."""
        return self._live.stats.received

    @property
    def local_time(self) -> float:
        """Simulation time of the local data, or without them of the last reply, seconds."""
        return self.sim_time if self.mirror.data is None else self.mirror.data.time

    def _articulation_key(self, name: str) -> str | None:
        articulation = self.objects.articulations.get(name)
        return None if articulation is None else articulation.prefix

    def require_handshake(self, op: str) -> None:
        """Refuse an op that goes by what a handshake said, when that is not known.

        Raises:
            NoSession: The handshake of the session, or of a new play, was given up.
        """
        if self.hello is None and self.session.greeted:
            raise NoSession("discover() did not finish. Nothing was sent.", op=op)
        if self.pending.play:
            raise NoSession(
                "sim.start() was broken off, so it is not known what plays now. Nothing was sent.",
                op=op,
                hint="Call sim.start(), discover() or resync().",
            )

    def _note_session(self, hello: HelloOk) -> None:
        """Note that a session was opened, maybe by a handshake that its caller had given up."""
        self.pending.clear()  # what belonged to the session before is refused now
        self.step_count = 0
        self.sent_level = ""
        self.publishers.events.publish(
            SessionOpened(
                session_id=hello.session_id, urlab_version=hello.urlab_version, mujoco_version=hello.mujoco_version
            )
        )

    def absorb_reset(self, reply: StateReply, keyframe: str | None) -> None:
        """Take over the state after a reset, whole or not at all; raises as `absorb` does."""
        received = time.time_ns()
        parts = self._checked(reply, "reset")
        with self.mirror.lock:
            self.mirror.reset(keyframe)
            for record in self.objects.entity_records.values():
                record.pose = None
            self._take_over(reply, parts, received, into_mirror=True)

    @property
    def _trusted(self) -> bool:
        """Whether published states can be this session's; a client that looks on has none to lose."""
        return self.session.confirmed or self.session.read_only

    def matches(self, snapshot: StateSnapshot) -> bool:
        """Whether a published state is of the world that the handshake described, as far as that can be seen."""
        if not self._trusted or snapshot.per_articulation.keys() != self.objects.records.keys():
            return False
        try:
            self._checked(snapshot, "state/full")
        except ProtocolError:
            return False
        return True

    def _absorb_live(self, snapshot: StateSnapshot) -> None:
        age = self.wall_time_sec - snapshot.wall_time.sec + (self.wall_time_nsec - snapshot.wall_time.nsec) / 1e9
        if 0 < age < _OVERTAKEN_S:
            return  # sent before the last reply, arrived after it
        if not self._trusted:
            return  # the connection was lost: this may be another server's
        known = self.objects.records
        if snapshot.per_articulation.keys() != known.keys():
            raise ProtocolError(
                f"state/full: it holds {_listed(snapshot.per_articulation)}, the handshake {_listed(known)}.",
                hint="The world changed on the server: call discover().",
            )
        self.absorb(snapshot, "state/full")

    def absorb(self, reply: StateReply | StateSnapshot, op: str, *, into_mirror: bool = True) -> None:
        """Take over the state in a reply, whole or not at all.

        Args:
            reply: The reply.
            op: Op that it answers, for messages.
            into_mirror: Also write it into the local data; not in puppet mode, whose state comes from there.

        Raises:
            ProtocolError: Something in it does not fit the model or the cameras; nothing was taken over.
        """
        received = time.time_ns()
        self._take_over(reply, self._checked(reply, op), received, into_mirror=into_mirror)

    def absorb_found(self, reply: StateReply, op: str) -> None:
        """Take over where a simulation stands that a handshake told of; raises as `absorb` does.

        Observers are not told: nothing has happened that they follow.
        """
        received = time.time_ns()
        self._write(reply, self._checked(reply, op), received, into_mirror=True)

    def _checked(self, reply: StateReply | StateSnapshot, op: str) -> _Parts:
        """Compare a state with the model and the cameras, and return it with what each part of it is about.

        Raises:
            ProtocolError: Something in it does not fit.
        """
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

    def _take_over(self, reply: StateReply | StateSnapshot, parts: _Parts, received: int, *, into_mirror: bool) -> None:
        self._write(reply, parts, received, into_mirror=into_mirror)
        own = self.publishers.own_steps
        if own and isinstance(reply, StateReply) and not (self.live or self.session.features.publishes_steps):
            own.publish(reply)
        for observer in self.observers:
            try:
                observer.on_state(reply)
            except Exception:
                log.exception("%r failed on a state", observer)

    def _write(self, reply: StateReply | StateSnapshot, parts: _Parts, received: int, *, into_mirror: bool) -> None:
        articulations, entities, pictures = parts
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
            self.mirror.mark_stale()
            self._absorb_clocks(reply, received)

    def _check_perturbation(self, drag: Perturbation, op: str) -> None:
        model = self.mirror.model
        if model is not None and not (
            0 < drag.body_id < model.nbody and len(drag.xfrc) == 6 and np.isfinite(drag.xfrc).all()
        ):
            raise ProtocolError(
                f"{op}: a perturbation of body {drag.body_id} by {drag.xfrc.tolist()}: "
                f"bodies are 1 to {model.nbody - 1}, a wrench is six numbers.",
                op=op,
            )

    def _absorb_clocks(self, reply: StateReply | StateSnapshot, received: int) -> None:
        self.step_count = reply.step
        self.sim_time = reply.time
        if isinstance(reply, StateSnapshot):
            self.user = reply.user
        self.recv_wall_time_ns = received
        if reply.sim_time is not None:
            self.sim_time_sec, self.sim_time_nsec = reply.sim_time.sec, reply.sim_time.nsec
        if reply.wall_time is not None:
            self.wall_time_sec, self.wall_time_nsec = reply.wall_time.sec, reply.wall_time.nsec

    def forget_clocks(self) -> None:
        """Start at zero, as a new play does: what was known is of the world before. Call under the lock."""
        self.step_count = 0
        self.sim_time = 0.0
        self.sim_time_sec = self.sim_time_nsec = 0

    def mirror_qpos(self, key: str, qpos: Floats) -> None:
        """Take over the leading joint positions of an articulation that `set_qpos` wrote, by any of its names.

        Raises:
            ProtocolError: They are neither all of its positions nor those of its free base.
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
            self.mirror.mark_stale()

    def mirror_options(self, options: SimOptions) -> None:
        """Take over the options that `set_sim_options` echoed, all or none.

        Raises:
            ProtocolError: One of them cannot be right.
        """
        try:
            check_sim_options(options)
            if self.mirror.model is not None:
                with self.mirror.lock:
                    write_options(self.mirror.model.opt, options)
        except ValueError as error:
            raise ProtocolError(f"set_sim_options: the server says that {error}.", op="set_sim_options") from None

    def _note_refusal(self, refusal: URLabRPCError) -> None:
        if isinstance(refusal, NoActiveManager):
            self.on_play_ended("stopped by somebody else")
        elif isinstance(refusal, SessionTakenOver):
            self.publishers.events.publish(SessionLost(session_id=self.session.session_id, reason=refusal.message))

    def on_play_ended(self, reason: str = "") -> None:
        """Note that the play session is gone: the server is back in live mode, without articulations."""
        played = self.hello is not None and self.hello.manager_present
        if self.hello is not None:
            self.hello.manager_present = False
        self.publishers.release_regions()
        self.session.control.forget()
        if self.publishers.camera_switch is not None:
            self.publishers.camera_switch.forget()
        self.mode = StepMode.LIVE
        self.paused = False
        self.promoted_from = None
        if played:
            self.publishers.events.publish(PlayEnded(reason=reason))
            if self.on_adopted is not None:
                self.on_adopted()

    def _frames(self, cameras: Mapping[str, CameraFrame]) -> list[tuple[URLabCameraView, CameraFrame]]:
        found: list[tuple[URLabCameraView, CameraFrame]] = []
        for name, frame in cameras.items():
            view = self.objects.camera(name) or self.objects.announced_camera(name, frame)
            if view is None:
                raise ProtocolError(f"step: a frame of camera {name!r}, which the handshake does not list.", op="step")
            found.append((view, frame))
        return found


def _listed(keys: Iterable[str]) -> str:
    return ", ".join(keys) or "no articulation"


def _pixels(view: URLabCameraView, frame: CameraFrame) -> Pixels:
    mode = view.mode
    if isinstance(mode, CameraMode) and frame.dtype != ("float32" if mode is CameraMode.DEPTH else "bgra8"):
        raise ProtocolError(f"step: a frame of {mode} camera {view.name!r} has dtype {frame.dtype!r}.", op="step")
    size = frame.width, frame.height
    return decode_camera(frame.data, view.mode, *size, memory=view.memory, where=view.name).pixels
