"""Servers that do nothing but talk: they answer each op, or publish on demand, with bytes that were made before.

They run in a child process, so that they take no time from the interpreter that is measured. The child is this very
file run as a script; it ends when its standard input closes.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Self

import msgspec
import zmq

__all__ = ["LAST_STEP", "PROCESSOR_S", "Publisher", "Requester", "publisher", "server"]

LAST_STEP = b"\x81\xa2op\xa4last"
"""Request that is answered with the last `step` request, byte for byte."""

PROCESSOR_S = b"\x81\xa2op\xa9processor"
"""Request that is answered with the processor time of the server so far, seconds, as a float64 of msgpack."""


class Requester:
    """The floor: a blocking REQ socket that sends bytes and gets bytes."""

    def __init__(self, port: int) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.linger = 0
        self._socket.rcvtimeo = 60_000  # or what goes wrong would hang
        self._socket.connect(f"tcp://127.0.0.1:{port}")

    def ask(self, request: bytes) -> bytes:
        self._socket.send(request)
        return self._socket.recv()

    def asking(self, request: bytes) -> Callable[[], bytes]:
        """Return a function without arguments that sends `request` and waits for the answer."""
        send, receive = self._socket.send, self._socket.recv

        def ask() -> bytes:
            send(request)
            return receive()

        return ask

    def close(self) -> None:
        self._socket.close()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Publisher:
    """Tells a publishing child what to send.

    Attributes:
        ports: Of its PUB sockets.
    """

    def __init__(self, ports: Sequence[int], control: int) -> None:
        self.ports = ports
        self._control = Requester(control)

    def wait_subscribed(self, socket: int) -> None:
        """Wait until somebody listens to this socket."""
        self._control.ask(msgspec.msgpack.encode(("wait", socket, 0, 0.0)))

    def send(self, socket: int, count: int, hz: float = 0.0) -> None:
        """Let it send so many messages on one of its sockets, at a rate or at once. Returns at once."""
        self._control.ask(msgspec.msgpack.encode(("send", socket, count, hz)))

    def close(self) -> None:
        self._control.close()


@contextlib.contextmanager
def server(answers: Mapping[str, bytes]) -> Iterator[int]:
    """Run a server that answers ops by name; yield its port."""
    with _child("answer", dict(answers)) as ports:
        yield ports[0]


@contextlib.contextmanager
def publisher(messages: Sequence[Sequence[tuple[bytes, bytes]]]) -> Iterator[Publisher]:
    """Run a publisher with one PUB socket for each list of (topic, payload), which it sends round and round."""
    with _child("publish", [list(own) for own in messages]) as (control, *ports):
        handle = Publisher(ports, control)
        try:
            yield handle
        finally:
            handle.close()


@contextlib.contextmanager
def _child(role: str, material: object) -> Iterator[list[int]]:
    command = [sys.executable, __file__, role]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        stdin, stdout = process.stdin, process.stdout
        assert stdin is not None and stdout is not None  # noqa: S101, PT018
        encoded = msgspec.msgpack.encode(material)
        stdin.write(len(encoded).to_bytes(8, "big") + encoded)
        stdin.flush()
        try:
            yield msgspec.json.decode(stdout.readline())
        finally:
            stdin.close()


# In the child


def _bind(context: zmq.Context[zmq.Socket[bytes]], kind: int) -> tuple[zmq.Socket[bytes], int]:
    socket = context.socket(kind)
    socket.linger = 0
    return socket, socket.bind_to_random_port("tcp://127.0.0.1")


def _answer(answers: dict[str, bytes]) -> None:
    by_name = {name.encode(): reply for name, reply in answers.items()}
    socket, port = _bind(zmq.Context(), zmq.REP)
    _tell([port])
    last = b""
    while True:
        request = socket.recv()
        name = request[5 : 5 + (request[4] & 31)]  # a map whose first entry is `op` and a short string
        if name == b"step":
            last = request
        if name == b"processor":
            socket.send(msgspec.msgpack.encode(time.process_time()))
        else:
            socket.send(last if request == LAST_STEP else by_name[name])


def _publish(messages: list[list[tuple[bytes, bytes]]]) -> None:
    context = zmq.Context()
    control, control_port = _bind(context, zmq.REP)
    sockets: list[zmq.Socket[bytes]] = []
    ports: list[int] = []
    for _ in messages:
        socket = context.socket(zmq.XPUB)
        socket.linger = 0
        socket.sndhwm = 0  # no limit: what is measured is the subscriber
        ports.append(socket.bind_to_random_port("tcp://127.0.0.1"))
        sockets.append(socket)
    _tell([control_port, *ports])
    while True:
        verb, index, count, hz = msgspec.msgpack.decode(control.recv(), type=tuple[str, int, int, float])
        if verb == "wait":
            sockets[index].recv()
        control.send(b"")
        due = time.perf_counter()
        for i in range(count):
            if hz:
                due += 1 / hz
                time.sleep(max(0.0, due - time.perf_counter()))
            sockets[index].send_multipart(messages[index][i % len(messages[index])], copy=False)


def _tell(ports: list[int]) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(ports) + b"\n")
    sys.stdout.buffer.flush()


def _main() -> None:
    stdin = sys.stdin.buffer
    material = stdin.read(int.from_bytes(stdin.read(8), "big"))

    def end_with_parent() -> None:
        stdin.read()
        os._exit(0)

    threading.Thread(target=end_with_parent, daemon=True).start()
    if sys.argv[1] == "answer":
        _answer(msgspec.msgpack.decode(material, type=dict[str, bytes]))
    else:
        _publish(msgspec.msgpack.decode(material, type=list[list[tuple[bytes, bytes]]]))


if __name__ == "__main__":
    _main()
