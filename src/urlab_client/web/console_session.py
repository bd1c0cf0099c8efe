"""What all viewers share: the session that is kept, the newest state, the log, the controls.

Nothing is queued for anybody. A viewer is told that something changed and takes what is newest when they are ready.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, Generator, Mapping
from typing import TYPE_CHECKING, Any

import anyio
import numpy as np
from msgspec import Struct, structs

from urlab_client.protocol.base import Effect, Request
from urlab_client.protocol.codec import op_of
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import ClientClosed, URLabError, URLabTimeoutError
from urlab_client.protocol.messages.recording import RecordingStart, RecordingStop, ReplayStart, ReplayStop
from urlab_client.protocol.messages.runtime import SetControlSource, SetPaused, SetSimSpeed, SetTwist
from urlab_client.protocol.messages.session import ArticulationCommand, Step
from urlab_client.protocol.messages.streams import (
    ClientEvent,
    PlayEnded,
    PlayStarted,
    ServerAnswers,
    ServerLost,
    ServerReconnected,
    ServerSilent,
    SessionLost,
    SessionOpened,
    StateSnapshot,
)
from urlab_client.web.description import WorldDescription, describe
from urlab_client.web.driving_lease import DrivingLease, Viewer
from urlab_client.web.mujoco_viewer import MujocoViewer
from urlab_client.web.ops import encode, perform
from urlab_client.web.pictures import Feed

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabCameraView, URLabClient

__all__ = ["Audience", "ConsoleSession", "Link", "LogEntry"]

log = logging.getLogger("urlab_client.web")

_PERIOD_S = 1 / 60
_RETRY_S = 1.0
_PULSE_S = 0.5
_CONNECT_S = 3.0
_KEPT = 300
_DIGITS = 5
_SEEK_STEPS = 8  # recordings have about one frame a timestep
_MOVING_S = 0.4  # a paused server repeats its state ten times a second


class Link(Struct):
    """The connection to the server: `connecting`, `connected`, `lost`, `silent` or `taken_over`, and why."""

    state: str
    reason: str = ""
    since: float = 0.0


class LogEntry(Struct):
    """One line of the log. `kind` is `call`, `error` or `event`; `at` is Unix time in seconds."""

    n: int
    at: float
    kind: str
    who: str
    what: str
    text: str
    ms: float | None = None


class Audience:
    """One viewer who is watching right now.

    Attributes:
        viewer: Who it is.
        changed: Set when there is something new.
    """

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.changed = asyncio.Event()


class ConsoleSession:
    """See the module.

    Args:
        client: The client; the console opens its session and keeps it.
        lease: The controls.
    """

    def __init__(self, client: URLabClient, lease: DrivingLease) -> None:
        self.client = client
        self.lease = lease
        self.link = Link("connecting", since=time.time())
        self.world = WorldDescription()
        self.world_json = encode({"type": "world", "world": self.world})
        self.state_json: bytes | None = None
        self.state_seq = 0
        self.entries: deque[LogEntry] = deque(maxlen=_KEPT)
        self.audience: set[Audience] = set()
        self.snapshot: StateSnapshot | None = None
        self.mujoco_viewer = MujocoViewer(client)
        self._bells: set[asyncio.Event] = set()
        self._n = 0
        self._want: str | None = "discover"
        self._wake = asyncio.Event()
        self._ready = asyncio.Event()
        self._moved_at = 0.0
        self._rate = 0.0
        self._rate_from: tuple[float, float] | None = None
        self._running = False
        self._wake_runner = asyncio.Event()
        self._seeded: set[str] = set()
        self._pending: set[str] = set()
        self._commanded = asyncio.Event()
        self._feeds: dict[str, Feed] = {}
        self._speed: float | None = None
        self._source: str | None = None
        self._recording = self._replaying = False
        self._replay: tuple[int, int] | None = None
        self._twists: dict[str, tuple[float, float, float]] = {}

    # Life

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncGenerator[None]:
        """Keep the session and receive state while the body runs."""
        async with anyio.create_task_group() as tasks:
            for job in (self._keep, self._receive, self._command, self._run_direct, self._pulse):
                tasks.start_soon(job)
            try:
                yield
            finally:
                tasks.cancel_scope.cancel()

    async def _keep(self) -> None:
        """Open the session, and again whenever it is needed."""
        events = self.client.events()
        while True:
            if self._want is not None:
                await self._connect()
            waiting = asyncio.create_task(events.receive(timeout=None if self._want is None else _RETRY_S))
            asked = asyncio.create_task(self._wake.wait())
            try:
                await asyncio.wait((waiting, asked), return_when=asyncio.FIRST_COMPLETED)
                if waiting.done():
                    try:
                        self._take(waiting.result())
                    except URLabTimeoutError:
                        pass
                    except ClientClosed:
                        return
            finally:
                waiting.cancel()
                asked.cancel()
                await asyncio.wait((waiting, asked))
            self._wake.clear()

    async def _connect(self) -> None:
        want, self._want = self._want, None
        try:
            if want == "resync":
                try:
                    await self.client.resync(timeout=_CONNECT_S)
                except URLabError:
                    await self.client.discover()
            else:
                await self.client.discover()
        except (URLabError, OSError) as error:
            self._want = "discover" if want == "discover" else "resync"
            if self.link.reason != str(error):
                self._set_link("lost" if self._ready.is_set() else "connecting", str(error))
                self.note("error", "console", "connect", str(error))
            return
        self._set_link("connected")
        self._ready.set()
        self._begin_anew()

    def _take(self, event: ClientEvent) -> None:
        """Act on what happened to the connection."""
        text = ", ".join(f"{name} {value}" for name, value in _said(event).items() if value)
        self.note("event", "server", str(event.__struct_config__.tag), text)
        match event:
            case ServerLost():
                self._set_link("lost", event.reason or "the connection broke")
                self._want = "resync"
            case ServerReconnected():
                self._want = "resync"
            case ServerSilent():
                self._set_link("silent", f"no reply to {event.op} in {event.waited_s:.0f} s")
            case ServerAnswers():
                self._set_link("connected")
            case SessionLost() if event.session_id == self.client.session_id and self._want is None:
                self._set_link("taken_over", "another program has taken the server over")
                self._running = False
            case PlayStarted():
                if event.articulations or not self.client.session_id:
                    self._begin_anew()
                else:
                    self._want = "discover"
            case PlayEnded() | SessionOpened():
                self._running = False
                self._begin_anew()
            case _:
                pass

    def take_back(self) -> None:
        """Open a session again, after another program took the server over."""
        self._want = "discover"
        self._wake.set()

    def _set_link(self, state: str, reason: str = "") -> None:
        if self.link.state != state or self.link.reason != reason:
            self.link = Link(state, reason, time.time())
            self.tell()

    def _begin_anew(self) -> None:
        """Forget what belonged to the play before."""
        self._seeded.clear()
        self._twists.clear()
        self._recording = self._replaying = False
        self._replay = None
        self._redescribe()

    def _redescribe(self) -> None:
        self.world = describe(self.client, self.world.version + 1, self.mujoco_viewer.missing)
        self.world_json = encode({"type": "world", "world": self.world})
        self.tell()

    # State

    async def _receive(self) -> None:
        await self._ready.wait()
        while True:
            try:
                async with self.client.state_stream("latest", timeout=None) as states:
                    due = time.monotonic()
                    while True:
                        self._publish(await states.receive(timeout=None))
                        # By the clock and not by when it woke up, else each late awakening makes the rate lower.
                        due = max(due + _PERIOD_S, time.monotonic() - _PERIOD_S)
                        await anyio.sleep(max(0.0, due - time.monotonic()))
            except ClientClosed:
                return
            except URLabError as error:
                self.note("error", "console", "state", str(error))
                await anyio.sleep(_RETRY_S)

    def _publish(self, snapshot: StateSnapshot) -> None:
        now = time.monotonic()
        if self.snapshot is None or snapshot.time != self.snapshot.time:
            self._moved_at = now
            if self._rate_from is None or not snapshot.time >= self._rate_from[1]:
                self._rate_from, self._rate = (now, snapshot.time), 0.0
            elif now - self._rate_from[0] > 1:
                self._rate = (snapshot.time - self._rate_from[1]) / (now - self._rate_from[0])
                self._rate_from = (now, snapshot.time)
        self.snapshot = snapshot
        self.state_seq += 1
        wall = snapshot.wall_time.sec + snapshot.wall_time.nsec / 1e9
        received = snapshot.recv_wall_time_ns / 1e9
        # The server's own clock where it can be the same as ours; else what we know, when it got here.
        made = wall if 0 <= received - wall < 10 else received
        self.state_json = encode(
            {
                "type": "state",
                "seq": self.state_seq,
                "time": snapshot.time,
                "step": snapshot.step,
                "made": made * 1e3,
                "articulations": {
                    key: {
                        "qpos": _rounded(state.qpos),
                        "qvel": _rounded(state.qvel),
                        "ctrl": _rounded(state.ctrl),
                        "sensors": {name: _rounded(value) for name, value in (state.sensors or {}).items()},
                        "targets": self._targets(key),
                    }
                    for key, state in snapshot.per_articulation.items()
                },
                "entities": {name: {"xpos": _rounded(pose.xpos)} for name, pose in snapshot.entities.items()},
            }
        )
        self.tell()

    def _targets(self, key: str) -> list[float] | None:
        art = self.client.articulations.get(key)
        return _rounded(art.ctrl_array) if art is not None and key in self._seeded else None

    @property
    def moving(self) -> bool:
        """Whether simulation time advances."""
        return self.link.state == "connected" and time.monotonic() - self._moved_at < _MOVING_S

    def status(self, viewer: Viewer) -> dict[str, Any]:
        """Return what one viewer is told besides the state."""
        holder = self.lease.holder
        return {
            "type": "status",
            "link": self.link,
            "address": self.client.address,
            "playing": self.client.manager_present,
            "moving": self.moving,
            "running": self._running if self.client.step_mode is not StepMode.LIVE else self.moving,
            "rate": round(self._rate, 3) if self.moving else 0.0,
            "mode": self.client.step_mode,
            "speed": self._speed,
            "source": self._source,
            "recording": self._recording,
            "replaying": self._replaying,
            "replay": self._replay,
            "twists": self._twists,
            "viewers": len(self.audience),
            "driver": None if holder is None else holder.name,
            "mine": holder is not None and holder.key == viewer.key,
            "lease_left": round(self.lease.left, 1),
            "lease": self.lease.seconds,
        }

    def tell(self) -> None:
        """Let everybody look again."""
        for one in self.audience:
            one.changed.set()
        for bell in self._bells:
            bell.set()

    @contextlib.contextmanager
    def bell(self) -> Generator[asyncio.Event]:
        """Yield an event that is set whenever there is something new."""
        bell = asyncio.Event()
        bell.set()
        self._bells.add(bell)
        try:
            yield bell
        finally:
            self._bells.discard(bell)

    async def _pulse(self) -> None:
        while True:
            await anyio.sleep(_PULSE_S)
            self.tell()

    def note(self, kind: str, who: str, what: str, text: str, ms: float | None = None) -> None:
        """Add a line to the log."""
        self._n += 1
        self.entries.append(LogEntry(self._n, time.time(), kind, who, what, text, ms))
        self.tell()

    # Acting

    async def do(self, viewer: Viewer, request: Request[Any]) -> object:
        """Perform an op for a viewer.

        Raises:
            NotDriving: It changes something, and somebody else has the controls.
            URLabError: As the client raises.
        """
        op = op_of(request)
        if op.effect is not Effect.READ and not (isinstance(request, SetPaused) and request.paused):
            self.lease.use(viewer)
        began = time.perf_counter()
        try:
            reply = await perform(self.client, request)
        except (URLabError, ValueError, TypeError, KeyError) as error:
            self.note("error", viewer.name, op.name, str(error), 1e3 * (time.perf_counter() - began))
            raise
        if op.effect is not Effect.READ:
            arguments = encode(structs.asdict(request)).decode()
            self.note("call", viewer.name, op.name, arguments, 1e3 * (time.perf_counter() - began))
        self._follow(request, reply)
        return reply

    def _follow(self, request: Request[Any], reply: Any) -> None:
        """Remember what the server does not tell again."""
        match request:
            case SetSimSpeed():
                self._speed = reply.percent
            case SetControlSource(articulation=None):
                self._source = reply.source
            case SetTwist():
                self._twists[request.articulation] = (reply.linear[0], reply.linear[1], reply.angular[2])
            case RecordingStart():
                self._recording, self._replaying = True, False  # the server ends the one for the other
            case RecordingStop():
                self._recording = False
            case ReplayStart():
                self._recording = False
                self._replaying, self._replay = reply.total_frames > 0, (0, reply.total_frames)
            case ReplayStop():
                self._replaying = False
            case _:
                pass
        if op_of(request).name == "configure_controller":
            self._redescribe()

    def set_points(self, viewer: Viewer, values: Mapping[str, Mapping[str, float]]) -> None:
        """Set set-points by articulation and actuator. In live mode they are sent at once, the newest only.

        Raises:
            NotDriving: Somebody else has the controls.
            KeyError: An articulation or actuator is unknown; nothing was set.
            ValueError: A value is not a finite number; nothing was set.
        """
        found = {key: (self.client.articulations[key], given) for key, given in values.items()}
        for art, given in found.values():
            for name, value in given.items():
                art.actuators[name]  # raises
                if not np.isfinite(value):
                    raise ValueError(f"{name}: {value} is not a set-point")
        self.lease.use(viewer)
        for key, (art, given) in found.items():
            self._seed(key, art)
            art.set_ctrl(given)
            self._pending.add(key)
        self._commanded.set()

    def _seed(self, key: str, art: URLabArticulation) -> None:
        """Before a first set-point, hold still: the others of the articulation are sent along with it."""
        if key in self._seeded:
            return
        self._seeded.add(key)
        if self.snapshot is None or key not in self.snapshot.per_articulation or art.ctrl_array.any():
            return
        state = self.snapshot.per_articulation[key]
        for actuator in art.actuators.values():
            at = actuator.ctrl_local
            if art.controller is not None and actuator.joint is not None:
                actuator.set_control(float(state.qpos[art.joints[actuator.joint].qpos_local_offset]))
            elif state.ctrl is not None:
                art.ctrl_array[at] = state.ctrl[at]

    async def _command(self) -> None:
        """Send set-points in live mode, one request at a time."""
        while True:
            await self._commanded.wait()
            self._commanded.clear()
            keys, self._pending = self._pending, set()
            if self.client.step_mode is not StepMode.LIVE:
                continue  # the next step takes them along
            commands = {
                key: ArticulationCommand(ctrl=self.client.articulations[key].ctrl_array.tolist())
                for key in keys
                if key in self.client.articulations
            }
            try:
                await self.client.call(Step(per_articulation=commands))
            except URLabError as error:
                self.note("error", "console", "set-points", str(error))

    async def step(self, viewer: Viewer, n_steps: int) -> dict[str, Any]:
        """Step in direct mode, with the set-points and pictures of the cameras that are watched.

        Raises:
            NotDriving: Somebody else has the controls.
            ValueError: The mode is another one.
        """
        if self.client.step_mode is not StepMode.DIRECT:
            raise ValueError(f"stepping needs mode direct, not {self.client.step_mode}")
        self.lease.use(viewer)
        return await self._step(n_steps)

    async def _step(self, n_steps: int) -> dict[str, Any]:
        for key, art in self.client.articulations.items():
            self._seed(key, art)
        watched = {path.removeprefix("-/"): "latest" for path, feed in self._feeds.items() if feed.watched}
        reply = await self.client.step(n_steps, include_cameras=watched or False)
        if reply.replay is not None:
            self._replay = (reply.replay.current_frame, reply.replay.total_frames)
            if self._replaying and reply.replay.current_frame >= reply.replay.total_frames - 1:
                self._running = False
        return {"time": reply.time, "step": reply.step}

    async def seek(self, viewer: Viewer, frame: int) -> tuple[int, int]:
        """Go to a frame of the replay, and return the one reached and how many there are.

        No op does that. A replay goes on by what is stepped, though, and begins where it is started: to go back it is
        started again. The plugin's replay plays by itself and does not report its position.

        Raises:
            NotDriving: Somebody else has the controls.
            ValueError: No replay runs, or the server does not say where it is.
            URLabError: As the client raises.
        """
        if not self._replaying or self._replay is None or self.client.step_mode is not StepMode.DIRECT:
            raise ValueError("no replay runs in mode direct")
        self.lease.use(viewer)
        at, total = self._replay
        frame = min(max(frame, 0), total - 1)
        if frame < at:
            self._follow(ReplayStart(), await self.client.call(ReplayStart()))
            at = 0
        for _ in range(_SEEK_STEPS):
            if at >= frame:
                break
            reply = await self.client.step(frame - at)
            if reply.replay is None:
                raise ValueError("this server does not say where its replay is")
            at = reply.replay.current_frame
            self._replay = at, total
        self.tell()
        return self._replay

    async def run(self, viewer: Viewer, running: bool) -> None:
        """Let physics run, or stop it, in whatever mode; everybody may stop it.

        Raises:
            NotDriving: It was to run, and somebody else has the controls.
        """
        if running:
            self.lease.use(viewer)
        if self.client.step_mode is StepMode.LIVE:
            await self.do(viewer, SetPaused(paused=not running))
        else:
            self._running = running
            self.note("call", viewer.name, "run" if running else "stop", "")
            self._wake_runner.set()
        self.tell()

    async def _run_direct(self) -> None:
        """In direct mode step along with the clock while that is wanted; what is missed is not made up for."""
        while True:
            if not self._running or self.client.step_mode is not StepMode.DIRECT:
                self._wake_runner.clear()
                await self._wake_runner.wait()
                continue
            began = time.monotonic()
            try:
                await self._step(max(1, round(_PERIOD_S / (self.world.timestep or _PERIOD_S))))
            except (URLabError, KeyError) as error:
                self._running = False
                self.note("error", "console", "step", str(error))
            await anyio.sleep(max(0.0, began + _PERIOD_S - time.monotonic()))

    # Cameras

    def feed(self, path: str) -> Feed | None:
        """Return the pictures of the camera `ARTICULATION/CAMERA` (`-` for those of the scene), None without it."""
        view = self._camera(path)
        if view is None:
            return None
        if path not in self._feeds or self._feeds[path].view is not view:
            self._feeds[path] = Feed(self.client, view)
        return self._feeds[path]

    def _camera(self, path: str) -> URLabCameraView | None:
        owner, _, name = path.partition("/")
        if owner == "-":
            return self.client.global_cameras.get(name)
        art = self.client.articulations.get(owner)
        return None if art is None else art.cameras.get(name)


def _rounded(values: Any) -> list[float] | None:
    return None if values is None else np.round(np.asarray(values, dtype=np.float64), _DIGITS).tolist()


def _said(event: ClientEvent) -> dict[str, Any]:
    hidden = {"seq", "dropped", "gap", "recv_wall_time_ns"}
    return {name: value for name, value in structs.asdict(event).items() if name not in hidden}
