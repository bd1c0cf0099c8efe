"""What requests over ZeroMQ and over shared memory share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeAlias

from msgspec import Struct

from urlab_client.errors import ConnectionLost, OutcomeUnknown, URLabError, URLabTimeoutError
from urlab_client.protocol.base import Effect, Op

LateReply: TypeAlias = Callable[[asyncio.Future[bytes]], None]
"""Callback invoked with a future when the caller abandons a request that was sent. The future receives the late reply,
or is cancelled if none can arrive.
"""


class Deadlines(Struct, frozen=True):
    """Loop times until which to wait for the reply to a request, and for its connection; None waits without limit."""

    reply: float | None
    connect: float | None


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
