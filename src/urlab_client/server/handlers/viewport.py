"""Handlers of the `viewport` ops: the camera of the editor's perspective view."""

from __future__ import annotations

import math
import time
from typing import Any

from urlab_client.protocol.base import Request
from urlab_client.protocol.messages.viewport import (
    FrameActor,
    FrameActorOk,
    GetCamera,
    GetCameraOk,
    SetCamera,
    SetCameraOk,
    SetViewportMode,
    SetViewportModeOk,
    TrackActor,
    TrackActorOk,
    Untrack,
    UntrackOk,
)
from urlab_client.server.assets.actors import Actor
from urlab_client.server.compile.bounds import actor_bounds
from urlab_client.server.core import ServerCore
from urlab_client.server.editor.viewport import DEFAULT_OFFSET, Track, ViewMode, ViewportCamera, rotator
from urlab_client.server.physics.controllers import float32
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need
from urlab_client.values.rotation import Quat, Vec3, xyzw


@handles(SetCamera)
def set_camera(server: ServerCore, request: SetCamera) -> SetCameraOk:
    location = need_point(request, request.location, "location")
    euler = need_rotator(request, request.rotation_quat, request.rotation_euler)
    fov = request.fov
    server.viewport.place(location, euler=euler, fov=float32(fov) if fov is not None and 0.0 < fov < math.inf else None)
    view = server.viewport.view
    return SetCameraOk(location=view.location, rotation_quat=view.rotation, rotation_euler=view.euler, fov=view.fov)


@handles(GetCamera)
def get_camera(server: ServerCore, request: GetCamera) -> GetCameraOk:
    del request
    view = look(server)
    return GetCameraOk(location=view.location, rotation_quat=view.rotation, rotation_euler=view.euler, fov=view.fov)


@handles(FrameActor)
def frame_actor(server: ServerCore, request: FrameActor) -> FrameActorOk:
    actor = _actor(server, request, request.target, request.target_by)
    try:
        corners = actor_bounds(actor, every_geom=True)
    except CompileFailed as error:
        raise Refusal("no_bounds", f"the model of '{actor.name}' does not compile: {error.message}") from None
    if corners is None:
        raise Refusal("no_bounds", f"'{actor.name}' has no geometry with bounds; planes are endless and do not count")
    server.viewport.view = view = look(server).framing(*corners)
    return FrameActorOk(location=view.location, rotation_quat=view.rotation, rotation_euler=view.euler, fov=view.fov)


@handles(SetViewportMode)
def set_viewport_mode(server: ServerCore, request: SetViewportMode) -> SetViewportModeOk:
    name = need(request, request.mode, "mode")
    try:
        mode = ViewMode(name.casefold())
    except ValueError:
        raise Refusal("invalid_mode", f"unknown view mode '{name}': use {', '.join(ViewMode)}") from None
    if mode is ViewMode.REFLECTIONS:
        raise Refusal("unsupported", "MuJoCo has no view mode 'reflections'")
    server.viewport.mode = mode
    return SetViewportModeOk(mode=name)


@handles(TrackActor)
def track_actor(server: ServerCore, request: TrackActor) -> TrackActorOk:
    actor = _actor(server, request, request.target, request.target_by)
    offset = request.offset
    server.viewport.start_tracking(
        Track(
            actor_name=actor.name,
            offset=offset if offset is not None and all(map(math.isfinite, offset)) else DEFAULT_OFFSET,
            smoothing=request.smoothing,
        )
    )
    return TrackActorOk(tracked_actor_path=server.world.actor_path(actor))


@handles(Untrack)
def untrack(server: ServerCore, request: Untrack) -> UntrackOk:
    del request
    _tracked(server)
    return UntrackOk(was_tracking=server.viewport.stop_tracking())


def need_point(request: Request[Any], value: Vec3, field: str) -> Vec3:
    """Return the value of a required vector field.

    Raises:
        Refusal: `missing_field` if it is absent, malformed or not finite.
    """
    point = need(request, value, field)
    if not all(map(math.isfinite, point)):
        raise Refusal("missing_field", f"{request.__struct_config__.tag}: '{field}' needs finite numbers")
    return point


def need_rotator(request: Request[Any], quat: Quat | None, euler: Vec3 | None) -> Vec3 | None:
    """Return the rotator (roll, pitch, yaw), degrees, of a request's rotation in Unreal's frame; None without one.

    Raises:
        Refusal: `missing_field` for numbers that do not form a rotation.
    """
    try:
        return rotator(quat, euler)
    except ValueError as error:
        raise Refusal("missing_field", f"{request.__struct_config__.tag}: the rotation is unusable: {error}") from None


def look(server: ServerCore) -> ViewportCamera:
    """Return the current camera; a followed actor may have moved."""
    actor = _tracked(server)
    if actor is not None:
        server.viewport.follow(*_pose(server, actor), time.monotonic())
    return server.viewport.view


def _actor(server: ServerCore, request: Request[Any], target: str, target_by: str) -> Actor:
    key = need(request, target, "target")
    actor = server.world.actor(key, by_name=target_by.casefold() == "actor_name")
    if actor is None:
        raise Refusal("unknown_actor", key)
    return actor


def _tracked(server: ServerCore) -> Actor | None:
    """Return the followed actor. Tracking ends when the actor is gone."""
    track = server.viewport.track
    if track is None:
        return None
    actor = server.world.actor(track.actor_name, by_name=True)
    if actor is None:
        server.viewport.stop_tracking()
    return actor


def _pose(server: ServerCore, actor: Actor) -> tuple[Vec3, Quat]:
    """Return the position of an actor: that of its root body during play, otherwise as authored."""
    running = server.play.current
    control = None if running is None else running.engine.articulations.controls.get(actor.name)
    if running is None or control is None:
        return actor.location, actor.rotation
    body, data = control.index.root_body, running.scene.data
    with running.engine.lock:
        x, y, z = data.xpos[body].tolist()
        quat = data.xquat[body].tolist()
    return (x, y, z), xyzw((quat[0], quat[1], quat[2], quat[3]))
