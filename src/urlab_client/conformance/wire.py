"""Bare requests to a server, with every exchange recorded, and their frames held against the declarations.

Nothing of the client's own behaviour stands between.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, Final, cast

import msgspec
from msgspec import Struct, inspect

from urlab_client.aio.launch import transport_to
from urlab_client.aio.transport.base import Deadlines
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.conformance.declarations import expecting, holds
from urlab_client.errors import URLabError
from urlab_client.protocol.base import ControlRequest, Needs, Op
from urlab_client.protocol.codec import building
from urlab_client.protocol.messages.jobs import OpStarted
from urlab_client.protocol.messages.session import ErrorReply, HelloOk
from urlab_client.protocol.registry import OPS
from urlab_client.values.layouts import BytesLike

OWNER: Final = "urlab-conformance"
"""Name under which the run claims robots."""

_POLL_S: Final = 0.05
_KEPT_BYTES: Final = 1 << 16
_KEPT: Final = 4096
_ANY: Final = OPS["meta"]


class Exchange(Struct):
    """A request and its reply, as they were on the wire; long replies are without models and pixels, or cut."""

    number: int
    op: str
    request: bytes
    reply: bytes
    request_bytes: int
    reply_bytes: int
    seconds: float


class Wire:
    """A connection whose requests are plain data.

    Attributes:
        transport: Sends the requests.
        session_id: Of the last handshake.
        exchanges: The newest exchanges.
        count: Number of exchanges so far.
        odd: By op, how its replies depart from their declarations.
        numbers: By op, numbers in replies that are not float64.
        refusals: Codes of refusals, with the op of each.
        times: Seconds of each op's exchanges.
    """

    def __init__(self, address: str, step_port: int, keys: ClientKeys | None, *, shm: bool, timeout: float) -> None:
        self.regions: ServerRegions | None = ServerRegions(None) if shm else None
        self.transport: ZmqTransport = transport_to(address, step_port, keys, self.regions)
        self._subscriptions = Subscriptions(keys)
        self._timeout = timeout
        self.session_id: str = ""
        self.exchanges: deque[Exchange] = deque(maxlen=_KEPT)
        self.count: int = 0
        self.odd: dict[str, set[str]] = {}
        self.numbers: dict[str, set[str]] = {}
        self.refusals: dict[str, str] = {}
        self.times: dict[str, list[float]] = {}

    async def aclose(self) -> None:
        """Close the connection."""
        self._subscriptions.close()
        await self.transport.aclose()

    async def frame(self, request: bytes, op: Op = _ANY, *, timeout: float | None = None) -> bytes:
        """Send bytes as they are, and return the reply as it is."""
        loop = asyncio.get_running_loop()
        limit = max(self._timeout, op.timeout or 0.0) if timeout is None else timeout
        started = time.perf_counter()
        way = self.transport.shared or self.transport
        reply = await way.request(request, op, Deadlines(loop.time() + limit, loop.time() + self._timeout))
        took = time.perf_counter() - started
        self.count += 1
        kept = request[:_KEPT_BYTES], reply if len(reply) <= _KEPT_BYTES else thinned(reply)[:_KEPT_BYTES]
        self.exchanges.append(Exchange(self.count, op.name, *kept, len(request), len(reply), took))
        self.times.setdefault(op.name, []).append(took)
        return reply

    async def raw(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op of the session, and return the reply, whatever it says.

        Raises:
            Differs: The reply is not a message.
        """
        declared = OPS.get(op, _ANY)
        request = {"op": op, "session_id": self.session_id, **fields}
        if issubclass(declared.request, ControlRequest):
            request.setdefault("control_owner", OWNER)
        frame = await self.frame(msgspec.msgpack.encode({k: v for k, v in request.items() if v is not ...}), declared)
        with expecting("a message"):
            reply = plain(frame)
            if not frame.startswith(b"{") and (other := other_numbers(frame)):
                self.numbers.setdefault(op, set()).update(other)
        self._hold(declared, reply)
        return reply

    async def job(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op, and return its reply, or what its job comes to, whatever that says."""
        reply = await self.raw(op, **fields)
        while OPS[op].needs is Needs.EDITOR and reply.get("op") == "op_started":
            await asyncio.sleep(_POLL_S)
            status = await self.ask("op_status", job_id=reply["job_id"])
            if status["state"] in {"done", "failed"}:
                return status["result"]
        return reply

    def _hold(self, op: Op, reply: dict[str, Any]) -> None:
        if reply.get("op") == "error":
            self.refusals.setdefault(str(reply.get("code")), op.name)
        if found := reply_oddities(op, reply):
            self.odd.setdefault(op.name, set()).update(found)

    async def ask(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op of the session, and return the successful reply, or that of its job.

        Raises:
            Differs: It was refused.
        """
        reply = await self.job(op, **fields)
        holds(reply.get("op") == OPS[op].reply_name, OPS[op].reply_name, _answered(op, reply))
        return reply

    async def refused(self, code: str, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op that must be refused with a code, at once or as a job, and return the refusal.

        Raises:
            Differs: It was not, or with another code.
        """
        reply = await self.job(op, **fields)
        refused = reply.get("op") == "error" and reply.get("code") == code
        holds(refused, f"{op} to be refused with {code}", _answered(op, reply))
        return reply

    async def follow(self, hello: HelloOk) -> None:
        """Adopt the regions of a handshake."""
        await self.transport.follow(hello)

    async def listen(self, endpoint: str, seconds: float, until: Callable[[list[Message]], bool]) -> list[Message]:
        """Return what a publisher sends, until that suffices or the time is over."""
        listener = _Listener(until)
        wanted = Subscription(endpoint, (b"",), lambda _: True)
        self._subscriptions.attach(listener, lambda: wanted)
        try:
            async with asyncio.timeout(seconds):
                await listener.done.wait()
        except TimeoutError:
            pass
        finally:
            self._subscriptions.detach(listener)
        return listener.messages


class Message(Struct):
    """A published message."""

    topic: bytes
    payload: bytes
    at: float


class _Listener(MessageHandler):
    def __init__(self, until: Callable[[list[Message]], bool]) -> None:
        self.messages: list[Message] = []
        self.done = asyncio.Event()
        self._until = until

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        if self.done.is_set():  # the task that waits has not run yet
            return
        self.messages.append(Message(topic, bytes(payload), time.perf_counter()))
        if self._until(self.messages):
            self.done.set()

    def on_malformed(self, problem: str) -> None:
        self.done.set()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self.done.set()


def _answered(op: str, reply: dict[str, Any]) -> str:
    if reply.get("op") == "error":
        return f"{op} refused with {reply.get('code')}: {reply.get('message', '')}"
    return f"{op} answered with {reply.get('op')!r}"


# Frames held against the declarations. The client ignores unknown fields and converts numbers, so that it can talk to
# newer servers; a check of a server wants to know of each of them.

_SIZED: Final = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
_CONTAINERS: Final = {0xDC: (1, 2), 0xDD: (1, 4), 0xDE: (2, 2), 0xDF: (2, 4)}
_PLAIN: Final = {
    **dict.fromkeys((*range(0x80), *range(0xE0, 0x100)), (0, "integer")),
    **{0xCC + i: (1 << i % 4, "integer") for i in range(8)},
    0xC0: (0, "nil"),
    0xC2: (0, ""),
    0xC3: (0, ""),
    0xCA: (4, "float32"),
    0xCB: (8, ""),
}
"""Bytes that follow the first one, and the kind of number."""


def other_numbers(frame: bytes) -> dict[str, int]:
    """Count what a msgpack frame has in place of float64 numbers: integers, float32 numbers and nil.

    Raises:
        ValueError: The frame is not one msgpack value.
    """
    found: Counter[str] = Counter()
    at, values = 0, 1  # each value stands before those that it contains, so counting what is still to come suffices
    while values and at < len(frame):
        first = frame[at]
        at, values = at + 1, values - 1
        if 0x80 <= first <= 0x9F:
            values += (first & 0x0F) * (2 if first < 0x90 else 1)
        elif 0xA0 <= first <= 0xBF:
            at += first & 0x1F
        elif first in _CONTAINERS:
            each, width = _CONTAINERS[first]
            values += each * int.from_bytes(frame[at : at + width], "big")
            at += width
        elif first in _SIZED:
            at += _SIZED[first] + int.from_bytes(frame[at : at + _SIZED[first]], "big")
        elif first in _PLAIN:
            width, kind = _PLAIN[first]
            at += width
            found.update([kind] if kind else [])
        else:
            raise ValueError("it is not msgpack")
    if values or at != len(frame):
        raise ValueError(f"the message ends at byte {at} of {len(frame)}")
    return dict(found)


def reply_oddities(op: Op, reply: dict[str, Any]) -> list[str]:
    """Return where a reply to an op departs from its declaration."""
    kinds: dict[str, type[Struct]] = {op.reply_name: op.reply, "error": ErrorReply, "op_started": OpStarted}
    kind = kinds.get(str(reply.get("op")))
    return [f"op is {reply.get('op')!r}"] if kind is None else oddities(reply, kind)


def oddities(value: Any, declared: Any) -> list[str]:
    """Return where a decoded reply departs from its declaration, one line for each place.

    Args:
        value: The reply as plain data.
        declared: The reply's struct, or any annotation.
    """
    return list(dict.fromkeys(_odd(value, _info(declared), "")))


@cache
def _info(declared: Any) -> inspect.Type:
    with building():
        return inspect.type_info(declared)


def _odd(value: Any, info: inspect.Type, where: str) -> Iterator[str]:
    match info:
        case inspect.Metadata():
            yield from _odd(value, info.type, where)
        case inspect.AnyType() | inspect.RawType():
            return
        case inspect.UnionType():
            kinds = [one for one in info.types if value is None or not isinstance(one, inspect.NoneType)]
            # The alternative of the right kind, whatever is wrong inside.
            yield from min(
                (list(_odd(value, one, where)) for one in kinds),
                key=lambda lines: (any(line.startswith(f"{where[1:]} is ") for line in lines), len(lines)),
            )
        case inspect.StructType():
            yield from _odd_map(value, info, where)
        case inspect.DictType() if isinstance(value, dict):
            for key, item in cast("dict[str, Any]", value).items():
                yield from _odd(item, info.value_type, f"{where}.{key}")
        case inspect.ListType() | inspect.VarTupleType() if isinstance(value, list):
            for item in cast("list[Any]", value):
                yield from _odd(item, info.item_type, f"{where}[]")
        case inspect.TupleType() if isinstance(value, list) and len(cast("list[Any]", value)) == len(info.item_types):
            for item, kind in zip(cast("list[Any]", value), info.item_types, strict=True):
                yield from _odd(item, kind, f"{where}[]")
        case _ if not _fits(value, info):
            yield f"{where[1:]} is {_said(value)}, declared {_named(info)}"
        case _:
            return


def _odd_map(value: Any, info: inspect.StructType, where: str) -> Iterator[str]:
    if not isinstance(value, dict):
        yield f"{where[1:] or 'the reply'} is {_said(value)}, declared a map"
        return
    given = dict(cast("dict[str, Any]", value))
    if info.tag_field is not None:
        given.pop(info.tag_field, None)
    for field in info.fields:
        if field.encode_name in given:
            yield from _odd(given.pop(field.encode_name), field.type, f"{where}.{field.encode_name}")
        elif field.required:
            yield f"{where[1:]}{'.' if where else ''}{field.encode_name} is missing"
    for name in given:
        yield f"{where[1:]}{'.' if where else ''}{name} is not declared"


_SCALARS: Final[dict[type[inspect.Type], type]] = {
    inspect.BoolType: bool,
    inspect.StrType: str,
    inspect.BytesType: bytes,
    inspect.NoneType: type(None),
}


def _fits(value: Any, info: inspect.Type) -> bool:
    match info:
        case inspect.FloatType():
            return _is_number(value)
        case inspect.IntType():
            return _is_number(value) and float(value).is_integer()
        case inspect.LiteralType():
            return value in info.values
        case inspect.EnumType():
            return value in {member.value for member in info.cls}
        case inspect.CustomType():  # an array
            return isinstance(value, list) and all(map(_is_number, cast("list[Any]", value)))
        case _:
            return isinstance(value, _SCALARS.get(type(info), ()))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _named(info: inspect.Type) -> str:
    if isinstance(info, inspect.CustomType):
        return "numbers"
    return type(info).__name__.removesuffix("Type").lower()


def _said(value: Any) -> str:
    return f"{type(value).__name__} {value!r:.40}"


def codec_of(frame: bytes) -> Any:
    """Return the module that decodes and encodes a frame: msgspec's JSON, which the first byte shows, or msgpack."""
    return msgspec.json if frame[:1] == b"{" else msgspec.msgpack


def plain(frame: bytes) -> dict[str, Any]:
    """Return a reply as plain data; the first byte shows whether it is msgpack or JSON.

    Raises:
        ValueError: It is neither, or not a map.
    """
    try:
        value = codec_of(frame).decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"a reply of {len(frame)} bytes cannot be decoded: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"a reply is {_said(value)} instead of a map")  # noqa: TRY004 - of the wire, not of a caller
    return cast("dict[str, Any]", value)


_LONG: Final = 1024


def thinned(frame: bytes) -> bytes:
    """Return a reply with the size in the place of each long text and each long run of bytes."""

    def visit(value: Any) -> Any:
        match value:
            case str() | bytes() if len(value) > _LONG:
                return f"({len(value)} bytes)"
            case dict():
                return {name: visit(item) for name, item in cast("dict[str, Any]", value).items()}
            case list():
                return [visit(item) for item in cast("list[Any]", value)]
            case _:
                return value

    try:
        return codec_of(frame).encode(visit(plain(frame)))
    except ValueError:
        return frame
