"""Ops of `client.debug`: drawing into the world."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from msgspec import field

from urlab_client.protocol.base import EDITOR_TIMEOUT_S, Color, EulerDeg, Op, Reply, Request, doc
from urlab_client.values.rotation import Quat, Vec3

Ttl = Annotated[float, doc("Lifetime, seconds: 0 for a single frame, negative until `clear_markers`.")]
Tag = Annotated[str | None, doc("Accepted but not used; markers cannot be cleared by tag.")]
UnrealQuat = Annotated[
    Quat, doc("Rotation (x, y, z, w) in Unreal's frame; send (-x, y, -z, w) for a MuJoCo quaternion.")
]
Point = Annotated[Vec3, doc("World position, metres.")]


class DrawMarkerOk(Reply, tag="draw_marker_ok", kw_only=True):
    """Drawn."""


class DrawMarker(Request[DrawMarkerOk], tag="draw_marker", kw_only=True):
    """Draw a sphere of 5 cm radius, optionally with a label."""

    location: Point
    color: Color
    ttl: Ttl = 0.0
    label: Annotated[str | None, doc("Text at the same place.")] = None
    tag: Tag = None


class DrawLineOk(Reply, tag="draw_line_ok", kw_only=True):
    """Drawn."""


class DrawLine(Request[DrawLineOk], tag="draw_line", kw_only=True):
    """Draw a line segment."""

    from_: Point = field(name="from")
    to: Point
    color: Color
    ttl: Ttl = 0.0
    thickness: Annotated[float, doc("Line width in Unreal units.")] = 1.0
    tag: Tag = None


class DrawBoxOk(Reply, tag="draw_box_ok", kw_only=True):
    """Drawn."""


class DrawBox(Request[DrawBoxOk], tag="draw_box", kw_only=True):
    """Draw a wire box."""

    center: Point
    half_extents: Annotated[Vec3, doc("Half sizes, metres.")]
    color: Color
    rotation_quat: UnrealQuat | None = None
    ttl: Ttl = 0.0
    tag: Tag = None


class DrawArrowOk(Reply, tag="draw_arrow_ok", kw_only=True):
    """Drawn."""


class DrawArrow(Request[DrawArrowOk], tag="draw_arrow", kw_only=True):
    """Draw an arrow."""

    from_: Point = field(name="from")
    to: Point
    color: Color
    ttl: Ttl = 0.0
    thickness: Annotated[float, doc("Line width in Unreal units.")] = 1.0
    arrow_size: Annotated[float | None, doc("Head size, metres; default a fifth of the length.")] = None
    tag: Tag = None


class DrawAxesOk(Reply, tag="draw_axes_ok", kw_only=True):
    """Drawn."""


class DrawAxes(Request[DrawAxesOk], tag="draw_axes", kw_only=True):
    """Draw a red, green and blue triad. Unreal's frame is left-handed, so green points along MuJoCo's -y."""

    location: Point
    rotation_quat: UnrealQuat | None = None
    rotation_euler: EulerDeg | None = None
    scale: Annotated[float, doc("Arrow length, metres.")] = 0.2
    ttl: Ttl = 0.0
    tag: Tag = None


class ClearMarkersOk(Reply, tag="clear_markers_ok", kw_only=True):
    """Cleared."""


class ClearMarkers(Request[ClearMarkersOk], tag="clear_markers", kw_only=True):
    """Remove all debug drawing from the world in use."""

    tag: Tag = None


class SetOverlayTextOk(Reply, tag="set_overlay_text_ok", kw_only=True):
    """Shown."""


class SetOverlayText(Request[SetOverlayTextOk], tag="set_overlay_text", kw_only=True):
    """Show a line of text on the screen for 10 s; empty text clears it."""

    text: Annotated[str, doc("The text.")]
    anchor: Annotated[str, doc("Accepted but not used; the plugin always uses the top left.")] = "top_left"


_drawing = partial(Op, ns="debug", timeout=EDITOR_TIMEOUT_S, errors=("no_world",), generated=True)

OPS: Final = (
    _drawing(request=DrawMarker, positional=2),
    _drawing(request=DrawLine, positional=3),
    _drawing(request=DrawBox, positional=3),
    _drawing(request=DrawArrow, positional=3),
    _drawing(request=DrawAxes, positional=1),
    _drawing(request=ClearMarkers),
    _drawing(request=SetOverlayText, errors=("no_engine",), positional=1),
)
