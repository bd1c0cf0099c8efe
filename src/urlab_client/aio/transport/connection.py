"""What all ZeroMQ connections of the client share: keys, settings, diagnosis, and the context of requests.

The client detects a silent peer (a pulled cable, a suspended machine, a stopped process) after at most
`HEARTBEAT_MS + SILENCE_MS`, and a peer whose system closes the connection immediately. The peer's I/O thread answers
heartbeats even while its worker is busy for minutes, so they detect a dead server but not a blocked one.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, cast

import zmq
from zmq.utils.monitor import recv_monitor_message

from urlab_client._platform.signals import uninterrupted
from urlab_client.aio.background import Tell
from urlab_client.aio.transport.waiting import Socket, Watch
from urlab_client.keys import KeyPair, public_key, read_pair

HEARTBEAT_MS = 1000
SILENCE_MS = 3000
# The system's own limits are minutes, which would delay the detection of a restored cable as long.
_CONNECT_MS = 3000
_SILENT = 0.9  # of that time, and nothing refused the attempt
_RECONNECT_MS = 50
RECONNECT_MAX_MS = 1000

FAILED_HANDSHAKES: Final = (
    zmq.Event.HANDSHAKE_FAILED_AUTH,
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL,
    zmq.Event.HANDSHAKE_FAILED_PROTOCOL,
)

_MONITORED: Final = (
    zmq.Event.CONNECTED
    | zmq.Event.CONNECT_RETRIED
    | zmq.Event.DISCONNECTED
    | zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
)

UNANSWERED: Final = "the host does not answer"

_OBSTACLES: Final = {
    zmq.Event.CONNECT_RETRIED: "connection refused",
    zmq.Event.CONNECTED: "something accepts the connection but does not speak ZeroMQ, or is suspended",
    **dict.fromkeys(FAILED_HANDSHAKES, "the ZeroMQ handshake failed"),
}

# Events that show that ZeroMQ continues on its own.
_RETRYING: Final = (zmq.Event.CONNECT_RETRIED, zmq.Event.CONNECTED, zmq.Event.HANDSHAKE_SUCCEEDED)
# One of them arrives this long after a loss, if any: ZeroMQ abandons a connection that delivered invalid data.
_REVIVE_S: Final = 0.1
# The same after a failed handshake, when ZeroMQ itself may wait before the next attempt.
_RETRY_S: Final = 2 * RECONNECT_MAX_MS / 1000

_MOST_SOCKETS: Final = 16_384
"""Maximum number of sockets. ZeroMQ's default of 1023 suffices for about 340 clients. Windows allows one less."""

SERVER_KEY_HINT = "If the server requires CURVE keys, pass server_key=…, and client_key=… if it knows its clients."

_SERVER_VARIABLE = "URLAB_SERVER_KEY"
_CLIENT_VARIABLE = "URLAB_CLIENT_KEY"

Context: TypeAlias = zmq.Context[Socket]
Note: TypeAlias = Callable[[zmq.Event, int, str | None], None]
"""Handles an event of a connection: the event, its value, and the obstacle that it shows, if any."""


@dataclass(frozen=True)
class ClientKeys:
    """The key of the expected server and the client's own keys.

    Attributes:
        server: The server's public key, Z85.
        own: The client's key pair.
    """

    server: bytes
    own: KeyPair

    def protect(self, socket: Socket) -> None:
        """Enable CURVE on a socket. Call before it connects."""
        socket.curve_serverkey = self.server
        socket.curve_publickey = self.own.public
        socket.curve_secretkey = self.own.secret


def is_local(address: str) -> bool:
    """Return whether the server at an address is on this machine, where no attacker can impersonate it."""
    scheme, _, rest = address.partition("://")
    if scheme != "tcp":
        return True
    head, _, tail = rest.rpartition(":")
    host = (head if tail.isdigit() and head else rest).strip("[]")
    try:
        return host == "localhost" or ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return False


def client_keys(address: str, server_key: str | None, client_key: str | None) -> ClientKeys | None:
    """Return the keys for a server, or None for a server without keys.

    Args:
        address: Address of the server. For a server on another machine, environment variables supply missing keys.
        server_key: The server's public key or a file with it; empty for none, overriding the environment.
        client_key: The client's secret key file; None or empty to generate a key.

    Raises:
        KeyFileError: A key is malformed.
        ValueError: The keys cannot be used together or with this address.
    """
    if not is_local(address):
        server_key = os.environ.get(_SERVER_VARIABLE) if server_key is None else server_key
        client_key = os.environ.get(_CLIENT_VARIABLE) if client_key is None and server_key else client_key
    if not server_key:
        if client_key:
            raise ValueError("client_key requires server_key: the client must know which server it connects to")
        return None
    if not address.startswith("tcp://"):
        raise ValueError(f"server_key requires a tcp:// address, got {address!r}")
    return ClientKeys(public_key(server_key), read_pair(client_key) if client_key else KeyPair.new())


class Connection:
    """A ZeroMQ socket that connects to one address, and the monitor that shows what becomes of it.

    Takes over the socket, which is not yet connected. `note` is called on the event loop for each event.

    Raises:
        ValueError: The address is not valid; the socket is closed.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        socket: Socket,
        endpoint: str,
        keys: ClientKeys | None,
        note: Note,
        *,
        tell: Tell | None = None,
    ) -> None:
        self.endpoint: str = endpoint
        self._loop = loop
        self.socket: Socket = socket
        self._note = note
        self._attempts = Attempts(loop.time())
        self._retrying = False
        self._closed = False
        self._watches: list[Watch] = []
        socket.linger = 0
        socket.heartbeat_ivl = HEARTBEAT_MS
        socket.heartbeat_timeout = SILENCE_MS
        socket.heartbeat_ttl = SILENCE_MS
        socket.connect_timeout = _CONNECT_MS
        socket.handshake_ivl = _CONNECT_MS
        socket.reconnect_ivl = _RECONNECT_MS
        socket.reconnect_ivl_max = RECONNECT_MAX_MS
        # A request must not queue for a server that is gone, because it would reach the next one. And for a subscriber,
        # a full queue delays heartbeats until the connection is closed; without this option, libzmq 4.3.5 (issue 3937)
        # aborts the process when the queue is read after that, because the next connection would reuse the old pipe.
        socket.immediate = True
        socket.ipv6 = "[" in endpoint  # with names it would prefer IPv6, also where the server has none
        if keys is not None:
            keys.protect(socket)
        with uninterrupted():
            self._monitor = socket.get_monitor_socket(_MONITORED)
        try:
            socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise ValueError(f"{endpoint!r} is not an address that ZeroMQ can connect to: {error}") from error
        self._watches.append(Watch(loop, self.read_events, fd=self._monitor.fileno(), tell=tell))
        loop.call_soon(self.read_events)

    def watch(self, on_readable: Callable[[], object], *, expected: Callable[[], bool] = lambda: True) -> Watch:
        """Call `on_readable` whenever the socket is readable; see `Watch`."""
        watch = Watch(self._loop, on_readable, fd=self.socket.fileno(), expected=expected)
        self._watches.append(watch)
        return watch

    def read_events(self) -> None:
        """Report the events that have happened."""
        while not self._closed and cast("int", self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            message = cast("dict[str, Any]", recv_monitor_message(self._monitor, zmq.NOBLOCK))
            event, value = zmq.Event(message["event"]), message["value"]
            self._retrying = self._retrying or event in _RETRYING
            self._note(event, value, self._attempts.obstacle(event, value, self._loop.time()))

    def revive(self, *, was_connected: bool) -> None:
        """Connect again, after a while, if ZeroMQ does not do so after a loss or an aborted handshake."""

        def look() -> None:
            self.read_events()
            if not self._retrying:
                self.reconnect()

        self._retrying = False
        self._loop.call_later(_REVIVE_S if was_connected else _RETRY_S, look)

    def reconnect(self) -> None:
        """Connect again."""
        if self._closed:
            return
        with contextlib.suppress(zmq.ZMQError), uninterrupted():  # ZeroMQ has already dropped the endpoint
            self.socket.disconnect(self.endpoint)
        self.socket.connect(self.endpoint)

    def close(self) -> None:
        """Close the socket. Idempotent."""
        if self._closed:
            return
        self._closed = True
        for watch in self._watches:
            watch.close()
        with uninterrupted():
            self.socket.disable_monitor()
        self._monitor.close(linger=0)
        self.socket.close(linger=0)


class Attempts:
    """Tracks the attempts of a connection to distinguish a refusing host from a silent one, as ZeroMQ does not."""

    def __init__(self, now: float) -> None:
        self._began = now
        self._ended = False

    def obstacle(self, event: zmq.Event, value: int, now: float) -> str | None:
        """Return the obstacle that a monitor's event shows, or None if it shows none.

        The value of `CONNECT_RETRIED` is the milliseconds until the next attempt.
        """
        took, self._began = now - self._began, now
        ended, self._ended = self._ended, event is zmq.Event.DISCONNECTED
        if event is zmq.Event.CONNECT_RETRIED:
            self._began += value / 1000
            if ended or took < 0:
                # The event announces the next attempt and no failed one, or events were read too late to decide.
                return None
            if took >= _SILENT * _CONNECT_MS / 1000:
                return UNANSWERED
        if event is zmq.Event.HANDSHAKE_FAILED_NO_DETAIL and value == errno.EAGAIN:  # means a timeout
            event = zmq.Event.CONNECTED
        return _OBSTACLES.get(event)


class _SharedContext:
    """The ZeroMQ context of all request sockets of a process.

    A context has two threads and a few descriptors. With one context for each of many clients in an event loop, these
    threads wake up for every message and would use more processor time than the clients.
    """

    def __init__(self) -> None:
        self._start_over()
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._start_over)

    def _start_over(self) -> None:
        # A fork's copy of the context has no threads behind it.
        self._lock = threading.Lock()
        self._context: Context | None = None
        self._users = 0

    def borrow(self) -> Context:
        """Return the context, created if needed. The caller must call `give_back`."""
        with self._lock:
            if self._context is None:
                self._context = zmq.Context()
                self._context.max_sockets = min(_MOST_SOCKETS, self._context.get(zmq.SOCKET_LIMIT))
            self._users += 1
            return self._context

    def give_back(self, context: Context) -> None:
        """Return a borrowed context after closing its sockets. The last call terminates the context."""
        with self._lock:
            if context is not self._context:  # this process is a fork of the borrower
                return
            self._users -= 1
            if self._users:
                return
            self._context = None
        with uninterrupted():
            context.destroy(linger=0)  # `term` would wait for sockets whose making failed or was interrupted


shared_context: Final = _SharedContext()
