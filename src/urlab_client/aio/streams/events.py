"""Events of a client: of its connection, its session and play."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from copy import deepcopy
from typing import Any

from urlab_client.aio.arguments import collection
from urlab_client.aio.streams.handler import Source, StreamHandler
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.subscriber import client_closed
from urlab_client.events import ClientEvent
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.values.names import did_you_mean

_KINDS = {str(kind.__struct_config__.tag): kind for kind in ClientEvent.__subclasses__()}


class EventBus:
    """Publishes the events of a client to its listeners.

    Attributes:
        on_listener: Callback invoked on any thread when a listener is added.
        lock: Guards the listeners, and the end.
        listeners: The listeners, with the kinds of events that each wants.
        closed: Whether the client was closed.
    """

    def __init__(self) -> None:
        self.on_listener: Callable[[], None] | None = None
        self.lock: threading.Lock = threading.Lock()
        self.listeners: dict[StreamHandler[ClientEvent], frozenset[type[ClientEvent]]] = {}
        self.closed: bool = False

    def stream(self, kinds: Collection[str | type[ClientEvent]], buffer: int) -> Stream[ClientEvent]:
        """Return a stream of future events that buffers the last `buffer` of them. Call from any thread.

        Raises:
            ClientClosed: The client was closed.
            ValueError: A kind of event does not exist.
            TypeError: `kinds` is a single name instead of a collection.
        """
        source = _EventSource(self, _classes(kinds))
        return Stream(source, policy=StreamPolicy.ALL, buffer=buffer, timeout=None, eager=True, tolerant=True)

    def publish(self, event: ClientEvent) -> None:
        """Publish an event to all listeners. Call from the event loop."""
        with self.lock:
            listeners = [one for one, kinds in self.listeners.items() if type(event) in kinds]
        for listener in listeners:
            listener.push(b"", deepcopy(event), 0)  # its own copy, in which the stream notes what was dropped
            listener.on_drained()

    def close(self) -> None:
        """End every stream with `ClientClosed`. Call from the event loop. Idempotent."""
        with self.lock:
            self.closed = True
            listeners = tuple(self.listeners)
            self.listeners.clear()
        for listener in listeners:
            listener.on_end(client_closed)

    @property
    def heard(self) -> bool:
        return bool(self.listeners)


class _EventSource(Source[ClientEvent]):
    """The events of some kinds; what the bus passes to a stream are the items themselves. For any thread."""

    name = "events"

    def __init__(self, bus: EventBus, kinds: frozenset[type[ClientEvent]]) -> None:
        self._bus = bus
        self._kinds = kinds

    def attach(self, handler: StreamHandler[Any]) -> None:
        with self._bus.lock:
            if self._bus.closed:
                raise client_closed()
            self._bus.listeners[handler] = self._kinds
        if self._bus.on_listener is not None:
            self._bus.on_listener()

    def detach(self, handler: StreamHandler[Any]) -> None:
        with self._bus.lock:
            self._bus.listeners.pop(handler, None)

    def decode(self, topic: bytes, payload: ClientEvent) -> ClientEvent:
        return payload

    def silence(self, handler: StreamHandler[Any], seconds: float) -> tuple[str, str]:
        return f"no event within {seconds * 1000:.0f} ms.", ""


def _classes(kinds: Collection[str | type[ClientEvent]]) -> frozenset[type[ClientEvent]]:
    found: set[type[ClientEvent]] = set()
    for kind in collection("kinds", kinds):
        event = _KINDS.get(kind) if isinstance(kind, str) else kind
        if event is None or event not in _KINDS.values():
            suggested = did_you_mean(str(kind), _KINDS)
            raise ValueError(f"{kind!r} is not a kind of event.{suggested} The kinds are: {', '.join(_KINDS)}.")
        found.add(event)
    return frozenset(found or _KINDS.values())
