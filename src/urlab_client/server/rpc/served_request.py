"""The record of a request that a server has answered."""

from __future__ import annotations

from msgspec import Struct

__all__ = ["ServedRequest"]


class ServedRequest(Struct, frozen=True, kw_only=True):
    """An answered request; see `SimulatedServer.add_request_callback`.

    Attributes:
        op: Its op; `unknown` if the server does not have it.
        error: Code of the error reply; empty if there was no error.
        seconds: Time from its turn to the reply.
        request_bytes: Size of the request.
        reply_bytes: Size of the reply.
    """

    op: str
    error: str
    seconds: float
    request_bytes: int
    reply_bytes: int
