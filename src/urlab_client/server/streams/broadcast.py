"""The messages of a play session and its rows: ticks are copied on the physics thread and encoded on another."""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Final, NamedTuple, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.enums import ObservationLevel, StepMode
from urlab_client.errors import UNCLAIMED
from urlab_client.protocol.codec import encode_reply
from urlab_client.protocol.messages.session import Clock
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, SceneRow, SensorRow, TwistRow
from urlab_client.protocol.topics import STATE_FULL, StreamTopic, TopicKind
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.controllers import ArticulationControl, Twist
from urlab_client.server.physics.observe import Observer, wall_clock
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.streams.commands import Actuators, CameraEndpoint, Gains, StreamedCommand, StreamedSetPoints
from urlab_client.server.transport.shared_memory import SharedMemoryServer

logger: logging.Logger = logging.getLogger("urlab_client.server")

Floats: TypeAlias = NDArray[np.float64]
Encoder: TypeAlias = Callable[[], bytes | None]
"""Encodes the current data; None for no message."""

PublishedRow: TypeAlias = tuple[bytes, Encoder]
"""A row of the state stream, with its topic."""

_ROW_KINDS: Final = {
    int(mujoco.mjtJoint.mjJNT_FREE): TopicKind.BASE_STATE,
    int(mujoco.mjtJoint.mjJNT_BALL): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_HINGE): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_SLIDE): TopicKind.JOINT,
}


def topic_frame(kind: TopicKind, owner: str, name: str = "") -> bytes | None:
    try:
        return StreamTopic(kind, owner, name).encode()
    except ValueError as error:
        logger.warning("%s of '%s' is not streamed: %s", kind, owner, error)
        return None


def published_rows(
    scene: CompiledScene, data: mujoco.MjData, controls: Iterable[ArticulationControl]
) -> Iterator[PublishedRow]:
    """Yield every row in the order of a tick: articulation by articulation, then the scene."""
    none = True
    for control in controls:
        none = False
        for kind, name, encode in _articulation_rows(scene.model, data, control):
            topic = topic_frame(kind, control.index.key, name)
            if topic is not None:
                yield topic, encode
    if none:  # as in the plugin, the scene comes with the articulations
        return
    for entity in scene.entities:
        values = {TopicKind.XPOS: data.xpos[entity.body], TopicKind.XQUAT: data.xquat[entity.body]}
        if entity.free_joint is not None:
            values[TopicKind.QPOS] = data.qpos[entity.qpos_adr : entity.qpos_adr + 7]
            values[TopicKind.QVEL] = data.qvel[entity.qvel_adr : entity.qvel_adr + 6]
        for kind, view in values.items():
            topic = topic_frame(kind, entity.name)
            if topic is not None:
                yield topic, SceneRow(kind, view).encode


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


LOCK_S: Final = 0.02
"""Longest single wait for the physics lock; the operation is then retried."""

INFO_EVERY: Final = 50
INFO_START_TICKS: Final = 2500
INFO_LATER_EVERY: Final = 500
"""The info messages go out every 50 live ticks up to tick 2500, then every 500."""

_LIVE: Final = frozenset({StepMode.LIVE, StepMode.AUTO})


class Tick(NamedTuple):
    """One tick, copied by the physics thread.

    Attributes:
        live: Number of the tick among the live ones, from 1; 0 outside live mode.
        arrays: Copies of the arrays in `Broadcast.sources`; empty without subscribers.
        twists: Commanded twist and action keys of each articulation; empty without subscribers.
        full: Whether the snapshot is subscribed to.
    """

    live: int
    time: float
    step: int
    wall_time: Clock
    arrays: list[Floats]
    twists: list[tuple[float, float, float, int]]
    full: bool


class Broadcast:
    """Turns the ticks of one play session into messages."""

    def __init__(
        self,
        running: Running,
        hand_over: Callable[[Broadcast, Tick], None],
        memory: SharedMemoryServer | None,
    ) -> None:
        """Prepare the messages of a scene; `want` selects which are encoded.

        Args:
            hand_over: Passes a tick to the sending thread; called under the engine's lock.
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
        self._rows = (
            list(published_rows(scene, self._mirror, mirrored.values())) if self._dialect.rows_published else []
        )
        self._actuators = Actuators(scene.model, self._controls)
        self._wanted_rows: list[PublishedRow] = []
        self.full_wanted: bool = False
        self._info_wanted = False
        self._live_ticks = 0
        self._info_due = next_info(0)

    # On the sending thread.

    def want(self, state: Iterable[bytes], info: Iterable[bytes]) -> None:
        """Apply the subscriptions of the two sockets; listen to physics only if there are any."""
        prefixes = tuple(state)
        self._wanted_rows = [row for row in self._rows if row[0].startswith(prefixes)] if prefixes else []
        self.full_wanted = STATE_FULL.startswith(prefixes) if prefixes else False
        self._info_wanted = any(True for _ in info)
        hooks = self._engine.on_tick
        if not (self._wanted_rows or self.full_wanted or self._info_wanted or self._memory is not None):
            self.leave()
        elif self._capture not in hooks:
            hooks.append(self._capture)
            self._engine.step_wanted = self._wants_step

    def leave(self) -> None:
        """Stop listening to physics. Safe to call twice."""
        if self._capture in self._engine.on_tick:
            self._engine.on_tick.remove(self._capture)

    def state_messages(self, tick: Tick) -> Iterator[PublishedRow]:
        """Yield topic and encoder of a tick's messages on the state socket, the snapshot last.

        The next one may be taken although an encoder has failed.
        """
        if not tick.arrays:
            return
        for target, values in zip(self._targets, tick.arrays, strict=True):
            target[:] = values
        for twist, values in zip(self._twists, tick.twists, strict=True):
            twist.vx, twist.vy, twist.yaw_rate, twist.actions = values
        if tick.live:
            yield from self._wanted_rows
        if tick.full:
            yield STATE_FULL, partial(self._state_full, tick)

    def _state_full(self, tick: Tick) -> bytes:
        snapshot = StateSnapshot(
            **self._observer.state(ObservationLevel.STANDARD, tick.time, tick.step),
            entities=self._observer.entities(),
            user=self._observer.scene_channels(),
        )
        snapshot.wall_time = tick.wall_time
        return encode_reply(self._dialect.shaped(snapshot))

    def info_messages(
        self, tick: Tick, cameras: Callable[[CompiledScene], Iterable[CameraEndpoint]]
    ) -> Iterator[Callable[[], bytes]]:
        """Yield the encoders of the frames due on the info socket."""
        if not (self._info_wanted and tick.live >= self._info_due):
            return
        self._info_due = next_info(tick.live)
        endpoints = tuple(cameras(self.running.scene))
        for control in self._controls:
            yield partial(self._actuators.info, control, endpoints)

    def command_topics(self) -> Iterator[bytes]:
        for control in self._controls:
            for kind in (TopicKind.CONTROL, TopicKind.SET_GAINS):
                topic = topic_frame(kind, control.index.key)
                if topic is not None:
                    yield topic

    def obey(self, commands: deque[StreamedCommand]) -> None:
        """Apply and remove commands; outside live mode they have no effect. They stay queued while physics is busy."""
        engine = self._engine
        if engine.mode not in _LIVE:  # physics may then legitimately hold the lock for hours
            commands.clear()
            return
        if not engine.lock.inner.acquire(timeout=LOCK_S):
            return
        try:
            while commands:
                command = commands.popleft()
                if engine.mode not in _LIVE:
                    continue
                if isinstance(command, StreamedSetPoints):
                    self._actuators.stage(command, self._owned)
                else:
                    self._set_gains(*command)
        finally:
            engine.lock.inner.release()

    def _owned(self, control: ArticulationControl) -> bool:
        return self._dialect.claims and self.running.claims.owner(control.index.key) != UNCLAIMED

    def _set_gains(self, key: str, gains: Gains) -> None:
        try:
            with self._engine.commanding() as articulations:
                articulations.configure_controller(key, gains)
        except Refusal as refusal:
            logger.debug("gains streamed to '%s' have no effect: %s", key, refusal.message)

    # On the physics thread, under the engine's lock.

    def _wants_full(self) -> bool:
        return self.full_wanted or (self._memory is not None and self._memory.wants_state())

    def _wants_step(self) -> bool:
        return self._dialect.steps_published and self._wants_full()

    def _capture(self) -> None:
        engine = self._engine
        live = engine.mode in _LIVE
        self._live_ticks += live
        full = self._wants_full() if live else self._wants_step()
        shown = full or (live and bool(self._wanted_rows))
        if not shown and not (live and self._info_wanted and self._live_ticks >= self._info_due):
            return
        self._hand_over(
            self,
            Tick(
                live=self._live_ticks if live else 0,
                time=engine.time,
                step=engine.step_count,
                wall_time=wall_clock(),
                arrays=[array.copy() for array in self._sources] if shown else [],
                twists=[dataclasses.astuple(control.twist) for control in self._controls] if shown else [],
                full=full,
            ),
        )


def _with_own_twist(control: ArticulationControl) -> ArticulationControl:
    mirrored = copy.copy(control)
    mirrored.twist = Twist()
    return mirrored


def _arrays(scene: CompiledScene, data: mujoco.MjData) -> list[Floats]:
    """Return views of all arrays in the messages, never an empty list."""
    arrays = [data.qpos, data.qvel, data.qacc, data.ctrl, data.act, data.sensordata]
    return [*arrays, data.xpos, data.xquat] if scene.entities else arrays


def next_info(tick: int) -> int:
    every = INFO_EVERY if tick < INFO_START_TICKS else INFO_LATER_EVERY
    return (tick // every + 1) * every
