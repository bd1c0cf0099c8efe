"""The state that all viewers share: the session, the newest state, the log.

Nothing is queued. A viewer is notified of changes and takes the newest state when it is ready.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio
import anyio.to_thread
from msgspec import structs

from urlab_client.aio.background import kept_running
from urlab_client.console.body_pushing import BodyPushing
from urlab_client.console.controls import Controls
from urlab_client.console.description import WorldDescription, describe
from urlab_client.console.hand_driving import HandDriving
from urlab_client.console.lease import DrivingLease, Viewer
from urlab_client.console.messages import Ctrl, Hand, Link, LogEntry, Status, World, rounded, state_message
from urlab_client.console.mujoco_viewer import MujocoViewer
from urlab_client.console.ops import encode
from urlab_client.console.pictures import Feed
from urlab_client.console.recordings import Recordings
from urlab_client.console.replay import Replay
from urlab_client.enums import StepMode
from urlab_client.errors import ClientClosed, ServerUnreachable, URLabError, URLabTimeoutError
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
from urlab_client.protocol.messages.streams import StateSnapshot

if TYPE_CHECKING:
    from urlab_client.aio import URLabCameraView, URLabClient

log: logging.Logger = logging.getLogger("urlab_client.web")

_PERIOD_S = 1 / 60
_RETRY_S = 1.0
_PULSE_S = 0.5
_CONNECT_S = 3.0
_KEPT = 300
_AGENT_NAME = 40
_MOVING_S = 0.4  # a paused server repeats its state ten times a second


class Audience:
    """A viewer who is watching.

    Attributes:
        viewer: The viewer.
        changed: Event that is set on each change.
    """

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.changed: asyncio.Event = asyncio.Event()


class ConsoleSession:
    """See the module.

    Args:
        client: The client; the console opens its session and keeps it.
        lease: The controls.
        recordings: Folder for recordings.
        handshake: Callback that returns the handshake of a read-only client; None for a client that opens the session.
    """

    def __init__(
        self,
        client: URLabClient,
        lease: DrivingLease,
        recordings: Path,
        handshake: Callable[[], bytes] | None = None,
    ) -> None:
        self.client = client
        self.lease = lease
        self.link: Link = Link("connecting", since=time.time())
        self.world: WorldDescription = WorldDescription()
        self.world_json: bytes = encode(World(self.world))
        self.state_json: bytes | None = None
        self.state_seq: int = 0
        self.entries: deque[LogEntry] = deque(maxlen=_KEPT)
        self.audience: set[Audience] = set()
        self.snapshot: StateSnapshot | None = None
        self.mujoco_viewer: MujocoViewer = MujocoViewer(client)
        self.controls: Controls = Controls(self)
        self.hands: HandDriving = HandDriving(self)
        self.recordings: Recordings = Recordings(client, recordings)
        self.replay: Replay = Replay(self)
        self.body_pushing: BodyPushing = BodyPushing(self)
        self.controls.before_step = self.body_pushing.apply
        self._handshake = handshake
        self._adopted = b""
        self._bells: set[asyncio.Event] = set()
        self._n = 0
        self._agents = 0
        self._want: str | None = "discover"
        self._wake = asyncio.Event()
        self._ready = asyncio.Event()
        self._sim_time: float | None = None
        self._moved_at = 0.0
        self._rate = 0.0
        self._rate_from: tuple[float, float] | None = None
        self._feeds: dict[str, Feed] = {}

    # Life

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncGenerator[None]:
        """Keep the session and receive state while the block runs."""
        async with anyio.create_task_group() as tasks:
            controls = self.controls
            jobs = (
                controls.send_set_points,
                controls.keep_stepping,
                self.hands.keep_driving,
                self.replay.keep_playing,
            )
            for job in (self._keep, self._receive, self._pulse, *jobs):
                tasks.start_soon(self._run, job)
            try:
                yield
            finally:
                tasks.cancel_scope.cancel()
                with anyio.CancelScope(shield=True):
                    await self.recordings.end()

    async def _run(self, job: Callable[[], Awaitable[None]]) -> None:
        """Run a job for as long as the console is open. Its failure is not that of the application around it."""
        name = job.__name__.lstrip("_")
        await kept_running(f"urlab-web-{name}", job, lambda error: self.note("error", "console", name, str(error)))

    async def opened(self) -> None:
        """Wait until the session has been opened for the first time.

        Raises:
            ServerUnreachable: The server cannot be reached; nothing was sent.
        """
        with self.bell() as changed:
            while not self._ready.is_set():
                if self.link.reason:  # a first attempt has failed; each has its own deadline
                    raise ServerUnreachable(f"There is no session with the server: {self.link.reason}")
                changed.clear()
                await changed.wait()

    async def _keep(self) -> None:
        """Open the session, and reopen it whenever necessary."""
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
                    await self._discover()
            else:
                await self._discover()
        except Exception as error:  # noqa: BLE001 - whatever it is, the next attempt may do better
            self._want = "discover" if want == "discover" else "resync"
            if self.link.reason != str(error):
                self._set_link("lost" if self._ready.is_set() else "connecting", str(error))
                self.note("error", "console", "connect", str(error))
            return
        self._set_link("connected")
        self._ready.set()
        self._begin_anew()

    async def _discover(self) -> None:
        if self._handshake is None:
            await self.client.discover()
            return
        given = await anyio.to_thread.run_sync(self._handshake)
        if given != self._adopted:
            await self.client.discover(handshake=given)
            self._adopted = given

    def _take(self, event: ClientEvent) -> None:
        """Handle an event of the connection."""
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
                self.controls.running = False
            case PlayStarted():
                if event.articulations or not self.client.session_id:
                    self._begin_anew()
                else:
                    self._want = "discover"
            case PlayEnded() | SessionOpened():
                self.controls.running = False
                self._begin_anew()
            case _:
                pass

    def drive(self, viewer: Viewer, order: Ctrl | Hand) -> None:
        """Carry out a viewer's order.

        Raises:
            NotDriving: Another viewer has the controls.
            KeyError: A name is unknown; nothing was set.
            ValueError: The order cannot be carried out; nothing was set.
        """
        if isinstance(order, Hand):
            self.hands.command(viewer, order)
        else:
            self.controls.set_points(viewer, order.values)

    def new_agent_name(self, program: str) -> str:
        """Return a name for a new agent, which people and other agents see."""
        self._agents += 1
        return f"agent {self._agents}" + (f" ({program[:_AGENT_NAME]})" if program else "")

    def take_back(self) -> None:
        """Open a new session after another program has taken the server over."""
        self._want = "discover"
        self._wake.set()

    def _set_link(self, state: str, reason: str = "") -> None:
        if self.link.state != state or self.link.reason != reason:
            self.link = Link(state, reason, time.time())
            self.tell()

    def _begin_anew(self) -> None:
        """Discard the state of the previous play session."""
        self.controls.begin_anew()
        self._feeds = {path: one for path, one in self._feeds.items() if one.watched or self.camera(path) is one.view}
        self.redescribe()

    def redescribe(self) -> None:
        """Describe the world again after a change."""
        self.world = describe(self.client, self.world.version + 1, self.mujoco_viewer.missing)
        self.world_json = encode(World(self.world))
        self.tell()

    # State

    async def _receive(self) -> None:
        await self._ready.wait()
        while True:
            try:
                async with self.client.state_stream("latest", timeout=None) as states:
                    due = time.monotonic()
                    while True:
                        snapshot = await states.receive(timeout=None)
                        self._note_time(snapshot.time)
                        if self._handshake is not None and not self.client.matches(snapshot):
                            self.take_back()  # play has restarted; the driver provides a new handshake
                            await anyio.sleep(_RETRY_S)
                        elif not self.replay.open:
                            self._publish(snapshot, {key: self._targets(key) for key in snapshot.per_articulation})
                        # By the clock, not by the wake-up time: otherwise each late wake-up would lower the rate.
                        due = max(due + _PERIOD_S, time.monotonic() - _PERIOD_S)
                        await anyio.sleep(max(0.0, due - time.monotonic()))
            except ClientClosed:
                return
            except URLabError as error:
                self.note("error", "console", "state", str(error))
                await anyio.sleep(_RETRY_S)

    def _note_time(self, sim_time: float) -> None:
        """Track simulation time, also while a recording is shown."""
        now = time.monotonic()
        if sim_time == self._sim_time:
            return
        self._sim_time = sim_time
        self._moved_at = now
        if self._rate_from is None or not sim_time >= self._rate_from[1]:
            self._rate_from, self._rate = (now, sim_time), 0.0
        elif now - self._rate_from[0] > 1:
            self._rate = (sim_time - self._rate_from[1]) / (now - self._rate_from[0])
            self._rate_from = (now, sim_time)

    def show(self, snapshot: StateSnapshot, targets: Mapping[str, list[float]]) -> None:
        """Show a state to all viewers in place of the server's."""
        self._publish(snapshot, targets)

    def _publish(self, snapshot: StateSnapshot, targets: Mapping[str, list[float] | None]) -> None:
        self.snapshot = snapshot
        self.mujoco_viewer.follow(snapshot)
        self.state_seq += 1
        self.state_json = encode(state_message(self.state_seq, snapshot, targets))
        self.tell()

    def _targets(self, key: str) -> list[float] | None:
        art = self.client.articulations.get(key)
        return rounded(art.ctrl_array) if art is not None and self.controls.commands(key) else None

    @property
    def moving(self) -> bool:
        """Whether simulation time advances."""
        return self.link.state == "connected" and time.monotonic() - self._moved_at < _MOVING_S

    def status(self, viewer: Viewer) -> Status:
        """Return the status message for one viewer."""
        holder = self.lease.holder
        return Status(
            link=self.link,
            address=self.client.address,
            playing=self.client.manager_present,
            moving=self.replay.rate > 0 if self.replay.open else self.moving,
            running=self.controls.running if self.client.step_mode is not StepMode.LIVE else self.moving,
            rate=self.replay.rate if self.replay.open else round(self._rate, 3) if self.moving else 0.0,
            mode=self.client.step_mode,
            speed=self.controls.speed,
            source=self.controls.source,
            recording=self.recordings.running,
            conversions=self.recordings.conversions,
            replay=self.replay.view,
            twists=self.controls.twists,
            viewers=len(self.audience),
            driver=None if holder is None else holder.name,
            mine=holder is not None and holder.key == viewer.key,
            lease_left=round(self.lease.left, 1),
            lease=self.lease.seconds,
        )

    def tell(self) -> None:
        """Notify all viewers of a change."""
        for one in self.audience:
            one.changed.set()
        for bell in self._bells:
            bell.set()

    @contextlib.contextmanager
    def bell(self) -> Generator[asyncio.Event]:
        """Yield an event that is set on each change."""
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
        if (kind, who) == ("error", "console"):
            log.warning("%s: %s", what, text)
        self._n += 1
        self.entries.append(LogEntry(self._n, time.time(), kind, who, what, text, ms))
        self.tell()

    # Cameras

    def watched_cameras(self) -> list[str]:
        """Return the cameras that viewers watch, by the names that `step` takes."""
        return [path.removeprefix("-/") for path, feed in self._feeds.items() if feed.watched]

    async def renew_pictures(self) -> None:
        """Switch the source of pictures between a recording and the simulation."""
        for feed in [*self._feeds.values()]:
            await feed.renew()

    def feed(self, path: str) -> Feed | None:
        """Return the pictures of the camera `ARTICULATION/CAMERA` (`-` for those of the scene), None without it."""
        view = self.camera(path)
        if view is None:
            return None
        if path not in self._feeds or self._feeds[path].view is not view:
            said = f"camera {path}"
            self._feeds[path] = Feed(
                self.client, view, path, self.replay, lambda error: self.note("error", "console", said, str(error))
            )
        return self._feeds[path]

    def camera(self, path: str) -> URLabCameraView | None:
        """Return the camera at `ARTICULATION/CAMERA` (`-` for those of the scene), None without it."""
        owner, _, name = path.partition("/")
        if owner == "-":
            return self.client.global_cameras.get(name)
        art = self.client.articulations.get(owner)
        return None if art is None else art.cameras.get(name)


def _said(event: ClientEvent) -> dict[str, Any]:
    hidden = {"seq", "dropped", "gap", "recv_wall_time_ns"}
    return {name: value for name, value in structs.asdict(event).items() if name not in hidden}
