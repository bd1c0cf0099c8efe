"""Handlers of claims, leases, jobs and user channels."""

from __future__ import annotations

from typing import Any

from urlab_client.protocol.base import ControlRequest
from urlab_client.protocol.messages import control, farm, jobs, runtime
from urlab_client.server.core import ServerCore
from urlab_client.server.physics.channels import SCENE
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


def _owner(request: ControlRequest[Any]) -> str:
    return request.control_owner or request.session_id


def check_owner(server: ServerCore, request: ControlRequest[Any], robot: ArticulationControl) -> None:
    """Refuse a write to a robot by a client that does not own it, if robots have owners."""
    if server.dialect.claims:
        server.play.running().claims.check(robot.index.key, _owner(request))


def check_all_owners(server: ServerCore, request: ControlRequest[Any]) -> None:
    """Refuse a write to all robots while another client owns one of them, if robots have owners."""
    if server.dialect.claims:
        running = server.play.running()
        keys = [robot.index.key for robot in running.engine.articulations.controls.values()]
        running.claims.check_all(keys, _owner(request))


@handles(control.ClaimControl)
def claim_control(server: ServerCore, request: control.ClaimControl) -> control.ClaimControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    owner = _owner(request)
    running.claims.claim(key, owner, request.ttl_s, force=request.force)
    return control.ClaimControlOk(articulation=key, owner=owner, ttl_s=request.ttl_s)


@handles(control.ReleaseControl)
def release_control(server: ServerCore, request: control.ReleaseControl) -> control.ReleaseControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    running.claims.release(key, _owner(request))
    return control.ReleaseControlOk(articulation=key)


@handles(farm.AcquireLease)
def acquire_lease(server: ServerCore, request: farm.AcquireLease) -> farm.AcquireLeaseOk:
    return farm.AcquireLeaseOk(lease_id=server.lease.acquire(request.ttl_s), ttl_s=request.ttl_s)


@handles(farm.ReleaseLease)
def release_lease(server: ServerCore, request: farm.ReleaseLease) -> farm.ReleaseLeaseOk:
    server.lease.release(usable(request.lease_id, ""))
    return farm.ReleaseLeaseOk()


@handles(jobs.OpStatus)
def op_status(server: ServerCore, request: jobs.OpStatus) -> jobs.OpStatusOk:
    job = usable(request.job_id, "")
    if not job:
        raise Refusal("bad_request", "op_status: field 'job_id' is empty or cannot be read as text")
    result = server.jobs.take(job)
    if result is None:
        return jobs.OpStatusOk(job_id=job, state="running")
    return jobs.OpStatusOk(job_id=job, state="failed" if result["op"] == "error" else "done", result=result)


@handles(runtime.SetUserChannels)
def set_user_channels(server: ServerCore, request: runtime.SetUserChannels) -> runtime.SetUserChannelsOk:
    running = server.play.running()
    applied = 0
    rejected: dict[str, str] = {}
    for name, values in (request.arts or {}).items():
        robot = running.engine.articulations.find(name)
        owner = name if robot is None else running.engine.articulations.name(robot)
        for channel, value in values.items():
            reason = running.channels.write(owner, channel, value)
            applied += reason is None
            if reason is not None:
                rejected[f"{name}/{channel}"] = reason
    for channel, value in (request.scene or {}).items():
        reason = running.channels.write(SCENE, channel, value)
        applied += reason is None
        if reason is not None:
            rejected[f"{SCENE}/{channel}"] = reason
    return runtime.SetUserChannelsOk(applied=applied, rejected=rejected)
