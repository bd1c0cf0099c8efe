"""Ops of `client.farm`: which of several clients may use a server."""

from __future__ import annotations

from typing import Annotated, Final

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc

__all__ = ["OPS", "AcquireLease", "AcquireLeaseOk", "ReleaseLease", "ReleaseLeaseOk"]


class AcquireLeaseOk(Reply, tag="acquire_lease_ok", kw_only=True):
    """The lease."""

    lease_id: Annotated[str, doc("Id to give it back with.")]
    ttl_s: Annotated[float, doc("Seconds without a request after which it ends.")]


class AcquireLease(Request[AcquireLeaseOk], tag="acquire_lease", kw_only=True, omit_defaults=True):
    """Take the server's one driver lease and return its id.

    The server enforces nothing by it: it tells other clients that the server is in use. Every request keeps it
    alive.
    """

    owner: Annotated[str, doc("Who takes it, for people.")] = ""
    ttl_s: Annotated[float, doc("Seconds without a request after which it ends; 0 or less ends it at once.")] = 60.0


class ReleaseLeaseOk(Reply, tag="release_lease_ok", kw_only=True):
    """The lease is free."""


class ReleaseLease(Request[ReleaseLeaseOk], tag="release_lease", kw_only=True):
    """Give the driver lease back."""

    lease_id: Annotated[str, doc("What `acquire_lease` returned.")]


OPS: Final = (
    Op(
        request=AcquireLease,
        ns="farm",
        needs=Needs.NOTHING,
        errors=("not_ready", "busy"),
        generated=True,
        returns="lease_id",
        positional=1,
        dialects=("beta",),
    ),
    Op(
        request=ReleaseLease,
        ns="farm",
        needs=Needs.NOTHING,
        errors=("not_ready", "bad_request"),
        generated=True,
        positional=1,
        undeclared=("lease_id",),
        dialects=("beta",),
    ),
)
