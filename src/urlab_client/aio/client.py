"""The typed client of a URLab server."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from copy import copy
from functools import partial
from types import TracebackType
from typing import NoReturn, Self, TypeVar, cast

from urlab_client.aio.arguments import integer, require, text
from urlab_client.aio.articulation import URLabArticulation, URLabEntity
from urlab_client.aio.background import running_loop
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client_state import ClientState
from urlab_client.aio.client_types import STATE_PORT, CallRecord, ClientConfig, Diagnosis, Resync
from urlab_client.aio.defaults import DEFAULT, SESSION_LEVEL, SessionLevel, Timeout
from urlab_client.aio.explain import diagnose
from urlab_client.aio.launch import transport_to
from urlab_client.aio.motion import Motion
from urlab_client.aio.namespaces._ops import DebugNamespace, FarmNamespace, ViewportNamespace
from urlab_client.aio.namespaces.outliner import OutlinerNamespace
from urlab_client.aio.namespaces.recording import RecordingNamespace, ReplayNamespace
from urlab_client.aio.namespaces.runtime import RuntimeNamespace
from urlab_client.aio.namespaces.scene import SceneNamespace
from urlab_client.aio.namespaces.sim import SimNamespace
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.capturing import take_pictures
from urlab_client.aio.state.connection_monitor import ConnectionMonitor, SessionKeeper
from urlab_client.aio.state.derived_rows import DerivedRowSource
from urlab_client.aio.state.discovery import Discovery
from urlab_client.aio.state.recovery import resync
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.stepping import send_step, take_reset, take_steps
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.aio.streams.sources import RowFilter, RowSource
from urlab_client.aio.streams.stream import BUFFER_BYTES, BUFFER_ITEMS, Stream
from urlab_client.aio.transport.connection import client_keys, is_local
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.enums import (
    CameraTiming,
    EncodingName,
    ObservationLevel,
    ObservationLevelName,
    StepMode,
    StepModeName,
    Transport,
    TransportName,
)
from urlab_client.errors import URLabError
from urlab_client.events import ClientEvent
from urlab_client.protocol.base import Reply, Request
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Hello, MetaOk, OpInfo, Reset, ResetOk, Step, StepOk
from urlab_client.protocol.messages.session import Meta as MetaRequest
from urlab_client.protocol.messages.streams import (
    CameraSample,
    RowSample,
    StateSnapshot,
    StreamPolicy,
    StreamPolicyName,
)
from urlab_client.protocol.topics import TopicKind
from urlab_client.values.descriptions import ArticulationDescription, EntityDescription, SceneDescription
from urlab_client.values.html import fields
from urlab_client.values.names import NameMap

log: logging.Logger = logging.getLogger("urlab_client.client")

R = TypeVar("R", bound=Reply)

_REVERT_S = 1.0
_READ_ONLY_MODES = (StepMode.AUTO, StepMode.LIVE)


class URLabClient(ClientState):
    """A session with one server.

    The client sends nothing and starts nothing before the first call. Concurrent calls run one at a time.

    Args:
        address: `tcp://host` or `ipc://path`, to which the ports are appended; `tcp://host:port` names the RPC port
            itself. `sim://MODEL` starts a simulated server in a child process and stops it on close.
        step_mode: `auto`, `direct`, `puppet` or `live`.
        step_port: RPC port.
        state_port: State stream, used in live mode. If the server announces another port, that port replaces the
            default, but not a port that is given here, even if it has the same number.
        ctrl_port: Without effect: the client sends set-points with `step()`, not to the server's control socket.
        info_port: Without effect: actuators and cameras are described in the handshake.
        mujoco_version_check: Raise `URLabVersionMismatch` when server and client MuJoCo builds differ; False warns and
            works with a model compiled here.
        local_model: Load the handshake's compiled model into `model` and `data`.
        rcv_timeout_ms: Default deadline of a call in milliseconds; ops that take longer have longer ones.
        auto_promote_step_mode: Let `discover()` switch the server to `direct` or `puppet` if `step_mode` names one of
            them.
        transport: `zmq`, or `shm` on the same host.
        shm_dir: Directory of the shared-memory regions, if it differs from the one that the server names.
        encoding: `msgpack`, or `json` to make traffic readable while debugging.
        server_key: Public key of a server that uses CURVE: a file, or the 40 characters of the key. For a server on
            another machine, the environment variable `URLAB_SERVER_KEY` can name the file instead.
        client_key: File with the client's own secret key, for servers that authenticate clients. The environment
            variable `URLAB_CLIENT_KEY` can name it instead. None generates a key.
        trust_server: Load the binary model of a server that is neither on this machine nor authenticated by its key.
            If False, the client compiles the model of such a server from XML, in a child process with limits.
        live_pictures: Receive the pictures of all cameras automatically in live mode, for `latest_frame`. False saves
            the server and the network this load; `frames()` still receives pictures.
        claim_control: Take control of a robot with the first write to it, on servers where a robot has one owner. False
            is for clients that only watch, and for those that call `articulation.claim()`.
        keep_session: After the first `discover()`, discover again automatically after the server has restarted or play
            has been started by another client or in the editor; `events()` reports it. The client never takes back a
            session that another client has taken over. While the outcome of a step or reset is unknown, it waits for
            `resync()`.
        read_only: Watch a server that another client drives. The client opens no session, so it takes the server over
            from no other client. Calls that need a session raise `ReadOnlyClient`. `discover(handshake=…)` describes
            the scene; streams deliver state, pictures and events. Requires `transport="zmq"`.
        observe: Callback invoked with a `CallRecord` after each request, successful or not: op, bytes, time in the
            queue, round trip, outcome. It runs on the client's event loop, so it must be quick and must not call the
            client. The client logs exceptions that it raises and carries on.

    Raises:
        TypeError: `observe` is not a plain function.
        KeyFileError: A key file cannot be used.
        ValueError: The address or an option is malformed.
    """

    def __init__(
        self,
        address: str = "tcp://localhost",
        *,
        step_mode: StepMode | StepModeName = "auto",
        step_port: int = 5559,
        state_port: int = STATE_PORT,
        ctrl_port: int = 5556,
        info_port: int = 5557,
        mujoco_version_check: bool = True,
        local_model: bool = True,
        rcv_timeout_ms: int = 5000,
        auto_promote_step_mode: bool = True,
        transport: Transport | TransportName = "zmq",
        shm_dir: str | None = None,
        encoding: EncodingName = "msgpack",
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
            state_port=None if state_port is STATE_PORT else state_port,
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
        if read_only and (alone or config.step_mode not in _READ_ONLY_MODES):
            raise ValueError(
                "read_only needs transport='zmq', the address of a running server, and step_mode 'auto' or 'live'"
            )
        if rcv_timeout_ms <= 0:
            raise ValueError(f"rcv_timeout_ms must be above 0, got {rcv_timeout_ms}")
        keys = client_keys(address, config.server_key, config.client_key)
        memory = ServerRegions(shm_dir) if Transport(transport) is Transport.SHM else None
        self._transport = transport_to(address, step_port, keys, memory)
        session = Session(
            self._transport,
            default_timeout=rcv_timeout_ms / 1000,
            json=encoding == "json",
            observe=observe,
            claim_control=claim_control,
            read_only=read_only,
        )
        self._publishers = Publishers(
            session, self._state_port, live=lambda: self._state.mode.live, keys=keys, memory=memory
        )
        session.tell = self._publishers.events.publish
        if memory is not None:
            memory.tell = session.tell
        state = SimState(session, self._publishers, wanted_mode=StepMode(step_mode), live_pictures=live_pictures)
        self._motion = Motion(state, step=self.step, explain=self.explain, locate=self._locate)
        state.objects.move = self._motion.move_to
        self._publishers.capture = partial(take_pictures, state)
        super().__init__(state)
        self._config = config
        self._session = session
        self._discovery = Discovery(
            state,
            local_model=local_model,
            check_version=mujoco_version_check,
            promote=auto_promote_step_mode,
            trusted=trust_server or keys is not None or is_local(address),
        )
        self._monitor = ConnectionMonitor(session, state)
        self._keeper = SessionKeeper(session, state, self._discovery)
        self._transport.on_event = self._monitor.on_transport
        self._closed = False
        self._sim = SimNamespace(session, state, self._discovery)
        self._scene = SceneNamespace(session, self._sim)
        self._runtime = RuntimeNamespace(session, state)
        self._outliner = OutlinerNamespace(session)
        self._debug = DebugNamespace(session)
        self._viewport = ViewportNamespace(session)
        self._farm = FarmNamespace(session)
        self._recording = RecordingNamespace(session, state)
        self._replay = ReplayNamespace(session, state)

    @property
    def address(self) -> str:
        """The address given to the constructor."""
        return self._config.address

    @property
    def config(self) -> ClientConfig:
        """The constructor's arguments. They can be pickled or encoded to JSON to create an equal client elsewhere."""
        return self._config

    @property
    def articulations(self) -> NameMap[URLabArticulation]:
        """Articulations by key. Lookups also accept an actor id or a class name that is unambiguous."""
        return self._state.objects.articulations

    @property
    def articulations_by_id(self) -> dict[str, URLabArticulation]:
        """Articulations that have an actor id, by that id."""
        return self._state.objects.articulations_by_id

    @property
    def entities(self) -> NameMap[URLabEntity]:
        """Every dynamic body by name, articulations included."""
        return self._state.objects.entities

    @property
    def global_cameras(self) -> NameMap[URLabCameraView]:
        """Scene-level cameras by name."""
        return self._state.objects.global_cameras

    def camera(self, name: str) -> URLabCameraView:
        """Return a camera by `<articulation>/<camera>`, or by `<camera>` if that is unambiguous.

        Raises:
            UnknownName: No camera or more than one has this name. It is a `KeyError`.
        """
        return self._state.objects.require_camera(name)

    def describe(self) -> SceneDescription:
        """Return all robots, other dynamic bodies and scene cameras as of the last reply.

        Sends nothing. `to_dict()` and `to_json()` of the result return plain data.
        """
        with self._state.mirror.lock:
            described = [entity.describe() for entity in self.entities.values()]
            model = self.model
            return SceneDescription(
                address=self.address,
                playing=self.manager_present,
                step_mode=str(self.step_mode),
                sim_time=self.sim_time,
                timestep=None if model is None else float(model.opt.timestep),
                articulations=[one for one in described if isinstance(one, ArticulationDescription)],
                entities=[one for one in described if isinstance(one, EntityDescription)],
                cameras=[camera.describe() for camera in self.global_cameras.values()],
            )

    # Namespaces

    @property
    def scene(self) -> SceneNamespace:
        """Editor-time authoring."""
        return self._scene

    @property
    def sim(self) -> SimNamespace:
        """Start and stop play."""
        return self._sim

    @property
    def runtime(self) -> RuntimeNamespace:
        """Live changes to the running simulation."""
        return self._runtime

    @property
    def outliner(self) -> OutlinerNamespace:
        """Inspect the world."""
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
        """Share servers among clients."""
        return self._farm

    @property
    def recording(self) -> RecordingNamespace:
        """Record joint states."""
        return self._recording

    @property
    def replay(self) -> ReplayNamespace:
        """Play recordings back."""
        return self._replay

    # Operations

    async def discover(
        self,
        observations: ObservationLevel | ObservationLevelName = "standard",
        *,
        handshake: bytes | None = None,
        timeout: Timeout = DEFAULT,
    ) -> None:
        """Open a session, load the model, and build the wrappers of articulations, entities and cameras.

        Safe to repeat: wrappers of objects that still exist stay valid. Takes the server over from any other client.

        Changes nothing in the simulation. The state is that of the first published snapshot, for which the client waits
        up to a second. A server that publishes only in live mode sends none in the other modes; the state is then the
        last one known of this world, or the model's initial state, until the first reply.

        Args:
            observations: `minimal` (qpos, qvel), `standard` (adds ctrl, act, sensors) or `full` (adds body poses and
                actuator forces).
            handshake: Return value of `handshake()` of the client that drives the server. Required with
                `read_only=True`, not allowed otherwise. Call `discover()` again with the new one after each start of
                play.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            ValueError: The handshake is invalid, or the client is not read-only and takes none.
            ReadOnlyClient: The client is read-only and no handshake is given.
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
                await self._discovery.open_read_only(turn, handshake)
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
        observations: ObservationLevel | ObservationLevelName | SessionLevel = SESSION_LEVEL,
        timeout: Timeout = DEFAULT,
    ) -> StepOk:
        """Advance physics according to the step mode, and update the state.

        In `direct` the server steps `n_steps` times with the set-points in each articulation's `ctrl_array`. In
        `puppet` the local model steps `n_steps` times (0: not at all) and the result is pushed. In `live` the client
        sends the set-points and reads the current state; physics runs continuously.

        Args:
            n_steps: Physics steps, at least 1; at least 0 in `puppet`. Not used in `live`.
            include_cameras: True for the newest frame of every camera, or camera name to `sync` (rendered after the
                step) or `latest`. If the server cannot render for a step, the step waits up to 3 s per camera for its
                picture in the camera's stream. A `sync` picture that is older than the step is omitted from the reply,
                like one that did not arrive. Servers that do not render for steps in live mode ignore this there.
            observations: Level of this reply only; by default the level of the session.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The new state, which articulations, entities, cameras and `data` already show.

        Raises:
            StepTimeout: The server did not finish within its limit of 5 s; the steps are still queued there.
            OutcomeUnknown: The connection broke; the steps may or may not have been executed. `resync()` finds out.
            ValueError: Fewer steps than the mode allows; nothing was sent.
            KeyError: Unknown camera; nothing was sent.
            ValueError: A set-point is NaN or infinite, or in puppet mode something in `data`; nothing was sent.
            NoSession: `discover()` was not called or did not finish; nothing was sent.
        """
        n_steps = integer("step: n_steps", n_steps)  # a hot op: its request is not checked again before it is sent
        level = None if observations is SESSION_LEVEL else ObservationLevel(observations)
        turn = self._session.turn(Step, timeout=timeout)
        if not turn.begin_nowait():  # saves the three coroutines of `async with`
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
        """Reset the simulation and adopt the new state. Set-points keep their values.

        Args:
            keyframe_name: Keyframe to reset to. The short name is enough if only one articulation has it.
            seed: Seed that the server stores. On a simulated server that randomises its scene, it determines the
                episode's random values; otherwise it has no effect on the physics.
            per_articulation_qpos: Joint positions: articulation key to joint name to the first component of the
                position.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The state, with `step` 0.

        Raises:
            UnknownKeyframe: No keyframe or more than one has this name; nothing was reset.
            KeyError: Unknown articulation or joint; nothing was sent.
            TypeError: A position is not a number; nothing was sent.
            ValueError: A position is NaN or infinite; nothing was sent.
        """
        async with self._session.turn(Reset, timeout=timeout) as turn:
            return await take_reset(self._state, turn, keyframe_name, seed, per_articulation_qpos or {})

    async def resync(self, *, timeout: Timeout = DEFAULT) -> Resync:
        """Find out what happened to steps, resets and mode changes whose replies were lost, and continue from there.

        Call it after `OutcomeUnknown`, after a step raised `URLabTimeoutError`, or after a step was cancelled. It
        queries the server's step counter and time without stepping, and updates the state. It opens a new session if
        the old one is gone, or if a lost request may still be in transit, so that the server refuses that request when
        it arrives. It never sends a step or reset again; whether to repeat them is the caller's decision.

        Other abandoned calls that change what the client mirrors are settled as well, such as `set_paused()`,
        `set_sim_options()`, `sim.stop()`, `claim()` and `recording.start()`: the client sends them once more, or reads
        the result.

        Args:
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The findings; only the state of the simulation if no outcome was unknown.

        Raises:
            URLabConnectionError: The server is not reachable yet. Call `resync()` again later.
        """
        return await resync(self._state, self._discovery, timeout=timeout)

    async def run_for(self, seconds: float) -> float:
        """Let simulation time pass: step in `direct` and `puppet`; send set-points and wait in `live`.

        Args:
            seconds: Simulation time, seconds; rounded to whole physics steps in `direct` and `puppet`.

        Returns:
            Simulation time that passed, seconds.

        Raises:
            URLabTimeoutError: Simulation time does not advance in live mode, for example while paused; the message
                gives the reason.
            ValueError: `seconds` is negative, NaN or infinite; nothing was sent.
        """
        return await self._motion.run_for(seconds)

    async def wait_until(self, predicate: Callable[[], object], *, timeout: float = 10.0) -> float:
        """Let simulation time pass, as `run_for` does, until a condition is true.

        Args:
            predicate: The condition, which reads the client's state and must return quickly. It is called before the
                first step and then at least every 10 ms of simulation time; in live mode, after each snapshot.
            timeout: Seconds of simulation time after which to give up.

        Returns:
            Simulation time that passed, seconds.

        Raises:
            URLabTimeoutError: The condition did not become true in time, or simulation time does not advance; the
                message contains the findings of `explain()`.
            TypeError: The predicate returns an awaitable.
        """
        return await self._motion.wait_until(predicate, timeout)

    async def capture(
        self, cameras: Iterable[str] | None = None, *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraSample]:
        """Take pictures of several cameras now, in any step mode, without a step; see `URLabCameraView.capture`.

        In `direct` and `puppet` mode, and while paused, all pictures show the same moment.

        Args:
            cameras: Camera names as for `camera()`; None for all cameras.
            timeout: Seconds to wait for all pictures together; None waits without limit.

        Returns:
            The pictures, keyed by the given names.

        Raises:
            KeyError: No camera or more than one has this name; nothing was sent.
            TypeError: `cameras` is a single string or not iterable.
            PictureTimeout: Some pictures did not arrive in time; `.cameras` names their cameras.
            NoActiveManager: No play session is running.
            ModeLocked: The project is locked to a mode that delivers pictures only with steps.
        """
        objects = self._state.objects
        if isinstance(cameras, str):
            raise TypeError(f"capture takes a list of names; for one camera call client.camera({cameras!r}).capture()")
        if cameras is None:
            names = {shown: name for name, shown in objects.shown_cameras(objects.camera_names()).items()}
        else:
            try:
                names = {name: name for name in cameras}
            except TypeError:
                raise TypeError(f"capture takes camera names, got {cameras!r:.80}.") from None
        views = [self.camera(name) for name in names.values()]
        samples = await self._publishers.capture([view.camera for view in views], timeout) if views else []
        return dict(zip(names, samples, strict=True))

    def state_stream(
        self,
        policy: StreamPolicy | StreamPolicyName = "latest",
        *,
        max_rate: float | None = None,
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[StateSnapshot]:
        """Stream the snapshots that the server publishes during play.

        The server publishes one snapshot per physics tick in live mode, paused or not; one per step, and ten per second
        between steps, in `direct`; ten per second in `puppet`. The stream does not block other calls and adds no load
        to the server. If a server publishes only in live mode, as the beta does, the stream has one snapshot for each
        of this client's own steps in the other modes.

        Args:
            policy: `latest`, or `all` within the limits of the buffer.
            max_rate: Maximum number of snapshots per second, with `latest`; each is the newest at its time. The rate
                does not drift: an item that is read late does not delay those after it. None for no limit.
            buffer: Maximum number of buffered snapshots, with `all`.
            buffer_bytes: Maximum number of buffered bytes, with `all`.
            timeout: Seconds that iteration waits for each snapshot. The default is the client's timeout for the first
                one and no limit after that. None waits without limit.

        Raises:
            ValueError: The policy is unknown, the buffer is empty, or `max_rate` is not above 0 or used with another
                policy than `latest`.
            ClientClosed: The client was closed.
        """
        self._publishers.check_open()
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
        policy: StreamPolicy | StreamPolicyName = "latest_per_key",
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
    ) -> Stream[RowSample]:
        """Stream the small rows that the server publishes in live mode: one joint, sensor or free base each.

        If a server publishes only whole snapshots, as the beta does, the client derives the rows from snapshots: in
        live mode from the published ones, in the other modes from the replies to its own steps, with the readings of
        their observation level. Accelerations are then NaN.

        Args:
            articulation: Key of the articulation; None for all articulations and the plain entities.
            kinds: `joint`, `base_state`, `sensor`, `twist`, `actions`; for entities `xpos`, `xquat`, `qpos`, `qvel`.
                Empty for all kinds, or, with `components`, for the kinds that have components.
            components: Component names; empty for all.
            policy: `latest_per_key` keeps the newest row of each joint, sensor or base; `latest` keeps the newest row
                of all; `all` keeps every row within the limits of the buffer.
            buffer: Maximum number of buffered rows.
            buffer_bytes: Maximum number of buffered bytes.
            timeout: Seconds that iteration waits for each row. The default is the client's timeout for the first one
                and no limit after that. None waits without limit.

        Raises:
            KeyError: The articulation is unknown.
            ValueError: A kind or the policy is unknown, or the buffer is empty.
            ClientClosed: The client was closed.
            URLabError: `discover()` was not called yet; or rows must be derived from snapshots, which requires a local
                model.
        """
        if self._state.hello is None:
            raise URLabError("row_stream: the articulations are not known yet.", hint="Call discover() first.")
        if not self._session.features.publishes_rows and self.articulations and self.model is None:
            raise URLabError(
                "row_stream: this server publishes no rows, and deriving them from snapshots requires a local model.",
                hint="Create the client with local_model=True, or use state_stream().",
            )
        if articulation is None:
            keys = list(self.articulations)
        else:
            keys = [self.articulations[text("row_stream: articulation", articulation)].prefix]
        wanted = RowFilter(keys, kinds, components, entities=articulation is None)
        self._publishers.check_open()
        source: RowSource | DerivedRowSource = self._publishers.rows(wanted)
        if not self._session.features.publishes_rows:
            # From the socket, which delivers every snapshot; a region holds only the newest.
            states = self._publishers.state(StreamPolicy.ALL)
            source = DerivedRowSource(states, lambda: self.articulations, wanted)
        return Stream(
            source,
            policy=policy,
            buffer=buffer,
            buffer_bytes=buffer_bytes,
            timeout=timeout,
            default_timeout=self._publishers.default_timeout,
        )

    def events(
        self, *, kinds: Collection[str | type[ClientEvent]] = (), buffer: int = BUFFER_ITEMS
    ) -> Stream[ClientEvent]:
        """Stream events of the connection, the session and play, from this call on.

        Args:
            kinds: Kinds of events, by class or by name: `connected`, `lost`, `reconnected`, `silent`, `answers`,
                `session_opened`, `session_lost`, `play_started`, `play_ended`, `task_failed`. Empty for all.
            buffer: Maximum number of buffered events. Beyond it the oldest are dropped; `dropped` of the next event
                counts them.

        Raises:
            ClientClosed: The client was closed.
            ValueError: A kind is unknown.
            TypeError: `kinds` is a single string.
        """
        return self._publishers.events.stream(kinds, buffer)

    async def call(self, request: Request[R], *, timeout: Timeout = DEFAULT) -> R:
        """Send any request of `urlab_client.protocol.messages` and return its reply, without updating client state.

        The request stays as it is, so several clients may send the same one.

        Raises:
            URLabRPCError: The server refused the request.
            TypeError: It is not a request, but the name of an op, for example; nothing was sent.
            ValueError: A `Step` has numbers that are not finite, or 0 steps in direct mode, where the server would take
                one; nothing was sent.
        """
        require("call", request, Request, "a request of urlab_client.protocol.messages, such as Step()")
        request = copy(request)  # the session stamps its id on what it sends, and the owner of the robots
        if not isinstance(request, Step):
            return await self._session.call(request, timeout=timeout)
        async with self._session.turn(Step, timeout=timeout) as turn:
            return cast("R", await send_step(self._state, turn, request))

    async def explain(self) -> Diagnosis:
        """Find out why a robot does not move: sockets, versions, play, pause, modes, controllers, set-points.

        Takes a few seconds at most, returns the problems that it finds rather than raising, and changes nothing on the
        server.
        """
        return await diagnose(self._config, self._session, self._state, self._state_port())

    async def meta(self, *, timeout: Timeout = DEFAULT) -> list[OpInfo]:
        """List the ops that the server offers. Needs no session."""
        reply: MetaOk = await self._session.call(MetaRequest(), timeout=timeout)
        return reply.ops

    async def close(self) -> None:
        """Revert the step mode that `discover()` promoted, and close the connection. Idempotent."""
        if self._closed:
            return
        self._closed = True
        promoted_from = self._state.mode.promoted_from
        self._publishers.close()
        try:
            playing = self.connected and self.manager_present
            await self._publishers.camera_switch.aclose(connected=playing)
            await self._session.control.aclose(connected=playing)
            await self._keeper.aclose()
            await self._monitor.aclose()
            await asyncio.sleep(0)  # lets a blocking client notice that the server has gone in the meantime
            if promoted_from is not None and self.connected and self.manager_present:
                with contextlib.suppress(URLabError):  # best effort: play may have ended
                    async with self._session.turn(SetMode, timeout=_REVERT_S) as turn:
                        await self._state.mode.ask(turn, promoted_from)
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
        if self._closed or self._state.hello is None:
            return f"<{self._title()}>"
        robots = ", ".join(self.articulations) or "no robots"
        return f"<{self._title()}, {self.step_mode} at {self.sim_time:.3f} s: {robots}>"

    def _title(self) -> str:
        state = "closed" if self._closed else "connected" if self.connected else "not connected"
        return f"URLabClient {self.address} {state}"

    def _repr_html_(self) -> str:
        play = step_mode = passed = ""
        if self._state.hello is None:
            step_mode = f"{self._config.step_mode}, requested"
        elif not self._closed:
            ready = "ready" if self._state.mode.live else "ready, waiting for step()"
            play = ready if self.manager_present else "not running, as far as this client knows"
            step_mode, passed = str(self.step_mode), f"{self.sim_time:.3f} s"
        found = {
            "server": self.urlab_version and f"URLab {self.urlab_version}, MuJoCo {self.mujoco_version}",
            "play": play,
            "step mode": step_mode,
            "simulation time": passed,
            "robots": ", ".join(self.articulations),
            "other bodies": ", ".join(name for name in self.entities if name not in self.articulations),
        }
        return fields(self._title(), found)

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "URLabClient cannot be pickled: its connection belongs to this process. "
            "Send client.config and create a client from it: URLabClient(**config.options())."
        )

    async def _locate(self) -> None:
        if not self._state.located:
            await self._runtime.forward()

    def _state_port(self) -> int:
        # The user's choice takes precedence over the server's announcement: there may be a tunnel in between.
        chosen = self._config.state_port
        if chosen is None:
            hello = self._state.hello
            announced = None if hello is None or hello.instance is None else hello.instance.state_port
            chosen = announced or int(STATE_PORT)  # sockets refuse subclasses of int as ports
        return self._transport.state_port or chosen
