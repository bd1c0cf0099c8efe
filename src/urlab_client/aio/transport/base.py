"""The interface between a session and its transport."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol, TypeAlias

from msgspec import Struct

from urlab_client.errors import ConnectionLost, OutcomeUnknown, URLabError, URLabTimeoutError
from urlab_client.events import ClientEvent
from urlab_client.protocol.base import Effect, Op
from urlab_client.protocol.messages.session import HelloOk

LateReply: TypeAlias = Callable[[asyncio.Future[bytes]], None]
"""Callback invoked with a future when the caller abandons a request that was sent. The future receives the late reply,
or is cancelled if none can arrive.
"""


class TransportStats(Struct):
    """Counters of one client's requests.

    Attributes:
        sent: Requests handed to the transport.
        received: Replies matched to a request.
        late: Replies that arrived after their request was abandoned; dropped.
        connects: Connections opened; more than one means that the server was lost and found again.
        over_shm: Requests sent over shared memory.
        over_zmq: With `transport="shm"`, number of requests sent over ZMQ instead, by reason.
    """

    sent: int = 0
    received: int = 0
    late: int = 0
    connects: int = 0
    over_shm: int = 0
    over_zmq: dict[str, int] = {}


class SentRequest(Struct):
    """A request on its way, and the loop times of its sending and its deadline."""

    op: Op
    reply: asyncio.Future[bytes]
    at: float
    deadline: float | None


class RequestTransport(Protocol):
    """Sends requests and returns their replies. Use from one event loop."""

    stats: TransportStats
    on_event: Callable[[ClientEvent], None] | None
    """Callback invoked when the connection is opened, lost or restored."""

    @property
    def state_port(self) -> int | None:
        """Port of the state stream if the transport knows it; None if it is configured separately."""
        ...

    @property
    def endpoint(self) -> str:
        """Address that requests go to, for messages."""
        ...

    @property
    def connected(self) -> bool:
        """Whether a server is connected."""
        ...

    @property
    def owed(self) -> bool:
        """Whether the server has yet to answer a request whose caller gave up, so that it may still execute it."""
        ...

    async def request(
        self, frame: bytes, op: Op, *, deadline: float | None, connect_by: float | None, late: LateReply | None = None
    ) -> bytes:
        """Send `frame` and return the reply's bytes.

        Args:
            frame: The encoded request.
            op: Its op, which errors name and which determines the meaning of a lost reply.
            deadline: Loop time at which to give up; None waits without limit.
            connect_by: Loop time by which a connection must be open; None waits without limit.
            late: Callback invoked with a future for the reply when this call is cancelled or times out after sending;
                None drops the reply.

        Raises:
            ServerUnreachable: No connection was open by `connect_by`; nothing was sent.
            URLabTimeoutError: The request was sent, but no reply arrived by `deadline`.
            ConnectionLost: The connection broke after sending; the op changes nothing.
            OutcomeUnknown: The connection broke after sending; the op may have been executed.
            ClientClosed: The client was closed.
        """
        ...

    async def follow(self, hello: HelloOk) -> None:
        """Adopt the alternative transports that a handshake describes.

        Raises:
            URLabConnectionError: The requested transport is not available.
        """
        ...

    async def aclose(self) -> None:
        """Fail all pending requests and release all resources. Idempotent."""
        ...


def lost(op: Op, what: str) -> URLabError:
    """Return the error for a request that was sent when `what`, the connection or the server, was lost."""
    text = f"{op.name}: {what} was lost after the request was sent."
    if op.effect is Effect.READ:
        return ConnectionLost(text, op=op.name, hint="The op changes nothing, so it can be sent again.")
    hint = "It may have been executed: client.resync() determines the outcome and recovers."
    return OutcomeUnknown(text, op=op.name, hint=hint)


def no_reply(op: Op, where: str, seconds: float) -> URLabTimeoutError:
    """Return the error for a request that was sent and not answered by its deadline."""
    executed = "" if op.effect is Effect.READ else " The request was sent and may still be executed."
    return URLabTimeoutError(
        f"{op.name}: no reply {where} within {seconds * 1000:.0f} ms.{executed}",
        op=op.name,
        hint="The connection is up, so the server is busy or blocked; allow more time with timeout=…",
    )
