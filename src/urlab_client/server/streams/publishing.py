"""What a server streams and what is streamed to it: its state, info and control sockets, and the thread behind them.

For `SimulatedServer`, which opens them. The physics thread only copies arrays, and only while somebody subscribes to
what they show; matching, encoding and sending happen here, behind a bounded hand-over that drops the oldest ticks.
Camera images have sockets of their own.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import mujoco
import numpy as np
import zmq
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client._mujoco import actuator_count, control_counts, control_starts
from urlab_client._uninterrupted import uninterrupted
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.control_messages import (
    ActuatorInfo,
    CameraEndpoint,
    ControlPayload,
    JointGains,
    decode_gains,
    gains_by_parameter,
)
from urlab_client.protocol.enums import ObservationLevel, StepMode
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.messages.session import ArticulationState, Clock, EntityState
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, SceneRow, SensorRow, TwistRow
from urlab_client.protocol.topics import STATE_FULL, StreamTopic, TopicKind
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.controllers import ArticulationControl, Twist
from urlab_client.server.physics.observe import Observer, sim_clock, wall_clock
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.health import Health
from urlab_client.server.system.thread_join import ended
from urlab_client.server.transport.curve_authentication import CurveKeys, ZapAuthenticator
from urlab_client.server.transport.endpoint import bind_tcp, bound_peers
from urlab_client.server.transport.shared_memory import SharedMemoryServer

__all__ = ["StreamServer", "next_info"]

logger = logging.getLogger("urlab_client.server")

Floats: TypeAlias = NDArray[np.float64]
Encoder: TypeAlias = Callable[[], bytes | None]

WAITING_TICKS: Final = 64
"""Ticks that may wait to be sent; of more, the oldest go unsent."""

WAITING_COMMANDS: Final = 1024
"""Control messages that may wait for the physics lock; of more, the oldest are lost."""

BATCH: Final = 256
"""Messages read from a socket before the others have their turn."""

LOCK_S: Final = 0.02
"""Longest wait for the physics lock in one go; what it was wanted for is tried again."""

MAX_COMMAND_BYTES: Final = 1 << 20
"""A larger control message costs its sender the connection."""

MAX_FILTER_BYTES: Final = 4096
"""Likewise a larger subscription."""

INFO_EVERY: Final = 50
INFO_START_TICKS: Final = 2500
INFO_LATER_EVERY: Final = 500
"""The info messages go out every 50 live ticks up to tick 2500, then every 500."""

NO_LIMIT: Final = 100.0
"""What stands for the control range of an actuator that has none."""

_LIVE: Final = frozenset({StepMode.LIVE, StepMode.AUTO})
_WAKE: Final = "inproc://urlab-streams-wake"
_ROW_KINDS: Final = {
    int(mujoco.mjtJoint.mjJNT_FREE): TopicKind.BASE_STATE,
    int(mujoco.mjtJoint.mjJNT_BALL): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_HINGE): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_SLIDE): TopicKind.JOINT,
}


class StateFull(Struct, tag_field="op", tag="state_full", kw_only=True, omit_defaults=True):
    """The map of a `state/full` message, every field of it but the last always present."""

    time: float
    step: int
    sim_time: Clock
    wall_time: Clock
    per_articulation: dict[str, ArticulationState]
    entities: dict[str, EntityState]
    user: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class _Tick:
    """One tick as the physics thread left it.

    Attributes:
        live: Number of the tick among the live ones seen, from 1; 0 outside live mode.
        time: `mjData.time`, seconds.
        step: Step counter.
        wall_time: When the copies were made.
        arrays: Copies of what `_Broadcast.sources` lists; empty when nobody wants them.
        twists: Commanded twist and action keys of each articulation; likewise.
        full: Whether the snapshot is wanted.
    """

    live: int
    time: float
    step: int
    wall_time: Clock
    arrays: list[Floats]
    twists: list[tuple[float, float, float, int]]
    full: bool


@dataclass(frozen=True, slots=True)
class _Row:
    topic: bytes
    encode: Encoder


class _Broadcast:
    """One play session on the air: takes ticks from its physics and makes messages of them.

    Attributes:
        running: The simulation.
        full_wanted: Whether the snapshot is subscribed to.
    """

    def __init__(
        self,
        running: Running,
        hand_over: Callable[[_Broadcast, _Tick], None],
        memory: SharedMemoryServer | None,
    ) -> None:
        """Prepare the messages of a scene; `want` decides which are made.

        Args:
            running: The simulation.
            hand_over: Takes a tick to the thread that sends; called under the engine's lock.
            memory: Where snapshots go besides, whenever it wants them.
        """
        self.running = running
        self._hand_over = hand_over
        self._memory = memory
        self._engine = running.engine
        self._dialect = running.engine.dialect
        scene = running.scene
        # The encoders read a mirror of the data that only the sending thread touches.
        self._mirror = mujoco.MjData(scene.model)
        self._controls = list(running.engine.articulations.controls.values())
        mirrored = {key: _with_own_twist(control) for key, control in running.engine.articulations.controls.items()}
        self._twists = [control.twist for control in mirrored.values()]
        self._observer = Observer(dataclasses.replace(scene, data=self._mirror), mirrored, running.channels)
        self._sources = _arrays(scene, scene.data)
        self._targets = _arrays(scene, self._mirror)
        self._rows = list(_rows(scene, self._mirror, mirrored.values())) if self._dialect.rows_published else []
        self._actuators = _Actuators(scene.model, self._controls)
        self._wanted_rows: list[_Row] = []
        self.full_wanted = False
        self._info_wanted = False
        self._live_ticks = 0
        self._info_due = next_info(0)

    # On the thread that sends.

    def want(self, state: Iterable[bytes], info: Iterable[bytes]) -> None:
        """Take over what is subscribed to on the two sockets; listen to physics only if that is anything."""
        prefixes = tuple(state)
        self._wanted_rows = [row for row in self._rows if row.topic.startswith(prefixes)] if prefixes else []
        self.full_wanted = STATE_FULL.startswith(prefixes) if prefixes else False
        self._info_wanted = any(True for _ in info)
        hooks = self._engine.on_tick
        if not (self._wanted_rows or self.full_wanted or self._info_wanted or self._memory is not None):
            self.leave()
        elif self._capture not in hooks:
            hooks.append(self._capture)

    def leave(self) -> None:
        """Stop listening to physics. Safe to call twice."""
        if self._capture in self._engine.on_tick:
            self._engine.on_tick.remove(self._capture)

    def state_messages(self, tick: _Tick) -> Iterator[tuple[bytes, bytes]]:
        """Yield topic and payload of what a tick brings on the state socket, the snapshot last."""
        if not tick.arrays:
            return
        for target, values in zip(self._targets, tick.arrays, strict=True):
            target[:] = values
        for twist, values in zip(self._twists, tick.twists, strict=True):
            twist.vx, twist.vy, twist.yaw_rate, twist.actions = values
        if tick.live:
            for row in self._wanted_rows:
                payload = row.encode()
                if payload is not None:
                    yield row.topic, payload
        if tick.full:
            yield STATE_FULL, self._state_full(tick)

    def _state_full(self, tick: _Tick) -> bytes:
        snapshot = StateFull(
            time=tick.time,
            step=tick.step,
            sim_time=sim_clock(tick.time),
            wall_time=tick.wall_time,
            per_articulation=self._observer.articulations(ObservationLevel.STANDARD),
            entities=self._observer.entities(),
            user=self._observer.scene_channels() or None,
        )
        return encode_reply(self._dialect.shaped(snapshot))

    def info_messages(
        self, tick: _Tick, cameras: Callable[[CompiledScene], Iterable[CameraEndpoint]]
    ) -> Iterator[bytes]:
        """Yield the frames due on the info socket."""
        if not (self._info_wanted and tick.live >= self._info_due):
            return
        self._info_due = next_info(tick.live)
        endpoints = tuple(cameras(self.running.scene))
        for control in self._controls:
            yield self._actuators.info(control, endpoints).encode()

    def command_topics(self) -> Iterator[bytes]:
        """Yield the topics that the articulations listen to."""
        for control in self._controls:
            for kind in (TopicKind.CONTROL, TopicKind.SET_GAINS):
                topic = _topic(kind, control.index.key)
                if topic is not None:
                    yield topic

    def obey(self, commands: deque[_Command]) -> bool:
        """Carry out and remove commands, which outside live mode have no effect.

        Returns:
            False when physics is busy: the commands are still there.
        """
        engine = self._engine
        if engine.mode not in _LIVE:  # then physics may legally keep the lock for hours
            commands.clear()
            return True
        if not engine.lock.inner.acquire(timeout=LOCK_S):
            return False
        try:
            while commands:
                command = commands.popleft()
                if engine.mode not in _LIVE:
                    continue
                if isinstance(command, ControlPayload):
                    self._actuators.stage(command)
                else:
                    self._set_gains(*command)
        finally:
            engine.lock.inner.release()
        return True

    def _set_gains(self, key: str, gains: dict[str, JointGains]) -> None:
        try:
            with self._engine.commanding() as articulations:
                articulations.configure_controller(key, gains_by_parameter(gains))
        except Refusal as refusal:
            logger.debug("gains streamed to '%s' have no effect: %s", key, refusal.message)

    # On the physics thread, under the engine's lock.

    def _capture(self) -> None:
        engine = self._engine
        live = engine.mode in _LIVE
        self._live_ticks += live
        full = self.full_wanted or (self._memory is not None and self._memory.wants_state())
        full = full and (live or self._dialect.steps_published)
        shown = full or (live and bool(self._wanted_rows))
        if not shown and not (live and self._info_wanted and self._live_ticks >= self._info_due):
            return
        self._hand_over(
            self,
            _Tick(
                live=self._live_ticks if live else 0,
                time=engine.time,
                step=engine.step_count,
                wall_time=wall_clock(),
                arrays=[array.copy() for array in self._sources] if shown else [],
                twists=[_values(control.twist) for control in self._controls] if shown else [],
                full=full,
            ),
        )


def _with_own_twist(control: ArticulationControl) -> ArticulationControl:
    mirrored = copy.copy(control)
    mirrored.twist = Twist()
    return mirrored


def _values(twist: Twist) -> tuple[float, float, float, int]:
    return twist.vx, twist.vy, twist.yaw_rate, twist.actions


def _arrays(scene: CompiledScene, data: mujoco.MjData) -> list[Floats]:
    """Return views of everything the messages show, never an empty list."""
    arrays = [data.qpos, data.qvel, data.qacc, data.ctrl, data.act, data.sensordata]
    return [*arrays, data.xpos, data.xquat] if scene.entities else arrays


def _topic(kind: TopicKind, owner: str, name: str = "") -> bytes | None:
    """Return a topic frame; None for names that no topic can carry."""
    try:
        return StreamTopic(kind, owner, name).encode()
    except ValueError as error:
        logger.warning("%s of '%s' is not streamed: %s", kind, owner, error)
        return None


def _rows(scene: CompiledScene, data: mujoco.MjData, controls: Iterable[ArticulationControl]) -> Iterator[_Row]:
    """Yield every row in the order of a tick: articulation by articulation, then the scene."""
    none = True
    for control in controls:
        none = False
        for kind, name, encode in _articulation_rows(scene.model, data, control):
            topic = _topic(kind, control.index.key, name)
            if topic is not None:
                yield _Row(topic, encode)
    if none:  # as in the plugin, the scene comes with the articulations
        return
    for entity in scene.entities:
        values = {TopicKind.XPOS: data.xpos[entity.body], TopicKind.XQUAT: data.xquat[entity.body]}
        if entity.free_joint is not None:
            values[TopicKind.QPOS] = data.qpos[entity.qpos_adr : entity.qpos_adr + 7]
            values[TopicKind.QVEL] = data.qvel[entity.qvel_adr : entity.qvel_adr + 6]
        for kind, view in values.items():
            topic = _topic(kind, entity.name)
            if topic is not None:
                yield _Row(topic, SceneRow(kind, view).encode)


def _articulation_rows(
    model: mujoco.MjModel, data: mujoco.MjData, control: ArticulationControl
) -> Iterator[tuple[TopicKind, str, Encoder]]:
    index = control.index
    for joint, name in zip(index.joints.tolist(), index.joint_names, strict=True):
        kind = _ROW_KINDS[int(model.jnt_type[joint])]
        encode = _base_state if kind is TopicKind.BASE_STATE else _joint
        yield kind, name, encode(model, data, joint)
    for sensor, name in zip(index.sensors.tolist(), index.sensor_names, strict=True):
        first, dim = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
        yield TopicKind.SENSOR, name, _sensor(sensor, data.sensordata[first : first + dim])
    twist = control.twist
    yield TopicKind.TWIST, "", lambda: TwistRow(twist.vx, twist.vy, twist.yaw_rate).encode()
    yield TopicKind.ACTIONS, "", lambda: ActionsRow(twist.actions).encode() if twist.actions else None


def _joint(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Encoder:
    qpos, qvel, qacc = data.qpos, data.qvel, data.qacc
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return lambda: JointRow(joint, float(qpos[position]), float(qvel[velocity]), float(qacc[velocity])).encode()


def _base_state(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Encoder:
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    qpos, qvel = data.qpos[position : position + 7], data.qvel[velocity : velocity + 6]
    return lambda: BaseStateRow.from_free_joint(qpos, qvel).encode()


def _sensor(sensor: int, values: Floats) -> Encoder:
    return lambda: SensorRow(sensor, values.astype("<f4")).encode()


def next_info(tick: int) -> int:
    """Return the first live tick after `tick` that brings the info messages."""
    every = INFO_EVERY if tick < INFO_START_TICKS else INFO_LATER_EVERY
    return (tick // every + 1) * every


class _Actuators:
    """The actuators of all articulations by their ids in the model."""

    def __init__(self, model: mujoco.MjModel, controls: Iterable[ArticulationControl]) -> None:
        self._model = model
        self._set_points = [control.set_points for control in controls]
        self._owner = np.full(actuator_count(model), -1, dtype=np.intp)
        self._place = np.zeros(actuator_count(model), dtype=np.intp)
        for number, control in enumerate(controls):
            actuators = control.index.actuators
            widths = control_counts(model)[actuators]
            self._owner[actuators] = number
            self._place[actuators] = np.cumsum(widths) - widths

    def stage(self, command: ControlPayload) -> None:
        """Store set-points; unknown ids are ignored, an actuator of several inputs gets its first."""
        known = (command.actuator_ids >= 0) & (command.actuator_ids < len(self._owner))
        ids, values = command.actuator_ids[known], command.values[known]
        owners = self._owner[ids]
        for number, set_points in enumerate(self._set_points):
            mine = owners == number
            set_points.network[self._place[ids[mine]]] = values[mine]

    def info(self, control: ArticulationControl, cameras: tuple[CameraEndpoint, ...]) -> ActuatorInfo:
        """Return what the info socket says about an articulation."""
        model, index = self._model, control.index
        first = control_starts(model)[index.actuators]
        limited = model.actuator_ctrllimited[first].astype(bool)
        ranges = model.actuator_ctrlrange[first].astype(np.float32).astype(np.float64)
        return ActuatorInfo(
            robot=index.key,
            names=tuple(f"{index.prefix}{name}" for name in index.actuator_names),
            ids=index.actuators,
            mins=np.where(limited, ranges[:, 0], -NO_LIMIT),
            maxs=np.where(limited, ranges[:, 1], NO_LIMIT),
            cameras=cameras,
        )


_Command: TypeAlias = ControlPayload | tuple[str, dict[str, JointGains]]


def _commands(frames: list[bytes]) -> Iterator[_Command]:
    """Read a message of the control socket; a frame without a partner is ignored.

    Raises:
        ProtocolError: A payload is malformed.
    """
    for topic, payload in zip(frames[::2], frames[1::2], strict=False):
        owner, is_gains, _ = topic.partition(b"/set_gains")
        where = topic.decode(errors="replace")
        yield (owner.decode(), decode_gains(payload, where)) if is_gains else ControlPayload.decode(payload, where)


class StreamServer:
    """The state, info and control sockets of a server. They are bound for its life and silent between play sessions.

    A slow subscriber loses the newest of its messages beyond ZeroMQ's 1000, all others get theirs.

    Attributes:
        state_port: Port of the state stream.
        ctrl_port: Port of streamed controls and gains.
        info_port: Port of the info stream.
        filter: What becomes of a message to subscribers, from its topic and payload: its payload, or None for nothing.
            Set it before `start`; called on the thread that sends.
    """

    state_port: int
    ctrl_port: int
    info_port: int

    def __init__(
        self,
        cameras: Callable[[CompiledScene], Iterable[CameraEndpoint]],
        *,
        health: Health,
        host: str = "127.0.0.1",
        state_port: int = 0,
        ctrl_port: int = 0,
        info_port: int = 0,
        curve_keys: CurveKeys | None = None,
        memory: SharedMemoryServer | None = None,
    ) -> None:
        """Bind the sockets; `start` begins to serve.

        Args:
            cameras: Where the cameras of a scene publish, for the info stream.
            health: Told when nothing can be streamed any more.
            host: IP address of the interface.
            state_port: TCP port; 0 picks a free one, here and below.
            ctrl_port: TCP port.
            info_port: TCP port.
            door: Who may connect; None for anybody who reaches the interface.
            memory: Shared memory that gets the snapshots as well.

        Raises:
            PortInUse: Somebody has a port.
            OSError: The address is not one of this machine.
        """
        self.filter: Callable[[bytes, bytes], bytes | None] | None = None
        self._cameras = cameras
        self._memory = memory
        self._context = zmq.Context()
        self._context.linger = 0
        self._authenticator = ZapAuthenticator(self._context, curve_keys, health)
        self._health = health
        self._failed = 0
        # XPUB is PUB that tells what is subscribed to.
        self._state = self._context.socket(zmq.XPUB)
        self._info = self._context.socket(zmq.XPUB)
        self._control = self._context.socket(zmq.SUB)
        self._control.maxmsgsize = MAX_COMMAND_BYTES
        for socket in (self._state, self._info):
            socket.maxmsgsize = MAX_FILTER_BYTES
        for socket in (self._state, self._info, self._control):
            self._authenticator.protect(socket)
            bound_peers(socket)
        try:
            self.state_port = bind_tcp(self._state, host, state_port, "state_port")
            self.ctrl_port = bind_tcp(self._control, host, ctrl_port, "ctrl_port")
            self.info_port = bind_tcp(self._info, host, info_port, "info_port")
        except BaseException:
            self._authenticator.close()
            with uninterrupted():
                self._context.destroy(linger=0)
            raise
        self._wake = self._context.socket(zmq.PAIR)
        self._wake.bind(_WAKE)
        self._waker = self._context.socket(zmq.PAIR)
        self._waker.connect(_WAKE)
        self._waking = threading.Lock()
        self._awake = False
        self._stopping = False
        self._target: Running | None = None
        self._shown: Running | None = None
        self._ticks: deque[tuple[_Broadcast, _Tick]] = deque(maxlen=WAITING_TICKS)
        self._commands: deque[_Command] = deque(maxlen=WAITING_COMMANDS)
        self._malformed = 0
        self._subscribed: dict[zmq.Socket[bytes], set[bytes]] = {self._state: set(), self._info: set()}
        self._listening: list[bytes] = []
        self._broadcast: _Broadcast | None = None
        self._thread = threading.Thread(target=self._run, name="urlab-streams", daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the sockets are served."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start the thread that serves."""
        self._thread.start()

    def show(self, running: Running | None) -> None:
        """Serve this simulation from now on, or none. Returns at once; may be called from any thread."""
        self._target = running
        self._rouse()

    def stop(self) -> None:
        """Ask the thread to end, without waiting."""
        self._stopping = True
        self._rouse()

    def join(self, timeout: float) -> bool:
        """Wait for the end after `stop`.

        Args:
            timeout: Seconds to wait.

        Returns:
            False when the thread was still busy then; it closes the sockets when it is done.
        """
        if self._thread.ident is None:
            self._close()
            return True
        return ended(self._thread, timeout)

    def _hand_over(self, broadcast: _Broadcast, tick: _Tick) -> None:
        self._ticks.append((broadcast, tick))
        self._rouse()

    def _rouse(self) -> None:
        if self._awake:
            return
        with self._waking:
            if not self._awake and not self._waker.closed:
                self._awake = True
                self._waker.send(b"", zmq.NOBLOCK)

    # The thread.

    def _run(self) -> None:
        poller = zmq.Poller()
        for socket in (self._wake, self._state, self._info, self._control):
            poller.register(socket, zmq.POLLIN)
        try:
            while not self._stopping:
                # Commands that physics was too busy for are tried again.
                ready = dict(poller.poll(0 if self._commands else None))
                if self._wake in ready:
                    self._wake.recv()
                    self._awake = False  # before looking, so that what comes later rouses again
                try:
                    self._turn(ready)
                except zmq.ZMQError:
                    raise
                except Exception as error:
                    if self._broadcast is None and self._shown is not None:
                        raise  # a play session that cannot be streamed: subscribers would wait for nothing
                    self._skip(error)
        except BaseException as error:  # noqa: BLE001 - subscribers hear of it by the next request
            self._health.report(error)
        finally:
            self._leave()
            self._close()

    def _skip(self, error: Exception) -> None:
        """Go on without the ticks and commands that were under way, and log what went wrong."""
        self._ticks.clear()
        self._commands.clear()
        self._failed += 1
        if self._failed & (self._failed - 1) == 0:  # what fails once often fails again
            logger.error("messages were not streamed (%d times so far)", self._failed, exc_info=error)

    def _turn(self, ready: dict[Any, int]) -> None:
        changed = [self._read_subscriptions(socket) for socket in self._subscribed if socket in ready]
        self._publish()
        if self._shown is not self._target:
            self._switch()
        elif any(changed) and self._broadcast is not None:
            self._broadcast.want(self._subscribed[self._state], self._subscribed[self._info])
        if self._control in ready:
            self._read_commands()
        if self._commands:
            if self._broadcast is None:
                self._commands.clear()
            else:
                self._broadcast.obey(self._commands)

    def _read_subscriptions(self, socket: zmq.Socket[bytes]) -> bool:
        """Keep up with who wants what, and return whether that changed."""
        topics = self._subscribed[socket]
        before = topics.copy()
        for frames in _waiting(socket):
            kind, topic = frames[0][:1], frames[0][1:]
            if kind == b"\x01":
                topics.add(topic)
            elif kind == b"\x00":
                topics.discard(topic)
        return topics != before

    def _switch(self) -> None:
        target = self._shown = self._target
        self._leave()
        if target is None:
            return
        broadcast = self._broadcast = _Broadcast(target, self._hand_over, self._memory)
        self._listening = list(broadcast.command_topics())
        for topic in self._listening:
            self._control.subscribe(topic)
        broadcast.want(self._subscribed[self._state], self._subscribed[self._info])

    def _leave(self) -> None:
        """Be silent and deaf."""
        broadcast, self._broadcast = self._broadcast, None
        if broadcast is not None:
            broadcast.leave()
        for topic in self._listening:
            self._control.unsubscribe(topic)
        self._listening = []
        self._ticks.clear()
        if self._memory is not None:
            self._memory.end_state()

    def _publish(self) -> None:
        for _ in range(len(self._ticks)):
            broadcast, tick = self._ticks.popleft()
            if broadcast is not self._broadcast:
                continue
            for topic, payload in broadcast.state_messages(tick):
                if topic == STATE_FULL:
                    if self._memory is not None:
                        self._memory.publish_state(payload)
                    if not broadcast.full_wanted:
                        continue
                sent = payload if self.filter is None else self.filter(topic, payload)
                if sent is not None:
                    self._state.send(topic, zmq.SNDMORE | zmq.NOBLOCK)
                    self._state.send(sent, zmq.NOBLOCK)
            for frame in broadcast.info_messages(tick, self._cameras):
                sent = frame if self.filter is None else self.filter(frame, frame)
                if sent is not None:
                    self._info.send(sent, zmq.NOBLOCK)

    def _read_commands(self) -> None:
        for frames in _waiting(self._control):
            try:
                self._commands.extend(_commands(frames))
            except (ProtocolError, UnicodeDecodeError) as error:
                self._malformed += 1
                if self._malformed & (self._malformed - 1) == 0:  # a broken sender repeats itself
                    logger.warning("a control message is ignored (%d so far): %s", self._malformed, error)

    def _close(self) -> None:
        with self._waking:
            self._waker.close()
        self._authenticator.close()
        with uninterrupted():
            self._context.destroy(linger=0)


def _waiting(socket: zmq.Socket[bytes]) -> Iterator[list[bytes]]:
    for _ in range(BATCH):
        try:
            yield socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return
