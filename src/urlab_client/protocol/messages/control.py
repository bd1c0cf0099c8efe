"""Ops by which a client becomes the owner of a robot, without which newer servers refuse its writes."""

from __future__ import annotations

from typing import Annotated, Final

from urlab_client.protocol.base import ControlRequest, Needs, Op, Reply, doc

__all__ = ["OPS", "UNCLAIMED", "ClaimControl", "ClaimControlOk", "ReleaseControl", "ReleaseControlOk"]

UNCLAIMED: Final = "(unclaimed)"
"""What a server names as owner of a robot that nobody owns."""


class ClaimControlOk(Reply, tag="claim_control_ok", kw_only=True):
    """The robot is the client's."""

    articulation: Annotated[str, doc("Engine's object name, whatever was asked for.")]
    owner: Annotated[str, doc("Who owns it: `control_owner`, or the session id where the server does not read that.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim ends; 0 for never.")]


class ClaimControl(ControlRequest[ClaimControlOk], tag="claim_control", kw_only=True, omit_defaults=True):
    """Become the one owner of a robot, or stay it."""

    articulation: Annotated[str, doc("Articulation key, actor id or engine's object name.")]
    ttl_s: Annotated[float, doc("Seconds without a write after which the claim ends; 0 or less for never.")] = 0.0
    force: Annotated[bool, doc("Take the robot from its owner.")] = False


class ReleaseControlOk(Reply, tag="release_control_ok", kw_only=True):
    """The robot is nobody's."""

    articulation: Annotated[str, doc("Engine's object name, whatever was asked for.")]


class ReleaseControl(ControlRequest[ReleaseControlOk], tag="release_control", kw_only=True, omit_defaults=True):
    """Give up a robot."""

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
