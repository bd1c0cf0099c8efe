"""Bare requests to a server, with every exchange recorded: nothing of the client's own behaviour stands between."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import msgspec
from msgspec import Struct

from urlab_client.aio.launch import transport_to
from urlab_client.aio.transport.base import RequestTransport
from urlab_client.aio.transport.connection import ClientKeys
from urlab_client.aio.transport.shm import ShmTransport
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.conformance.declarations import Differs
from urlab_client.conformance.frames import oddities, other_numbers, plain, thinned
from urlab_client.errors import URLabError
from urlab_client.protocol.base import ControlRequest, Op
from urlab_client.protocol.messages.jobs import OpStarted
from urlab_client.protocol.messages.session import ErrorReply, HelloOk
from urlab_client.protocol.registry import OPS
from urlab_client.values.layouts import BytesLike

OWNER: Final = "urlab-conformance"
"""Name under which the run claims robots."""

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
        session_id: Of the last handshake.
        exchanges: The newest exchanges.
        count: Number of exchanges so far.
        odd: By op, how its replies depart from their declarations.
        numbers: By op, numbers in replies that are not float64.
        refusals: Codes of refusals, with the op of each.
        times: Seconds of each op's exchanges.
    """

    def __init__(self, address: str, step_port: int, keys: ClientKeys | None, *, shm: bool, timeout: float) -> None:
        inner = transport_to(address, step_port, keys, shm=shm)
        self.regions: ServerRegions | None = ServerRegions(None) if shm else None
        self._transport: RequestTransport = inner if self.regions is None else ShmTransport(inner, self.regions)
        self._subscriptions = Subscriptions(keys)
        self._timeout = timeout
        self.session_id: str = ""
        self.exchanges: deque[Exchange] = deque(maxlen=_KEPT)
        self.count: int = 0
        self.odd: dict[str, set[str]] = {}
        self.numbers: dict[str, set[str]] = {}
        self.refusals: dict[str, str] = {}
        self.times: dict[str, list[float]] = {}

    @property
    def endpoint(self) -> str:
        """Address that the requests go to."""
        return self._transport.endpoint

    @property
    def state_port(self) -> int | None:
        """Port of the state stream, of a server that this process started."""
        return self._transport.state_port

    @property
    def over_shm(self) -> int:
        """Number of requests that went through shared memory."""
        return self._transport.stats.over_shm

    async def aclose(self) -> None:
        """Close the connection."""
        self._subscriptions.close()
        await self._transport.aclose()

    async def frame(self, request: bytes, op: Op = _ANY, *, timeout: float | None = None) -> bytes:
        """Send bytes as they are, and return the reply as it is."""
        loop = asyncio.get_running_loop()
        limit = max(self._timeout, op.timeout or 0.0) if timeout is None else timeout
        started = time.perf_counter()
        reply = await self._transport.request(
            request, op, deadline=loop.time() + limit, connect_by=loop.time() + self._timeout
        )
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
        try:
            reply = plain(frame)
            if not frame.startswith(b"{") and (other := other_numbers(frame)):
                self.numbers.setdefault(op, set()).update(other)
        except ValueError as error:
            raise Differs("a message", str(error)) from error
        self._hold(declared, reply)
        return reply

    def _hold(self, op: Op, reply: dict[str, Any]) -> None:
        kinds = {op.reply_name: op.reply, "error": ErrorReply, "op_started": OpStarted}
        kind = kinds.get(reply.get("op", ""))
        if kind is ErrorReply:
            self.refusals.setdefault(str(reply.get("code")), op.name)
        found = [f"op is {reply.get('op')!r}"] if kind is None else oddities(reply, kind)
        if found:
            self.odd.setdefault(op.name, set()).update(found)

    async def ask(self, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op of the session, and return the successful reply.

        Raises:
            Differs: It was refused.
        """
        reply = await self.raw(op, **fields)
        if reply.get("op") != OPS[op].reply_name:
            raise Differs(OPS[op].reply_name, _said(op, reply))
        return reply

    async def refused(self, code: str, op: str, /, **fields: Any) -> dict[str, Any]:
        """Send an op that must be refused with a code, and return the refusal.

        Raises:
            Differs: It was not, or with another code.
        """
        reply = await self.raw(op, **fields)
        if reply.get("op") != "error" or reply.get("code") != code:
            raise Differs(f"{op} to be refused with {code}", _said(op, reply))
        return reply

    async def follow(self, hello: HelloOk) -> None:
        """Adopt the regions of a handshake."""
        await self._transport.follow(hello)

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
        self.messages.append(Message(topic, bytes(payload), time.perf_counter()))
        if self._until(self.messages):
            self.done.set()

    def on_malformed(self, problem: str) -> None:
        self.done.set()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self.done.set()


def _said(op: str, reply: dict[str, Any]) -> str:
    if reply.get("op") == "error":
        return f"{op} refused with {reply.get('code')}: {reply.get('message', '')}"
    return f"{op} answered with {reply.get('op')!r}"
