"""Handlers of the `viewport` and `debug` ops: the camera of the perspective view, and drawing into the world."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any, Final

from urlab_client.protocol.base import EulerDeg, Request
from urlab_client.protocol.messages import debug, viewport
from urlab_client.server.assets.actors import Actor
from urlab_client.server.compile.composition import actor_bounds
from urlab_client.server.core import ServerCore
from urlab_client.server.editor.markers import Primitive, arrow, box, label, line, sphere
from urlab_client.server.editor.viewport import DEFAULT_OFFSET, Track, ViewMode, ViewportCamera, rotator
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable
from urlab_client.simulation.controllers import float32
from urlab_client.values.rotation import IDENTITY, Quat, Vec3, euler_to_quat, rotate, swap_frame, xyzw

YELLOW: Final[Vec3] = (1.0, 1.0, 0.0)
"""Replaces an invalid colour."""

_RED: Final[Vec3] = (1.0, 0.0, 0.0)

_GREEN: Final[Vec3] = (0.0, 1.0, 0.0)

_BLUE: Final[Vec3] = (0.0, 0.0, 1.0)

_HEAD: Final = 0.2
"""Length of an arrow's head as a fraction of the arrow."""


@handles(viewport.SetCamera)
def set_camera(server: ServerCore, request: viewport.SetCamera) -> viewport.SetCameraOk:
    location = need_point(request, request.location, "location")
    euler = need_rotator(request, request.rotation_quat, request.rotation_euler)
    fov = request.fov
    server.viewport.place(location, euler=euler, fov=float32(fov) if fov is not None and 0.0 < fov < math.inf else None)
    return viewport.SetCameraOk(**_seen(server.viewport.view))


@handles(viewport.GetCamera)
def get_camera(server: ServerCore, _: viewport.GetCamera) -> viewport.GetCameraOk:
    return viewport.GetCameraOk(**_seen(look(server)))


@handles(viewport.FrameActor)
def frame_actor(server: ServerCore, request: viewport.FrameActor) -> viewport.FrameActorOk:
    actor = _actor(server, request, request.target, request.target_by)
    try:
        corners = actor_bounds(actor, every_geom=True)
    except CompileFailed as error:
        raise Refusal("no_bounds", f"the model of '{actor.name}' does not compile: {error.message}") from None
    if corners is None:
        raise Refusal("no_bounds", f"'{actor.name}' has no geometry with bounds; planes are endless and do not count")
    server.viewport.view = view = look(server).framing(*corners)
    return viewport.FrameActorOk(**_seen(view))


@handles(viewport.SetViewportMode)
def set_viewport_mode(server: ServerCore, request: viewport.SetViewportMode) -> viewport.SetViewportModeOk:
    name = need(request, request.mode, "mode")
    try:
        mode = ViewMode(name.casefold())
    except ValueError:
        raise Refusal("invalid_mode", f"unknown view mode '{name}': use {', '.join(ViewMode)}") from None
    if mode is ViewMode.REFLECTIONS:
        raise Refusal("unsupported", "MuJoCo has no view mode 'reflections'")
    server.viewport.mode = mode
    return viewport.SetViewportModeOk(mode=name)


@handles(viewport.TrackActor)
def track_actor(server: ServerCore, request: viewport.TrackActor) -> viewport.TrackActorOk:
    actor = _actor(server, request, request.target, request.target_by)
    offset = request.offset
    server.viewport.start_tracking(
        Track(
            actor_name=actor.name,
            offset=offset if offset is not None and all(map(math.isfinite, offset)) else DEFAULT_OFFSET,
            smoothing=request.smoothing,
        )
    )
    return viewport.TrackActorOk(tracked_actor_path=server.world.actor_path(actor))


@handles(viewport.Untrack)
def untrack(server: ServerCore, _: viewport.Untrack) -> viewport.UntrackOk:
    _tracked(server)
    return viewport.UntrackOk(was_tracking=server.viewport.stop_tracking())


def _seen(view: ViewportCamera) -> dict[str, Any]:
    return {"location": view.location, "rotation_quat": view.rotation, "rotation_euler": view.euler, "fov": view.fov}


def need_point(request: Request[Any], value: Vec3, field: str) -> Vec3:
    """Return the value of a required vector field."""
    point = need(request, value, field)
    if not all(map(math.isfinite, point)):
        raise Refusal("missing_field", f"{request.__struct_config__.tag}: '{field}' needs finite numbers")
    return point


def need_rotator(request: Request[Any], quat: Quat | None, euler: Vec3 | None) -> Vec3 | None:
    """Return the rotator (roll, pitch, yaw), degrees, of a request's rotation in Unreal's frame; None without one."""
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
    actor = server.world.actors.get(key, by_name=target_by.casefold() == "actor_name")
    if actor is None:
        raise Refusal("unknown_actor", key)
    return actor


def _tracked(server: ServerCore) -> Actor | None:
    """Return the followed actor. Tracking ends when the actor is gone."""
    track = server.viewport.track
    if track is None:
        return None
    actor = server.world.actors.get(track.actor_name, by_name=True)
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


class RotatedBox(debug.DrawBox, tag="draw_box", kw_only=True):
    """A box request with the angles that the plugin also reads, although its clients do not send them."""

    rotation_euler: EulerDeg | None = None


@handles(debug.DrawMarker)
def draw_marker(server: ServerCore, request: debug.DrawMarker) -> debug.DrawMarkerOk:
    at, color = need_point(request, request.location, "location"), _color(request.color)
    _draw(server, [sphere(at, color)], request.ttl)
    if request.label:
        # As in the plugin, text without a time to live is permanent.
        _draw(server, [label(at, request.label, color)], request.ttl if request.ttl > 0.0 else -1.0)
    return debug.DrawMarkerOk()


@handles(debug.DrawLine)
def draw_line(server: ServerCore, request: debug.DrawLine) -> debug.DrawLineOk:
    start, end = need_point(request, request.from_, "from"), need_point(request, request.to, "to")
    _draw(server, [line(start, end, _color(request.color), _size(request.thickness, 1.0))], request.ttl)
    return debug.DrawLineOk()


@handles(RotatedBox)
def draw_box(server: ServerCore, request: RotatedBox) -> debug.DrawBoxOk:
    center = need_point(request, request.center, "center")
    x, y, z = need_point(request, request.half_extents, "half_extents")
    rotation = _rotation(request, request.rotation_quat, request.rotation_euler)
    _draw(server, [box(center, (abs(x), abs(y), abs(z)), rotation, _color(request.color))], request.ttl)
    return debug.DrawBoxOk()


@handles(debug.DrawArrow)
def draw_arrow(server: ServerCore, request: debug.DrawArrow) -> debug.DrawArrowOk:
    start, end = need_point(request, request.from_, "from"), need_point(request, request.to, "to")
    head = _size(request.arrow_size, _HEAD * math.dist(start, end))
    _draw(server, [arrow(start, end, _color(request.color), head, _size(request.thickness, 1.0))], request.ttl)
    return debug.DrawArrowOk()


@handles(debug.DrawAxes)
def draw_axes(server: ServerCore, request: debug.DrawAxes) -> debug.DrawAxesOk:
    origin = need_point(request, request.location, "location")
    rotation = _rotation(request, request.rotation_quat, request.rotation_euler)
    length = abs(request.scale) if math.isfinite(request.scale) else 0.2
    arrows: list[Primitive] = []
    # Unreal's axes: y is opposite to MuJoCo's.
    for axis, color in (((length, 0.0, 0.0), _RED), ((0.0, -length, 0.0), _GREEN), ((0.0, 0.0, length), _BLUE)):
        dx, dy, dz = rotate(rotation, axis)
        x, y, z = origin
        arrows.append(arrow(origin, (x + dx, y + dy, z + dz), color, _HEAD * length))
    _draw(server, arrows, request.ttl)
    return debug.DrawAxesOk()


@handles(debug.ClearMarkers)
def clear_markers(server: ServerCore, _: debug.ClearMarkers) -> debug.ClearMarkersOk:
    server.drawings.clear(in_play=server.world.pie_running)
    return debug.ClearMarkersOk()


@handles(debug.SetOverlayText)
def set_overlay_text(server: ServerCore, request: debug.SetOverlayText) -> debug.SetOverlayTextOk:
    server.drawings.set_overlay(usable(request.text, ""))
    return debug.SetOverlayTextOk()


def _draw(server: ServerCore, primitives: Sequence[Primitive], ttl: float) -> None:
    server.drawings.add(primitives, ttl=ttl, in_play=server.world.pie_running)


def _color(color: Vec3) -> Vec3:
    """Return a colour in steps of a byte; yellow by default."""
    red, green, blue = (_channel(value) for value in usable(color, YELLOW))
    return red, green, blue


def _channel(value: float) -> float:
    return 0.0 if math.isnan(value) else math.trunc(min(max(value, 0.0), 1.0) * 255.0) / 255.0


def _size(value: float | None, otherwise: float) -> float:
    return value if value is not None and 0.0 < value < math.inf else otherwise


def _rotation(request: Request[Any], quat: Quat | None, euler: Vec3 | None) -> Quat:
    angles = need_rotator(request, quat, euler)
    return IDENTITY if angles is None else swap_frame(euler_to_quat(angles))
