"""What feeds the streams: the state socket, the cameras' sockets, and what happens to the client itself."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection
from typing import Protocol

import msgspec

from urlab_client.aio.live.camera_switch import CameraSwitch
from urlab_client.aio.streams import Stream
from urlab_client.aio.transport.regions import Place, Regions, SharedPicture
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions, client_closed
from urlab_client.protocol import doorbell
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.messages.session import CameraInfo, StateReply
from urlab_client.protocol.messages.streams import (
    CameraSample,
    ClientEvent,
    PlayEnded,
    PlayStarted,
    RowSample,
    ServerAnswers,
    ServerConnected,
    ServerLost,
    ServerReconnected,
    ServerSilent,
    SessionLost,
    SessionOpened,
    StateSnapshot,
    StreamPolicy,
)
from urlab_client.protocol.rows import (
    STATE_FULL,
    BytesLike,
    StreamTopic,
    TopicKind,
    articulation_filter,
    camera_filter,
    decode_camera,
    decode_row,
    resolve_endpoint,
    scene_filter,
)
from urlab_client.protocol.shm import STATE_FILE, camera_file

__all__ = [
    "CameraSource",
    "EventBus",
    "HasCamera",
    "OwnSteps",
    "RowSource",
    "SharedCameraSource",
    "SharedStateSource",
    "StateSource",
]

FIRST_PICTURE_S = 30.0
"""How long a server may take for its first picture: it looks for OpenGL before."""

_OF_COMPONENT = frozenset({TopicKind.JOINT, TopicKind.BASE_STATE, TopicKind.SENSOR})
_OF_ARTICULATION = _OF_COMPONENT | {TopicKind.TWIST, TopicKind.ACTIONS}
_OF_SCENE = frozenset({TopicKind.XPOS, TopicKind.XQUAT, TopicKind.QPOS, TopicKind.QVEL})
_WITH_ID = frozenset({TopicKind.JOINT, TopicKind.SENSOR})

_EVENTS = msgspec.msgpack.Decoder(
    ServerConnected
    | ServerLost
    | ServerReconnected
    | ServerSilent
    | ServerAnswers
    | SessionOpened
    | SessionLost
    | PlayStarted
    | PlayEnded
)


class SocketSource(ABC):
    """What a subscription brings.

    Attributes:
        name: The call that made the stream, for messages.
        unreachable: What to look at when there is no connection.
        silent: What to look at when there is one and nothing comes.
    """

    name: str
    unreachable: str
    silent: str

    def __init__(self, subscriptions: Subscriptions) -> None:
        self._subscriptions = subscriptions

    @abstractmethod
    def subscription(self) -> Subscription:
        """Say what to receive, from where, as things stand."""

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        self._subscriptions.attach(handler, self.subscription)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        self._subscriptions.detach(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether a message is anything to the reader at all."""
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0: what is published comes at once."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why nothing came for so long, and what to do about it."""
        within = f"within {seconds * 1000:.0f} ms"
        line = self._subscriptions.line(handler)
        if line is None:
            return f"nothing {within}.", ""
        if not line.connected:
            return f"no connection to {line.endpoint} {within}: {line.obstacle}.", self.unreachable
        filters = [repr(prefix.decode()) for prefix in self.subscription().filters]
        topics = ", ".join(filters[:3]) + (f" and {len(filters) - 3} more" if len(filters) > 3 else "")
        return f"connected to {line.endpoint}, but nothing came {within} on topics {topics}.", self.silent


class OwnSteps:
    """Hands the states in replies to those who receive snapshots, where the server publishes in live mode only."""

    def __init__(self) -> None:
        self._handlers: dict[MessageHandler, None] = {}

    def __bool__(self) -> bool:
        return bool(self._handlers)

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        self._handlers[handler] = None

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        self._handlers.pop(handler, None)

    def publish(self, reply: StateReply) -> None:
        """Hand a state over."""
        payload = StateSnapshot.of(reply).encode()
        for handler in tuple(self._handlers):
            handler.on_message(STATE_FULL, payload)
            handler.on_drained()


class StateSource(SocketSource):
    """The snapshots of the state socket.

    Args:
        subscriptions: The client's.
        endpoint: Tells where the state socket is.
        own: What brings the states of the client's own steps, where the server publishes none of them.
    """

    name = "state_stream"
    unreachable = "The port is open only while play runs: client.sim.start(). Is it the server's state port?"
    silent = (
        "While play runs a snapshot comes at least every 100 ms, in every mode and paused, too: is this the server's "
        "state port?"
    )

    def __init__(self, subscriptions: Subscriptions, endpoint: Callable[[], str], own: OwnSteps | None = None) -> None:
        super().__init__(subscriptions)
        self._endpoint = endpoint
        self._own = OwnSteps() if own is None else own

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        super().attach(handler)
        self._own.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        super().detach(handler)
        self._own.detach(handler)

    def subscription(self) -> Subscription:
        """See the base class."""
        return Subscription(self._endpoint(), (STATE_FULL,), STATE_FULL.__eq__)

    def decode(self, topic: bytes, payload: BytesLike) -> StateSnapshot:
        """Read a snapshot. Raises `ProtocolError`."""
        return StateSnapshot.decode(payload, topic.decode())


class RowSource(SocketSource):
    """The binary rows of the state socket.

    Args:
        subscriptions: The client's.
        endpoint: Tells where the state socket is.
        articulations: Keys of the articulations whose rows are wanted.
        kinds: Kinds of rows; empty for all that the other arguments allow.
        components: Component names of joints, free joints and sensors; empty for all.
        entities: Whether `kinds` left empty includes the scene rows.

    Raises:
        ValueError: A kind is not one of rows, a name cannot stand in a topic, or nothing is left to receive.
    """

    name = "row_stream"
    unreachable = StateSource.unreachable
    silent = (
        "Rows come in live mode only: client.runtime.set_mode('live'); paused they repeat. Component names are the "
        "engine's, not always the compiled ones."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        endpoint: Callable[[], str],
        articulations: Collection[str],
        kinds: Collection[str | TopicKind] = (),
        components: Collection[str] = (),
        *,
        entities: bool = False,
    ) -> None:
        super().__init__(subscriptions)
        self._endpoint = endpoint
        self._articulations = frozenset(articulations)
        self._components = frozenset(components)
        self._kinds = frozenset(TopicKind(kind) for kind in kinds)
        if not self._kinds:
            self._kinds = _OF_COMPONENT if components else _OF_ARTICULATION
            self._kinds |= _OF_SCENE if entities and not components else frozenset()
        no_rows = self._kinds - _OF_ARTICULATION - _OF_SCENE
        if no_rows:
            raise ValueError(f"there are no rows of kind {', '.join(sorted(no_rows))}")
        self._filters = tuple(sorted(self._narrow()))
        if not self._filters:
            raise ValueError("row_stream: there is no articulation to receive rows of; has discover() found any?")

    def _narrow(self) -> set[bytes]:
        filters = {scene_filter()} if self._kinds & _OF_SCENE else set[bytes]()
        for key in self._articulations:
            if not self._components and self._kinds >= _OF_ARTICULATION:
                filters.add(articulation_filter(key))
                continue
            for kind in self._kinds & _OF_ARTICULATION:
                if self._components and kind in _OF_COMPONENT:
                    filters |= {StreamTopic(kind, key, component).encode() for component in self._components}
                else:
                    filters.add(articulation_filter(key, kind))
        return filters

    def subscription(self) -> Subscription:
        """See the base class."""
        return Subscription(self._endpoint(), self._filters, self._accepts)

    def _accepts(self, topic: bytes) -> bool:
        try:
            found = StreamTopic.parse(topic)
        except ProtocolError:
            return False  # a kind of topic that a newer server has
        if found.kind not in self._kinds:
            return False
        if found.kind in _OF_SCENE:
            return True
        named = found.kind not in _OF_COMPONENT or not self._components or found.name in self._components
        return named and found.owner in self._articulations

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Leave out components that are not in the compiled model: their rows carry a negative id and zeros."""
        return not (len(payload) >= 4 and payload[3] & 0x80 and StreamTopic.parse(topic).kind in _WITH_ID)

    def decode(self, topic: bytes, payload: BytesLike) -> RowSample:
        """Read a row. Raises `ProtocolError`."""
        found = StreamTopic.parse(topic)
        row = decode_row(found, payload)
        return RowSample(kind=found.kind, owner=found.owner, component=found.name, row=row)


class HasCamera(Protocol):
    """A camera as the client knows it; what it says may change with each handshake."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def info(self) -> CameraInfo:
        """The handshake's description."""
        ...

    @property
    def mode(self) -> CameraMode | str:
        """What its pixels mean."""
        ...


class CameraSource(SocketSource):
    """The pictures of one camera.

    Args:
        subscriptions: The client's.
        view: The camera.
        host: Tells under which name or address the server was reached.
        live: Tells whether the server is in live mode, as far as is known.
        switch: Switches the camera on and off; None where it always streams.
        asked: Whether the user asked for these pictures, rather than having them received in the background.
    """

    name = "frames"
    unreachable = (
        "The port is open while play runs and the camera streams. A camera that found no free port reports one that "
        "it does not serve: the plugin serves nine."
    )
    silent = (
        "Pictures are published in live mode only, and while the camera is switched on in the editor; in the other "
        "modes ask for them with client.step(include_cameras=…). A server that cannot draw publishes none; before its "
        "first picture it looks for OpenGL, which takes seconds, and its log says what it found."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        view: HasCamera,
        host: Callable[[], str],
        *,
        live: Callable[[], bool] = lambda: True,
        switch: CameraSwitch | None = None,
        asked: bool = True,
    ) -> None:
        super().__init__(subscriptions)
        self.view = view
        self._host = host
        self._live = live
        self._switch = switch
        self._asked = asked
        self._users: set[MessageHandler] = set()

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop, and switch the camera on."""
        super().attach(handler)
        self._use(handler)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        super().detach(handler)
        self._leave(handler)

    def _use(self, handler: MessageHandler) -> None:
        if self._switch is not None and handler not in self._users:
            self._users.add(handler)
            self._switch.use(self.view.info, asked=self._asked)

    def _leave(self, handler: MessageHandler) -> None:
        if self._switch is not None and handler in self._users:
            self._users.discard(handler)
            self._switch.leave(self.view.info)

    def first_after(self, handler: MessageHandler) -> float:
        """Return how long a server may take until it can draw, where it is there and in live mode; else 0."""
        line = self._subscriptions.line(handler)
        return FIRST_PICTURE_S if line is not None and line.connected and self._live() else 0.0

    def subscription(self) -> Subscription:
        """See the base class."""
        info = self.view.info
        topic = camera_filter(info.zmq_topic)
        return Subscription(resolve_endpoint(info.zmq_endpoint, self._host()), (topic,), topic.__eq__, pictures=True)

    def decode(self, topic: bytes, payload: BytesLike) -> CameraSample:
        """Read a picture. Raises `ProtocolError`."""
        view = self.view
        width, height = view.info.resolution
        frame = decode_camera(payload, view.mode, width, height, where=topic.decode(errors="replace"))
        return CameraSample(
            camera=view.name,
            mode=view.mode,
            pixels=frame.pixels,
            frame_id=frame.frame_id,
            sim_time=frame.sim_time,
            capture_time=frame.capture_time,
        )


class _SharedMemorySource(SocketSource):
    """A source whose publications are in shared memory, too, and come from there whenever they can."""

    regions: Regions

    @abstractmethod
    def place(self) -> Place:
        """Say which region. Raises `ProtocolError` where there can be none."""

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        self.regions.attach(handler, self)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        self.regions.detach(handler)

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why nothing came for so long, and what to do about it."""
        path = self.regions.path(handler)
        if path is None:
            return super().silence(handler, seconds)
        return f"nothing new in {path} within {seconds * 1000:.0f} ms.", self.silent


class SharedStateSource(_SharedMemorySource, StateSource):
    """The snapshots of the state region, or of the state socket.

    Args:
        regions: The client's.
        subscriptions: The client's.
        endpoint: Tells where the state socket is.
    """

    def __init__(
        self,
        regions: Regions,
        subscriptions: Subscriptions,
        endpoint: Callable[[], str],
        own: OwnSteps | None = None,
    ) -> None:
        super().__init__(subscriptions, endpoint, own)
        self.regions = regions
        # The socket may be one ahead of the region. Two are never equal: each tells when it was built.
        self._came = deque[BytesLike](maxlen=2)

    def attach(self, handler: MessageHandler) -> None:
        """See the base classes."""
        super().attach(handler)
        self._own.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        """See the base classes."""
        super().detach(handler)
        self._own.detach(handler)

    def place(self) -> Place:
        """See the base class."""
        return Place(STATE_FILE, STATE_FULL, doorbell.STATE)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Leave out what came already: where the region takes over from the socket, both bring it."""
        if payload in self._came:
            return False
        self._came.append(payload)
        return True


class SharedCameraSource(_SharedMemorySource, CameraSource):
    """The pictures of one camera, from its region or from its socket.

    A picture from the region is converted when somebody looks at it, straight into an array of the user's.

    Args:
        regions: The client's.
        subscriptions: The client's.
        view: The camera.
        host: Tells under which name or address the server was reached.
        live: Tells whether the server is in live mode, as far as is known.
        switch: Switches the camera on and off; None where it always streams.
        asked: Whether the user asked for these pictures, rather than having them received in the background.
    """

    def __init__(
        self,
        regions: Regions,
        subscriptions: Subscriptions,
        view: HasCamera,
        host: Callable[[], str],
        *,
        live: Callable[[], bool] = lambda: True,
        switch: CameraSwitch | None = None,
        asked: bool = True,
    ) -> None:
        super().__init__(subscriptions, view, host, live=live, switch=switch, asked=asked)
        self.regions = regions
        self._taken: SharedPicture | None = None

    def attach(self, handler: MessageHandler) -> None:
        """See the base classes."""
        super().attach(handler)
        self._use(handler)

    def detach(self, handler: MessageHandler) -> None:
        """See the base classes."""
        super().detach(handler)
        self._leave(handler)

    def first_after(self, handler: MessageHandler) -> float:
        """See the base class; regions get pictures in every mode."""
        return super().first_after(handler) if self.regions.path(handler) is None else FIRST_PICTURE_S

    def place(self) -> Place:
        """See the base class."""
        topic = self.view.info.zmq_topic
        separator = "/camera/" if "/camera/" in topic else "/"
        articulation, _, camera = topic.strip().partition(separator)
        return Place(camera_file(articulation, camera), camera_filter(topic), doorbell.CAMERA)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Leave out a picture that was read already, in place of the one before it."""
        taken = self._taken
        return not (
            isinstance(payload, SharedPicture)
            and taken is not None
            and payload.reader is taken.reader
            and payload.sequence <= taken.sequence
        )

    def decode(self, topic: bytes, payload: BytesLike) -> CameraSample:
        """Read a picture. Raises `ProtocolError`."""
        if not isinstance(payload, SharedPicture):
            return super().decode(topic, payload)
        decode = super().decode
        found = payload.read(lambda slot: decode(topic, slot))
        self._taken = SharedPicture(payload.reader, found.sequence, len(payload))
        return found.payload


class EventBus:
    """Tells whoever listens what happens to a client. Publishing without listeners costs nothing and keeps nothing.

    Attributes:
        on_listener: Told, on any thread, that somebody began to listen.
    """

    name = "events"

    def __init__(self) -> None:
        self.on_listener: Callable[[], None] | None = None
        self._lock = threading.Lock()
        self._handlers: dict[MessageHandler, None] = {}
        self._closed = False

    def stream(self, buffer: int) -> Stream[ClientEvent]:
        """Return a stream of the events from now on, the last `buffer` of which wait for the reader. From any thread.

        Raises:
            ClientClosed: The client was closed.
        """
        return Stream(self, policy=StreamPolicy.ALL, buffer=buffer, timeout=None, eager=True, tolerant=True)

    def publish(self, event: ClientEvent) -> None:
        """Let the listeners know; from the event loop."""
        with self._lock:
            handlers = tuple(self._handlers)
        if not handlers:
            return
        message = msgspec.msgpack.encode(event)  # each listener gets an event of its own
        for handler in handlers:
            handler.on_message(b"", message)
            handler.on_drained()

    def close(self) -> None:
        """End every stream with `ClientClosed`, from the event loop. Idempotent."""
        with self._lock:
            self._closed = True
            handlers = tuple(self._handlers)
            self._handlers.clear()
        for handler in handlers:
            handler.on_end(client_closed)

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from any thread."""
        with self._lock:
            if self._closed:
                raise client_closed()
            self._handlers[handler] = None
        if self.on_listener is not None:
            self.on_listener()

    @property
    def heard(self) -> bool:
        """Whether anybody listens."""
        return bool(self._handlers)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`, from any thread. Idempotent."""
        with self._lock:
            self._handlers.pop(handler, None)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return True: every event is wanted."""
        return True

    def decode(self, topic: bytes, payload: BytesLike) -> ClientEvent:
        """Read an event."""
        return _EVENTS.decode(payload)

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return that nothing happened."""
        return f"nothing happened within {seconds * 1000:.0f} ms.", ""
