"""What happens to a client: to its connection, its session and play."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from typing import get_args

import msgspec

from urlab_client.aio.arguments import collection
from urlab_client.aio.streams import Stream
from urlab_client.aio.transport.subscriber import MessageHandler, client_closed
from urlab_client.protocol.layouts import BytesLike
from urlab_client.protocol.messages.streams import (
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
    StreamPolicy,
)
from urlab_client.protocol.names import did_you_mean

__all__ = ["EventBus"]

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
)
_EVENTS = msgspec.msgpack.Decoder(_Event)
_KINDS = {str(kind.__struct_config__.tag): kind for kind in get_args(_Event)}


class EventBus:
    """Tells whoever listens what happens to a client. Publishing without listeners costs nothing and keeps nothing.

    Attributes:
        on_listener: Told, on any thread, that somebody began to listen.
    """

    def __init__(self) -> None:
        self.on_listener: Callable[[], None] | None = None
        self._lock = threading.Lock()
        self._handlers: dict[MessageHandler, None] = {}
        self._closed = False

    def stream(self, kinds: Collection[str | type[ClientEvent]], buffer: int) -> Stream[ClientEvent]:
        """Return a stream of the events from now on, the last `buffer` of which wait for the reader. From any thread.

        Args:
            kinds: Names or classes of the events wanted; empty for all.
            buffer: Events kept.

        Raises:
            ClientClosed: The client was closed.
            ValueError: There is no event of such a kind.
            TypeError: `kinds` is a name by itself.
        """
        source = _EventSource(self, _topics(kinds))
        return Stream(source, policy=StreamPolicy.ALL, buffer=buffer, timeout=None, eager=True, tolerant=True)

    def publish(self, event: ClientEvent) -> None:
        """Let the listeners know; from the event loop."""
        with self._lock:
            handlers = tuple(self._handlers)
        if not handlers:
            return
        topic = str(event.__struct_config__.tag).encode()
        message = msgspec.msgpack.encode(event)  # each listener gets an event of its own
        for handler in handlers:
            handler.on_message(topic, message)
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


class _EventSource:
    """The `Source` of one stream of events; the topics are their kinds."""

    name = "events"

    def __init__(self, bus: EventBus, topics: frozenset[bytes]) -> None:
        self._bus = bus
        self._topics = topics

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from any thread."""
        self._bus.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`, from any thread. Idempotent."""
        self._bus.detach(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether an event is of a kind that was asked for."""
        return topic in self._topics

    def decode(self, topic: bytes, payload: BytesLike) -> ClientEvent:
        """Read an event."""
        return _EVENTS.decode(payload)

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return that nothing happened."""
        return f"nothing happened within {seconds * 1000:.0f} ms.", ""


def _topics(kinds: Collection[str | type[ClientEvent]]) -> frozenset[bytes]:
    names: set[str] = set()
    for kind in collection("kinds", kinds):
        name = kind if isinstance(kind, str) else next((name for name, one in _KINDS.items() if one is kind), None)
        if name not in _KINDS:
            suggested = did_you_mean(str(name), _KINDS)
            raise ValueError(f"{kind!r} is not a kind of event.{suggested} There are: {', '.join(_KINDS)}.")
        names.add(name)
    return frozenset(name.encode() for name in names or _KINDS)
