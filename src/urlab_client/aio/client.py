"""The typed client of a URLab server."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from types import TracebackType
from typing import NoReturn, Self, TypeVar

from msgspec import structs

from urlab_client.aio.address import transport_to
from urlab_client.aio.arguments import integer
from urlab_client.aio.client_state import ClientState
from urlab_client.aio.control import Control
from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.event_loop import running_loop
from urlab_client.aio.explain import diagnose
from urlab_client.aio.live.camera_switch import CameraSwitch
from urlab_client.aio.live.publishers import Publishers
from urlab_client.aio.motion import Motion
from urlab_client.aio.namespaces.debug import DebugNamespace
from urlab_client.aio.namespaces.farm import FarmNamespace
from urlab_client.aio.namespaces.outliner import OutlinerNamespace
from urlab_client.aio.namespaces.recording import RecordingNamespace, ReplayNamespace
from urlab_client.aio.namespaces.runtime import RuntimeNamespace
from urlab_client.aio.namespaces.scene import SceneNamespace
from urlab_client.aio.namespaces.sim import SimNamespace
from urlab_client.aio.namespaces.viewport import ViewportNamespace
from urlab_client.aio.session import Session
from urlab_client.aio.session_level import SESSION_LEVEL, SessionLevel
from urlab_client.aio.state.capturing import Capturing
from urlab_client.aio.state.connection_monitor import ConnectionMonitor
from urlab_client.aio.state.discovery import Discovery
from urlab_client.aio.state.recovery import resync
from urlab_client.aio.state.resetting import take_reset
from urlab_client.aio.state.session_keeper import SessionKeeper
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.step_mode import ask_mode
from urlab_client.aio.state.stepping import take_steps
from urlab_client.aio.streams import BUFFER_BYTES, BUFFER_ITEMS, Stream
from urlab_client.aio.transport.curve import client_keys, is_local
from urlab_client.aio.transport.server_regions import SharedMemoryRegions
from urlab_client.aio.transport.shm import ShmTransport
from urlab_client.protocol.base import Reply, Request
from urlab_client.protocol.client_types import CallRecord, ClientConfig, Diagnosis, Resync
from urlab_client.protocol.enums import CameraTiming, ObservationLevel, StepMode, Transport
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Hello, MetaOk, OpInfo, Reset, ResetOk, Step, StepOk
from urlab_client.protocol.messages.session import Meta as MetaRequest
from urlab_client.protocol.messages.streams import CameraSample, ClientEvent, RowSample, StateSnapshot, StreamPolicy
from urlab_client.protocol.topics import TopicKind

__all__ = ["URLabClient"]

log: logging.Logger = logging.getLogger("urlab_client.client")

R = TypeVar("R", bound=Reply)

_REVERT_S = 1.0
_LOOKING_ON = (StepMode.AUTO, StepMode.LIVE)


class URLabClient(ClientState):
    """A session with one server.

    The client sends and starts nothing before the first call. Concurrent calls run one at a time.

    Args:
        address: `tcp://host` or `ipc://path`, to which the ports are appended; `tcp://host:port` names the RPC port
            itself. `sim://MODEL` starts a simulated server in a child process and stops it on close.
        step_mode: `auto`, `direct`, `puppet` or `live`.
        step_port: RPC port.
        state_port: State stream, used in live mode. The client uses another port instead of the default if the server
            announces one.
        ctrl_port: Streaming control.
        info_port: Actuator and camera descriptions.
        mujoco_version_check: Raise `URLabVersionMismatch` when server and client MuJoCo builds differ; False warns and
            works with a model compiled here.
        local_model: Load the handshake's compiled model into `model` and `data`.
        rcv_timeout_ms: Default deadline of a call in milliseconds; ops that take longer have longer ones.
        auto_promote_step_mode: Let `discover()` switch the server to `direct` or `puppet` when `step_mode` says so.
        transport: `zmq`, or `shm` on the same host.
        shm_dir: Directory of the shared-memory regions, when it is not the one the server names.
        encoding: `msgpack`, or `json` to make traffic readable while debugging.
        server_key: Public key of a server that uses CURVE: a file, or its 40 characters. On other machines than this
            one the environment variable `URLAB_SERVER_KEY` may name the file instead.
        client_key: File with the client's own secret key, for servers that know their clients; likewise
            `URLAB_CLIENT_KEY`. None makes up a key.
        trust_server: Load the binary model of a server that is neither on this machine nor known by its key. Without,
            the model is compiled here from XML, in a child process with limits.
        live_pictures: Receive the pictures of all cameras by themselves in live mode, for `latest_frame`. False spares
            server and network those that nobody looks at; `frames()` is received all the same.
        claim_control: Take control of a robot with the first write to it, where robots have one owner. False is for
            those who look on, and for those who say `articulation.claim()`.
        keep_session: After the first `discover()`, discover again by itself when the server has been restarted or play
            has been started by somebody else; `events()` tells of it. A session that another client has taken over is
            never taken back, and while a step or reset is in doubt, `resync()` comes first.
        read_only: Look on beside the client that drives: the client opens no session, so that it takes the server over
            from nobody, and refuses everything that would need one with `ReadOnlyClient`. `discover(handshake=…)` says
            what there is; state, pictures and events come by the streams. For `transport="zmq"`.
        observe: Called with a `CallRecord` when a request is over, whatever became of it: op, bytes, time in the queue,
            round trip, outcome. It runs on the client's event loop, so it must be quick and must not call the client;
            what it raises is logged and changes nothing.

    Raises:
        TypeError: `observe` is not a plain function.
        KeyFileError: A key file cannot be used.
        ValueError: The address or an option is malformed.
    """

    def __init__(
        self,
        address: str = "tcp://localhost",
        *,
        step_mode: str | StepMode = "auto",
        step_port: int = 5559,
        state_port: int = 5555,
        ctrl_port: int = 5556,
        info_port: int = 5557,
        mujoco_version_check: bool = True,
        local_model: bool = True,
        rcv_timeout_ms: int = 5000,
        auto_promote_step_mode: bool = True,
        transport: str | Transport = "zmq",
        shm_dir: str | None = None,
        encoding: str = "msgpack",
        server_key: str | os.PathLike[str] | None = None,
        client_key: str | os.PathLike[str] | None = None,
        trust_server: bool = False,
        live_pictures: bool = True,
        claim_control: bool = True,
        keep_session: bool = False,
        read_only: bool = False,
        observe: Callable[[CallRecord], object] | None = None,
    ) -> None:
        config = ClientConfig(
            address=address,
            step_mode=StepMode(step_mode),
            step_port=step_port,
            state_port=state_port,
            ctrl_port=ctrl_port,
            info_port=info_port,
            mujoco_version_check=mujoco_version_check,
            local_model=local_model,
            rcv_timeout_ms=rcv_timeout_ms,
            auto_promote_step_mode=auto_promote_step_mode,
            transport=Transport(transport),
            shm_dir=shm_dir,
            encoding=encoding,
            server_key=None if server_key is None else os.fspath(server_key),
            client_key=None if client_key is None else os.fspath(client_key),
            trust_server=trust_server,
            live_pictures=live_pictures,
            claim_control=claim_control,
            keep_session=keep_session,
            read_only=read_only,
        )
        if encoding not in {"msgpack", "json"}:
            raise ValueError(f"encoding must be msgpack or json, not {encoding!r}")
        if shm_dir is not None and Transport(transport) is not Transport.SHM:
            raise ValueError("shm_dir is for transport='shm'")
        alone = address.startswith("sim:") or config.transport is Transport.SHM
        if read_only and (alone or config.step_mode not in _LOOKING_ON):
            raise ValueError("read_only is for a server that another client drives, over transport='zmq', in no mode")
        if rcv_timeout_ms <= 0:
            raise ValueError(f"rcv_timeout_ms must be above 0, got {rcv_timeout_ms}")
        keys = client_keys(address, config.server_key, config.client_key)
        memory = SharedMemoryRegions(shm_dir) if Transport(transport) is Transport.SHM else None
        plain = transport_to(address, step_port, keys, shm=memory is not None)
        self._transport = plain if memory is None else ShmTransport(plain, memory)
        session = Session(
            self._transport, default_timeout=rcv_timeout_ms / 1000, json=encoding == "json", observe=observe
        )
        session.control = Control(session, wanted=claim_control)
        session.read_only = read_only
        self._publishers = Publishers(
            lambda: self._transport.endpoint,
            self._state_port,
            default_timeout=rcv_timeout_ms / 1000,
            live=lambda: self._state.mode is StepMode.LIVE,
            features=lambda: session.features,
            keys=keys,
            memory=memory,
        )
        if not read_only:
            self._publishers.camera_switch = CameraSwitch(session, self._publishers.subscriptions.refresh)
        self._motion = Motion(
            self,
            driven=lambda: any(record.driven for record in self._state.objects.records.values()),
            patience=rcv_timeout_ms / 1000,
            session=session,
        )
        state = SimState(
            session, self._publishers, self._motion, wanted_mode=StepMode(step_mode), live_pictures=live_pictures
        )
        self._publishers.capture = Capturing(state, rcv_timeout_ms / 1000).take
        super().__init__(config, session, state)
        self._discovery = Discovery(
            state,
            local_model=local_model,
            check_version=mujoco_version_check,
            promote=auto_promote_step_mode,
            trusted=trust_server or keys is not None or is_local(address),
        )
        self._watch = ConnectionMonitor(session, state)
        self._keeper = SessionKeeper(session, state, self._discovery)
        self._transport.on_event = self._watch.on_connection
        self._closed = False
        self._sim = SimNamespace(session, state, self._discovery)
        self._scene = SceneNamespace(session, self._sim)
        self._runtime = RuntimeNamespace(session, state)
        self._outliner = OutlinerNamespace(session)
        self._debug = DebugNamespace(session)
        self._viewport = ViewportNamespace(session)
        self._farm = FarmNamespace(session)
        self._recording = RecordingNamespace(session)
        self._replay = ReplayNamespace(session)

    # Namespaces

    @property
    def scene(self) -> SceneNamespace:
        """Editor-time authoring."""
        return self._scene

    @property
    def sim(self) -> SimNamespace:
        """Starting and stopping play."""
        return self._sim

    @property
    def runtime(self) -> RuntimeNamespace:
        """Live changes to the running simulation."""
        return self._runtime

    @property
    def outliner(self) -> OutlinerNamespace:
        """Looking at the world."""
        return self._outliner

    @property
    def debug(self) -> DebugNamespace:
        """Debug drawing."""
        return self._debug

    @property
    def viewport(self) -> ViewportNamespace:
        """The editor's perspective viewport."""
        return self._viewport

    @property
    def farm(self) -> FarmNamespace:
        """Sharing servers among clients."""
        return self._farm

    @property
    def recording(self) -> RecordingNamespace:
        """Recording joint states."""
        return self._recording

    @property
    def replay(self) -> ReplayNamespace:
        """Playing recordings back."""
        return self._replay

    # Operations

    async def discover(
        self,
        observations: str | ObservationLevel = "standard",
        *,
        handshake: bytes | None = None,
        timeout: Timeout = DEFAULT,
    ) -> None:
        """Open a session, load the model, and build the wrappers of articulations, entities and cameras.

        Safe to repeat: wrappers that still exist go on working. Takes the server over from any other client.

        Args:
            observations: `minimal` (qpos, qvel), `standard` (adds ctrl, act, sensors) or `full` (adds body poses and
                actuator forces).
            handshake: For a client with `read_only=True`, and for no other: what `handshake()` of the client that
                drives returns. Call this again with the new one after each start of play.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            ValueError: A handshake is given to a client that is not read-only, or it is none.
            ReadOnlyClient: The client is read-only, and no handshake is given.
            URLabVersionMismatch: Client and server MuJoCo builds differ.
            ServerUnreachable: Nothing answers at the address.
            URLabConnectionError: With `transport="shm"`, the server's shared memory is not on this machine.
            AuthenticationFailed: Server and client do not accept each other's keys.
        """
        level = ObservationLevel(observations)
        if handshake is not None:
            if not self._config.read_only:
                raise ValueError("discover: handshake is for a client with read_only=True, which opens no session")
            async with self._session.turn(MetaRequest, timeout=timeout) as turn:
                await self._discovery.look_on(turn, handshake)
            return
        async with self._session.turn(Hello, timeout=timeout) as turn:
            await self._discovery.open(turn, level)
        if self._config.keep_session:
            self._keeper.start()

    async def step(
        self,
        n_steps: int = 1,
        *,
        include_cameras: bool | Mapping[str, str | CameraTiming] = False,
        observations: str | ObservationLevel | SessionLevel = SESSION_LEVEL,
        timeout: Timeout = DEFAULT,
    ) -> StepOk:
        """Advance physics according to the step mode, and update the state.

        In `direct` the server steps `n_steps` times with the set-points in each articulation's `ctrl_array`. In
        `puppet` the local model steps `n_steps` times (0: not at all) and the result is pushed. In `live` the client
        sends the set-points and reads the current state; physics runs continuously.

        Args:
            n_steps: Physics steps, at least 1; at least 0 in `puppet`. Not used in `live`.
            include_cameras: True for the newest frame of every camera, or camera name to `sync` (rendered after the
                step) or `latest`. Where the server cannot render for a step, the step waits up to 3 s per camera for
                its picture in the camera's stream. A `sync` picture that is older than the step is omitted from the
                reply, like one that did not arrive. Ignored in live mode by servers that draw in the other modes only.
            observations: Level of this reply alone; default the level of the session.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The state, which articulations, entities, cameras and `data` have already adopted.

        Raises:
            StepTimeout: The server did not finish within its 5 s; the steps are still queued there.
            OutcomeUnknown: The connection broke: the steps may or may not have been taken. `resync()` finds out.
            ValueError: Fewer steps than the mode allows; nothing was sent.
            KeyError: Unknown camera; nothing was sent.
            ValueError: A set-point is NaN or infinite, or in puppet mode something in `data`; nothing was sent.
            NoSession: `discover()` was not called, or was broken off; nothing was sent.
        """
        n_steps = integer("step: n_steps", n_steps)  # a hot op: its request is not checked again before it is sent
        level = None if observations is SESSION_LEVEL else ObservationLevel(observations)
        turn = self._session.turn(Step, timeout=timeout)
        if not turn.begin_at_once():  # which `async with` would take three coroutines for
            await turn.begin()
        try:
            return await take_steps(self._state, turn, n_steps, include_cameras, level)
        finally:
            turn.end()

    async def reset(
        self,
        keyframe_name: str | None = None,
        seed: int | None = None,
        per_articulation_qpos: Mapping[str, Mapping[str, float]] | None = None,
        *,
        timeout: Timeout = DEFAULT,
    ) -> ResetOk:
        """Reset the simulation and take over the state. Set-points stay.

        Args:
            keyframe_name: Keyframe to reset to. The short name is enough where one articulation has it.
            seed: Remembered by the server. On a simulated server that varies its scene it decides on the episode's
                numbers; else it has no effect on MuJoCo.
            per_articulation_qpos: Articulation key to joint name to the first component of its position.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The state, with `step` 0.

        Raises:
            UnknownKeyframe: No keyframe, or more than one, has this name; nothing was reset.
            KeyError: Unknown articulation or joint; nothing was sent.
            TypeError: A position is not a number; nothing was sent.
            ValueError: A position is NaN or infinite; nothing was sent.
        """
        async with self._session.turn(Reset, timeout=timeout) as turn:
            return await take_reset(self._state, turn, keyframe_name, seed, per_articulation_qpos or {})

    async def resync(self, *, timeout: Timeout = DEFAULT) -> Resync:
        """Find out what happened to steps, resets and mode changes whose replies were lost, and continue from there.

        Call it after `OutcomeUnknown`, after `URLabTimeoutError` of a step, or after a step was cancelled. Asks
        the server for its step counter and time without stepping it, updates the state, and opens a new session
        when the old one is gone, or when a lost request may still be on its way: it is then refused when it arrives.
        No step and no reset is sent a second time; whether to repeat them is the caller's decision.

        Args:
            timeout: Seconds to wait; None waits without limit.

        Returns:
            What was found; if nothing was in doubt, only the state of the simulation.

        Raises:
            URLabConnectionError: The server is not back yet. What is in doubt stays so for the next attempt.
        """
        return await resync(self._state, self._discovery, timeout=timeout)

    async def run_for(self, seconds: float) -> float:
        """Let simulation time pass: step in `direct` and `puppet`, in `live` hand set-points over and watch.

        Args:
            seconds: Simulation time, seconds; rounded to whole physics steps where the client steps.

        Returns:
            Simulation time that passed, seconds.

        Raises:
            URLabTimeoutError: In live mode, simulation time stands still, for example while paused; the message says
                why.
            ValueError: Negative, NaN or infinite; nothing was sent.
        """
        return await self._motion.run_for(seconds)

    async def wait_until(self, predicate: Callable[[], object], *, timeout: float = 10.0) -> float:
        """Let simulation time pass, as `run_for` does, until a condition is true.

        Args:
            predicate: The condition. Called before the first step, and then at least every 10 ms of simulation time,
                in live mode with each snapshot; it reads the client's state and must return at once.
            timeout: Seconds of simulation time after which to give up.

        Returns:
            Simulation time that passed, seconds.

        Raises:
            URLabTimeoutError: The condition was not true within that time, or simulation time stands still; the message
                contains what `explain()` found.
            TypeError: The predicate returns an awaitable.
        """
        return await self._motion.wait_until(predicate, timeout)

    async def capture(
        self, cameras: Iterable[str] | None = None, *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraSample]:
        """Take pictures of several cameras now, in any step mode, without a step; see `URLabCameraView.capture`.

        In `direct` and `puppet` mode, and while paused, all of them show the same moment.

        Args:
            cameras: Names, as `camera()` takes them; None for all there are.
            timeout: Seconds to wait for all of them together; None waits without limit.

        Returns:
            The pictures by the names given.

        Raises:
            KeyError: There is no such camera, or there are several; nothing was sent.
            TypeError: `cameras` is a name by itself.
            PictureTimeout: Some came not in time; `.cameras` names them.
            NoActiveManager: No play session runs.
            ModeLocked: The project pins a mode in which pictures come with steps only.
        """
        objects = self._state.objects
        if isinstance(cameras, str):
            raise TypeError(f"capture takes several names; one: client.camera({cameras!r}).capture()")
        if cameras is None:
            names = {shown: name for name, shown in objects.shown_cameras(objects.camera_names()).items()}
        else:
            try:
                names = {name: name for name in cameras}
            except TypeError:
                raise TypeError(f"capture takes names of cameras, got {cameras!r:.80}.") from None
        views = [self.camera(name) for name in names.values()]
        samples = await self._publishers.capture(views, timeout) if views else []
        return dict(zip(names, samples, strict=True))

    def state_stream(
        self,
        policy: str | StreamPolicy = "latest",
        *,
        max_rate: float | None = None,
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[StateSnapshot]:
        """Stream the snapshots that the server publishes while play runs.

        One per physics tick in live mode, paused or not; one per step, else ten per second, in `direct`; ten per
        second in `puppet`. Works alongside all other calls, and costs the server nothing. If a server publishes only
        in live mode, as the beta does, the stream has one snapshot for each of this client's own steps in the other
        modes.

        Args:
            policy: `latest`, or `all` within the buffer.
            max_rate: With `latest`, snapshots per second at most, each the newest by then. The rate does not drift: an
                item that is taken late does not delay those after it. None for as many as come.
            buffer: Snapshots that may wait, with `all`.
            buffer_bytes: Bytes that may wait, with `all`.
            timeout: Seconds that iterating waits for each snapshot; by default the client's for the first one and then
                without limit; None waits.

        Raises:
            ValueError: Unknown policy, an empty buffer, or a rate that is not above 0 or not for this policy.
        """
        return Stream(
            self._publishers.state(policy),
            policy=policy,
            max_rate=max_rate,
            buffer=buffer,
            buffer_bytes=buffer_bytes,
            timeout=timeout,
            default_timeout=self._publishers.default_timeout,
        )

    def row_stream(
        self,
        articulation: str | None = None,
        kinds: Collection[str | TopicKind] = (),
        components: Collection[str] = (),
        *,
        policy: str | StreamPolicy = "latest_per_key",
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[RowSample]:
        """Stream the small rows that the server publishes in live mode: one joint, sensor or free base each.

        If a server publishes only whole snapshots, as the beta does, the client makes rows from those: in live mode
        from what the server publishes, in the other modes from the replies to its own steps, with the readings of
        their level. Accelerations are then NaN.

        Args:
            articulation: Key of the articulation; None for all there are, and the plain entities.
            kinds: `joint`, `base_state`, `sensor`, `twist`, `actions`; of entities `xpos`, `xquat`, `qpos`, `qvel`.
                Empty for all of them, or with `components` for those that have one.
            components: Component names; empty for all.
            policy: `latest_per_key` keeps the newest row of each joint and so on; `latest`; `all` within the buffer.
            buffer: Rows that may wait.
            buffer_bytes: Bytes that may wait.
            timeout: Seconds that iterating waits for each row; by default the client's for the first one and then
                without limit; None waits.

        Raises:
            KeyError: Unknown articulation.
            ValueError: Unknown kind or policy, or an empty buffer.
            URLabError: `discover()` was not called yet. Or rows have to be made of snapshots, and without a local model
                joints are not known.
        """
        if self._state.hello is None:
            raise URLabError(
                "row_stream: which articulations there are is not known yet.", hint="Call discover() first."
            )
        if not self._session.features.publishes_rows and self.articulations and self.model is None:
            raise URLabError(
                "row_stream: this server publishes no rows; only with a local model can they be made of snapshots.",
                hint="Make the client with local_model=True, or use state_stream().",
            )
        keys = list(self.articulations) if articulation is None else [self.articulations[articulation].prefix]
        return Stream(
            self._publishers.rows(
                keys, kinds, components, entities=articulation is None, robots=lambda: self.articulations
            ),
            policy=policy,
            buffer=buffer,
            buffer_bytes=buffer_bytes,
            timeout=timeout,
            default_timeout=self._publishers.default_timeout,
        )

    def events(
        self, *, kinds: Collection[str | type[ClientEvent]] = (), buffer: int = BUFFER_ITEMS
    ) -> Stream[ClientEvent]:
        """Stream what happens to the connection, the session and play, from this call on.

        Args:
            kinds: Which events, by class or by name: `connected`, `lost`, `reconnected`, `silent`, `answers`,
                `session_opened`, `session_lost`, `play_started`, `play_ended`. Empty for all.
            buffer: Events that wait for a reader; the oldest give way, which shows in the next one's `dropped`.

        Raises:
            ClientClosed: The client was closed.
            ValueError: There is no event of such a kind.
            TypeError: `kinds` is a name by itself.
        """
        return self._publishers.events.stream(kinds, buffer)

    async def call(self, request: Request[R], *, timeout: Timeout = DEFAULT) -> R:
        """Send any request of `urlab_client.protocol.messages` and return its reply, without taking anything over.

        Raises:
            URLabRPCError: The server refused.
        """
        return await self._session.call(request, timeout=timeout)

    async def explain(self) -> Diagnosis:
        """Find out why a robot does not move: sockets, versions, play, pause, modes, controllers, set-points.

        Takes at most a few seconds, does not raise for problems that it finds, and changes nothing on the server.
        """
        config = structs.replace(self._config, state_port=self._state_port())
        return await diagnose(config, self._session, self._state)

    async def meta(self, *, timeout: Timeout = DEFAULT) -> list[OpInfo]:
        """List the ops that the server offers; needs no session."""
        reply: MetaOk = await self._session.call(MetaRequest(), timeout=timeout)
        return reply.ops

    async def close(self) -> None:
        """Take back a step mode that `discover()` promoted, and close the connection. Idempotent."""
        if self._closed:
            return
        self._closed = True
        promoted_from = self._state.promoted_from
        self._publishers.close()
        try:
            playing = self.connected and self.manager_present
            if self._publishers.camera_switch is not None:
                await self._publishers.camera_switch.aclose(connected=playing)
            await self._session.control.aclose(connected=playing)
            await self._keeper.aclose()
            await self._watch.aclose()
            await asyncio.sleep(0)  # a blocking client notices only now that the server has gone meanwhile
            if promoted_from is not None and self.connected and self.manager_present:
                with contextlib.suppress(URLabError):  # a courtesy: the server may have moved on
                    async with self._session.turn(SetMode, timeout=_REVERT_S) as turn:
                        await ask_mode(self._state, turn, promoted_from)
        finally:
            await self._session.aclose()

    async def __aenter__(self) -> Self:
        running_loop()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    def __repr__(self) -> str:
        state = "closed" if self._closed else "connected" if self.connected else "not connected"
        return f"<URLabClient {self.address} {state}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "URLabClient cannot be pickled: it belongs to a connection of this process. "
            "Send client.config, and make a client from it: URLabClient(**config.options())."
        )

    def _state_port(self) -> int:
        hello = self._state.hello
        told = None if hello is None or hello.instance is None else hello.instance.state_port
        # What the user has chosen goes before what the server says: there may be a tunnel between.
        chosen = self._config.state_port
        return self._transport.state_port or (told if told and chosen == ClientConfig().state_port else chosen)
