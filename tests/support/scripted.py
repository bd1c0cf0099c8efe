"""A server whose every answer a test dictates, on a real socket."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import zmq
from hello import hello_ok
from ports import free_port
from waiting import DEADLINE_S

from urlab_client.aio import URLabClient
from urlab_client.protocol.base import DialectName
from urlab_client.protocol.registry import dialect_ops

__all__ = ["ScriptedServer", "client_of", "meta_ok", "names"]

HELLO = hello_ok(manager_present=False)


def meta_ok(dialect: DialectName) -> dict[str, Any]:
    """The list of ops of a generation of the plugin."""
    return {
        "op": "meta_ok",
        "ops": [
            {"name": op.name, "category": str(op.needs), "namespace": op.ns}
            for op in dialect_ops(dialect).values()
            if op.name not in {"hello", "meta"}
        ],
    }


Answer = Callable[[dict[str, Any]], "dict[str, Any] | bytes | None"]


class ScriptedServer:
    """Answers each request with what `answer` returns: a reply, raw bytes, or None for silence.

    Attributes:
        seen: Decoded requests, in order.
        held: Envelopes of requests that got silence; `release` answers them late.
    """

    def __init__(self, port: int = 0) -> None:
        self.seen: queue.Queue[dict[str, Any]] = queue.Queue()
        self.answers: dict[str, Answer] = {
            "hello": lambda _: HELLO,
            "meta": lambda _: meta_ok("alpha"),
        }
        self.held: queue.Queue[list[bytes]] = queue.Queue()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.linger = 0
        self.port = port or free_port()
        self._socket.bind(f"tcp://127.0.0.1:{self.port}")
        self._wake = self._context.socket(zmq.PAIR)
        self._wake.bind("inproc://wake")
        self._control = self._context.socket(zmq.PAIR)
        self._control.connect("inproc://wake")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def on(self, op: str, answer: Answer | dict[str, Any] | bytes | None) -> None:
        """Decide the answer to an op."""
        self.answers[op] = answer if callable(answer) else lambda _: answer

    def release(self, reply: dict[str, Any]) -> None:
        """Answer the oldest request that got silence."""
        envelope = self.held.get(timeout=DEADLINE_S)
        self._control.send_multipart([*envelope, msgspec.msgpack.encode(reply)])

    def request(self, op: str | None = None) -> dict[str, Any]:
        """Return the next request that arrived, or the next of an op, whatever else arrives until then."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            found = self.seen.get(timeout=max(0.0, deadline - time.monotonic()))
            if op is None or found["op"] == op:
                return found

    def close(self) -> None:
        """Vanish, as a killed process does."""
        if self._thread.is_alive():
            self._control.send(b"stop")
            self._thread.join(5)
            self._control.close(0)
            self._context.term()

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._wake, zmq.POLLIN)
        while True:
            ready = dict(poller.poll())
            if self._wake in ready:
                frames = self._wake.recv_multipart()
                if frames == [b"stop"]:
                    break
                self._socket.send_multipart(frames)
            if self._socket in ready:
                *envelope, body = self._socket.recv_multipart()
                request = (msgspec.json if body[:1] == b"{" else msgspec.msgpack).decode(body)
                answer = self.answers.get(request["op"], lambda _: None)(request)
                if answer is None:
                    self.held.put(envelope)
                self.seen.put(request)  # before the answer: whoever has that may look here
                if answer is not None:
                    raw = answer if isinstance(answer, bytes) else msgspec.msgpack.encode(answer)
                    self._socket.send_multipart([*envelope, raw])
        self._socket.close(0)
        self._wake.close(0)


def client_of(server: ScriptedServer, **options: Any) -> URLabClient:
    """Return a client of a scripted server which receives no pictures in the background."""
    return URLabClient("tcp://127.0.0.1", step_port=server.port, live_pictures=False, **options)


def names(requests: list[dict[str, Any]]) -> list[str]:
    """Return the ops of requests."""
    return [request["op"] for request in requests]
