"""Where published states, rows and pictures come from: a socket and, optionally, a region of shared memory."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypeVar

from urlab_client.aio.arguments import collection
from urlab_client.aio.streams.camera_switch import CameraSwitch
from urlab_client.aio.streams.handler import Source
from urlab_client.aio.transport.shm_streams import Place, Regions, SharedPicture
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.enums import CameraMode, known
from urlab_client.errors import ProtocolError
from urlab_client.protocol.messages.session import CameraInfo, StateReply
from urlab_client.protocol.messages.streams import CameraSample, RowSample, StateSnapshot, StreamItem
from urlab_client.protocol.rows import decode_row
from urlab_client.protocol.shm import STATE_FILE, Ring, camera_file
from urlab_client.protocol.topics import (
    STATE_FULL,
    StreamTopic,
    TopicKind,
    articulation_filter,
    camera_filter,
    resolve_endpoint,
    scene_filter,
)
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import PictureMemory, decode_camera

T_co = TypeVar("T_co", bound=StreamItem, covariant=True)

FIRST_PICTURE_S = 30.0
"""Seconds that a server may take for its first picture, because it initialises OpenGL first."""

_ONLY_OWN = (
    "This server publishes state only in live mode: call client.runtime.set_mode('live'). In the other modes, "
    "snapshots come only from this client's own steps."
)


class PublishedSource(Source[T_co]):
    """A source of published messages; `regions` are preferred to sockets where the client uses shared memory.

    Attributes:
        unreachable: Hint if there is no connection.
        silent: Hint if there is a connection but no message arrives.
    """

    unreachable: str
    silent: str

    def __init__(self, subscriptions: Subscriptions, regions: Regions | None = None) -> None:
        self._subscriptions = subscriptions
        self._regions = regions

    @abstractmethod
    def subscription(self) -> Subscription:
        """Return the current subscription."""

    def place(self) -> Place:
        """Return the place of the region. Raises `ProtocolError` if there can be none."""
        raise ProtocolError(f"{self.name} is not available in shared memory.")

    def attach(self, handler: MessageHandler) -> None:
        if self._regions is None:
            self._subscriptions.attach(handler, self.subscription)
        else:
            self._regions.attach(handler, self.subscription, self.place)

    def detach(self, handler: MessageHandler) -> None:
        (self._regions or self._subscriptions).detach(handler)

    def region(self, handler: MessageHandler) -> Path | None:
        """Return the file of the region that feeds `handler`, or None if no region does."""
        return None if self._regions is None else self._regions.path(handler)

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        within = f"within {seconds * 1000:.0f} ms"
        region = self.region(handler)
        if region is not None:
            return f"nothing new in {region} {within}.", self.silent
        line = self._subscriptions.line(handler)
        if line is None:
            return f"nothing {within}.", ""
        if not line.connected:
            return f"no connection to {line.endpoint} {within}: {line.obstacle}.", self.unreachable
        filters = [repr(prefix.decode()) for prefix in self.subscription().filters]
        topics = ", ".join(filters[:3]) + (f" and {len(filters) - 3} more" if len(filters) > 3 else "")
        return f"connected to {line.endpoint}, but nothing arrived {within} on topics {topics}.", self.silent


class OwnSteps:
    """Delivers the states in replies to receivers of snapshots if the server publishes only in live mode.

    Attributes:
        handlers: The receivers.
    """

    def __init__(self) -> None:
        self.handlers: dict[MessageHandler, None] = {}

    def attach(self, handler: MessageHandler) -> None:
        self.handlers[handler] = None

    def detach(self, handler: MessageHandler) -> None:
        self.handlers.pop(handler, None)

    def publish(self, reply: StateReply) -> None:
        payload = StateSnapshot.of(reply).encode()
        for handler in tuple(self.handlers):
            handler.take(STATE_FULL, payload)
            handler.drain()


class StateSource(PublishedSource[StateSnapshot]):
    """The snapshots of the state region or the state socket, or of the client's own steps while there are no others."""

    name = "state_stream"
    unreachable = (
        "The port is open only while play runs: call client.sim.start(). Check that it is the server's state port."
    )
    silent = (
        "While play runs, the server publishes a snapshot at least every 100 ms in every mode, even while paused. "
        "Check that this is the server's state port."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        endpoint: Callable[[], str],
        own: OwnSteps | None = None,
        *,
        regions: Regions | None = None,
        only_own: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(subscriptions, regions)
        self._endpoint = endpoint
        self._own = OwnSteps() if own is None else own
        self._only_own = only_own
        # The socket may be one snapshot ahead of the region. Each contains its build time, so no two are equal.
        self._came = deque[BytesLike](maxlen=2)

    def attach(self, handler: MessageHandler) -> None:
        super().attach(handler)
        self._own.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        super().detach(handler)
        self._own.detach(handler)

    def subscription(self) -> Subscription:
        return Subscription(self._endpoint(), (STATE_FULL,), STATE_FULL.__eq__)

    def place(self) -> Place:
        return Place(STATE_FILE, STATE_FULL, Ring.STATE)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Skip snapshots that already arrived: both deliver them when the region takes over from the socket."""
        if self._regions is None:
            return True
        if payload in self._came:
            return False
        self._came.append(payload)
        return True

    def first_after(self, handler: MessageHandler) -> float:
        return math.inf if self._only_own() else 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        problem, advice = super().silence(handler, seconds)
        return problem, _ONLY_OWN if self._only_own() else advice

    def decode(self, topic: bytes, payload: BytesLike) -> StateSnapshot:
        return StateSnapshot.decode(payload, topic.decode())


class Camera:
    """A camera as the last handshake describes it, and the memory of its decoded pictures."""

    __slots__ = ("info", "memory", "name")

    def __init__(self, name: str, info: CameraInfo) -> None:
        self.name: str = name
        self.info: CameraInfo = info
        self.memory: PictureMemory = PictureMemory()

    @property
    def mode(self) -> CameraMode | str:
        """Meaning of its pixels; a plain string for a mode that this client does not know."""
        return known(CameraMode, self.info.mode)


class CameraSource(PublishedSource[CameraSample]):
    """The pictures of one camera. One from a region is converted on first access, directly into the user's array.

    The camera is switched on while something is attached, on servers where that is needed. `asked` says whether the
    user requested these pictures, or the client receives them in the background.
    """

    name = "frames"
    unreachable = (
        "The port is open while play runs and the camera streams. The plugin serves nine cameras; any further camera "
        "reports a port that it does not serve."
    )
    silent = (
        "Older servers publish pictures only in live mode and while the camera is switched on in the editor. Newer "
        "servers publish in every mode, but only while the simulation moves. capture() takes a picture at any time. "
        "A server that cannot render publishes no pictures. It initialises OpenGL before its first picture, which "
        "takes seconds; its log shows the result."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        camera: Camera,
        host: Callable[[], str],
        *,
        regions: Regions | None = None,
        live: Callable[[], bool] = lambda: True,
        switch: CameraSwitch | None = None,
        asked: bool = True,
    ) -> None:
        super().__init__(subscriptions, regions)
        self.camera = camera
        self._host = host
        self._live = live
        self._switch = switch
        self._asked = asked
        self._users: set[MessageHandler] = set()
        self._taken: SharedPicture | None = None

    def attach(self, handler: MessageHandler) -> None:
        super().attach(handler)
        if self._switch is not None and handler not in self._users:
            self._users.add(handler)
            self._switch.use(self.camera.info, asked=self._asked)

    def detach(self, handler: MessageHandler) -> None:
        super().detach(handler)
        if self._switch is not None and handler in self._users:
            self._users.discard(handler)
            self._switch.leave(self.camera.info)

    def first_after(self, handler: MessageHandler) -> float:
        """Return the seconds that a connected, publishing server may take until it can render; otherwise 0.

        Sockets deliver pictures only in live mode, regions in every mode.
        """
        if self.region(handler) is not None:
            return FIRST_PICTURE_S
        line = self._subscriptions.line(handler)
        return FIRST_PICTURE_S if line is not None and line.connected and self._live() else 0.0

    def subscription(self) -> Subscription:
        info = self.camera.info
        topic = camera_filter(info.zmq_topic)
        return Subscription(resolve_endpoint(info.zmq_endpoint, self._host()), (topic,), topic.__eq__, pictures=True)

    def place(self) -> Place:
        topic = self.camera.info.zmq_topic
        separator = "/camera/" if "/camera/" in topic else "/"
        articulation, _, camera = topic.strip().partition(separator)
        return Place(camera_file(articulation, camera), camera_filter(topic), Ring.CAMERA)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Skip a picture that was already read in place of its predecessor."""
        taken = self._taken
        return not (
            isinstance(payload, SharedPicture)
            and taken is not None
            and payload.reader is taken.reader
            and payload.sequence <= taken.sequence
        )

    def decode(self, topic: bytes, payload: BytesLike) -> CameraSample:
        if not isinstance(payload, SharedPicture):
            return self._sample(topic, payload)
        found = payload.read(lambda slot: self._sample(topic, slot))
        self._taken = SharedPicture(payload.reader, found.sequence, len(payload))
        return found.payload

    def _sample(self, topic: bytes, payload: BytesLike) -> CameraSample:
        camera = self.camera
        width, height = camera.info.resolution
        frame = decode_camera(
            payload, camera.mode, width, height, memory=camera.memory, where=topic.decode(errors="replace")
        )
        return CameraSample(
            camera=camera.name,
            mode=camera.mode,
            pixels=frame.pixels,
            frame_id=frame.frame_id,
            sim_time=frame.sim_time,
            capture_time=frame.capture_time,
        )


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
