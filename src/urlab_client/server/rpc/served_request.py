"""What a server tells of a request that it has answered."""

from __future__ import annotations

from msgspec import Struct

__all__ = ["ServedRequest"]


class ServedRequest(Struct, frozen=True, kw_only=True):
    """A request that was answered; see `SimulatedServer.add_request_callback`.

    Attributes:
        op: Its op; `unknown` if the server has none of that name.
        error: Code of the error that it was answered with; empty if none.
        seconds: Time from its turn to the reply.
        request_bytes: Size of the request.
        reply_bytes: Size of the reply.
    """

    op: str
    error: str
    seconds: float
    request_bytes: int
    reply_bytes: int
