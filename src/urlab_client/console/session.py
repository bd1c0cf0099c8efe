"""The session that viewers and agents share: the connection to the server, and everything they see and do.

It keeps the client's session open, and receives the state. The rest is in its parts.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING

import anyio
import anyio.to_thread
from msgspec import structs

from urlab_client.aio.background import kept_running
from urlab_client.console.body_pushing import BodyPushing, Posing
from urlab_client.console.controls import Controls, applied_set_points
from urlab_client.console.hand_driving import HandDriving
from urlab_client.console.lease import DrivingLease, Viewer
from urlab_client.console.messages import Link, Status, encode, rounded
from urlab_client.console.mujoco_viewer import MujocoViewer
from urlab_client.console.pictures import Cameras
from urlab_client.console.recordings import Recordings
from urlab_client.console.replay import Replay, recorded_handshake
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import StepMode
from urlab_client.errors import ClientClosed, ServerUnreachable, URLabError
from urlab_client.events import (
    ClientEvent,
    PlayEnded,
    PlayStarted,
    ServerAnswers,
    ServerLost,
    ServerReconnected,
    ServerSilent,
    SessionLost,
    SessionOpened,
)
from urlab_client.protocol.messages.runtime import SetPaused
from urlab_client.protocol.messages.session import ArticulationState

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient

_PERIOD_S = 1 / 60
_RETRY_S = 1.0
_PULSE_S = 0.5
_CONNECT_S = 3.0
_AGENT_NAME = 40
_TIMES = re.compile(r"\d+ ms")  # by which messages of one failure differ
_MOVING_S = 0.4  # a paused server repeats its state ten times a second


class ConsoleSession:
    """See the module.

    A client that is not read-only opens the session itself. A read-only one adopts the session of another client, whose
    handshake the callback returns. With `replayed`, that of a recording, it shows this recording and nothing else.

    Attributes:
        link: The connection to the server.
        viewers: Those who watch the page or the WebSocket, by key.
    """

    def __init__(
        self,
        client: URLabClient,
        *,
        recordings: Path,
        lease_seconds: float = 20.0,
        handshake: Callable[[], bytes] | None = None,
        replayed: Path | None = None,
    ) -> None:
        self.client = client
        self.link: Link = Link("connecting", since=time.time())
        self.viewers: dict[str, Viewer] = {}
        lease, view = DrivingLease(lease_seconds), SharedView(client)
        self.lease: DrivingLease = lease
        self.view: SharedView = view
        self.mujoco_viewer: MujocoViewer = MujocoViewer(client, view)
        self.cameras: Cameras = Cameras(client, view)
        self.recordings: Recordings = Recordings(client, recordings)
        self.replay: Replay = Replay(client, view, self.cameras, alone=replayed is not None)
        self._replayed = replayed
        self.posing: Posing = Posing(client, lease, view, self.cameras)
        self.body_pushing: BodyPushing = BodyPushing(client, lease, self.mujoco_viewer, self.replay, self.posing)
        self.controls: Controls = Controls(client, lease, view, self.cameras, self.body_pushing.apply)
        self.hands: HandDriving = HandDriving(client, lease, self.controls, view)
        self._handshake = handshake
        self._adopted = b""
        self._agents = self._seen = 0
        self._want: str | None = "discover"
        self._wake = asyncio.Event()
        self._connecting = anyio.Lock()
        self._ready = asyncio.Event()
        self._clock = _SimulationClock()
        self._status: Status = self._present_status()
        self._status_of = -1
        self._status_json: dict[bool, str] = {}

    # Life

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncGenerator[None]:
        """Keep the session and receive state while the block runs."""
        jobs = (
            self._follow_events,
            self._keep,
            self._receive,
            self._pulse,
            self.controls.send_set_points,
            self.controls.keep_stepping,
            self.hands.keep_driving,
            self.replay.keep_playing,
            self._begin_replay,
        )
        async with anyio.create_task_group() as tasks:
            for job in jobs:
                tasks.start_soon(self._run, job)
            try:
                yield
            finally:
                tasks.cancel_scope.cancel()
                with anyio.CancelScope(shield=True):
                    await self.recordings.end()

    async def _begin_replay(self) -> None:
        """Show a recording from its start, once somebody watches."""
        if self._replayed is None:
            return
        await self.opened()
        await self.replay.begin(self._replayed)
        await self.replay.change(at=0.0, playing=False)
        with self.view.watch() as changed:
            while not self.viewers:
                changed.clear()
                await changed.wait()
        if not self.replay.at:
            await self.replay.change(playing=True)

    async def begin_replay(self, file: Path, *, placing: bool = False) -> None:
        """Show a recording; without a simulation, also one of other robots."""
        if self.replay.alone:
            from urlab_client.integrations.record import read_run

            handshake = await anyio.to_thread.run_sync(lambda: recorded_handshake(read_run(file)))
            await self.replay.end()
            async with self._connecting:
                self._handshake = lambda: handshake
                await self._discover()
            self._begin_anew()
        if placing:
            self.controls.suspend()
        try:
            await self.replay.begin(file, placing=placing)
        finally:
            if not (self.replay.view and self.replay.view.placing):
                self.controls.resume()

    async def end_replay(self) -> None:
        """Show the simulation again, as it was before a replay that moved it."""
        await self.replay.end()
        self.controls.resume()

    async def _run(self, job: Callable[[], Awaitable[None]]) -> None:
        """Run a job for as long as the console is open. Its failure is not that of the application around it."""
        name = job.__name__.lstrip("_")
        await kept_running(f"urlab-web-{name}", job, lambda error: self._note_error(name, error))

    def _note_error(self, what: str, error: Exception) -> None:
        self.view.note("error", "console", what, str(error).removeprefix("hello: "))  # nobody asked for that op

    async def _pulse(self) -> None:
        while True:
            await anyio.sleep(_PULSE_S)
            self.view.notify()

    # The connection

    async def opened(self) -> None:
        """Wait until the session has been opened for the first time."""
        with self.view.watch() as changed:
            while not self._ready.is_set():
                if self.link.reason:  # a first attempt has failed; each has its own deadline
                    raise ServerUnreachable(f"There is no session with the server: {self.link.reason}")
                changed.clear()
                await changed.wait()

    def reconnect(self) -> None:
        """Open a new session, for example after another program has taken the server over."""
        self._ask_for("discover")

    def _ask_for(self, want: str) -> None:
        self._want = want
        self._wake.set()

    async def _follow_events(self) -> None:
        async for event in self.client.events():
            async with self._connecting:  # what an attempt causes is judged by its result
                self._follow(event)

    async def _keep(self) -> None:
        """Open the session, and reopen it whenever necessary."""
        with contextlib.suppress(ClientClosed):
            while True:
                if self._want is not None:
                    async with self._connecting:
                        await self._connect()
                with anyio.move_on_after(None if self._want is None else _RETRY_S):
                    await self._wake.wait()
                self._wake.clear()

    async def _connect(self) -> None:
        want, self._want = self._want, None
        try:
            if want == "resync":
                try:
                    await self.client.resync(timeout=_CONNECT_S)
                except URLabError:
                    await self._discover()
            elif self.link.state == "taken_over" and self._handshake is None:
                await self._take_back()
            else:
                await self._discover()
        except ClientClosed:
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the next attempt may do better
            self._want = want
            if _TIMES.sub("", self.link.reason) != _TIMES.sub("", str(error)):  # else it is known already
                self._set_link("lost" if self._ready.is_set() else "connecting", str(error))
                self._note_error("connect", error)
            return
        self._set_link("connected")
        self._ready.set()
        self._begin_anew()

    async def _take_back(self) -> None:
        """Open a session again with the step mode that the last one had; no op tells which another program has left."""
        mode, stood = self.client.step_mode, not self._clock.advances
        await self._discover()
        if not self.client.manager_present:
            return
        try:
            if mode is StepMode.LIVE and stood:
                await self.client.call(SetPaused(paused=True))  # first: entering live mode does not pause
            await self.client.runtime.set_mode(mode)
        except URLabError as error:
            self._note_error("set_mode", error)
        else:
            self.view.note("call", "console", "restore_mode", encode({"mode": mode}).decode())

    async def _discover(self) -> None:
        if self._handshake is None:
            await self.client.discover()
            return
        given = await anyio.to_thread.run_sync(self._handshake)
        if given != self._adopted:
            await self.client.discover(handshake=given)
            self._adopted = given

    def _follow(self, event: ClientEvent) -> None:
        """Handle an event of the connection."""
        if isinstance(event, SessionLost) and self.link.state == "taken_over":
            return  # each refused call tells again
        self.view.note("event", "server", str(event.__struct_config__.tag), _text_of(event))
        match event:
            case ServerLost():
                self._set_link("lost", event.reason or "the connection broke")
                self._ask_for("resync")
            case ServerReconnected():
                self._ask_for("resync")
            case ServerSilent():
                self._set_link("silent", f"no reply to {event.op} in {event.waited_s:.0f} s")
            case ServerAnswers():
                self._set_link("connected")
            case SessionLost() if event.session_id == self.client.session_id and self._want is None:
                self._set_link("taken_over", "another program has taken the server over")
                self.controls.running = False
            case PlayStarted():
                if event.articulations or not self.client.session_id:
                    self._begin_anew()
                else:
                    self._ask_for("discover")
            case PlayEnded() | SessionOpened():
                self.controls.running = False
                self._begin_anew(ended=isinstance(event, PlayEnded))
            case _:
                pass

    def _set_link(self, state: str, reason: str = "") -> None:
        if self.link.state != state or self.link.reason != reason:
            away = "connected" not in {state, self.link.state}  # still: since the first moment without contact
            self.link = Link(state, reason, self.link.since if away else time.time())
            self.view.notify()

    def _begin_anew(self, *, ended: bool = False) -> None:
        """Discard the state of the previous play session."""
        self.controls.begin_anew(ended=ended)
        self.cameras.begin_anew()
        self.view.describe_world()

    # State

    async def _receive(self) -> None:
        await self._ready.wait()
        while True:
            try:
                async with self.client.state_stream("latest", timeout=None) as states:
                    due = time.monotonic()
                    while True:
                        snapshot = await states.receive(timeout=None)
                        self._clock.note(snapshot.time)
                        if self._handshake is not None and not self.client.matches(snapshot):
                            self.reconnect()  # play has restarted; the driver provides a new handshake
                            await anyio.sleep(_RETRY_S)
                        elif not self.replay.open:
                            robots = snapshot.per_articulation.items()
                            self.view.show(snapshot, {key: self._targets(key, state) for key, state in robots})
                        # By the clock, not by the wake-up time: otherwise each late wake-up would lower the rate.
                        due = max(due + _PERIOD_S, time.monotonic() - _PERIOD_S)
                        await anyio.sleep(max(0.0, due - time.monotonic()))
            except ClientClosed:
                return
            except URLabError as error:
                self._note_error("state", error)
                await anyio.sleep(_RETRY_S)

    def _targets(self, key: str, state: ArticulationState) -> list[float] | None:
        """Return a robot's set-points: what viewers command, or what else the server applies; None if not known."""
        art = self.client.articulations.get(key)
        if art is None:
            return None
        if self.controls.commands(key) and self.link.state != "taken_over" and self.controls.source != "ui":
            return rounded(art.ctrl_array)
        return applied_set_points(art, state)

    @property
    def moving(self) -> bool:
        """Whether simulation time advances."""
        return self.link.state in {"connected", "taken_over"} and self._clock.advances

    # Viewers

    @contextlib.contextmanager
    def new_viewer(self) -> Generator[Viewer]:
        """Yield a new viewer, who watches while the block runs."""
        self._seen += 1  # and none again: the log would call two of them the same
        viewer = Viewer(secrets.token_urlsafe(16), f"Viewer {self._seen}")
        self.viewers[viewer.key] = viewer
        self.view.notify()
        try:
            yield viewer
        finally:
            del self.viewers[viewer.key]
            self.lease.release(viewer)
            self.view.notify()

    def new_agent_name(self, program: str) -> str:
        """Return a name for a new agent, which people and other agents see."""
        self._agents += 1
        return f"agent {self._agents}" + (f" ({program[:_AGENT_NAME]})" if program else "")

    def status(self, viewer: Viewer) -> Status:
        """Return the status message for one viewer."""
        return structs.replace(self._present_status(), mine=self._is_driving(viewer))

    def status_json(self, viewer: Viewer) -> str:
        """Return the status message for one viewer as of the last change: the same object while it is the same.

        It is made once per change, and encoded if it differs, however many watch.
        """
        if self._status_of != self.view.n_changes:
            self._status_of = self.view.n_changes
            status = self._present_status()
            if status != self._status:
                self._status = status
                self._status_json.clear()
        mine = self._is_driving(viewer)
        if mine not in self._status_json:
            self._status_json[mine] = encode(structs.replace(self._status, mine=mine)).decode()
        return self._status_json[mine]

    def _is_driving(self, viewer: Viewer) -> bool:
        holder = self.lease.holder
        return holder is not None and holder.key == viewer.key

    @property
    def running(self) -> bool:
        """Whether physics runs, in live mode by itself, in direct mode stepped by the console."""
        return self.moving if self.client.step_mode is StepMode.LIVE else self.controls.running

    def _present_status(self) -> Status:
        client, controls, replay, holder = self.client, self.controls, self.replay, self.lease.holder
        link, mode = self.link, client.step_mode
        return Status(
            link=link,
            address=client.address,
            playing=client.manager_present,
            moving=replay.rate > 0 if replay.open else self.moving,
            running=self.running,
            rate=replay.rate if replay.open else round(self._clock.rate, 3) if self.moving else 0.0,
            mode=mode,
            mode_chosen=mode is controls.chosen_mode,
            speed=controls.speed,
            source=controls.source,
            recording=self.recordings.running,
            conversions=[structs.replace(conversion) for conversion in self.recordings.conversions],
            replay=replay.view,
            twists=dict(controls.twists),
            # In other modes, and in the steps of another program, nothing holds them.
            holding=[*controls.holding] if mode is StepMode.DIRECT and link.state != "taken_over" else [],
            viewers=len(self.viewers),
            driver=None if holder is None else holder.name,
            mine=False,
            lease_left=round(self.lease.left, 1),
            lease=self.lease.seconds,
        )


class _SimulationClock:
    """Simulation time as received, also while a recording is shown.

    Attributes:
        rate: Simulation time per real time, over about a second.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self._time: float | None = None
        self._moved_at = 0.0
        self._rate_from: tuple[float, float] | None = None

    @property
    def advances(self) -> bool:
        return time.monotonic() - self._moved_at < _MOVING_S

    def note(self, sim_time: float) -> None:
        now = time.monotonic()
        if sim_time == self._time:
            return
        self._time = sim_time
        self._moved_at = now
        if self._rate_from is None or not sim_time >= self._rate_from[1]:
            self._rate_from, self.rate = (now, sim_time), 0.0
        elif now - self._rate_from[0] > 1:
            self.rate = (sim_time - self._rate_from[1]) / (now - self._rate_from[0])
            self._rate_from = (now, sim_time)


def _text_of(event: ClientEvent) -> str:
    hidden = {"seq", "dropped", "gap", "recv_wall_time_ns", "session_id"}
    said = {name: value for name, value in structs.asdict(event).items() if name not in hidden}
    return ", ".join(f"{name} {value}" for name, value in said.items() if value)
