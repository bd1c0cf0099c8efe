"""A relay between clients and a server: every request, reply, snapshot and picture passes through it, unchanged.

It listens at two ports of its own and one for each camera, so it replaces the ports that replies name by its own.
Shared memory goes past it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Self, TypeAlias, cast

import msgspec
import zmq
from msgspec import Struct

from urlab_client.aio.background import background_thread
from urlab_client.aio.transport.connection import HEARTBEAT_MS, SILENCE_MS, ClientKeys, is_local
from urlab_client.errors import URLabError
from urlab_client.keys import KeyPair
from urlab_client.protocol.topics import resolve_endpoint

Socket: TypeAlias = zmq.Socket[bytes]

_STOP: Final = "inproc://urlab-relay-stop"
_PORTS: Final = frozenset({"hello", "begin_pie", "set_camera_streaming"})
"""Ops whose replies name ports."""


class Passed(Struct):
    """A request and its reply that passed through.

    Attributes:
        op: Name of the op; empty if the request has none.
        request: The request's bytes.
        reply: The reply's bytes, as the server sent it.
        seconds: Time from the request to its reply, at the relay.
        at: Unix time of the request, nanoseconds.
    """

    op: str
    request: bytes
    reply: bytes
    seconds: float
    at: int


class _Head(Struct):
    op: str = ""


def op_name(frame: bytes) -> str:
    """Return the op of a request or reply; empty if it has none."""
    codec = msgspec.json if frame[:1] == b"{" else msgspec.msgpack
    try:
        return codec.decode(frame, type=_Head).op
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return ""


class Ports:
    """Where a relay, or the replay of a recording, listens.

    Args:
        host: Interface to bind.
        keys: Key pair that clients must know the public half of; required unless the interface is loopback.

    Raises:
        ValueError: The interface can be reached by others, and there are no keys.
    """

    def __init__(self, host: str, keys: KeyPair | None) -> None:
        if keys is None and not is_local(f"tcp://{host}"):
            raise ValueError(f"{host} can be reached by others, so it needs a key (--listen-key)")
        self.host = host
        self._keys = keys
        self.context: zmq.Context[Socket] = zmq.Context()

    def bind(self, kind: int, port: int = 0) -> tuple[Socket, int]:
        """Return a bound socket and its port."""
        socket = self.context.socket(kind)
        socket.linger = 0
        if self._keys is not None:
            socket.curve_server = True
            socket.curve_publickey = self._keys.public
            socket.curve_secretkey = self._keys.secret
        host = f"[{self.host}]" if ":" in self.host else self.host
        socket.ipv6 = ":" in self.host
        try:
            if port:
                socket.bind(f"tcp://{host}:{port}")
                return socket, port
            return socket, socket.bind_to_random_port(f"tcp://{host}")
        except zmq.ZMQError as error:
            socket.close()
            raise OSError(f"{host}:{port} cannot be bound: {error}") from error

    def told(self, port: int) -> str:
        """Return the endpoint of a port as replies name it: clients put in the host that they know."""
        return f"tcp://0.0.0.0:{port}"


class Relay:
    """Relays between clients and the server at an address, in a thread of its own.

    Args:
        endpoint: RPC endpoint of the server, with its port.
        keys: Keys of the server, if it needs any.
        server_state_port: Port of the server's state stream, if its handshake tells none.
        ports: Where to listen.
        port: Port for requests; 0 for any.
        state_port: Port for the state stream; 0 for any.

    Attributes:
        port: Port for requests.
        state_port: Port for the state stream.
        failure: Why the relay ended; None while it runs.
    """

    def __init__(
        self,
        endpoint: str,
        keys: ClientKeys | None,
        server_state_port: int,
        ports: Ports,
        *,
        port: int = 0,
        state_port: int = 0,
    ) -> None:
        self.failure: URLabError | None = None
        self._endpoint = endpoint
        self._host = endpoint.partition("://")[2].rpartition(":")[0]
        self._keys = keys
        self._ports = ports
        self._front, self.port = ports.bind(zmq.ROUTER, port)
        self._back = self._connected(zmq.DEALER, endpoint)
        self._poller = zmq.Poller()
        self._pairs: dict[Socket, tuple[Socket, str]] = {}
        self._cameras: dict[str, int] = {}
        self._pending: dict[tuple[bytes, ...], tuple[bytes, float, int]] = {}
        self._state, self.state_port = self._publisher(f"tcp://{self._host}:{server_state_port}", "state", state_port)
        self._state_ports = {server_state_port}
        self._stop = ports.context.socket(zmq.PAIR)
        self._stop.bind(_STOP)
        for socket in (self._front, self._back, self._stop):
            self._poller.register(socket, zmq.POLLIN)
        self._ended = threading.Event()
        self._thread = background_thread("urlab-relay", self._run, failed=self._fail)

    # What a subclass does with it

    def on_request(self, request: bytes) -> bytes:
        """Return what the server gets; called on the relay's thread."""
        return request

    def on_exchange(self, passed: Passed) -> bytes:
        """Return what the client gets; called on the relay's thread."""
        return passed.reply

    def on_message(self, source: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes] | None:
        """Return what subscribers get; called on the relay's thread.

        Args:
            source: `state`, or `camera`.
            topic: The topic.
            payload: The payload.
        """
        return topic, payload

    # Life

    def start(self) -> Self:
        """Start to relay."""
        self._thread.start()
        return self

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop, and close every socket. Idempotent."""
        if not self._ports.context.closed:
            stop = self._ports.context.socket(zmq.PAIR)
            stop.connect(_STOP)
            stop.send(b"")
            self._ended.wait()  # an interrupted `Thread.join` takes the thread for ended
            self._ports.context.destroy(linger=0)

    def join(self) -> None:
        """Wait until the relay fails or is closed."""
        while not self._ended.wait(0.2):  # so that Ctrl-C is seen everywhere
            pass
        if self.failure is not None:
            raise self.failure

    def _fail(self, error: URLabError) -> None:
        self.failure = error

    # Sockets

    def _connected(self, kind: int, endpoint: str) -> Socket:
        socket = self._ports.context.socket(kind)
        socket.linger = 0
        socket.heartbeat_ivl, socket.heartbeat_timeout = HEARTBEAT_MS, SILENCE_MS
        if self._keys is not None:
            self._keys.protect(socket)
        socket.connect(endpoint)
        return socket

    def _publisher(self, endpoint: str, source: str, port: int = 0) -> tuple[Socket, int]:
        """Relay a publisher; return the socket that it is connected with, and the port for subscribers."""
        below = self._connected(zmq.XSUB, endpoint)
        above, bound = self._ports.bind(zmq.XPUB, port)
        self._pairs[below], self._pairs[above] = (above, source), (below, "")
        for socket in (below, above):
            self._poller.register(socket, zmq.POLLIN)
        return below, bound

    def _run(self) -> None:
        try:
            self._relay()
        finally:
            self._ended.set()

    def _relay(self) -> None:
        while True:
            for socket, _ in self._poller.poll():
                if socket is self._stop:
                    return
                if socket is self._front:
                    self._take_requests()
                elif socket is self._back:
                    self._take_replies()
                else:
                    self._take_messages(cast("Socket", socket))

    def _take_requests(self) -> None:
        with contextlib.suppress(zmq.Again):
            while True:
                *envelope, request = self._front.recv_multipart(zmq.NOBLOCK)
                self._pending[tuple(envelope)] = request, time.perf_counter(), time.time_ns()
                self._back.send_multipart([*envelope, self.on_request(request)])

    def _take_replies(self) -> None:
        with contextlib.suppress(zmq.Again):
            while True:
                *envelope, reply = self._back.recv_multipart(zmq.NOBLOCK)
                request, began, at = self._pending.pop(tuple(envelope), (b"", time.perf_counter(), time.time_ns()))
                op = op_name(request)
                passed = Passed(op, request, reply, time.perf_counter() - began, at)
                answer = self.on_exchange(passed)
                if op in _PORTS:
                    answer = with_ports(answer, self._own_ports)
                self._front.send_multipart([*envelope, answer])

    def _take_messages(self, socket: Socket) -> None:
        other, source = self._pairs[socket]
        with contextlib.suppress(zmq.Again):
            while True:
                frames = socket.recv_multipart(zmq.NOBLOCK)
                if source and len(frames) == _MESSAGE:
                    changed = self.on_message(source, frames[0], frames[1])
                    if changed is None:
                        continue
                    frames = list(changed)
                other.send_multipart(frames)

    def _own_ports(self, place: dict[str, Any], name: str) -> None:
        """Put the relay's own port in the place of the server's."""
        if name == "zmq_endpoint":
            endpoint = resolve_endpoint(str(place[name]), self._host)
            if endpoint not in self._cameras:
                self._cameras[endpoint] = self._publisher(endpoint, "camera")[1]
            place[name] = self._ports.told(self._cameras[endpoint])
        elif name == "state_port":
            if int(place[name]) not in self._state_ports:
                self._state_ports.add(int(place[name]))
                self._state.connect(f"tcp://{self._host}:{int(place[name])}")
            place[name] = float(self.state_port)
        elif name == "step_port":
            place[name] = float(self.port)


_MESSAGE: Final = 2

OwnPorts: TypeAlias = Callable[[dict[str, Any], str], None]


def with_ports(reply: bytes, own: OwnPorts) -> bytes:
    """Return a reply with other ports, and everything else as it was."""
    codec = msgspec.json if reply[:1] == b"{" else msgspec.msgpack
    try:
        value = codec.decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return reply
    changed = False

    def visit(place: Any) -> None:
        nonlocal changed
        if isinstance(place, dict):
            known = cast("dict[str, Any]", place)
            for name in list(known):
                if name in {"zmq_endpoint", "state_port", "step_port"}:
                    own(known, name)
                    changed = True
                elif name not in {"vfs_assets", "arts", "per_articulation"}:
                    visit(known[name])
        elif isinstance(place, list):
            for item in cast("list[Any]", place):
                visit(item)

    visit(value)
    return codec.encode(value) if changed else reply
