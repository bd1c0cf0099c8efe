"""Events of a client: of its connection, its session and play."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from typing import get_args

import msgspec

from urlab_client.aio.arguments import collection
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.subscriber import MessageHandler, client_closed
from urlab_client.events import (
    ClientEvent,
    PlayEnded,
    PlayStarted,
    ServerAnswers,
    ServerConnected,
    ServerLost,
    ServerReconnected,
    ServerSilent,
    SessionLost,
    SessionOpened,
    TaskFailed,
)
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.values.layouts import BytesLike
from urlab_client.values.names import did_you_mean

_Event = (
    ServerConnected
    | ServerLost
    | ServerReconnected
    | ServerSilent
    | ServerAnswers
    | SessionOpened
    | SessionLost
    | PlayStarted
    | PlayEnded
    | TaskFailed
)
_EVENTS = msgspec.msgpack.Decoder(_Event)
_KINDS = {str(kind.__struct_config__.tag): kind for kind in get_args(_Event)}


class EventBus:
    """Publishes the events of a client to its listeners. Without listeners, events are discarded at no cost.

    Attributes:
        on_listener: Callback invoked on any thread when a listener is added.
    """

    def __init__(self) -> None:
        self.on_listener: Callable[[], None] | None = None
        self._lock = threading.Lock()
        self._handlers: dict[MessageHandler, None] = {}
        self._closed = False

    def stream(self, kinds: Collection[str | type[ClientEvent]], buffer: int) -> Stream[ClientEvent]:
        """Return a stream of future events that buffers the last `buffer` of them. Call from any thread.

        Args:
            kinds: Names or classes of the events wanted; empty for all.
            buffer: Number of events kept.

        Raises:
            ClientClosed: The client was closed.
            ValueError: A kind of event does not exist.
            TypeError: `kinds` is a single name instead of a collection.
        """
        source = _EventSource(self, _topics(kinds))
        return Stream(source, policy=StreamPolicy.ALL, buffer=buffer, timeout=None, eager=True, tolerant=True)

    def publish(self, event: ClientEvent) -> None:
        """Publish an event to all listeners. Call from the event loop."""
        with self._lock:
            handlers = tuple(self._handlers)
        if not handlers:
            return
        topic = str(event.__struct_config__.tag).encode()
        message = msgspec.msgpack.encode(event)  # each listener decodes its own copy
        for handler in handlers:
            handler.take(topic, message)
            handler.drain()

    def close(self) -> None:
        """End every stream with `ClientClosed`. Call from the event loop. Idempotent."""
        with self._lock:
            self._closed = True
            handlers = tuple(self._handlers)
            self._handlers.clear()
        for handler in handlers:
            handler.on_end(client_closed)

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from any thread."""
        with self._lock:
            if self._closed:
                raise client_closed()
            self._handlers[handler] = None
        if self.on_listener is not None:
            self.on_listener()

    @property
    def heard(self) -> bool:
        """Whether there are listeners."""
        return bool(self._handlers)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Call from any thread. Idempotent."""
        with self._lock:
            self._handlers.pop(handler, None)


class _EventSource:
    """The `Source` of one stream of events. Topics are the kinds of events."""

    name = "events"

    def __init__(self, bus: EventBus, topics: frozenset[bytes]) -> None:
        self._bus = bus
        self._topics = topics

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from any thread."""
        self._bus.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Call from any thread. Idempotent."""
        self._bus.detach(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether an event is of a requested kind."""
        return topic in self._topics

    def decode(self, topic: bytes, payload: BytesLike) -> ClientEvent:
        """Decode an event."""
        return _EVENTS.decode(payload)

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return that no event occurred."""
        return f"no event within {seconds * 1000:.0f} ms.", ""


def _topics(kinds: Collection[str | type[ClientEvent]]) -> frozenset[bytes]:
    names: set[str] = set()
    for kind in collection("kinds", kinds):
        name = kind if isinstance(kind, str) else next((name for name, one in _KINDS.items() if one is kind), None)
        if name not in _KINDS:
            suggested = did_you_mean(str(name), _KINDS)
            raise ValueError(f"{kind!r} is not a kind of event.{suggested} The kinds are: {', '.join(_KINDS)}.")
        names.add(name)
    return frozenset(name.encode() for name in names or _KINDS)
