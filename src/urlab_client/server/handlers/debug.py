"""Handlers of the `debug` ops: drawing into the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from urlab_client.protocol.base import EulerDeg, Request
from urlab_client.protocol.messages.debug import (
    ClearMarkers,
    ClearMarkersOk,
    DrawArrow,
    DrawArrowOk,
    DrawAxes,
    DrawAxesOk,
    DrawBox,
    DrawBoxOk,
    DrawLine,
    DrawLineOk,
    DrawMarker,
    DrawMarkerOk,
    SetOverlayText,
    SetOverlayTextOk,
)
from urlab_client.server.core import ServerCore
from urlab_client.server.editor.markers import Arrow, Box, DebugLine, Primitive, Sphere, Text
from urlab_client.server.handlers.viewport import need_point, need_rotator
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import usable
from urlab_client.values.rotation import IDENTITY, Quat, Vec3, euler_to_quat, rotate, swap_frame

YELLOW: Final[Vec3] = (1.0, 1.0, 0.0)
"""Replaces an invalid colour."""

_RED: Final[Vec3] = (1.0, 0.0, 0.0)
_GREEN: Final[Vec3] = (0.0, 1.0, 0.0)
_BLUE: Final[Vec3] = (0.0, 0.0, 1.0)

_HEAD: Final = 0.2
"""Length of an arrow's head as a fraction of the arrow."""


class RotatedBox(DrawBox, tag="draw_box", kw_only=True, omit_defaults=True):
    """A box request with the angles that the plugin also reads, although its clients do not send them."""

    rotation_euler: EulerDeg | None = None


@handles(DrawMarker)
def draw_marker(server: ServerCore, request: DrawMarker) -> DrawMarkerOk:
    at, color = need_point(request, request.location, "location"), _color(request.color)
    _draw(server, [Sphere(center=at, color=color)], request.ttl)
    if request.label:
        # As in the plugin, text without a time to live is permanent.
        _draw(server, [Text(at=at, text=request.label, color=color)], request.ttl if request.ttl > 0.0 else -1.0)
    return DrawMarkerOk()


@handles(DrawLine)
def draw_line(server: ServerCore, request: DrawLine) -> DrawLineOk:
    line = DebugLine(
        start=need_point(request, request.from_, "from"),
        end=need_point(request, request.to, "to"),
        color=_color(request.color),
        thickness=_size(request.thickness, 1.0),
    )
    _draw(server, [line], request.ttl)
    return DrawLineOk()


@handles(RotatedBox)
def draw_box(server: ServerCore, request: RotatedBox) -> DrawBoxOk:
    center = need_point(request, request.center, "center")
    x, y, z = need_point(request, request.half_extents, "half_extents")
    box = Box(
        center=center,
        half_extents=(abs(x), abs(y), abs(z)),
        rotation=_rotation(request, request.rotation_quat, request.rotation_euler),
        color=_color(request.color),
    )
    _draw(server, [box], request.ttl)
    return DrawBoxOk()


@handles(DrawArrow)
def draw_arrow(server: ServerCore, request: DrawArrow) -> DrawArrowOk:
    start = need_point(request, request.from_, "from")
    end = need_point(request, request.to, "to")
    arrow = Arrow(
        start=start,
        end=end,
        color=_color(request.color),
        head=_size(request.arrow_size, _HEAD * math.dist(start, end)),
        thickness=_size(request.thickness, 1.0),
    )
    _draw(server, [arrow], request.ttl)
    return DrawArrowOk()


@handles(DrawAxes)
def draw_axes(server: ServerCore, request: DrawAxes) -> DrawAxesOk:
    origin = need_point(request, request.location, "location")
    rotation = _rotation(request, request.rotation_quat, request.rotation_euler)
    length = abs(request.scale) if math.isfinite(request.scale) else 0.2
    arrows: list[Primitive] = []
    # Unreal's axes: y is opposite to MuJoCo's.
    for axis, color in (((length, 0.0, 0.0), _RED), ((0.0, -length, 0.0), _GREEN), ((0.0, 0.0, length), _BLUE)):
        dx, dy, dz = rotate(rotation, axis)
        x, y, z = origin
        arrows.append(Arrow(start=origin, end=(x + dx, y + dy, z + dz), color=color, head=_HEAD * length))
    _draw(server, arrows, request.ttl)
    return DrawAxesOk()


@handles(ClearMarkers)
def clear_markers(server: ServerCore, request: ClearMarkers) -> ClearMarkersOk:
    del request
    server.drawings.clear(in_play=server.world.pie_running)
    return ClearMarkersOk()


@handles(SetOverlayText)
def set_overlay_text(server: ServerCore, request: SetOverlayText) -> SetOverlayTextOk:
    server.drawings.set_overlay(usable(request.text, ""))
    return SetOverlayTextOk()


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
