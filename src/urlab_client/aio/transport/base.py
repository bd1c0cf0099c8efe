"""What a session needs from a transport."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol, TypeAlias

from msgspec import Struct

from urlab_client.protocol.base import Op
from urlab_client.protocol.messages.session import HelloOk
from urlab_client.protocol.messages.streams import ClientEvent

__all__ = ["LateReply", "RequestTransport", "TransportStats"]

LateReply: TypeAlias = Callable[[asyncio.Future[bytes]], None]
"""Told of a request that left and whose caller gave up: the future gets the reply, or is cancelled when none can come.
"""


class TransportStats(Struct):
    """Counters of one client's requests.

    Attributes:
        sent: Requests handed to the transport.
        received: Replies matched to a request.
        late: Replies that came after their request had given up; dropped.
        connects: Connections made; more than one means the server was lost and found again.
        over_shm: Requests among those sent that went over shared memory.
        over_zmq: With `transport="shm"`, how many requests that went over ZMQ all the same, by reason.
    """

    sent: int = 0
    received: int = 0
    late: int = 0
    connects: int = 0
    over_shm: int = 0
    over_zmq: dict[str, int] = {}


class RequestTransport(Protocol):
    """One request at a time goes out, one reply comes back. Used from one event loop."""

    stats: TransportStats
    on_event: Callable[[ClientEvent], None] | None
    """Told when the connection is made, lost and restored."""

    @property
    def state_port(self) -> int | None:
        """Port of the state stream where the transport knows it, None where that is a matter of configuration."""
        ...

    @property
    def endpoint(self) -> str:
        """Where requests go, for messages."""
        ...

    @property
    def connected(self) -> bool:
        """Whether a server is on the line."""
        ...

    async def request(
        self, frame: bytes, op: Op, *, deadline: float | None, connect_by: float | None, late: LateReply | None = None
    ) -> bytes:
        """Send `frame` and return the reply's bytes.

        Args:
            frame: The encoded request.
            op: Its op: named in errors, and decides what a lost reply means.
            deadline: Loop time at which to give up; None waits.
            connect_by: Loop time by which a connection must stand; None waits.
            late: Told, when this is cancelled or times out after sending, where the reply will be; None drops it.

        Raises:
            ServerUnreachable: No connection by `connect_by`; nothing was sent.
            URLabTimeoutError: Sent, but no reply by `deadline`.
            ConnectionLost: The connection broke after sending; the op changes nothing.
            OutcomeUnknown: The connection broke after sending; the op may have been executed.
            ClientClosed: The client was closed.
        """
        ...

    async def follow(self, hello: HelloOk) -> None:
        """Take over what a handshake says about other ways to the server.

        Raises:
            URLabConnectionError: The way that was asked for is not there.
        """
        ...

    async def aclose(self) -> None:
        """Fail what is waiting and release everything. Idempotent."""
        ...
