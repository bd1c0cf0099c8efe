"""Rows derived from whole snapshots, for servers that publish no rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from urlab_client.aio.articulation import URLabArticulation
from urlab_client.aio.model.layout import FREE
from urlab_client.aio.streams.handler import Source, StreamHandler
from urlab_client.aio.streams.sources import RowFilter, StateSource, sample
from urlab_client.errors import ProtocolError
from urlab_client.protocol.messages.session import ArticulationState, EntityState
from urlab_client.protocol.messages.streams import RowSample, StateSnapshot
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, Row, SceneRow, SensorRow, TwistRow
from urlab_client.protocol.topics import StreamTopic, TopicKind
from urlab_client.values.layouts import BytesLike


class DerivedRowSource(Source[RowSample]):
    """Rows for the clients of a server that publishes only snapshots."""

    name = "row_stream"

    def __init__(
        self, states: StateSource, robots: Callable[[], Mapping[str, URLabArticulation]], wanted: RowFilter
    ) -> None:
        self._states = states
        self._robots = robots
        self._wanted = wanted

    def attach(self, handler: StreamHandler[Any]) -> None:
        self._states.attach(handler)

    def detach(self, handler: StreamHandler[Any]) -> None:
        self._states.detach(handler)

    def decode(self, topic: bytes, payload: BytesLike) -> RowSample:
        return sample(topic, payload)

    def first_after(self, handler: StreamHandler[Any]) -> float:
        return self._states.first_after(handler)

    def silence(self, handler: StreamHandler[Any], seconds: float) -> tuple[str, str]:
        return self._states.silence(handler, seconds)

    def parts(self, topic: bytes, payload: BytesLike) -> list[tuple[bytes, BytesLike]]:
        try:
            snapshot = StateSnapshot.decode(payload, topic.decode())
            return [(name.encode(), row.encode()) for name, row in self._rows(snapshot) if self._wanted.has(name)]
        except (ValueError, IndexError) as error:
            raise ProtocolError(f"{self.name}: the snapshot does not fit the known model: {error}.") from error

    def _rows(self, snapshot: StateSnapshot) -> Iterator[tuple[StreamTopic, Row]]:
        robots = self._robots()
        for key in self._wanted.articulations & snapshot.per_articulation.keys() & robots.keys():
            yield from _rows_of(key, robots[key], snapshot.per_articulation[key])
        for name, state in snapshot.entities.items():
            yield from _rows_of_entity(name, state)


def _rows_of(key: str, robot: URLabArticulation, state: ArticulationState) -> Iterator[tuple[StreamTopic, Row]]:
    for name, joint in robot.joints.items():
        at, moves = joint.qpos_local_offset, joint.qvel_local_offset
        if joint.jnt_type == FREE:
            base = BaseStateRow.from_free_joint(state.qpos[at : at + 7], state.qvel[moves : moves + 6])
            yield StreamTopic(TopicKind.BASE_STATE, key, name), base
        else:
            row = JointRow(joint.id, float(state.qpos[at]), float(state.qvel[moves]), math.nan)
            yield StreamTopic(TopicKind.JOINT, key, name), row
    for name, values in (state.sensors or {}).items():
        sensor = robot.sensors.get(name)
        reading = np.array(values, np.float32)
        yield StreamTopic(TopicKind.SENSOR, key, name), SensorRow(-1 if sensor is None else sensor.id, reading)
    if state.twist is not None:
        vx, vy, _ = state.twist.linear
        yield StreamTopic(TopicKind.TWIST, key), TwistRow(vx, vy, state.twist.angular[2])
    if state.actions:  # the plugin sends no row for 0, either
        yield StreamTopic(TopicKind.ACTIONS, key), ActionsRow(state.actions)


def _rows_of_entity(name: str, state: EntityState) -> Iterator[tuple[StreamTopic, Row]]:
    values = {
        TopicKind.XPOS: state.xpos,
        TopicKind.XQUAT: state.xquat,
        TopicKind.QPOS: state.qpos,
        TopicKind.QVEL: state.qvel,
    }
    for kind, vector in values.items():
        if vector is not None:
            yield StreamTopic(kind, name), SceneRow(kind, np.asarray(vector, np.float64))
