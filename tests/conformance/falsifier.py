"""A relay that falsifies one thing on its way between the checks and a server."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import msgspec

from urlab_client.conformance.sessions import Passed, Ports, Relay
from urlab_client.server import SimulatedServer

Fields = dict[str, Any]
OnRequest = Callable[[Fields], object]
OnReply = Callable[[Fields, Fields], object]
OnMessage = Callable[[str, bytes, bytes], tuple[bytes, bytes]]


class Falsifier(Relay):
    """Relays, and changes requests, replies or messages.

    Each function changes the maps that it gets; one for replies may also return bytes to send instead.

    Attributes:
        changed: Number of frames that were changed.
    """

    def __init__(
        self,
        server: SimulatedServer,
        *,
        request: OnRequest | None = None,
        reply: OnReply | None = None,
        message: OnMessage | None = None,
    ) -> None:
        endpoint = f"tcp://127.0.0.1:{server.step_port}"
        super().__init__(endpoint, None, server.state_port, Ports("127.0.0.1", None))
        self._request, self._reply, self._message = request, reply, message
        self.changed = 0

    def on_request(self, request: bytes) -> bytes:
        if self._request is None or (fields := decoded(request)) is None:
            return request
        self._request(fields)
        return self._result(request, msgspec.msgpack.encode(fields))

    def on_exchange(self, passed: Passed) -> bytes:
        request, reply = decoded(passed.request), decoded(passed.reply)
        if self._reply is None or request is None or reply is None:
            return passed.reply
        instead = self._reply(request, reply)
        return self._result(passed.reply, instead if isinstance(instead, bytes) else msgspec.msgpack.encode(reply))

    def on_message(self, source: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes]:
        return (topic, payload) if self._message is None else self._message(source, topic, payload)

    def _result(self, before: bytes, after: bytes) -> bytes:
        self.changed += before != after
        return after


def decoded(frame: bytes) -> Fields | None:
    try:
        value = msgspec.msgpack.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None
    return value if isinstance(value, dict) else None


def in_reply(op: str, change: Callable[[Fields], object]) -> OnReply:
    """Change the replies of one kind, such as `step_ok`, or the refusals with a code, such as `error:busy`."""

    def apply(_request: Fields, reply: Fields) -> object:
        if op in (reply.get("op"), f"error:{reply.get('code')}"):
            return change(reply)
        return None

    return apply


def refusal(op: str, code: str, /, **fields: Any) -> OnReply:
    """Change the code of the refusals of an op, with these fields or without those that are None."""

    def apply(request: Fields, reply: Fields) -> None:
        asked = request.get("op") == op and all(request.get(name) == value for name, value in fields.items())
        if asked and reply.get("code") == code:
            reply["code"] = "busy"

    return apply


def failing(op: str) -> OnReply:
    """Refuse an op that the server has carried out."""

    def apply(request: Fields, _: Fields) -> object:
        error = {"op": "error", "code": "internal_error", "message": "falsified"}
        return msgspec.msgpack.encode(error) if request.get("op") == op else None

    return apply


def in_request(op: str, change: Callable[[Fields], object]) -> OnRequest:
    def apply(request: Fields) -> None:
        if request.get("op") == op:
            change(request)

    return apply


def in_state(change: Callable[[Fields], object], *ops: str) -> OnReply:
    """Change each robot's state in the replies to a step, and those of further kinds."""

    def apply(_request: Fields, reply: Fields) -> None:
        if reply.get("op") in ("step_ok", *ops):
            for state in (reply.get("arts") or reply.get("per_articulation") or {}).values():
                change(state)

    return apply


def put(name: str, value: Any) -> Callable[[Fields], object]:
    return lambda fields: fields.update({name: value})


def drop(name: str) -> Callable[[Fields], object]:
    return lambda fields: fields.pop(name, None) and None


def each(name: str, change: Callable[[Any], Any]) -> Callable[[Fields], object]:
    """Replace a field, where it is there, by what a function makes of it."""
    return lambda fields: fields.update({name: change(fields[name])}) if name in fields else None


def narrowed(reply: Fields) -> bytes:
    """Return a reply in which `time` is a float32."""
    frame, at = msgspec.msgpack.encode(reply), float(reply["time"])
    name = msgspec.msgpack.encode("time")
    return frame.replace(name + struct.pack(">Bd", 0xCB, at), name + struct.pack(">Bf", 0xCA, at), 1)


class Previous:
    """Sends the reply of the step before."""

    def __init__(self) -> None:
        self.kept: Fields | None = None

    def __call__(self, reply: Fields) -> object:
        before, self.kept = self.kept, dict(reply)
        return None if before is None else msgspec.msgpack.encode(before)


class Kept:
    """Sends the first value of a field for ever."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.value: Any = None

    def __call__(self, fields: Fields) -> None:
        if self.name in fields:
            self.value = fields[self.name] if self.value is None else self.value
            fields[self.name] = self.value


class InLive:
    """Changes the replies to steps in live mode."""

    def __init__(self, change: Callable[[Fields], object]) -> None:
        self._change = change
        self._live = False

    def __call__(self, request: Fields, reply: Fields) -> None:
        if request.get("op") == "set_mode":
            self._live = request["mode"] == "live"
        elif self._live and reply.get("op") == "step_ok":
            self._change(reply)


class EndedJobs:
    """Knows no job of an earlier session."""

    def __init__(self) -> None:
        self._ended: bool = False

    def __call__(self, request: Fields, reply: Fields) -> None:
        if reply.get("op") in ("op_started", "hello_ok"):
            self._ended = reply["op"] == "hello_ok"
        elif self._ended and reply.get("op") == "op_status_ok":
            reply.update(op="error", code="unknown_job", message="of an earlier session")


class SameJob:
    """Gives every job that fails at once the number of the first."""

    def __init__(self) -> None:
        self._kept = Kept("job_id")

    def __call__(self, request: Fields, reply: Fields) -> None:
        if reply.get("op") == "op_started" and request.get("name") == "":
            self._kept(reply)
