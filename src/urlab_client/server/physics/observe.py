"""What clients observe: reply blocks made from `mjData`, and the user channels that clients write and read.

For the op handlers and publishers. The caller holds the engine's lock; everything returned is a copy.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final, TypedDict, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.enums import ObservationLevel
from urlab_client.protocol.base import INT32_MAX
from urlab_client.protocol.messages.session import ArticulationState, BodyPose, Clock, EntityState, TwistState
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.compile.scene_index import EntityIndex
from urlab_client.server.physics.controllers import ArticulationControl

SCENE: Final = "scene"
"""Stands for the robot's name in channels of the scene."""


def channel_problem(name: str, value: object) -> str | None:
    """Return what is wrong with a declared channel, `ROBOT/CHANNEL` or `scene/CHANNEL`, or None."""
    owner, slash, channel = name.partition("/")
    if not (owner and slash and channel):
        return f"'{name}' does not say ROBOT/CHANNEL or scene/CHANNEL"
    if _kind(value) is None:
        return f"'{name}' cannot begin with {value!r}: it takes a bool, number, text, list of numbers, or pos and quat"
    return None


class UserChannels:
    """The channels of one play session. From any thread.

    Args:
        declared: First value by `ROBOT/CHANNEL` or `scene/CHANNEL`; its kind is the channel's.
    """

    def __init__(self, declared: Mapping[str, Any]) -> None:
        self._lock = threading.Lock()
        self._values: dict[tuple[str, str], Any] = {}
        for name, value in declared.items():
            owner, _, channel = name.partition("/")
            self._values[owner, channel] = value

    @property
    def declared(self) -> bool:
        return bool(self._values)

    def write(self, owner: str, channel: str, value: object) -> str | None:
        """Set a channel and return why not, in the wire's words, or None."""
        if value is None:
            return "unsupported_value"
        kind = _kind(value)
        if kind is None:
            return "unsupported_object" if isinstance(value, dict) else "unsupported_value"
        with self._lock:
            if _kind(self._values.get((owner, channel))) != kind:
                return "undeclared_or_kind_mismatch"
            self._values[owner, channel] = value
        return None

    def of(self, owner: str) -> dict[str, Any] | None:
        if not self._values:
            return None
        with self._lock:
            return {channel: value for (whose, channel), value in self._values.items() if whose == owner} or None


def _kind(value: object) -> str | None:
    match value:
        case bool():
            return "bool"
        case int() | float():
            return "number" if math.isfinite(value) else None
        case str():
            return "text"
        case list():
            items = cast("list[object]", value)
            numbers = all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in items)
            return "numbers" if numbers else None
        case dict():
            keys = cast("dict[str, object]", value).keys()
            return "pose" if keys == {"pos", "quat"} else None
        case _:
            return None


def sim_seconds(seconds: float) -> tuple[int, int]:
    """Split a time in seconds into whole ones and nanoseconds, truncating.

    Values beyond 32 bits are clamped, and those that are not finite are 0.
    """
    if -INT32_MAX <= seconds <= INT32_MAX:
        sec = int(seconds)
        return sec, int((seconds - sec) * 1e9)
    if not math.isfinite(seconds):
        return 0, 0
    return (INT32_MAX if seconds > 0 else -INT32_MAX), 0


def wall_seconds() -> tuple[int, int]:
    """Return UTC now as whole seconds and nanoseconds, a multiple of 100."""
    sec, nsec = divmod(time.time_ns(), 1_000_000_000)
    return sec, nsec - nsec % 100


def sim_clock(seconds: float) -> Clock:
    sec, nsec = sim_seconds(seconds)
    return Clock(sec=sec, nsec=nsec)


def wall_clock() -> Clock:
    sec, nsec = wall_seconds()
    return Clock(sec=sec, nsec=nsec)


class StateFields(TypedDict):
    """The fields that all replies and messages with a state share."""

    time: float
    step: int
    sim_time: Clock
    wall_time: Clock
    per_articulation: dict[str, ArticulationState]


class _StateReader:
    """Where one articulation's values lie, prepared so that reading costs one gather per field."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, control: ArticulationControl) -> None:
        index = control.index
        self._twist = control.twist
        self._qpos = data.qpos
        self._qvel = data.qvel
        self._ctrl = data.ctrl
        self._act = data.act
        self._force = data.actuator_force
        self._sensordata = data.sensordata
        self._xpos = data.xpos
        self._xquat = data.xquat
        self._qpos_adr = index.qpos_adr.astype(np.intp)
        self._qvel_adr = index.qvel_adr.astype(np.intp)
        self._ctrl_adr = index.ctrl_adr.astype(np.intp)
        self._force_adr = index.force_adr.astype(np.intp)
        stateful = index.act_adr >= 0
        self._act_places = np.flatnonzero(stateful)
        self._act_adr = index.act_adr[stateful].astype(np.intp)
        self._bodies = index.bodies.astype(np.intp)
        self._body_names = index.body_names
        self._sensor_adr, self._sensors = _sensors(model, index.sensors, index.sensor_names)

    def read(self, level: ObservationLevel) -> ArticulationState:
        twist = self._twist
        state = ArticulationState(
            qpos=self._qpos.take(self._qpos_adr),
            qvel=self._qvel.take(self._qvel_adr),
            twist=TwistState(linear=twist.linear, angular=twist.angular),
            actions=twist.actions,
        )
        if level is ObservationLevel.MINIMAL:
            return state
        state.ctrl = self._ctrl.take(self._ctrl_adr)
        state.act = np.zeros(len(self._ctrl_adr))
        if len(self._act_adr):
            state.act[self._act_places] = self._act.take(self._act_adr)
        values: list[float] = self._sensordata.take(self._sensor_adr).tolist()
        state.sensors = {name: values[start:stop] for name, start, stop in self._sensors}
        if level is ObservationLevel.STANDARD:
            return state
        xpos: list[list[float]] = self._xpos.take(self._bodies, axis=0).tolist()
        xquat: list[list[float]] = self._xquat.take(self._bodies, axis=0).tolist()
        state.bodies = {
            name: BodyPose(xpos=(x, y, z), xquat=(qw, qx, qy, qz))
            for name, (x, y, z), (qw, qx, qy, qz) in zip(self._body_names, xpos, xquat, strict=True)
        }
        state.actuator_force = self._force.take(self._force_adr)
        return state


def _sensors(
    model: mujoco.MjModel, sensors: NDArray[np.int32], names: Sequence[str]
) -> tuple[NDArray[np.intp], tuple[tuple[str, int, int], ...]]:
    """Return where the sensors' values lie, and each sensor's span among the gathered values."""
    adr: list[int] = []
    spans: list[tuple[str, int, int]] = []
    for sensor, name in zip(sensors, names, strict=True):
        first, dim = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
        spans.append((name, len(adr), len(adr) + dim))
        adr.extend(range(first, first + dim))
    return np.array(adr, dtype=np.intp), tuple(spans)


class Observer:
    """Reads reply blocks from a scene's data."""

    def __init__(
        self,
        scene: CompiledScene,
        controls: Mapping[str, ArticulationControl],
        channels: UserChannels | None = None,
    ) -> None:
        """Prepare for a scene.

        Args:
            controls: `Articulations.controls` of the engine that steps it; holds the twists.
            channels: The user channels; None for none.
        """
        self._channels = channels
        data = scene.data
        self._readers = {key: _StateReader(scene.model, data, control) for key, control in controls.items()}
        self._entities = scene.entities
        self._xpos = data.xpos
        self._xquat = data.xquat
        self._qpos = data.qpos
        self._qvel = data.qvel

    def state(self, level: ObservationLevel, time: float, step: int) -> StateFields:
        return StateFields(
            time=time,
            step=step,
            sim_time=sim_clock(time),
            wall_time=wall_clock(),
            per_articulation=self.articulations(level),
        )

    def articulations(self, level: ObservationLevel) -> dict[str, ArticulationState]:
        """Return the state of every articulation by key, with the fields of `level`."""
        states = {key: reader.read(level) for key, reader in self._readers.items()}
        if self._channels is not None and self._channels.declared and level is not ObservationLevel.MINIMAL:
            for key, state in states.items():
                state.user = self._channels.of(key)
        return states

    def scene_channels(self) -> dict[str, Any]:
        return {} if self._channels is None else self._channels.of(SCENE) or {}

    def entities(self) -> dict[str, EntityState]:
        """Return the state of every entity by name; `qpos` (7,) and `qvel` (6,) for those with a free joint."""
        return {entity.name: self._entity(entity) for entity in self._entities}

    def _entity(self, entity: EntityIndex) -> EntityState:
        x, y, z = self._xpos[entity.body].tolist()
        qw, qx, qy, qz = self._xquat[entity.body].tolist()
        state = EntityState(xpos=(x, y, z), xquat=(qw, qx, qy, qz))
        if entity.free_joint is not None:
            state.qpos = self._qpos[entity.qpos_adr : entity.qpos_adr + 7].copy()
            state.qvel = self._qvel[entity.qvel_adr : entity.qvel_adr + 6].copy()
        return state
