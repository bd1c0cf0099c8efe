"""What the client knows of the simulation: the handshake, the local model, and the state of the last reply.

The client and its namespaces share one `SimState`; users see it through the attributes of `URLabClient`.
"""

from __future__ import annotations

import logging
import math
import re
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

import anyio.to_thread
import numpy as np

from urlab_client.aio.articulation import URLabArticulation, URLabEntity
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.live.live_state import LatestPicture, LiveState
from urlab_client.aio.live.publishers import Publishers
from urlab_client.aio.model.articulation_state import Carried, MirroredArticulation, MirroredEntity
from urlab_client.aio.model.mirror import Mirror, write_options
from urlab_client.aio.session import Session, Turn
from urlab_client.aio.state.handshake import Examined, examine
from urlab_client.aio.state.recovery import PendingOutcomes, leaves_open
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import LATER_MODE_NAMES, CameraMode, StepMode, known
from urlab_client.protocol.errors import (
    BadMode,
    ModeLocked,
    NoActiveManager,
    NoSession,
    ProtocolError,
    SessionTakenOver,
    URLabError,
    URLabRPCError,
)
from urlab_client.protocol.messages.runtime import SetMode, SetPaused
from urlab_client.protocol.messages.session import (
    NOT_SENT,
    ArticulationCommand,
    ArticulationState,
    CameraFrame,
    CameraInfo,
    EntityState,
    Hello,
    HelloOk,
    Perturbation,
    StateReply,
    StepOk,
)
from urlab_client.protocol.messages.streams import PlayEnded, PlayStarted, SessionLost, SessionOpened, StateSnapshot
from urlab_client.protocol.names import NameMap
from urlab_client.protocol.rows import Pixels, decode_camera
from urlab_client.protocol.sim_options import check_sim_options
from urlab_client.protocol.types import SimOptions

__all__ = ["SimState", "StateObserver"]

log = logging.getLogger("urlab_client.client")

# By the server's clock. More than this means that the clock was set, not that a message was overtaken.
_OVERTAKEN_S = 1.0

# Unreal's actor names: class, then a number or a generated id.
_ENGINE_NAME = re.compile(r"(?P<stem>.+)_C_(?:\d+|UAID_\w+)")


_Parts = tuple[
    list[tuple[MirroredArticulation, ArticulationState]],
    list[tuple[MirroredEntity, EntityState]],
    list[tuple[URLabCameraView, Pixels, CameraFrame]],
]
"""The parts of a state that fits, each with what it is about."""


class StateObserver(Protocol):
    """Looks on while the client works. Called on the event loop, so it must be quick; it must not raise."""

    def on_state(self, reply: StateReply | StateSnapshot) -> None:
        """Take note of a state that was taken over. Its arrays go on to the caller of `step()`: copy what is kept."""
        ...

    def wanted_pictures(self, asked: bool | dict[str, str | None], n_steps: int) -> bool | dict[str, str | None]:
        """Return the pictures that the next step is to bring: what its caller asked for, and more."""
        ...


class SimState:
    """Everything that `discover()` and the replies after it say.

    Attributes:
        session: The RPC session.
        publishers: What the server publishes.
        mirror: Local model and data.
        wanted_mode: Step mode the user asked for.
        mode_assumed: Whether nothing the server said shows yet that `mode` is in force.
        promoted_from: Mode to go back to on close, after a promotion of our own; maybe one that only the server knows.
        mode_word: What the server called the step mode when it last told it.
        level: Observation level of the session.
        sent_level: Observation level the server has, which an earlier step may have changed.
        hello: The last handshake, without the model's bytes.
        articulations: Articulations by key.
        entities: Every dynamic body by name, articulations included.
        global_cameras: Scene-level cameras.
        step_count: Steps since the last handshake or reset.
        sim_time: Simulation time of the last reply, seconds.
        on_adopted: Told of each handshake taken over, and of the end of play.
        pending: Requests whose replies were lost.
        stopping: Whether this client is ending play, so that its end is not news.
        observers: Told of each state taken over, such as recorders.
    """

    def __init__(
        self,
        session: Session,
        publishers: Publishers,
        *,
        wanted_mode: StepMode,
        local_model: bool,
        check_version: bool,
        promote: bool,
        trusted: bool,
        live_pictures: bool,
    ) -> None:
        self.session = session
        self.publishers = publishers
        self.mirror = Mirror()
        self.wanted_mode = wanted_mode
        self._mode = StepMode.LIVE
        self.mode_assumed = False
        self._live = LiveState(publishers.state(), self._absorb_live, self.mirror.lock)
        self.promoted_from: StepMode | str | None = None
        self.mode_word = ""
        self.level = "standard"
        self.sent_level = "standard"
        self.hello: HelloOk | None = None
        self.articulations: NameMap[URLabArticulation] = NameMap(kind="articulation")
        self.articulations_by_id: dict[str, URLabArticulation] = {}
        self.entities: NameMap[URLabEntity] = NameMap(kind="entity")
        self.global_cameras: NameMap[URLabCameraView] = NameMap(kind="camera")
        self.step_count = 0
        self.sim_time = 0.0
        self.sim_time_sec = self.sim_time_nsec = 0
        self.wall_time_sec = self.wall_time_nsec = 0
        self.recv_wall_time_ns = 0
        self.user: dict[str, Any] = {}
        self._local_model = local_model
        self._check_version = check_version
        self._mismatch_said = False
        session.on_opened = self._note_session
        session.on_refusal = self._note_refusal
        session.control.resolve = self._articulation_key
        self._promote = promote
        self._trusted = trusted
        self._live_pictures = live_pictures
        self.pending = PendingOutcomes()
        self.on_adopted: Callable[[], None] | None = None
        self.stopping = False
        self.observers: list[StateObserver] = []
        self._records: dict[str, MirroredArticulation] = {}
        self._entity_records: dict[str, MirroredEntity] = {}

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
            receivers.extend(view.pictures for view in self._views())
        for receiver in receivers:
            if live:
                receiver.start()
            else:
                receiver.stop()

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
    def records(self) -> Mapping[str, MirroredArticulation]:
        """Records of the articulations, by key."""
        return self._records

    @property
    def entity_records(self) -> Mapping[str, MirroredEntity]:
        """Records of the plain entities, by name."""
        return self._entity_records

    @property
    def local_time(self) -> float:
        """Simulation time of the local data, or without them of the last reply, seconds."""
        return self.sim_time if self.mirror.data is None else self.mirror.data.time

    def _articulation_key(self, name: str) -> str | None:
        articulation = self.articulations.get(name)
        return None if articulation is None else articulation.prefix

    def direct_commands(self, carried: Carried) -> dict[str, ArticulationCommand]:
        """Return what a step tells the articulations and entities, with the wrenches that it carries."""
        commands = {record.name: record.direct_command(carried.get(record)) for record in self._ours()}
        for name, record in self._entity_records.items():
            if record not in carried:
                continue
            if not self.session.features.claims:
                # Under its own name: the server tries the body's name alone after `<key>_<body>`.
                commands[name] = record.wrench_command(carried[record])
            else:
                # An entity has no owner, so one of the robots takes it along.
                key = next(iter(commands or self._records))
                carrier = commands.setdefault(key, ArticulationCommand())
                carrier.xfrc_applied = {**(carrier.xfrc_applied or {}), **carried[record]}
        return commands

    def live_commands(self, carried: Carried) -> dict[str, ArticulationCommand]:
        """Return what a step in live mode tells the articulations."""
        if self.session.features.live_pictures_in_steps:
            return self.direct_commands(carried)
        return {record.name: record.live_command() for record in self._ours()}

    def _ours(self) -> list[MirroredArticulation]:
        # A server whose robots have owners refuses a step that writes to others' robots, so it hears of ours only.
        records = self._records.values()
        return [record for record in records if record.driven] if self.session.features.claims else [*records]

    def take_wrenches(self) -> Carried:
        """Take what the step that is being built carries out of its buffers."""
        carried: Carried = {record: record.take_wrenches() for record in self._ours() if record.wrenches}
        if self._records or not self.session.features.claims:
            for record in self._entity_records.values():
                if record.wrenches:
                    carried[record] = record.take_wrenches()
        return carried

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

    async def open(self, turn: Turn, observations: str) -> HelloOk:
        """Open a session and take over what the server says."""
        hello = await self.session.hello(turn, Hello(observations=observations))
        self.level = self.sent_level = observations
        await self.adopt(turn, hello)
        return hello

    async def _loadable(self, turn: Turn, hello: HelloOk) -> HelloOk:
        """Return a handshake whose model this process can and may load.

        Raises:
            URLabVersionMismatch: It is another MuJoCo's, and the user wants to hear of that.
            URLabError: The server is not trusted with binary models and offers no other.
        """
        mismatch = self.mirror.check_version(hello)
        if mismatch is not None:
            if self._check_version:
                raise mismatch
            if not self._mismatch_said:
                self._mismatch_said = True
                warnings.warn(
                    f"{mismatch.args[0]} The local model is compiled here from XML and only approximates the server's.",
                    stacklevel=2,
                )
            if hello.mjcf_compiled is None:
                hello = await self._hello_with_assets(turn)
        if hello.mjb is not None and not self._trusted:
            hello = await self._without_binary(turn, hello)
        return hello

    async def _hello_with_assets(self, turn: Turn) -> HelloOk:
        hello = await self.session.hello(turn, Hello(observations=self.level, include_assets=True))
        self.sent_level = self.level
        return hello

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

    async def _without_binary(self, turn: Turn, hello: HelloOk) -> HelloOk:
        """Return the handshake with a model in XML alone: MuJoCo's binary loader is no match for a hostile model.

        Raises:
            URLabError: The server has none.
        """
        if hello.mjcf_compiled is None:
            log.info("the server is not trusted with binary models: the local model is compiled here from XML")
            hello = await self._hello_with_assets(turn)
        if hello.manager_present and hello.mjcf_compiled is None:
            raise URLabError(
                "The server offers its model only in MuJoCo's binary format, which is loaded from servers on this "
                "machine and from servers known by their key.",
                op="hello",
                hint="Pass server_key=…, or trust_server=True if you trust the network in between, or "
                "local_model=False.",
            )
        hello.mjb = None
        return hello

    async def adopt(self, turn: Turn, hello: HelloOk) -> None:
        """Take over a handshake: load its model, bind the wrappers, bring the server into the wanted step mode."""
        hello.mjb_base64 = NOT_SENT  # it keeps the whole reply in memory
        await self.session.transport.follow(hello)
        loaded = None
        if self._local_model:
            if hello.mjb is not None:
                hello = await self._loadable(turn, hello)
            load = partial(self.mirror.load, hello, trusted=self._trusted)
            loaded = await turn.aside(anyio.to_thread.run_sync(load, abandon_on_cancel=True))
        examined = examine(hello, None if loaded is None else loaded.model)
        self.publishers.check_open()
        # From here on nothing waits until all is taken over: cancelled or not, model and wrappers belong together.
        # The model's bytes, several times its size, are not needed any more.
        hello.mjb = hello.mjcf_compiled = hello.vfs_assets = None
        played = self.hello is not None and self.hello.manager_present
        with self.mirror.lock:
            if self._local_model:
                self.mirror.use(loaded)
            self.hello = hello
            self._bind_articulations(hello, examined)
            self._bind_entities(examined)
            cameras = hello.global_cameras or {}
            self.global_cameras = NameMap(
                {n: self._global_camera(n, info) for n, info in cameras.items()}, kind="camera"
            )
            self.step_count = 0
        self.pending.play = False
        self._views()  # binds the cameras to what the handshake says of them
        self.publishers.refresh()
        if self.publishers.camera_switch is not None:
            self.publishers.camera_switch.restart([view.info for view in self._views()])
        if hello.manager_present and not played:
            self.publishers.events.publish(PlayStarted(articulations=list(self.articulations)))
        if self.on_adopted is not None:
            self.on_adopted()
        if not hello.manager_present:
            self.mode = StepMode.LIVE
        elif self._promote and self.wanted_mode is not StepMode.AUTO:
            await self._promote_to(turn, self.wanted_mode)
        else:
            self.assume_mode(StepMode.LIVE if self.wanted_mode is StepMode.AUTO else self.wanted_mode)
        log.info(
            "session with %s, MuJoCo %s: %d articulations, mode %s",
            hello.urlab_version, hello.mujoco_version, len(self.articulations), self.mode,
        )  # fmt: skip

    async def _promote_to(self, turn: Turn, mode: StepMode) -> None:
        self.pending.mode = mode  # until the server has agreed, whatever comes between
        try:
            previous = await self.ask_mode(turn, mode)
        except ModeLocked as locked:
            if locked.pinned is not None:
                raise
            self.assume_mode(mode)  # which mode it is pinned to shows in the reply to the first step
            return
        except BaseException as error:
            if leaves_open(error) and self.promoted_from is None:
                self.promoted_from = StepMode.LIVE  # what play begins in; the reply would have told
            raise
        if previous is not self.mode:
            self.promoted_from = previous

    async def ask_mode(self, turn: Turn, mode: StepMode | str) -> StepMode | str:
        """Bring the server into a step mode, take over the one in force, and return the one before.

        A word that no mode is known by is the server's own for the mode that it was asked for.

        Raises:
            ModeLocked: The project pins another one, which has been taken over if its name is known.
        """
        try:
            with self.pending.about_mode(mode):
                try:
                    reply = await turn.call(SetMode(mode=mode))
                except BadMode:
                    # Servers after the beta call the modes by other names.
                    later = LATER_MODE_NAMES.get(mode) if isinstance(mode, StepMode) else None
                    reply = await turn.call(SetMode(mode=later or mode))
        except ModeLocked as locked:
            if locked.pinned is not None:
                self.mode = locked.pinned
            if locked.pinned is not mode:
                raise
            if mode is StepMode.DIRECT:
                # Play starts paused, and no change of mode can resume it where the mode is pinned.
                await turn.call(SetPaused(paused=False))
            return mode
        previous, current = known(StepMode, reply.previous_mode), known(StepMode, reply.current_mode)
        self.mode_word = reply.current_mode
        if not isinstance(current, StepMode):
            log.warning("the server calls step mode %s %r", mode, current)
            current = mode if isinstance(mode, StepMode) else StepMode.LIVE
        try:
            if self.session.features.idles_in_puppet:
                await self._still_puppet(turn, previous, current)
        finally:
            self.mode = current
        return previous

    async def _still_puppet(self, turn: Turn, previous: StepMode | str, current: StepMode) -> None:
        """Keep physics from taking steps of its own between the pushes of puppet mode, and undo that afterwards."""
        if current is StepMode.PUPPET:
            await turn.call(SetPaused(paused=True))
        elif previous is StepMode.PUPPET and current is StepMode.LIVE:  # direct mode takes the pause back itself
            await turn.call(SetPaused(paused=False))

    def _global_camera(self, name: str, info: CameraInfo) -> URLabCameraView:
        view = self.global_cameras.get(name)
        if view is None:
            return URLabCameraView(name, info, self.publishers)
        view.info = info
        return view

    def _views(self) -> list[URLabCameraView]:
        own = [view for art in self.articulations.values() for view in art.cameras.values()]
        return [*own, *self.global_cameras.values()]

    def _bind_articulations(self, hello: HelloOk, examined: Examined) -> None:
        wrappers: dict[str, URLabArticulation] = {}
        aliases: dict[str, list[str]] = {}
        for info in hello.articulations:
            key = info.prefix
            layout = examined.layouts[key]
            record = self._records.get(key)
            if record is None:
                record = self._records[key] = MirroredArticulation(self.mirror, info, layout)
            else:
                record.bind(info, layout)
            wrappers[key] = self.articulations.get(key) or URLabArticulation(record, self.session, self.publishers)
            found = _ENGINE_NAME.fullmatch(info.compiled_prefix)
            for alias in {info.actor_id, info.compiled_prefix, found["stem"] if found else ""} - {"", key}:
                aliases.setdefault(alias, []).append(key)
        self._records = {key: self._records[key] for key in wrappers}
        self.articulations = NameMap(wrappers, aliases, kind="articulation")
        self.articulations_by_id = {art.actor_id: art for art in wrappers.values() if art.actor_id}

    def _bind_entities(self, examined: Examined) -> None:
        plain: dict[str, URLabEntity] = {}
        records: dict[str, MirroredEntity] = {}
        for name, info in examined.entities.items():
            record = self._entity_records.get(name) or MirroredEntity(self.mirror, name)
            record.bind_entity(info)
            records[name] = record
            known = self.entities.get(name)
            plain[name] = known if known is not None and type(known) is URLabEntity else URLabEntity(record)
        self._entity_records = records
        self.entities = NameMap({**self.articulations, **plain}, kind="entity")

    def absorb_reset(self, reply: StateReply, keyframe: str | None) -> None:
        """Take over the state after a reset, whole or not at all; raises as `absorb` does."""
        received = time.time_ns()
        parts = self._checked(reply, "reset")
        with self.mirror.lock:
            self.mirror.reset(keyframe)
            for record in self._entity_records.values():
                record.pose = None
            self._take_over(reply, parts, received, into_mirror=True)

    def matches(self, snapshot: StateSnapshot) -> bool:
        """Whether a published state is of the world that the handshake described, as far as that can be seen."""
        if not self.session.confirmed or snapshot.per_articulation.keys() != self._records.keys():
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
        if not self.session.confirmed:
            return  # the connection was lost: this may be another server's
        if snapshot.per_articulation.keys() != self._records.keys():
            raise ProtocolError(
                f"state/full: it holds {_listed(snapshot.per_articulation)}, the handshake {_listed(self._records)}.",
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

    def _checked(self, reply: StateReply | StateSnapshot, op: str) -> _Parts:
        """Compare a state with the model and the cameras, and return it with what each part of it is about.

        Raises:
            ProtocolError: Something in it does not fit.
        """
        if not math.isfinite(reply.time):
            raise ProtocolError(f"{op}: the simulation time is {reply.time}.", op=op)
        articulations = [(self._records[key], s) for key, s in reply.per_articulation.items() if key in self._records]
        for record, state in articulations:
            record.check(state, op)
        entities: list[tuple[MirroredEntity, EntityState]] = []
        if isinstance(reply, (StepOk, StateSnapshot)) and reply.entities:
            known = self._entity_records
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
        articulations, entities, pictures = parts
        with self.mirror.lock:
            for record, state in articulations:
                record.absorb(state)
                if into_mirror:
                    record.write_mirror(state)
            for entity, pose in entities:
                entity.absorb_pose(pose, into_mirror=into_mirror)
            for view, pixels, frame in pictures:
                taken = reply.time if frame.sim_time is None else frame.sim_time
                view.pictures.deliver(pixels, taken, frame.frame_id)
            if into_mirror and self.mirror.data is not None:
                self.mirror.data.time = reply.time
            self.mirror.mark_stale()
            self._absorb_clocks(reply, received)
        own = self.publishers.own_steps
        if own and isinstance(reply, StateReply) and not (self.live or self.session.features.publishes_steps):
            own.publish(reply)
        for observer in self.observers:
            observer.on_state(reply)

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

    def mirror_qpos(self, key: str, qpos: Floats) -> None:
        """Take over the leading joint positions of an articulation that `set_qpos` wrote, by any of its names.

        Raises:
            ProtocolError: They are neither all of its positions nor those of its free base.
        """
        articulation = self.articulations.get(key)
        if articulation is None:
            return
        record = self._records[articulation.prefix]
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
        self.promoted_from = None
        if played:
            self.publishers.events.publish(PlayEnded(reason=reason))
            if self.on_adopted is not None:
                self.on_adopted()

    def note_missing_frames(self, asked: Iterable[str], reply: StepOk) -> None:
        """Mark the cameras whose frame was asked for and did not come: the server just leaves them out."""
        views = [view for view in map(self.camera, asked) if view is not None]
        came = {id(self.camera(name)) for name in reply.cameras or {}}
        for view in views:
            if view.delivered and id(view) not in came:
                log.warning("camera %s delivered no frame; its latest_frame is older than the state", view.name)
            view.delivered = id(view) in came

    def _frames(self, cameras: Mapping[str, CameraFrame]) -> list[tuple[URLabCameraView, CameraFrame]]:
        found: list[tuple[URLabCameraView, CameraFrame]] = []
        for name, frame in cameras.items():
            view = self.camera(name) or self._scene_camera(name, frame)
            if view is None:
                raise ProtocolError(f"step: a frame of camera {name!r}, which the handshake does not list.", op="step")
            found.append((view, frame))
        return found

    def _scene_camera(self, name: str, frame: CameraFrame) -> URLabCameraView | None:
        """Return a view of a camera of the scene that was announced by its picture alone."""
        if not self.hidden_cameras:
            return None
        mode = CameraMode.DEPTH if frame.dtype == "float32" else CameraMode.REAL
        info = CameraInfo(mode=mode, resolution=(frame.width, frame.height), fovy=0.0, zmq_endpoint="", zmq_topic=name)
        view = URLabCameraView(name, info, self.publishers)
        self.global_cameras = NameMap({**self.global_cameras, name: view}, kind="camera")
        return view

    def camera_names(self) -> list[str]:
        """Return a name of each camera that no other has: `<articulation>/<camera>`, or the scene's."""
        own = [f"{art.prefix}/{name}" for art in self.articulations.values() for name in art.cameras]
        return [*own, *self.global_cameras]

    def shown_cameras(self, names: Iterable[str]) -> dict[str, str]:
        """Return what users call cameras by `camera_names`: by the name alone where that means one of them."""
        short = {name: name.rpartition("/")[2] for name in names}
        counts = Counter(short.values())
        return {name: bare if counts[bare] == 1 else name for name, bare in short.items()}

    def camera_name(self, name: str) -> str:
        """Return which of `camera_names` a user means by `<articulation>/<camera>` or just `<camera>`.

        Raises:
            KeyError: None of them, or several.
        """
        names = self.camera_names()
        owner, slash, short = name.rpartition("/")
        if slash:
            art = self.articulations.get(owner)
            found = [f"{art.prefix}/{short}"] if art is not None and short in art.cameras else []
        else:
            found = [known for known in names if known == name or known.endswith(f"/{name}")]
        if not found:
            raise KeyError(f"no camera {name!r}; there are: {', '.join(names) or 'none'}")
        if len(found) > 1:
            raise KeyError(f"camera {name!r} is ambiguous: it could mean {' or '.join(map(repr, found))}")
        return found[0]

    @property
    def hidden_cameras(self) -> bool:
        """Whether the scene may have cameras that the handshake does not list."""
        return any("/" in name for record in self._records.values() for name in record.info.camera_topics)

    def camera(self, name: str) -> URLabCameraView | None:
        """Return the camera that a user means by `<articulation>/<camera>` or just `<camera>`, or None."""
        try:
            return self.require_camera(name)
        except KeyError:
            return None

    def require_camera(self, name: str) -> URLabCameraView:
        """Return the camera that a user means by `<articulation>/<camera>` or just `<camera>`.

        Raises:
            KeyError: None, or several.
        """
        if name in self.global_cameras:
            return self.global_cameras[name]
        owner, _, short = self.camera_name(name).rpartition("/")
        return self.articulations[owner].cameras[short] if owner else self.global_cameras[short]


def _listed(keys: Iterable[str]) -> str:
    return ", ".join(keys) or "no articulation"


def _pixels(view: URLabCameraView, frame: CameraFrame) -> Pixels:
    mode = view.mode
    if isinstance(mode, CameraMode) and frame.dtype != ("float32" if mode is CameraMode.DEPTH else "bgra8"):
        raise ProtocolError(f"step: a frame of {mode} camera {view.name!r} has dtype {frame.dtype!r}.", op="step")
    return decode_camera(frame.data, view.mode, frame.width, frame.height, where=view.name).pixels
