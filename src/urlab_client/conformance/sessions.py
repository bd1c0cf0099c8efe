"""Recorded sessions: every frame between clients and a server in an MCAP file, and their replay.

A replay answers requests as the recorded server did, in the recorded order, so a session with an editor becomes a test
that runs anywhere.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import defaultdict, deque
from pathlib import Path
from typing import Any, Final, Self, cast

import msgspec
import zmq
from msgspec import Struct

from urlab_client._installation import need
from urlab_client.aio.background import background_thread
from urlab_client.conformance.relay import Passed, Ports, op_name, with_ports
from urlab_client.errors import URLabError

need("mcap", extra="mcap")

from mcap.exceptions import McapError  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from mcap.writer import Writer  # noqa: E402

_PREFIX: Final = "urlab/"
_REQUEST, _REPLY = f"{_PREFIX}request", f"{_PREFIX}reply"
_HEADER: Final = 40
_VARIES: Final = frozenset({"session_id", "control_owner", "client_version"})
"""Request fields that differ from run to run."""


class SessionWriter:
    """Writes what passes through a relay to a file, in a thread of its own.

    Args:
        path: The file.
        images: Whether pixels are kept; otherwise pictures keep their size and numbers alone.
    """

    def __init__(self, path: Path, *, images: bool = False) -> None:
        self.failure: URLabError | None = None
        self._images = images
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="urlab-session", library="urlab_client")
        self._channels: dict[str, int] = {}
        self._items: queue.SimpleQueue[tuple[str, bytes, int, int] | None] = queue.SimpleQueue()
        self._count = 0
        self._thread = background_thread("urlab-tap", self._write, failed=self._fail)
        self._thread.start()

    def exchange(self, passed: Passed) -> None:
        """Keep a request and its reply, under one number."""
        self._count += 1
        reply = passed.reply
        if not self._images and b"cameras" in reply:
            reply = without_pixels(reply)
        self._items.put((_REQUEST, passed.request, passed.at, self._count))
        self._items.put((_REPLY, reply, passed.at + int(passed.seconds * 1e9), self._count))

    def message(self, source: str, topic: bytes, payload: bytes) -> None:
        """Keep a published message."""
        if source == "camera" and not self._images:
            payload = payload[:_HEADER] if payload.startswith(b"UCM1") else b""
        self._items.put((f"{_PREFIX}{source}/{topic.decode(errors='replace')}", payload, time.time_ns(), self._count))

    def close(self) -> None:
        """Write what waits, and close the file."""
        self._items.put(None)
        self._thread.join()
        self._file.close()
        if self.failure is not None:
            raise self.failure

    def _fail(self, error: URLabError) -> None:
        self.failure = error

    def _write(self) -> None:
        while (item := self._items.get()) is not None:
            topic, data, at, number = item
            if topic not in self._channels:
                self._channels[topic] = self._writer.register_channel(topic, "", 0)
            self._writer.add_message(self._channels[topic], at, data, at, number)
        self._writer.finish()


def without_pixels(reply: bytes) -> bytes:
    """Return a reply without the pixels of its pictures."""
    if reply[:1] == b"{":
        return reply
    try:
        value = msgspec.msgpack.decode(reply)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return reply
    pictures = cast("dict[str, Any]", value).get("cameras") if isinstance(value, dict) else None
    if not isinstance(pictures, dict):
        return reply
    for picture in cast("dict[str, Any]", pictures).values():
        if isinstance(picture, dict) and "data" in picture:
            picture["data"] = b""
    return msgspec.msgpack.encode(value)


class Recorded(Struct):
    """A recorded exchange, and the messages that were published between its reply and the next."""

    op: str
    request: bytes
    reply: bytes
    messages: list[tuple[str, bytes, bytes]] = []


def read_session(path: Path) -> list[Recorded]:
    """Read a recorded session.

    Raises:
        ValueError: The file is not one.
    """
    found: dict[int, Recorded] = {}
    try:
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                row = found.setdefault(message.sequence, Recorded("", b"", b""))
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


class Replay:
    """Answers requests as a recorded server did, in a thread of its own.

    Equal requests get their replies in the recorded order, the last one again when there are no more. A request that
    was not recorded gets the next reply to its op, and otherwise a refusal.

    Args:
        session: From `read_session`.
        ports: Where to listen.
        port: Port for requests; 0 for any.
        state_port: Port for the state stream; 0 for any.

    Attributes:
        port: Port for requests.
        state_port: Port for the state stream.
        unknown: Requests that the recording has no reply to, by op.
    """

    def __init__(self, session: list[Recorded], ports: Ports, *, port: int = 0, state_port: int = 0) -> None:
        self.unknown: dict[str, int] = {}
        self.failure: URLabError | None = None
        self._ports = ports
        self._front, self.port = ports.bind(zmq.ROUTER, port)
        self._state, self.state_port = ports.bind(zmq.PUB, state_port)
        self._cameras: dict[str, tuple[zmq.Socket[bytes], int]] = {}
        self._equal: dict[Any, deque[Recorded]] = defaultdict(deque)
        self._of_op: dict[str, deque[Recorded]] = defaultdict(deque)
        for row in session:
            self._equal[_key(row.request)].append(row)
            self._of_op[row.op].append(row)
        self._stop = ports.context.socket(zmq.PAIR)
        self._stop.bind("inproc://urlab-replay-stop")
        self._ended = threading.Event()
        self._thread = background_thread("urlab-replay", self._run, failed=self._fail)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        stop = self._ports.context.socket(zmq.PAIR)
        stop.connect("inproc://urlab-replay-stop")
        stop.send(b"")
        self._ended.wait()  # an interrupted `Thread.join` takes the thread for ended
        self._ports.context.destroy(linger=0)

    def join(self) -> None:
        """Wait until the replay fails or is closed."""
        while not self._ended.wait(0.2):  # so that Ctrl-C is seen everywhere
            pass
        if self.failure is not None:
            raise self.failure

    def _fail(self, error: URLabError) -> None:
        self.failure = error

    def _run(self) -> None:
        try:
            self._serve()
        finally:
            self._ended.set()

    def _serve(self) -> None:
        poller = zmq.Poller()
        poller.register(self._front, zmq.POLLIN)
        poller.register(self._stop, zmq.POLLIN)
        while True:
            if self._stop in dict(poller.poll()):
                return
            *envelope, request = self._front.recv_multipart()
            row = self._next(request)
            if row is None:
                op = op_name(request)
                self.unknown[op] = self.unknown.get(op, 0) + 1
                refusal = {"op": "error", "code": "unknown_op", "message": f"the recording has no reply to {op!r}"}
                self._front.send_multipart([*envelope, msgspec.msgpack.encode(refusal)])
                continue
            self._front.send_multipart([*envelope, self._answer(row)])
            for source, topic, payload in row.messages:
                if source == "state":
                    self._state.send_multipart([topic, payload])

    def _next(self, request: bytes) -> Recorded | None:
        for rows in (self._equal.get(_key(request)), self._of_op.get(op_name(request))):
            if rows:
                return rows.popleft() if len(rows) > 1 else rows[0]
        return None

    def _answer(self, row: Recorded) -> bytes:
        if row.op == "step" and b"cameras" in row.reply:
            return _with_black_pixels(row.reply)
        if row.op not in {"hello", "begin_pie", "set_camera_streaming"}:
            return row.reply
        return _without_regions(with_ports(row.reply, self._own_ports))

    def _own_ports(self, place: dict[str, Any], name: str) -> None:
        if name == "state_port":
            place[name] = float(self.state_port)
        elif name == "step_port":
            place[name] = float(self.port)
        else:
            told = str(place[name])
            if told not in self._cameras:
                self._cameras[told] = self._ports.bind(zmq.PUB)
            place[name] = self._ports.told(self._cameras[told][1])


def _key(request: bytes) -> Any:
    codec = msgspec.json if request[:1] == b"{" else msgspec.msgpack
    try:
        value = codec.decode(request)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return request
    if not isinstance(value, dict):
        return request
    fields = {name: item for name, item in cast("dict[str, Any]", value).items() if name not in _VARIES}
    return msgspec.json.encode(fields, order="deterministic")


def _without_regions(reply: bytes) -> bytes:
    """Return a handshake that names no shared memory, which a recording has not."""
    if reply[:1] == b"{":
        return reply
    value = msgspec.msgpack.decode(reply)
    for place in (value, value.get("handshake_payload")):
        if isinstance(place, dict):
            for name in ("shm_session_dir", "shm_rpc"):
                cast("dict[str, Any]", place).pop(name, None)
    return msgspec.msgpack.encode(value)


def _with_black_pixels(reply: bytes) -> bytes:
    """Return a reply with black pixels in the place of those that were not kept."""
    value = msgspec.msgpack.decode(reply)
    pictures: dict[str, dict[str, Any]] = value.get("cameras") or {}
    for picture in pictures.values():
        picture["data"] = picture["data"] or bytes(4 * int(picture["width"]) * int(picture["height"]))
    return msgspec.msgpack.encode(value)
