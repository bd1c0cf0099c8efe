"""Handlers of claims, leases, jobs and user channels."""

from __future__ import annotations

from typing import Any

from urlab_client.protocol.base import ControlRequest
from urlab_client.protocol.messages.control import ClaimControl, ClaimControlOk, ReleaseControl, ReleaseControlOk
from urlab_client.protocol.messages.farm import AcquireLease, AcquireLeaseOk, ReleaseLease, ReleaseLeaseOk
from urlab_client.protocol.messages.jobs import OpStatus, OpStatusOk
from urlab_client.protocol.messages.runtime import SetUserChannels, SetUserChannelsOk
from urlab_client.server.core import ServerCore
from urlab_client.server.physics.channels import SCENE
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


def _owner(request: ControlRequest[Any]) -> str:
    return request.control_owner or request.session_id


def check_owner(server: ServerCore, request: ControlRequest[Any], control: ArticulationControl) -> None:
    """Refuse a write to a robot by a client that does not own it, if robots have owners.

    Raises:
        Refusal: `not_control_owner`.
    """
    if server.dialect.claims:
        server.play.running().claims.check(control.index.key, _owner(request))


def check_all_owners(server: ServerCore, request: ControlRequest[Any]) -> None:
    """Refuse a write to all robots while another client owns one of them, if robots have owners.

    Raises:
        Refusal: `not_control_owner`.
    """
    if server.dialect.claims:
        running = server.play.running()
        keys = [control.index.key for control in running.engine.articulations.controls.values()]
        running.claims.check_all(keys, _owner(request))


@handles(ClaimControl)
def claim_control(server: ServerCore, request: ClaimControl) -> ClaimControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    owner = _owner(request)
    running.claims.claim(key, owner, request.ttl_s, force=request.force)
    return ClaimControlOk(articulation=key, owner=owner, ttl_s=request.ttl_s)


@handles(ReleaseControl)
def release_control(server: ServerCore, request: ReleaseControl) -> ReleaseControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    running.claims.release(key, _owner(request))
    return ReleaseControlOk(articulation=key)


@handles(AcquireLease)
def acquire_lease(server: ServerCore, request: AcquireLease) -> AcquireLeaseOk:
    return AcquireLeaseOk(lease_id=server.lease.acquire(request.ttl_s), ttl_s=request.ttl_s)


@handles(ReleaseLease)
def release_lease(server: ServerCore, request: ReleaseLease) -> ReleaseLeaseOk:
    server.lease.release(usable(request.lease_id, ""))
    return ReleaseLeaseOk()


@handles(OpStatus)
def op_status(server: ServerCore, request: OpStatus) -> OpStatusOk:
    job = usable(request.job_id, "")
    if not job:
        raise Refusal("bad_request", "op_status: field 'job_id' is empty or cannot be read as text")
    result = server.jobs.take(job)
    if result is None:
        return OpStatusOk(job_id=job, state="running")
    return OpStatusOk(job_id=job, state="failed" if result["op"] == "error" else "done", result=result)


@handles(SetUserChannels)
def set_user_channels(server: ServerCore, request: SetUserChannels) -> SetUserChannelsOk:
    running = server.play.running()
    applied = 0
    rejected: dict[str, str] = {}
    for robot, values in (request.arts or {}).items():
        control = running.engine.articulations.find(robot)
        owner = robot if control is None else running.engine.articulations.name(control)
        for channel, value in values.items():
            reason = running.channels.write(owner, channel, value)
            applied += reason is None
            if reason is not None:
                rejected[f"{robot}/{channel}"] = reason
    for channel, value in (request.scene or {}).items():
        reason = running.channels.write(SCENE, channel, value)
        applied += reason is None
        if reason is not None:
            rejected[f"{SCENE}/{channel}"] = reason
    return SetUserChannelsOk(applied=applied, rejected=rejected)
