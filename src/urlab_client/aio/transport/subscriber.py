"""Receiving from the server's PUB sockets on the caller's asyncio loop.

One SUB socket per publisher serves all subscriptions of a client. So a second reader of the state stream needs neither
a second copy on the wire nor a second wake-up of the loop: at 1 kHz a snapshot takes about 40 µs of processor time,
compared to 100 µs with a separate socket. Messages of different topics also keep the order in which the server sent
them, in which a snapshot follows the rows of its tick.

The loop reads the socket whenever it runs, even if no reader is waiting. The handlers' buffers bound the backlog, not
the speed of their readers, and a slow reader cannot fill the server's queues.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import cast

import zmq
from msgspec import Struct

from urlab_client._platform.signals import uninterrupted
from urlab_client.aio.background import running_loop
from urlab_client.aio.transport.connection import (
    FAILED_HANDSHAKES,
    RECONNECT_MAX_MS,
    SERVER_KEY_HINT,
    UNANSWERED,
    ClientKeys,
    Connection,
    Context,
)
from urlab_client.errors import ClientClosed, ProtocolError, URLabError
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.transport")

# Set before connecting. These queues fill only while the loop is blocked. Streams that need all messages use a backlog
# of small ones, and streams that need the newest skip it in milliseconds. Pictures are large.
_QUEUED_MESSAGES = 1000
_QUEUED_PICTURES = 4
_MAX_MESSAGE_BYTES = 256 * 1024 * 1024

# Other tasks run after this many messages or bytes.
_BATCH_MESSAGES = 64
_BATCH_BYTES = 8 * 1024 * 1024

# A context that is garbage-collected before its sockets waits for them forever. This set keeps contexts alive until
# they are closed, even if a client is never closed.
_contexts: set[Context] = set()

# Only a malfunctioning server produces an endless number of topics; then clear the cache.
_REMEMBERED_TOPICS = 4096


class MessageHandler(ABC):
    """Receives the messages of a subscription. Called on the event loop; must not block.

    Receivers call `take` and `drain`, so that an error in one handler costs the others nothing.
    """

    _errors = 0

    def take(self, topic: bytes, payload: BytesLike) -> None:
        """Call `on_message`; an error is logged and reported to `on_malformed`."""
        try:
            self.on_message(topic, payload)
        except Exception as error:  # noqa: BLE001 - whatever it is, the other handlers are none the worse
            self._blame(error)

    def drain(self) -> None:
        """Call `on_drained`; see `take`."""
        try:
            self.on_drained()
        except Exception as error:  # noqa: BLE001 - likewise
            self._blame(error)

    def _blame(self, error: Exception) -> None:
        self._errors += 1
        if self._errors & (self._errors - 1) == 0:  # ever more rarely
            log.error("a message could not be handled (%d so far)", self._errors, exc_info=error)
        self.on_malformed(f"{type(error).__name__}: {error}")

    @abstractmethod
    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        """Handle one message."""

    @abstractmethod
    def on_malformed(self, problem: str) -> None:
        """Handle a malformed message."""

    @abstractmethod
    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Handle the end of the subscription; `error` creates the reason."""

    def on_drained(self) -> None:  # noqa: B027 - a handler that acts on each message needs nothing here
        """Process the received messages after the last of a batch."""

    def on_connection(self, connected: bool) -> None:  # noqa: B027 - most handlers need not know
        """Handle that the connection was opened or lost."""

    def on_refusal(self) -> None:  # noqa: B027 - most handlers wait until the publisher is there
        """Handle that an attempt to open the first connection failed."""

    def on_gap(self, why: str) -> None:  # noqa: B027 - a handler that keeps only the newest misses nothing
        """Handle that messages are missing before the next one."""


class Subscription(Struct, frozen=True):
    """The messages to receive and their publisher.

    Attributes:
        endpoint: ZMQ endpoint of the publisher.
        filters: ZMQ's prefix filters.
        accepts: Callback that accepts or rejects a whole topic, called once per topic.
        pictures: Whether messages are large, so that they are not copied and only a few are queued.
    """

    endpoint: str
    filters: tuple[bytes, ...]
    accepts: Callable[[bytes], bool]
    pictures: bool = False


class Subscriber:
    """One SUB socket.

    Attributes:
        endpoint: Address of the publisher.
        connected: Whether the publisher is connected.
        obstacle: Most recent reason for a missing connection.
    """

    def __init__(
        self,
        context: Context,
        loop: asyncio.AbstractEventLoop,
        endpoint: str,
        *,
        pictures: bool,
        keys: ClientKeys | None,
    ) -> None:
        self.endpoint: str = endpoint
        self.connected: bool = False
        self.obstacle: str = UNANSWERED
        self._connects = 0
        self._loop = loop
        self._copy = not pictures
        self._handlers: dict[MessageHandler, Subscription] = {}
        self._routes: dict[bytes, tuple[MessageHandler, ...]] = {}
        self._down_since: float | None = None
        self._closed = False
        socket = self._socket = context.socket(zmq.SUB)
        socket.rcvhwm = _QUEUED_PICTURES if pictures else _QUEUED_MESSAGES
        socket.maxmsgsize = _MAX_MESSAGE_BYTES
        self._connection = Connection(loop, socket, endpoint, keys, self._note)
        self._connection.watch(self._on_readable)

    @property
    def idle(self) -> bool:
        """Whether there are no handlers."""
        return not self._handlers

    def attach(self, handler: MessageHandler, subscription: Subscription) -> None:
        """Deliver a subscription of this publisher."""
        for prefix in subscription.filters:
            self._socket.subscribe(prefix)  # the socket counts equal filters of several handlers
        self._handlers[handler] = subscription
        self._routes.clear()
        # Any operation on the socket may consume the edge of its descriptor.
        self._loop.call_soon(self._on_readable)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering."""
        for prefix in self._handlers.pop(handler).filters:
            self._socket.unsubscribe(prefix)
        self._routes.clear()
        self._loop.call_soon(self._on_readable)

    def close(self) -> None:
        """Close the socket."""
        self._closed = True
        self._connection.close()

    def _on_readable(self) -> None:
        socket, touched = self._socket, dict[MessageHandler, None]()
        messages = size = 0
        drained = self._closed
        try:
            while not self._closed and messages < _BATCH_MESSAGES and size < _BATCH_BYTES:
                if not cast("int", socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:  # an exception would cost more
                    drained = True
                    break
                topic = socket.recv(zmq.NOBLOCK)
                if messages == 0 or not self.connected:
                    # The event of a new connection precedes its messages, but arrives on another socket.
                    self._connection.read_events()
                messages += 1
                size += self._take(topic, touched)
        finally:
            # The descriptor is edge-triggered, so remaining messages would never be read without this call.
            if not drained and not self._closed:
                self._loop.call_soon(self._on_readable)
        for handler in touched:
            handler.drain()

    def _take(self, topic: bytes, touched: dict[MessageHandler, None]) -> int:
        """Receive the rest of a message, which has fully arrived, and deliver it to its handlers. Return its size."""
        socket = self._socket
        payload: BytesLike | None = None
        extra = 0
        if socket.getsockopt(zmq.RCVMORE):
            if self._copy:
                payload = socket.recv(zmq.NOBLOCK)
                more = bool(socket.getsockopt(zmq.RCVMORE))
            else:
                frame = socket.recv(zmq.NOBLOCK, copy=False)
                payload, more = frame.buffer, frame.more
            while more:
                socket.recv(zmq.NOBLOCK)
                extra += 1
                more = bool(socket.getsockopt(zmq.RCVMORE))
        route = self._routes.get(topic)
        for handler in self._route(topic) if route is None else route:
            if payload is None or extra:
                handler.on_malformed(f"topic {topic[:64]!r}: {2 + extra if extra else 1} frames, expected 2.")
            else:
                touched[handler] = None
                handler.take(topic, payload)
        return 0 if payload is None else len(payload)

    def _route(self, topic: bytes) -> tuple[MessageHandler, ...]:
        if len(self._routes) >= _REMEMBERED_TOPICS:
            self._routes.clear()
        route = tuple(handler for handler, subscription in self._handlers.items() if subscription.accepts(topic))
        self._routes[topic] = route
        return route

    def _note(self, event: zmq.Event, value: int, obstacle: str | None) -> None:
        if event is zmq.Event.HANDSHAKE_SUCCEEDED:
            self.connected = True
            self._connects += 1
            log.info("receiving from %s", self.endpoint)
            self._tell_line()
            if self._down_since is not None:
                why = f"reconnected after {self._loop.time() - self._down_since:.2f} s"
                self._down_since = None
                for handler in tuple(self._handlers):
                    handler.on_gap(why)
        elif event is zmq.Event.DISCONNECTED:
            if self.connected:
                self.obstacle = "the connection was lost and not restored"
                log.info("lost %s; reconnecting", self.endpoint)
                self.connected = False
                self._down_since = self._loop.time()
                self._connection.revive(was_connected=True)
                self._tell_line()
        elif obstacle is not None and self._connects == 0:
            self.obstacle = f"{obstacle}. {SERVER_KEY_HINT}" if event in FAILED_HANDSHAKES else obstacle
            if event is not zmq.Event.CONNECTED:  # the handshake may still follow
                for handler in tuple(self._handlers):
                    handler.on_refusal()
        if event in (zmq.Event.HANDSHAKE_FAILED_AUTH, zmq.Event.HANDSHAKE_FAILED_PROTOCOL):
            # ZeroMQ does not retry on its own, but the server may learn the key.
            self._loop.call_later(RECONNECT_MAX_MS / 1000, self._connection.reconnect)

    def _tell_line(self) -> None:
        for handler in tuple(self._handlers):
            handler.on_connection(self.connected)


class Subscriptions:
    """All subscriptions of one client. Sockets are opened on first use and closed when no handler remains."""

    def __init__(self, keys: ClientKeys | None = None) -> None:
        self._keys = keys
        self._context: Context | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._subscribers: dict[tuple[str, bool], Subscriber] = {}
        self._attached: dict[MessageHandler, tuple[Subscription, Callable[[], Subscription]]] = {}
        self.closed: bool = False

    def attach(self, handler: MessageHandler, wanted: Callable[[], Subscription]) -> None:
        """Deliver the subscription that `wanted` returns to `handler`; `refresh` calls `wanted` again.

        Raises:
            ClientClosed: The client was closed.
            ValueError: The endpoint is not a valid address.
        """
        if self.closed:
            raise client_closed()
        self._loop = running_loop(self._loop)
        subscription = wanted()
        self._connect(handler, subscription)
        self._attached[handler] = subscription, wanted

    def detach(self, handler: MessageHandler) -> None:
        """Stop receiving for `handler`. Does nothing if it does not receive."""
        found = self._attached.pop(handler, None)
        if found is not None:
            self._disconnect(handler, found[0])

    def refresh(self) -> None:
        """Follow publishers that moved, as cameras do when a new play session begins."""
        for handler, (before, wanted) in tuple(self._attached.items()):
            try:
                after = wanted()
                if (after.endpoint, after.filters) == (before.endpoint, before.filters):
                    continue
                self.detach(handler)
                self._connect(handler, after)
            except (ProtocolError, ValueError) as error:
                self.detach(handler)
                handler.on_end(_unusable(str(error)))
            else:
                self._attached[handler] = after, wanted
                handler.on_gap(f"moved from {before.endpoint} to {after.endpoint}")

    def line(self, handler: MessageHandler) -> Subscriber | None:
        """Return the socket that `handler` receives from, or None if it does not receive."""
        found = self._attached.get(handler)
        return None if found is None else self._subscribers[_key(found[0])]

    def close(self) -> None:
        """End every subscription with `ClientClosed` and release the sockets. Idempotent."""
        if self.closed:
            return
        self.closed = True
        handlers = tuple(self._attached)
        self._attached.clear()
        for subscriber in self._subscribers.values():
            subscriber.close()
        self._subscribers.clear()
        if self._context is not None:
            with uninterrupted():
                self._context.destroy(linger=0)  # `term` would wait for sockets whose making failed or was interrupted
            _contexts.discard(self._context)
        for handler in handlers:
            handler.on_end(client_closed)

    def _connect(self, handler: MessageHandler, subscription: Subscription) -> None:
        assert self._loop is not None  # noqa: S101  # set by `attach`
        key = _key(subscription)
        subscriber = self._subscribers.get(key)
        if subscriber is None:
            if self._context is None:
                self._context = zmq.Context()
                _contexts.add(self._context)
            subscriber = Subscriber(
                self._context, self._loop, subscription.endpoint, pictures=subscription.pictures, keys=self._keys
            )
            self._subscribers[key] = subscriber
        subscriber.attach(handler, subscription)

    def _disconnect(self, handler: MessageHandler, subscription: Subscription) -> None:
        key = _key(subscription)
        subscriber = self._subscribers[key]
        subscriber.detach(handler)
        if subscriber.idle:
            del self._subscribers[key]
            subscriber.close()


def _key(subscription: Subscription) -> tuple[str, bool]:
    return subscription.endpoint, subscription.pictures


def client_closed() -> ClientClosed:
    """Return the error for readers of a closed client."""
    return ClientClosed("The client was closed.", hint="Create a new client.")


def _unusable(problem: str) -> Callable[[], URLabError]:
    return lambda: URLabError(f"The publisher moved to an unusable address: {problem}")
