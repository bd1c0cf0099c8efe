"""Sessions between clients and a server: relayed unchanged, recorded in an MCAP file, and replayed.

A relay listens at two ports of its own and one for each camera, so it replaces the ports that replies name by its own.
Shared memory goes past it. A replay answers requests as the recorded server did, in the recorded order, so a session
with an editor becomes a test that runs anywhere.
"""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final, Self, TypeAlias, cast

import msgspec
import zmq
from msgspec import Struct

from urlab_client._installation import need
from urlab_client.aio.background import background_thread
from urlab_client.aio.transport.connection import HEARTBEAT_MS, SILENCE_MS, ClientKeys, is_local
from urlab_client.conformance.wire import codec_of, plain
from urlab_client.errors import URLabError
from urlab_client.keys import KeyPair
from urlab_client.protocol.topics import resolve_endpoint

Socket: TypeAlias = zmq.Socket[bytes]

_PORTS: Final = frozenset({"hello", "begin_pie", "set_camera_streaming"})
"""Ops whose replies name ports."""
_PREFIX: Final = "urlab/"
_REQUEST, _REPLY = f"{_PREFIX}request", f"{_PREFIX}reply"
_HEADER: Final = 40
_CHUNK: Final = 1 << 16
"""Bytes that are compressed at a time, while the relay waits."""
_VARIES: Final = frozenset({"session_id", "control_owner", "client_version"})
"""Request fields that differ from run to run."""


class Passed(Struct):
    """A request and its reply that passed through, or were recorded.

    Attributes:
        op: Name of the op; empty if the request has none.
        request: The request's bytes.
        reply: The reply's bytes, as the server sent it.
        seconds: Time from the request to its reply, at the relay.
        at: Unix time of the request, nanoseconds.
        messages: In a recording, what was published before the next reply: source, topic and payload.
    """

    op: str
    request: bytes
    reply: bytes
    seconds: float = 0.0
    at: int = 0
    messages: list[tuple[str, bytes, bytes]] = []


class _Head(Struct):
    op: str = ""


def op_name(frame: bytes) -> str:
    """Return the op of a request or reply; empty if it has none."""
    try:
        return codec_of(frame).decode(frame, type=_Head).op
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
        self.sockets: contextlib.ExitStack = contextlib.ExitStack()

    @cached_property
    def context(self) -> zmq.Context[Socket]:
        """The context of its sockets, which exists when there is one: until then nothing has to be closed."""
        made: zmq.Context[Socket] = zmq.Context()
        made.setsockopt(zmq.LINGER, 0)
        return made

    def socket(self, kind: int) -> Socket:
        """Return a socket, which is among `sockets`."""
        return self.sockets.enter_context(self.context.socket(kind))

    def bind(self, kind: int, port: int = 0) -> tuple[Socket, int]:
        """Return a bound socket and its port."""
        socket = self.socket(kind)
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
            self.sockets.close()
            raise OSError(f"{host}:{port} cannot be bound: {error}") from error


class Service(ABC):
    """A thread that answers at ports of its own, until it is closed or fails.

    Args:
        ports: Where to listen.
        port: Port for requests; 0 for any.

    Attributes:
        port: Port for requests.
        state_port: Port for the state stream.
        failure: Why it ended; None while it runs.
    """

    def __init__(self, ports: Ports, port: int) -> None:
        self.failure: URLabError | None = None
        self.port: int
        self.state_port: int = 0
        self._ports = ports
        self._poller = zmq.Poller()
        self._front, self.port = ports.bind(zmq.ROUTER, port)
        self._poller.register(self._front, zmq.POLLIN)
        self._ended = threading.Event()

    _thread: threading.Thread
    """Runs `_run`."""

    @abstractmethod
    def take(self, socket: Socket) -> None:
        """Take what has come to a socket; called on the thread."""

    @abstractmethod
    def camera_port(self, told: str) -> int:
        """Return the own port in the place of a camera's endpoint, as the server tells it."""

    def own_ports(self, place: dict[str, Any], name: str) -> None:
        """Put the own port in the place of the server's; clients put in the host that they know."""
        if name == "zmq_endpoint":
            place[name] = f"tcp://0.0.0.0:{self.camera_port(str(place[name]))}"
        else:
            place[name] = float(self.state_port if name == "state_port" else self.port)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ports.context.term()  # which ends the thread, and waits until that has closed the sockets

    def join(self) -> None:
        """Wait until it fails or is closed."""
        while not self._ended.wait(0.2):  # so that Ctrl-C is seen everywhere
            pass
        if self.failure is not None:
            raise self.failure

    def _fail(self, error: URLabError) -> None:
        self.failure = error

    def _run(self) -> None:
        try:
            while True:
                for socket, _ in self._poller.poll():
                    self.take(cast("Socket", socket))
        except zmq.ContextTerminated:
            pass
        finally:
            self._ports.sockets.close()
            self._ended.set()


class Relay(Service):
    """Relays between clients and the server at an address, in a thread of its own.

    Args:
        endpoint: RPC endpoint of the server, with its port.
        keys: Keys of the server, if it needs any.
        server_state_port: Port of the server's state stream, if its handshake tells none.
        ports: Where to listen.
        port: Port for requests; 0 for any.
        state_port: Port for the state stream; 0 for any.
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
        super().__init__(ports, port)
        self._thread = background_thread("urlab-relay", self._run, failed=self._fail)
        self._host = endpoint.partition("://")[2].rpartition(":")[0]
        self._keys = keys
        self._back = self._connected(zmq.DEALER, endpoint)
        self._poller.register(self._back, zmq.POLLIN)
        self._pairs: dict[Socket, tuple[Socket, str]] = {}
        self._cameras: dict[str, int] = {}
        self._pending: dict[tuple[bytes, ...], tuple[bytes, float, int]] = {}
        self._state, self.state_port = self._publisher(f"tcp://{self._host}:{server_state_port}", "state", state_port)
        self._state_ports = {server_state_port}

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

    # Sockets

    def _connected(self, kind: int, endpoint: str) -> Socket:
        socket = self._ports.socket(kind)
        socket.heartbeat_ivl, socket.heartbeat_timeout = HEARTBEAT_MS, SILENCE_MS
        socket.ipv6 = "[" in endpoint
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

    def take(self, socket: Socket) -> None:
        """See `Service.take`."""
        if socket is self._front:
            self._take_requests()
        elif socket is self._back:
            self._take_replies()
        else:
            self._take_messages(socket)

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
                    answer = _edited(answer, partial(_replace_ports, self.own_ports))
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

    def own_ports(self, place: dict[str, Any], name: str) -> None:
        """See `Service.own_ports`; the state of a port that a handshake tells is relayed, too."""
        if name == "state_port" and int(place[name]) not in self._state_ports:
            self._state_ports.add(int(place[name]))
            self._state.connect(f"tcp://{self._host}:{int(place[name])}")
        super().own_ports(place, name)

    def camera_port(self, told: str) -> int:
        """See `Service.camera_port`."""
        endpoint = resolve_endpoint(told, self._host)
        if endpoint not in self._cameras:
            self._cameras[endpoint] = self._publisher(endpoint, "camera")[1]
        return self._cameras[endpoint]


_MESSAGE: Final = 2

OwnPorts: TypeAlias = Callable[[dict[str, Any], str], None]


def _edited(reply: bytes, change: Callable[[dict[str, Any]], bool]) -> bytes:
    """Return a reply as a function changes it, which returns whether it has; as it is, if it cannot be read."""
    try:
        value = plain(reply)
    except ValueError:
        return reply
    return codec_of(reply).encode(value) if change(value) else reply


def _replace_ports(own: OwnPorts, place: Any) -> bool:
    """Replace the ports in a value; return whether there are any."""
    if isinstance(place, list):
        found = [_replace_ports(own, item) for item in cast("list[Any]", place)]  # in all of them
        return any(found)
    changed = False
    if isinstance(place, dict):
        fields = cast("dict[str, Any]", place)
        for name, item in list(fields.items()):
            if name in {"zmq_endpoint", "state_port", "step_port"}:
                own(fields, name)
                changed = True
            elif name not in {"vfs_assets", "arts", "per_articulation"}:
                changed |= _replace_ports(own, item)
    return changed


# Recordings


class SessionWriter:
    """Writes what passes through a relay to a file.

    Args:
        path: The file.
        images: Whether pixels are kept; otherwise pictures keep their size and numbers alone.
    """

    def __init__(self, path: Path, *, images: bool = False) -> None:
        need("mcap", extra="mcap")
        from mcap.writer import Writer

        self._images = images
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(profile="urlab-session", library="urlab_client")
        self._channels: dict[str, int] = {}
        self._count = 0

    def exchange(self, passed: Passed) -> None:
        """Keep a request and its reply, under one number."""
        self._count += 1
        reply = passed.reply
        if not self._images and b"cameras" in reply:
            reply = _edited(reply, _drop_pixels)
        self._write(_REQUEST, passed.request, passed.at)
        self._write(_REPLY, reply, passed.at + int(passed.seconds * 1e9))

    def message(self, source: str, topic: bytes, payload: bytes) -> None:
        """Keep a published message."""
        if source == "camera" and not self._images:
            payload = payload[:_HEADER] if payload.startswith(b"UCM1") else b""
        self._write(f"{_PREFIX}{source}/{topic.decode(errors='replace')}", payload, time.time_ns())

    def close(self) -> None:
        """Complete the file, and close it."""
        with self._file:
            self._writer.finish()

    def _write(self, topic: str, data: bytes, at: int) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "", 0)
        self._writer.add_message(self._channels[topic], at, data, at, self._count)


def _drop_pixels(reply: dict[str, Any]) -> bool:
    for picture in _pictures(reply):
        picture["data"] = b""
    return True


def _pictures(value: dict[str, Any]) -> list[dict[str, Any]]:
    cameras = value.get("cameras")
    found: list[Any] = list(cast("dict[str, Any]", cameras).values()) if isinstance(cameras, dict) else []
    return [picture for picture in found if isinstance(picture, dict) and "data" in picture]


def read_session(path: Path) -> list[Passed]:
    """Read a recorded session.

    Raises:
        ValueError: The file is not one.
    """
    need("mcap", extra="mcap")
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    found: dict[int, Passed] = {}
    try:
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                row = found.setdefault(message.sequence, Passed("", b"", b""))
                if channel.topic == _REQUEST:
                    row.request, row.op = message.data, op_name(message.data)
                elif channel.topic == _REPLY:
                    row.reply = message.data
                else:
                    source, _, topic = channel.topic.removeprefix(_PREFIX).partition("/")
                    row.messages.append((source, topic.encode(), message.data))
    except McapError as error:
        raise ValueError(f"{path} is not a recorded session: {error}") from error
    if not any(row.reply for row in found.values()):
        raise ValueError(f"{path} is not a recorded session: it has no replies")
    return [found[number] for number in sorted(found)]


class Replay(Service):
    """Answers requests as a recorded server did, in a thread of its own.

    Equal requests get their replies in the recorded order, the last one again when there are no more. A request that
    was not recorded gets the next reply to its op, and otherwise a refusal.

    Args:
        session: From `read_session`.
        ports: Where to listen.
        port: Port for requests; 0 for any.
        state_port: Port for the state stream; 0 for any.

    Attributes:
        unknown: Requests that the recording has no reply to, by op.
    """

    def __init__(self, session: list[Passed], ports: Ports, *, port: int = 0, state_port: int = 0) -> None:
        super().__init__(ports, port)
        self._thread = background_thread("urlab-replay", self._run, failed=self._fail)
        self.unknown: Counter[str] = Counter()
        self._state, self.state_port = ports.bind(zmq.PUB, state_port)
        self._cameras: dict[str, int] = {}
        self._equal: dict[Any, deque[Passed]] = defaultdict(deque)
        self._of_op: dict[str, deque[Passed]] = defaultdict(deque)
        for row in session:
            self._equal[_key(row.request)].append(row)
            self._of_op[row.op].append(row)

    def take(self, socket: Socket) -> None:
        """See `Service.take`."""
        *envelope, request = socket.recv_multipart()
        row = self._next(request)
        if row is None:
            op = op_name(request)
            self.unknown[op] += 1
            refusal = {"op": "error", "code": "unknown_op", "message": f"the recording has no reply to {op!r}"}
            socket.send_multipart([*envelope, msgspec.msgpack.encode(refusal)])
            return
        socket.send_multipart([*envelope, self._answer(row)])
        for source, topic, payload in row.messages:
            if source == "state":
                self._state.send_multipart([topic, payload])

    def _next(self, request: bytes) -> Passed | None:
        for rows in (self._equal.get(_key(request)), self._of_op.get(op_name(request))):
            if rows:
                return rows.popleft() if len(rows) > 1 else rows[0]
        return None

    def _answer(self, row: Passed) -> bytes:
        if row.op == "step" and b"cameras" in row.reply:
            return _edited(row.reply, _blacken_pixels)
        if row.op not in _PORTS:
            return row.reply
        return _edited(_edited(row.reply, partial(_replace_ports, self.own_ports)), _drop_regions)

    def camera_port(self, told: str) -> int:
        """See `Service.camera_port`; a replay publishes no pictures."""
        if told not in self._cameras:
            self._cameras[told] = self._ports.bind(zmq.PUB)[1]
        return self._cameras[told]


def _key(request: bytes) -> Any:
    """Return what is equal for equal requests."""
    try:
        fields = plain(request)
    except ValueError:
        return request
    kept = {name: item for name, item in fields.items() if name not in _VARIES}
    return msgspec.json.encode(kept, order="deterministic")


def _drop_regions(reply: dict[str, Any]) -> bool:
    """Drop the shared memory that a handshake names, which a recording has not."""
    for place in (reply, reply.get("handshake_payload")):
        if isinstance(place, dict):
            for name in ("shm_session_dir", "shm_rpc"):
                cast("dict[str, Any]", place).pop(name, None)
    return True


def _blacken_pixels(reply: dict[str, Any]) -> bool:
    """Put black pixels in the place of those that were not kept."""
    for picture in _pictures(reply):
        picture["data"] = picture["data"] or bytes(4 * int(picture["width"]) * int(picture["height"]))
    return True
