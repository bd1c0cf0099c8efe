"""What happens to a client: to its connection, its session and play."""

from __future__ import annotations

import threading
from collections.abc import Callable

import msgspec

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

__all__ = ["EventBus"]

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
