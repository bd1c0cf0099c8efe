"""Rows derived from whole snapshots, for servers that publish no rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from urlab_client.aio.articulation import URLabArticulation
from urlab_client.aio.model.layout import FREE
from urlab_client.aio.streams.handler import Source
from urlab_client.aio.streams.sources import RowFilter, StateSource, sample
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.errors import ProtocolError, URLabError
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
        self._feeds: dict[MessageHandler, _RowFeed] = {}

    def attach(self, handler: MessageHandler) -> None:
        feed = _RowFeed(handler, self._rows)
        self._states.attach(feed)
        self._feeds[handler] = feed

    def detach(self, handler: MessageHandler) -> None:
        feed = self._feeds.pop(handler, None)
        if feed is not None:
            self._states.detach(feed)

    def decode(self, topic: bytes, payload: BytesLike) -> RowSample:
        return sample(topic, payload)

    def first_after(self, handler: MessageHandler) -> float:
        return self._states.first_after(self._feeds[handler])

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        return self._states.silence(self._feeds[handler], seconds)

    def _rows(self, snapshot: StateSnapshot) -> Iterator[tuple[bytes, Row]]:
        """Yield the wanted rows of a snapshot with their topics."""
        robots = self._robots()
        for key in self._wanted.articulations & snapshot.per_articulation.keys() & robots.keys():
            for topic, row in _rows_of(key, robots[key], snapshot.per_articulation[key]):
                if self._wanted.has(topic):
                    yield topic.encode(), row
        for name, state in snapshot.entities.items():
            for topic, row in _rows_of_entity(name, state):
                if self._wanted.has(topic):
                    yield topic.encode(), row


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


class _RowFeed(MessageHandler):
    """Passes the rows of each snapshot to a reader of rows."""

    def __init__(self, reader: MessageHandler, rows: Callable[[StateSnapshot], Iterator[tuple[bytes, Row]]]) -> None:
        self._reader = reader
        self._rows = rows

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        try:
            for name, row in self._rows(StateSnapshot.decode(payload, topic.decode())):
                self._reader.on_message(name, row.encode())
        except (ProtocolError, ValueError, IndexError) as error:  # the snapshot does not fit the known model
            self._reader.on_malformed(str(error))

    def on_malformed(self, problem: str) -> None:
        self._reader.on_malformed(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self._reader.on_end(error)

    def on_drained(self) -> None:
        self._reader.on_drained()

    def on_connection(self, connected: bool) -> None:
        self._reader.on_connection(connected)

    def on_gap(self, why: str) -> None:
        self._reader.on_gap(why)
