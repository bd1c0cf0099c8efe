"""Rows derived from whole snapshots, for servers that publish no rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Protocol

import numpy as np

from urlab_client.aio.streams.row_source import RowSource
from urlab_client.aio.streams.state_source import StateSource
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.messages.session import ArticulationState, EntityState
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, Row, SceneRow, SensorRow, TwistRow
from urlab_client.protocol.topics import StreamTopic, TopicKind
from urlab_client.values.layouts import BytesLike

_FREE = 0  # mjJNT_FREE


class _HasJoint(Protocol):
    id: int
    jnt_type: int
    qpos_local_offset: int
    qvel_local_offset: int


class _HasSensor(Protocol):
    id: int


class HasRows(Protocol):
    """An articulation as the client knows it, with the elements of its state."""

    @property
    def joints(self) -> Mapping[str, _HasJoint]:
        """Joints by name."""
        ...

    @property
    def sensors(self) -> Mapping[str, _HasSensor]:
        """Sensors by name."""
        ...


class DerivedRowSource(RowSource):
    """Rows for the clients of a server that publishes only snapshots.

    Args:
        states: Source of the snapshots.
        articulations: Callback that returns the articulations by key.
        wanted: Keys of the articulations whose rows are wanted.
        kinds: See the base class.
        components: See the base class.
        entities: See the base class.
    """

    def __init__(
        self,
        states: StateSource,
        articulations: Callable[[], Mapping[str, HasRows]],
        wanted: Collection[str],
        kinds: Collection[str | TopicKind] = (),
        components: Collection[str] = (),
        *,
        entities: bool = False,
    ) -> None:
        super().__init__(states.subscriptions, states.endpoint, wanted, kinds, components, entities=entities)
        self._states = states
        self._robots = articulations
        self._feeds: dict[MessageHandler, _RowFeed] = {}

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from the event loop."""
        feed = _RowFeed(handler, self._topics)
        self._states.attach(feed)
        self._feeds[handler] = feed

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Idempotent."""
        feed = self._feeds.pop(handler, None)
        if feed is not None:
            self._states.detach(feed)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return True: only elements of the model have rows."""
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return what the source of the snapshots returns."""
        return self._states.first_after(self._feeds[handler])

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return what the source of the snapshots returns."""
        return self._states.silence(self._feeds[handler], seconds)

    def _topics(self, snapshot: StateSnapshot) -> Iterator[tuple[bytes, Row]]:
        """Return the wanted rows of a snapshot."""
        robots = self._robots()
        for key in self.articulations & snapshot.per_articulation.keys() & robots.keys():
            for topic, row in _rows_of(key, robots[key], snapshot.per_articulation[key]):
                if self.has(topic):
                    yield topic.encode(), row
        for name, state in snapshot.entities.items():
            for topic, row in _rows_of_entity(name, state):
                if self.has(topic):
                    yield topic.encode(), row


def _rows_of(key: str, robot: HasRows, state: ArticulationState) -> Iterator[tuple[StreamTopic, Row]]:
    for name, joint in robot.joints.items():
        at, moves = joint.qpos_local_offset, joint.qvel_local_offset
        if joint.jnt_type == _FREE:
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
        """Process one snapshot."""
        try:
            for name, row in self._rows(StateSnapshot.decode(payload, topic.decode())):
                self._reader.on_message(name, row.encode())
        except (ProtocolError, ValueError, IndexError) as error:  # the snapshot does not fit the known model
            self._reader.on_malformed(str(error))

    def on_malformed(self, problem: str) -> None:
        """See the base class."""
        self._reader.on_malformed(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """See the base class."""
        self._reader.on_end(error)

    def on_drained(self) -> None:
        """See the base class."""
        self._reader.on_drained()

    def on_connection(self, connected: bool) -> None:
        """See the base class."""
        self._reader.on_connection(connected)

    def on_gap(self, why: str) -> None:
        """See the base class."""
        self._reader.on_gap(why)
