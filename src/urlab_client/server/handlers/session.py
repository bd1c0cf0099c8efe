"""Handlers of the ops without a namespace and of `sim`, and the handshake that `hello` and `begin_pie` send."""

from __future__ import annotations

import base64
import logging
from pathlib import Path
from typing import Final

import msgspec
import mujoco

from urlab_client.enums import ObservationLevel, PIEState, StepMode
from urlab_client.errors import UNCLAIMED
from urlab_client.protocol.messages import session, sim
from urlab_client.protocol.shm import REPLY_FILE, REQUEST_FILE, RPC_STRIDE
from urlab_client.server.compile.scene_index import EntityIndex
from urlab_client.server.core import ServerCore
from urlab_client.server.handlers.runtime import check_owner
from urlab_client.server.physics.controllers import ArticulationControl
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.render.camera_renderer import FRAMES_DEADLINE_S, Film
from urlab_client.server.rpc.dispatch import handles
from urlab_client.simulation.controllers import float32

logger: logging.Logger = logging.getLogger("urlab_client.server")

URLAB_VERSION_AT_START: Final = "urlab/0.1"
"""What the handshake inside the reply to `begin_pie` says, whatever `hello` says."""

_PICTURES_WAIT_S: Final = 0.2
"""Default wait of a step for its pictures, seconds."""


@handles(session.Hello)
def hello(server: ServerCore, request: session.Hello) -> session.HelloOk:
    reply = handshake(server, "", include_assets=request.include_assets)
    running = server.play.current
    if running is not None:
        running.engine.reset_step_count()
    # Last: physics may be too busy to answer, and then the old session remains.
    reply.session_id = server.session.open(observations=request.observations, encoding=request.encoding)
    return reply


def handshake(server: ServerCore, session_id: str, *, include_assets: bool = False) -> session.HelloOk:
    """Describe the server for `hello` and the start of play, without affecting the session."""
    reply = session.HelloOk(
        session_id=session_id,
        urlab_version=server.dialect.urlab_version,
        mujoco_version_int=mujoco.mj_version(),
        mujoco_version=mujoco.mj_versionString(),
        manager_present=server.play.manager_present,
        articulations=[],
    )
    if not server.play.manager_present:
        return reply
    if server.instance is not None:
        reply.instance = server.instance()
    reply.shm_session_dir = server.shm_directory
    if server.dialect.instance and server.shm_directory is not None:
        reply.shm_rpc = _request_regions(Path(server.shm_directory))
    reply.entities = {}
    reply.global_cameras = {}
    running = server.play.current
    if running is None:
        return reply
    scene, engine = running.scene, running.engine
    with engine.lock.look():
        reply.mjb = running.mjb()
        reply.articulations = [
            _articulation(server, name, control) for name, control in engine.articulations.controls.items()
        ]
    reply.mjb_base64 = msgspec.Raw(msgspec.msgpack.encode(base64.b64encode(reply.mjb).decode("ascii")))
    reply.mjb_size = len(reply.mjb)
    reply.entities = {entity.name: _entity(entity) for entity in scene.entities}
    if include_assets:
        _add_assets(reply, running, attached=server.dialect.robots_attached)
    return reply


def _request_regions(directory: Path) -> session.ShmRpcInfo:
    return session.ShmRpcInfo(
        session=directory.name,
        req_path=str(directory / REQUEST_FILE),
        rep_path=str(directory / REPLY_FILE),
        req_event=f"Local\\URLab_{directory.name}_req_ready",
        rep_event=f"Local\\URLab_{directory.name}_rep_ready",
        req_stride=RPC_STRIDE,
        rep_stride=RPC_STRIDE,
    )


def _articulation(server: ServerCore, name: str, control: ArticulationControl) -> session.ArticulationInfo:
    index, controller, dialect = control.index, control.controller, server.dialect
    return session.ArticulationInfo(
        prefix=name,
        actor_id=index.actor_id,
        actor_name=index.key if dialect.public_names else None,
        default_control_mode="raw" if controller is None else "ue_controller",
        controller=None
        if controller is None
        else session.ControllerInfo(kind=controller.kind, params=controller.params(), schema=controller.schema()),
        actuator_types=dict(index.actuator_types),
        original_names=session.OriginalNames(),
        camera_topics={
            dialect.camera_key(name, camera.name): session.CameraInfo(
                mode=server.config.camera_mode(index, camera.name),
                resolution=camera.resolution,
                fovy=float32(camera.fovy),
                zmq_endpoint=server.camera_endpoint(name, dialect.camera_part(camera.name)),
                zmq_topic=dialect.camera_topic(name, camera.name),
            )
            for camera in index.cameras
        },
    )


def _entity(entity: EntityIndex) -> session.EntityInfo:
    if entity.free_joint_id < 0:
        return session.EntityInfo(id=entity.body, has_free_base=False)
    return session.EntityInfo(
        id=entity.body,
        has_free_base=True,
        free_joint=entity.free_joint,
        free_joint_id=entity.free_joint_id,
        qpos_offset=entity.qpos_adr,
        qvel_offset=entity.qvel_adr,
    )


def _add_assets(reply: session.HelloOk, running: Running, *, attached: bool) -> None:
    reply.vfs_assets = {}
    try:
        reply.mjcf_compiled, reply.vfs_assets = running.scene.export(attached=attached)
    except (OSError, ValueError, mujoco.FatalError) as error:
        logger.warning("the scene cannot be written as MJCF, so the handshake omits it: %s", error)


@handles(session.Meta)
def meta(server: ServerCore, _: session.Meta) -> session.MetaOk:
    # Includes ops that this server answers with `unsupported`: the catalogue describes the protocol, and a client must
    # not conclude from it that it talks to another version of the plugin.
    return session.MetaOk(
        ops=[
            session.OpInfo(
                name=op.name,
                category=op.needs,
                namespace=op.ns,
                required_fields=list(op.declared_required) or None,
                reply_fields=list(op.declared_reply) or None,
            )
            for op in server.dialect.ops.values()
            if op.name not in ("hello", "meta")
        ]
    )


@handles(session.Step)
def step(server: ServerCore, request: session.Step) -> session.StepOk | bytes:
    running = server.play.running()
    _check_owners(server, running, request)
    most = server.limits.n_steps
    if request.n_steps > most:
        raise Refusal("bad_request", f"step: {request.n_steps} steps are more than the limit n_steps, {most}")
    level = server.session.level_of(request.observations)
    if server.dialect.level_sticks:
        if running.engine.mode in (StepMode.DIRECT, StepMode.PUPPET):
            server.session.level = level
        level = server.session.level
    forms = server.dialect.camera_forms
    fresh = forms and (request.wait_cameras or request.render == "sync")
    wait_s = _pictures_wait_s(request) if fresh else FRAMES_DEADLINE_S
    shots = running.cameras.shots(request.include_cameras, fresh=fresh)

    if not (shots or server.session.json or running.engine.replay is not None or running.channels.declared):
        # Nearly every step: only the numbers of such replies change.
        engine, encode = running.engine, running.step_replies.encode
        return engine.step(request, lambda _: encode(level, engine.time, engine.step_count, engine.snapshots.number))

    def observe(mode: StepMode) -> tuple[session.StepOk, Film | None]:
        film = None
        if shots and (forms or mode in (StepMode.DIRECT, StepMode.PUPPET)):
            film = running.cameras.capture(shots, running.engine.snapshots.number)
        return _observe_step(running, level), film

    reply, film = running.engine.step(request, observe)
    if film is not None:
        reply.cameras = running.cameras.frames(shots, film, wait_s)
    return reply


def _pictures_wait_s(request: session.Step) -> float:
    wait_s = _PICTURES_WAIT_S if request.camera_timeout_ms is None else request.camera_timeout_ms / 1e3
    return min(wait_s, FRAMES_DEADLINE_S) if wait_s > 0 else 0.0  # NaN means no wait, too


def _check_owners(server: ServerCore, running: Running, request: session.Step) -> None:
    """Refuse commands to robots that the sender does not own, if robots have owners."""
    if not server.dialect.claims:
        return
    for name, command in (request.per_articulation or {}).items():
        if command.ctrl is None and command.ctrl_map is None and command.xfrc_applied is None:
            continue
        control = running.engine.articulations.find(name)
        if control is None:
            raise Refusal("not_control_owner", f"no articulation is called '{name}'", owner=UNCLAIMED)
        check_owner(server, request, control)


def _observe_step(running: Running, level: ObservationLevel) -> session.StepOk:
    engine, observer = running.engine, running.observer
    return session.StepOk(
        **observer.state(level, engine.time, engine.step_count),
        entities=observer.entities(),
        frame_id=engine.snapshots.number if engine.dialect.frame_ids else None,
        replay=None
        if engine.replay is None
        else session.ReplayProgress(current_frame=engine.replay.current_frame, total_frames=engine.replay.total_frames),
    )


@handles(session.Reset)
def reset(server: ServerCore, request: session.Reset) -> session.ResetOk:
    running = server.play.running()
    engine = running.engine
    with engine.lock:
        engine.reset(
            keyframe_name=request.keyframe_name, seed=request.seed, per_articulation_qpos=request.per_articulation_qpos
        )
        return session.ResetOk(**running.observer.state(server.session.level, engine.time, engine.step_count))


@handles(session.Forward)
def forward(server: ServerCore, _: session.Forward) -> session.ForwardOk:
    running = server.play.running()
    engine = running.engine
    with engine.lock:
        engine.forward()
        return session.ForwardOk(**running.observer.state(server.session.level, engine.time, engine.step_count))


@handles(sim.BeginPie)
def begin_pie(server: ServerCore, request: sim.BeginPie) -> sim.BeginPieOk:
    play = server.play
    if request.level_path:
        _open_level(server, request.level_path)
    if play.state not in (PIEState.READY, PIEState.COMPILING):
        if not server.world.has_manager:
            return sim.BeginPieOk(
                state=PIEState.TIMEOUT,
                compile_error=f"level {server.world.levels.package} has no manager actor: call ensure_manager first",
            )
        server.begin_play()
    state = play.wait(request.timeout_s)
    reply = sim.BeginPieOk(state=state, compile_error=play.compile_error)
    if state is PIEState.READY:
        reply.handshake_payload = payload = handshake(server, request.session_id)
        payload.urlab_version = URLAB_VERSION_AT_START
    return reply


def _open_level(server: ServerCore, path: str) -> None:
    """Open a level and end the current play session; if the level cannot be opened, nothing changes."""
    world = server.world
    was_running, world.pie_running = world.pie_running, False
    try:
        world.levels.load(path)
    except BaseException:
        world.pie_running = was_running
        raise
    server.stop_play()


@handles(sim.StopPie)
def stop_pie(server: ServerCore, _: sim.StopPie) -> sim.StopPieOk:
    server.stop_play()
    return sim.StopPieOk()


@handles(sim.PieStatus)
def pie_status(server: ServerCore, _: sim.PieStatus) -> sim.PieStatusOk:
    play = server.play
    running = play.current
    return sim.PieStatusOk(
        state=play.state, compile_error=play.compile_error, sim_time=None if running is None else running.engine.time
    )
