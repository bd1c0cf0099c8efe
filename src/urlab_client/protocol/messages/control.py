"""Ops with which a client becomes the owner of a robot; newer servers refuse writes from other clients."""

from __future__ import annotations

from typing import Annotated, Final

from urlab_client.errors import UNCLAIMED
from urlab_client.protocol.base import ControlRequest, Needs, Op, Reply, doc

__all__ = ["OPS", "UNCLAIMED", "ClaimControl", "ClaimControlOk", "ReleaseControl", "ReleaseControlOk"]


class ClaimControlOk(Reply, tag="claim_control_ok", kw_only=True):
    """The client owns the robot."""

    articulation: Annotated[str, doc("Engine's object name, regardless of the requested name.")]
    owner: Annotated[str, doc("Owner: `control_owner`, or the session id if the server does not read that field.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim expires; 0 for never.")]


class ClaimControl(ControlRequest[ClaimControlOk], tag="claim_control", kw_only=True):
    """Become the only owner of a robot, or renew the ownership."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim expires; 0 or less for never.")] = 0.0
    force: Annotated[bool, doc("Take the robot from its owner.")] = False


class ReleaseControlOk(Reply, tag="release_control_ok", kw_only=True):
    """The robot has no owner."""

    articulation: Annotated[str, doc("Engine's object name, regardless of the requested name.")]


class ReleaseControl(ControlRequest[ReleaseControlOk], tag="release_control", kw_only=True):
    """Release a robot."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]


OPS: Final = (
    Op(
        request=ClaimControl,
        ns="runtime",
        needs=Needs.MANAGER,
        errors=("not_ready", "missing_field", "unknown_articulation", "control_claimed"),
        dialects=("beta",),
    ),
    Op(
        request=ReleaseControl,
        ns="runtime",
        needs=Needs.MANAGER,
        errors=("not_ready", "missing_field", "unknown_articulation", "not_control_owner"),
        dialects=("beta",),
    ),
)
