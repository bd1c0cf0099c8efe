"""The binary rows of the state socket."""

from __future__ import annotations

from collections.abc import Callable, Collection

from urlab_client.aio.arguments import collection
from urlab_client.aio.streams.sources import PublishedSource, StateSource
from urlab_client.aio.transport.subscriber import Subscription, Subscriptions
from urlab_client.errors import ProtocolError
from urlab_client.protocol.messages.streams import RowSample
from urlab_client.protocol.rows import decode_row
from urlab_client.protocol.topics import StreamTopic, TopicKind, articulation_filter, scene_filter
from urlab_client.values.layouts import BytesLike

_OF_COMPONENT = frozenset({TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR})
_OF_ARTICULATION = _OF_COMPONENT | {TopicKind.TWIST, TopicKind.ACTIONS}
_OF_SCENE = frozenset({TopicKind.XPOS, TopicKind.XQUAT, TopicKind.QPOS, TopicKind.QVEL})
_WITH_ID = frozenset({TopicKind.JOINT, TopicKind.SENSOR})


class RowFilter:
    """The rows that a reader wants. Empty `kinds` and `components` mean all; `entities` adds the rows of the scene.

    Attributes:
        articulations: Keys of the articulations whose rows are wanted.
        topics: ZMQ's prefix filters.

    Raises:
        ValueError: A kind has no rows, a name is not valid in a topic, or there is nothing to receive.
    """

    def __init__(
        self,
        articulations: Collection[str],
        kinds: Collection[str | TopicKind] = (),
        components: Collection[str] = (),
        *,
        entities: bool = False,
    ) -> None:
        self.articulations: frozenset[str] = frozenset(articulations)
        self._components = frozenset(collection("components", components))
        self._kinds = frozenset(TopicKind(kind) for kind in collection("kinds", kinds))
        if not self._kinds:
            self._kinds = _OF_COMPONENT if components else _OF_ARTICULATION
            self._kinds |= _OF_SCENE if entities and not components else frozenset()
        no_rows = self._kinds - _OF_ARTICULATION - _OF_SCENE
        if no_rows:
            raise ValueError(f"there are no rows of kind {', '.join(sorted(no_rows))}")
        self.topics: tuple[bytes, ...] = tuple(sorted(self._narrow()))
        if not self.topics:
            raise ValueError("row_stream: no articulation to receive rows from. Check that discover() found one.")

    def _narrow(self) -> set[bytes]:
        filters = {scene_filter()} if self._kinds & _OF_SCENE else set[bytes]()
        for key in self.articulations:
            if not self._components and self._kinds >= _OF_ARTICULATION:
                filters.add(articulation_filter(key))
                continue
            for kind in self._kinds & _OF_ARTICULATION:
                if self._components and kind in _OF_COMPONENT:
                    filters |= {StreamTopic(kind, key, component).encode() for component in self._components}
                else:
                    filters.add(articulation_filter(key, kind))
        return filters

    def has(self, found: StreamTopic) -> bool:
        if found.kind not in self._kinds:
            return False
        if found.kind in _OF_SCENE:
            return True
        named = found.kind not in _OF_COMPONENT or not self._components or found.name in self._components
        return named and found.owner in self.articulations


class RowSource(PublishedSource[RowSample]):
    """The binary rows of the state socket."""

    name = "row_stream"
    unreachable: str = StateSource.unreachable
    silent = (
        "Rows are published only in live mode: call client.runtime.set_mode('live'). While paused they repeat. "
        "Component names are the engine's, which may differ from the compiled names."
    )

    def __init__(self, subscriptions: Subscriptions, endpoint: Callable[[], str], wanted: RowFilter) -> None:
        super().__init__(subscriptions)
        self._endpoint = endpoint
        self._wanted = wanted

    def subscription(self) -> Subscription:
        return Subscription(self._endpoint(), self._wanted.topics, self._accepts)

    def _accepts(self, topic: bytes) -> bool:
        try:
            found = StreamTopic.parse(topic)
        except ProtocolError:
            return False  # a kind of topic from a newer server
        return self._wanted.has(found)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Skip components that are not in the compiled model: their rows carry a negative id and zeros."""
        return not (len(payload) >= 4 and payload[3] & 0x80 and StreamTopic.parse(topic).kind in _WITH_ID)

    def decode(self, topic: bytes, payload: BytesLike) -> RowSample:
        return sample(topic, payload)


def sample(topic: bytes, payload: BytesLike) -> RowSample:
    """Decode a row. Raises `ProtocolError`."""
    found = StreamTopic.parse(topic)
    return RowSample(kind=found.kind, owner=found.owner, component=found.name, row=decode_row(found, payload))
