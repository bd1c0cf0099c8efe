"""Ops of `client.farm`: leases, with which clients share servers."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc


class AcquireLeaseOk(Reply, tag="acquire_lease_ok", kw_only=True):
    """The lease."""

    lease_id: Annotated[str, doc("Id for `release_lease`.")]
    ttl_s: Annotated[float, doc("Seconds without a request after which the lease expires.")]


class AcquireLease(Request[AcquireLeaseOk], tag="acquire_lease", kw_only=True):
    """Acquire the server's only driver lease and return its id.

    The lease is advisory: it shows other clients that the server is in use, and the server does not enforce it.
    Every request keeps it alive.
    """

    owner: Annotated[str, doc("Human-readable name of the holder.")] = ""
    ttl_s: Annotated[float, doc("Seconds without a request until the lease expires; 0 or less for immediately.")] = 60.0


class ReleaseLeaseOk(Reply, tag="release_lease_ok", kw_only=True):
    """The lease is free."""


class ReleaseLease(Request[ReleaseLeaseOk], tag="release_lease", kw_only=True):
    """Release the driver lease."""

    lease_id: Annotated[str, doc("Return value of `acquire_lease`.")]


_lease_op = partial(Op, ns="farm", needs=Needs.NOTHING, generated=True, positional=1, dialects=("beta",))

OPS: Final = (
    _lease_op(request=AcquireLease, errors=("busy",), returns="lease_id"),
    _lease_op(request=ReleaseLease, undeclared=("lease_id",)),
)
