"""Handlers of the `runtime` and `farm` ops: changes to the running simulation, and who may make them."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any, Final, TypeVar

import msgspec
import mujoco
import numpy as np
from msgspec import field

from urlab_client.enums import StepMode
from urlab_client.protocol.base import ControlRequest, Request
from urlab_client.protocol.messages import cameras, farm, jobs, runtime
from urlab_client.server.core import ServerCore
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.physics.controllers import ArticulationControl, ControlSource
from urlab_client.server.physics.engine import Engine
from urlab_client.server.physics.observe import SCENE
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable
from urlab_client.simulation.controllers import float32
from urlab_client.values.rotation import Quat, Vec3
from urlab_client.values.types import Contact, KeyframeInfo


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


@handles(runtime.ClaimControl)
def claim_control(server: ServerCore, request: runtime.ClaimControl) -> runtime.ClaimControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    owner = _owner(request)
    running.claims.claim(key, owner, request.ttl_s, force=request.force)
    return runtime.ClaimControlOk(articulation=key, owner=owner, ttl_s=request.ttl_s)


@handles(runtime.ReleaseControl)
def release_control(server: ServerCore, request: runtime.ReleaseControl) -> runtime.ReleaseControlOk:
    running = server.play.running()
    key = running.engine.articulations.control(need(request, request.articulation, "articulation")).index.key
    running.claims.release(key, _owner(request))
    return runtime.ReleaseControlOk(articulation=key)


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
    robots = running.engine.articulations
    named = [
        (name, name if (robot := robots.find(name)) is None else robots.names[robot.index.key], values)
        for name, values in (request.arts or {}).items()
    ]
    for name, owner, values in [*named, (SCENE, SCENE, request.scene or {})]:  # a robot may have the scene's name
        for channel, value in values.items():
            reason = running.channels.write(owner, channel, value)
            applied += reason is None
            if reason is not None:
                rejected[f"{name}/{channel}"] = reason
    return runtime.SetUserChannelsOk(applied=applied, rejected=rejected)


MAX_CONTACTS: Final = 64


@handles(runtime.SetMode)
def set_mode(server: ServerCore, request: runtime.SetMode) -> runtime.SetModeOk:
    engine = server.play.running().engine
    if engine.pinned_mode is not None:
        engine.set_mode(StepMode.LIVE)  # refuses before the field is checked
    previous, current = engine.set_mode(parse_mode(need(request, request.mode, "mode"), server.dialect))
    return runtime.SetModeOk(previous_mode=previous, current_mode=current)


@handles(runtime.SetPaused)
def set_paused(server: ServerCore, request: runtime.SetPaused) -> runtime.SetPausedOk:
    engine = server.play.running().engine
    return runtime.SetPausedOk(paused=engine.set_paused(need(request, request.paused, "paused")))


@handles(runtime.SetSimSpeed)
def set_sim_speed(server: ServerCore, request: runtime.SetSimSpeed) -> runtime.SetSimSpeedOk:
    engine = server.play.running().engine
    percent = need(request, request.percent, "percent")
    if math.isnan(percent):
        raise Refusal("missing_field", "set_sim_speed: field 'percent' is not a number")
    return runtime.SetSimSpeedOk(percent=engine.set_sim_speed(percent))


@handles(runtime.SetControlSource)
def set_control_source(server: ServerCore, request: runtime.SetControlSource) -> runtime.SetControlSourceOk:
    engine = server.play.running().engine
    source = parse_control_source(need(request, request.source, "source"))
    key = request.articulation or None
    if key is None:
        check_all_owners(server, request)
    else:
        check_owner(server, request, engine.articulations.control(key))
    with engine.commanding() as articulations:
        articulations.set_source(source, key)
    return runtime.SetControlSourceOk(source=source, scope="articulation" if key else "global", articulation=key)


class AnyTwist(runtime.SetTwist, tag="set_twist", kw_only=True):
    """Reads vectors of any length; missing elements count as 0."""

    # Clients send three numbers, as declared; a server accepts any number of them.
    linear: list[float] = field(default_factory=list[float])  # pyright: ignore[reportIncompatibleVariableOverride]
    angular: list[float] = field(default_factory=list[float])  # pyright: ignore[reportIncompatibleVariableOverride]


@handles(AnyTwist)
def set_twist(server: ServerCore, request: AnyTwist) -> runtime.SetTwistOk:
    engine = server.play.running().engine
    key = need(request, request.articulation, "articulation")
    check_owner(server, request, engine.articulations.control(key))
    with engine.lock:
        twist = engine.articulations.set_twist(key, request.linear, request.angular)
    return runtime.SetTwistOk(articulation=key, linear=twist.linear, angular=twist.angular)


@handles(runtime.ConfigureController)
def configure_controller(server: ServerCore, request: runtime.ConfigureController) -> runtime.ConfigureControllerOk:
    engine = server.play.running().engine
    key = need(request, request.articulation, "articulation")
    with engine.commanding() as articulations:
        params = articulations.configure_controller(key, request.params)
    return runtime.ConfigureControllerOk(articulation=key, params=params)


@handles(runtime.SetQpos)
def set_qpos(server: ServerCore, request: runtime.SetQpos) -> runtime.SetQposOk:
    running = server.play.running()
    engine, model, data = running.engine, running.scene.model, running.scene.data
    target = need(request, request.target, "target")
    by_name = request.target_by == "actor_name"
    control = engine.articulations.control(target) if by_name else _by_actor_id(engine, target)
    check_owner(server, request, control)
    index = control.index
    qpos = need(request, request.qpos, "qpos")
    if not len(index.joints):
        raise Refusal("no_joints", f"articulation '{index.key}' has no joints")
    addresses = index.qpos_adr
    first_is_free = int(model.jnt_type[index.joints[0]]) == mujoco.mjtJoint.mjJNT_FREE
    shortcut = len(qpos) == 7 != len(addresses) and first_is_free
    if shortcut:
        addresses = addresses[:7]
    elif len(qpos) != len(addresses):
        or_base = ", or 7 for its free base" if first_is_free and len(addresses) != 7 else ""
        raise Refusal(
            "dim_mismatch", f"{len(qpos)} values given, articulation '{index.key}' takes {len(addresses)}{or_base}"
        )
    with engine.lock:
        data.qpos[addresses] = qpos
        engine.forward()
        written = data.qpos[addresses]
    return runtime.SetQposOk(
        target=target, actor_name=index.key, actor_id=index.actor_id, qpos=written, free_base_shortcut=shortcut
    )


def _by_actor_id(engine: Engine, actor_id: str) -> ArticulationControl:
    for control in engine.articulations.controls.values():
        if control.index.actor_id == actor_id:
            return control
    raise Refusal("unknown_articulation", actor_id)


@handles(runtime.SetMocapPose)
def set_mocap_pose(server: ServerCore, request: runtime.SetMocapPose) -> runtime.SetMocapPoseOk:
    running = server.play.running()
    body = need(request, request.body, "body")
    mocap = _mocap_id(running.scene.model, body)
    if request.pos is None and request.quat is None:
        raise Refusal("missing_field", "set_mocap_pose: give 'pos' (3 numbers), 'quat' (4 numbers, w x y z) or both")
    data = running.scene.data
    with running.engine.lock:
        if request.pos is not None:
            data.mocap_pos[mocap] = request.pos
        if request.quat is not None:
            data.mocap_quat[mocap] = request.quat
        pos, quat = _mocap_pose(data, mocap)
    return runtime.SetMocapPoseOk(body=body, pos=pos, quat=quat)


@handles(runtime.ReadMocapPose)
def read_mocap_pose(server: ServerCore, request: runtime.ReadMocapPose) -> runtime.ReadMocapPoseOk:
    running = server.play.running()
    body = need(request, request.body, "body")
    mocap = _mocap_id(running.scene.model, body)
    with running.engine.lock:
        pos, quat = _mocap_pose(running.scene.data, mocap)
    return runtime.ReadMocapPoseOk(body=body, pos=pos, quat=quat)


def _mocap_id(model: mujoco.MjModel, body: str) -> int:
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
    if number < 0:
        raise Refusal("unknown_body", body)
    mocap = int(model.body_mocapid[number])
    if mocap < 0:
        raise Refusal("not_mocap_body", f"body '{body}' is not a mocap body: its MJCF does not say mocap=\"true\"")
    return mocap


def _mocap_pose(data: mujoco.MjData, mocap: int) -> tuple[Vec3, Quat]:
    x, y, z = data.mocap_pos[mocap].tolist()
    qw, qx, qy, qz = data.mocap_quat[mocap].tolist()
    return (x, y, z), (qw, qx, qy, qz)


@handles(runtime.GetContacts)
def get_contacts(server: ServerCore, request: runtime.GetContacts) -> runtime.GetContactsOk:
    running = server.play.running()
    model, data = running.scene.model, running.scene.data
    limit = request.max_contacts if request.max_contacts > 0 else MAX_CONTACTS
    wanted = request.filter or runtime.ContactFilter()
    contacts: list[Contact] = []
    with running.engine.lock:
        for number in range(data.ncon):
            contact = _contact(model, data, number, wanted)
            if contact is None:
                continue
            if len(contacts) == limit:
                return runtime.GetContactsOk(n_contacts=limit, truncated=True, contacts=contacts)
            contacts.append(contact)
    return runtime.GetContactsOk(n_contacts=len(contacts), truncated=False, contacts=contacts)


def _contact(model: mujoco.MjModel, data: mujoco.MjData, number: int, wanted: runtime.ContactFilter) -> Contact | None:
    """Return contact `number`, or None when the filter excludes it."""
    raw = data.contact[number]
    (geom1, body1), (geom2, body2) = (_side(model, int(geom)) for geom in raw.geom)
    pairs = ((wanted.geom1, geom1), (wanted.geom2, geom2), (wanted.body1, body1), (wanted.body2, body2))
    if any(name and name != actual for name, actual in pairs):
        return None
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, number, force)
    x, y, z = raw.pos.tolist()
    nx, ny, nz = raw.frame[:3].tolist()
    fx, fy, fz, tx, ty, tz = force.tolist()
    return Contact(
        geom1=geom1,
        geom2=geom2,
        body1=body1,
        body2=body2,
        pos=(x, y, z),
        normal=(nx, ny, nz),
        dist=float(raw.dist),
        force=(fx, fy, fz, tx, ty, tz),
    )


def _side(model: mujoco.MjModel, geom: int) -> tuple[str, str]:
    """Return the names of a contact's geom and its body; both empty if it is not a geom, for example a flex."""
    if geom < 0:
        return "", ""
    body = int(model.geom_bodyid[geom])
    return (
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or "",
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) or "",
    )


@handles(runtime.ListKeyframes)
def list_keyframes(server: ServerCore, _: runtime.ListKeyframes) -> runtime.ListKeyframesOk:
    model = server.play.running().scene.model
    return runtime.ListKeyframesOk(keyframes=[_keyframe(model, number) for number in range(model.nkey)])


def _keyframe(model: mujoco.MjModel, number: int) -> KeyframeInfo:
    return KeyframeInfo(
        name=mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, number) or "",
        time=float(model.key_time[number]),
        qpos=model.key_qpos[number].tolist(),
        qvel=model.key_qvel[number].tolist(),
        ctrl=model.key_ctrl[number].tolist(),
        mocap_pos=model.key_mpos[number].tolist(),
        mocap_quat=model.key_mquat[number].tolist(),
    )


@handles(runtime.SetSimOptions)
def set_sim_options(server: ServerCore, request: runtime.SetSimOptions) -> runtime.SetSimOptionsOk:
    running = server.play.running()
    options = need(request, request.options, "options")
    with running.engine.lock:
        return runtime.SetSimOptionsOk(options=running.options.apply(running.scene.model, running.scene.data, options))


def parse_mode(text: str, dialect: Dialect = ALPHA) -> StepMode:
    """Return the step mode called `text`, in any case. `streaming` means live, and so does `auto` in newer dialects."""
    name = text.casefold()
    try:
        mode = StepMode.LIVE if name == "streaming" else StepMode(name)
    except ValueError:
        raise Refusal("bad_mode", f"unknown step mode '{text}': use live, direct, puppet or auto") from None
    return StepMode.LIVE if mode is StepMode.AUTO and not dialect.auto_mode else mode


def parse_control_source(text: str) -> ControlSource:
    """Return the control source called `text`, in any case."""
    try:
        return ControlSource(text.casefold())
    except ValueError:
        raise Refusal("bad_value", f"unknown control source '{text}': use zmq or ui") from None


T = TypeVar("T")


@handles(cameras.SetCameraStreaming)
def set_camera_streaming(server: ServerCore, request: cameras.SetCameraStreaming) -> cameras.SetCameraStreamingOk:
    running = server.play.running()
    streaming: dict[str, cameras.CameraStreaming] = {}
    for key, wanted in _known(running, request, request.cameras).items():
        zmq, shm = _places(wanted)
        server.switch_camera(key, zmq=zmq, shm=shm)
        robot, _, part = key.partition("/")
        streaming[key] = cameras.CameraStreaming(
            streaming=zmq or shm,
            zmq=zmq,
            shm=shm,
            zmq_endpoint=server.camera_endpoint(robot, part) if zmq else None,
            zmq_topic=server.dialect.camera_topic(robot, part) if zmq else None,
        )
    return cameras.SetCameraStreamingOk(cameras=streaming)


@handles(cameras.SetCameraDelay)
def set_camera_delay(server: ServerCore, request: cameras.SetCameraDelay) -> cameras.SetCameraDelayOk:
    running = server.play.running()
    wanted: dict[str, tuple[cameras.CameraDelayInForce, int]] = {}
    for key, asked in _known(running, request, request.cameras).items():
        delay = asked if isinstance(asked, cameras.CameraDelay) else cameras.CameraDelay(delay_s=asked)
        wanted[key] = (_latency(key, delay, running.cameras.latency(key)), delay.seed or zlib.crc32(key.encode()))
    running.delay_cameras(wanted)
    return cameras.SetCameraDelayOk(cameras={key: _rounded(latency) for key, (latency, _) in wanted.items()})


def _known(running: Running, request: Request[Any], wanted: Mapping[str, T]) -> dict[str, T]:
    """Return a request's entries for existing cameras, by camera key, ignoring case."""
    asked = need(request, wanted, "cameras")
    if not asked:
        raise Refusal("bad_request", f"{request.__struct_config__.tag}: field 'cameras' is empty")
    keys = {key.casefold(): key for key in running.cameras.keys}
    return {keys[name.casefold()]: settings for name, settings in asked.items() if name.casefold() in keys}


def _places(wanted: bool | cameras.CameraTransports) -> tuple[bool, bool]:
    if isinstance(wanted, bool):
        return wanted, wanted
    if wanted.zmq is None and wanted.shm is None:
        return True, True
    return bool(wanted.zmq), bool(wanted.shm)


def _latency(
    key: str, asked: cameras.CameraDelay, before: cameras.CameraDelayInForce | None
) -> cameras.CameraDelayInForce:
    """Return the requested latency."""
    clock = asked.clock.lower()
    if clock not in ("sim", "wall"):
        raise Refusal("bad_request", f"set_camera_delay: clock of '{key}' is '{asked.clock}', not 'sim' or 'wall'")
    numbers = {"delay_s": asked.delay_s, "jitter_s": asked.jitter_s, "max_fps": asked.max_fps or 0.0}
    for name, number in numbers.items():
        if not math.isfinite(float32(number)):
            raise Refusal("bad_request", f"set_camera_delay: {name} of '{key}' is {number}, not a finite number")
    keeps = before is not None and asked.on_state_change is None and asked.max_fps is None
    return cameras.CameraDelayInForce(
        delay_s=max(0.0, asked.delay_s),
        jitter_s=max(0.0, asked.jitter_s),
        clock=clock,
        on_state_change=before.on_state_change if before is not None and keeps else asked.on_state_change is not False,
        max_fps=before.max_fps if before is not None and keeps else max(0.0, numbers["max_fps"]),
    )


def _rounded(latency: cameras.CameraDelayInForce) -> cameras.CameraDelayInForce:
    rounded = {name: float32(getattr(latency, name)) for name in ("delay_s", "jitter_s", "max_fps")}
    return msgspec.structs.replace(latency, **rounded)
