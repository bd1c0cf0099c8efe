"""The viewport's picture: where MuJoCo's camera goes, what the view modes mean, and debug drawing as geoms.

Only `ViewportStage` needs OpenGL.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.server.compile.composition import box_around
from urlab_client.server.editor.markers import MARKER_RADIUS_M, Arrow, Box, DebugLine, Primitive, Sphere, Text
from urlab_client.server.editor.viewport import ViewMode, ViewportCamera
from urlab_client.simulation.drawing import Bytes, Stage, follow_subject
from urlab_client.values.rotation import IDENTITY, Quat, Vec3, rotate

logger: logging.Logger = logging.getLogger("urlab_client.server")

SELECTED: Final[Vec3] = (1.0, 0.55, 0.05)
"""Colour of the box around the selected actor."""

Bounds: TypeAlias = tuple[Vec3, Vec3]
"""Lowest and highest corner of an axis-aligned box, metres."""

_LINE_PIXELS: Final = 2.0
"""Width of a line of thickness 1, pixels."""

_HEAD_SPREAD: Final = 0.45
"""Half the width of an arrow's head, as a share of its length."""

_LABEL_BYTES: Final = 99
_HIDDEN_GROUP: Final = 5


@dataclass(frozen=True, kw_only=True)
class ViewportPicture:
    """What a picture of the viewport shows, besides the scene.

    Attributes:
        size: Width and height, pixels.
        overlay: Text over the picture.
        selected: Name of the actor that is marked as selected; may be empty.
        fit: Move the camera, without turning it, so that everything but endless planes is in the picture.
    """

    size: tuple[int, int]
    view: ViewportCamera
    fit: bool = False
    mode: ViewMode = ViewMode.LIT
    primitives: Sequence[Primitive] = ()
    overlay: str = ""
    selected: str = ""


def aim(camera: mujoco.MjvCamera, view: ViewportCamera) -> None:
    """Point MuJoCo's free camera like the viewport's; it cannot roll."""
    x, y, z = view.forward
    if math.hypot(x, y) < 1e-9:  # straight up or down: the upper edge determines the azimuth
        up_x, up_y, _ = view.up
        x, y = (up_x, up_y) if z < 0.0 else (-up_x, -up_y)
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.distance = 1.0
    camera.lookat[:] = np.array(view.location) + view.forward
    camera.azimuth = math.degrees(math.atan2(y, x))
    camera.elevation = math.degrees(math.asin(min(max(z, -1.0), 1.0)))


@contextlib.contextmanager
def showing(mode: ViewMode, model: mujoco.MjModel, option: mujoco.MjvOption) -> Generator[None]:
    """Let a view mode choose which geoms are drawn: in `collision` those that collide, as they collide."""
    if mode is not ViewMode.COLLISION:
        yield
        return
    groups, chosen = model.geom_group.copy(), option.geomgroup.copy()
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    model.geom_group[:] = np.where(collides, 0, _HIDDEN_GROUP)
    option.geomgroup[:] = 0
    option.geomgroup[0] = 1
    option.flags[mujoco.mjtVisFlag.mjVIS_CONVEXHULL] = 1
    try:
        yield
    finally:
        model.geom_group[:] = groups
        option.geomgroup[:] = chosen
        option.flags[mujoco.mjtVisFlag.mjVIS_CONVEXHULL] = 0


def light_evenly(scene: mujoco.MjvScene) -> None:
    """Replace the lights of a scene by one that shows every colour as it is."""
    scene.nlight = 1
    light = scene.lights[0]
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.headlight, light.castshadow = 1, 0
    light.ambient[:], light.diffuse[:], light.specular[:] = 1.0, 0.0, 0.0


def bounds_of(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.bool_]) -> Bounds | None:
    """Return the box around the chosen geoms; None if none of them has bounds, as planes have not.

    Args:
        geoms: Mask, shape (ngeom,).
    """
    bounded = geoms & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    if not bounded.any():
        return None
    low, high = box_around(model, data, bounded)
    return _point(low), _point(high)


def outline(bounds: Bounds) -> Box:
    """Return the box around the selected actor."""
    low, high = np.array(bounds)
    return Box(
        center=_point((low + high) / 2.0), half_extents=_point((high - low) / 2.0), rotation=IDENTITY, color=SELECTED
    )


def add_primitives(scene: mujoco.MjvScene, primitives: Sequence[Primitive]) -> None:
    """Add debug drawing to a scene; geoms that do not fit are omitted with a warning."""
    geoms = itertools.chain.from_iterable(map(_strokes, primitives))
    for stroke in geoms:
        if scene.ngeom >= scene.maxgeom:
            logger.warning("debug drawing is left out of a picture: more than %d geoms", scene.maxgeom)
            return
        stroke.put(scene.geoms[scene.ngeom])
        scene.ngeom += 1


def ascii_text(text: str) -> str:
    """Return the text in the characters of MuJoCo's font, others as question marks."""
    return "".join(letter if " " <= letter <= "~" or letter == "\n" else "?" for letter in text)


@dataclass(frozen=True, kw_only=True)
class _Stroke:
    """One geom of debug drawing; a line, if it has an end."""

    kind: int
    at: Vec3
    color: Vec3
    size: Vec3 = (0.0, 0.0, 0.0)
    rotation: Quat = IDENTITY
    end: Vec3 | None = None
    text: str = ""

    def put(self, geom: Any) -> None:
        axes = [rotate(self.rotation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
        turn = np.array(axes).T.ravel()
        rgba = np.array([*self.color, 1.0], np.float32)
        mujoco.mjv_initGeom(geom, self.kind, np.array(self.size), np.array(self.at), turn, rgba)
        if self.end is not None:
            mujoco.mjv_connector(geom, self.kind, self.size[0], np.array(self.at), np.array(self.end))
        geom.emission, geom.specular = 0.6, 0.0  # about its own colour, whatever the lights
        geom.label = self.text
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR


def _strokes(primitive: Primitive) -> list[_Stroke]:
    kinds = mujoco.mjtGeom
    color = primitive.color
    match primitive:
        case Sphere():
            size = (MARKER_RADIUS_M, MARKER_RADIUS_M, MARKER_RADIUS_M)
            return [_Stroke(kind=kinds.mjGEOM_SPHERE, at=primitive.center, color=color, size=size)]
        case Text():
            text = ascii_text(primitive.text)[:_LABEL_BYTES]
            return [_Stroke(kind=kinds.mjGEOM_LABEL, at=primitive.at, color=color, size=(0.1, 0.1, 0.1), text=text)]
        case DebugLine():
            return [_line(primitive.start, primitive.end, color, primitive.thickness)]
        case Box():
            return [
                _Stroke(
                    kind=kinds.mjGEOM_LINEBOX,
                    at=primitive.center,
                    color=color,
                    size=primitive.half_extents,
                    rotation=primitive.rotation,
                )
            ]
        case Arrow():
            return _arrow(primitive)


def _line(start: Vec3, end: Vec3, color: Vec3, thickness: float) -> _Stroke:
    width = max(1.0, _LINE_PIXELS * thickness)
    return _Stroke(kind=mujoco.mjtGeom.mjGEOM_LINE, at=start, end=end, color=color, size=(width, width, width))


def _arrow(arrow: Arrow) -> list[_Stroke]:
    """Return the shaft and the four edges of the head."""
    tail: NDArray[np.float64] = np.array(arrow.start)
    tip: NDArray[np.float64] = np.array(arrow.end)
    length = float(np.linalg.norm(tip - tail))
    strokes = [_line(arrow.start, arrow.end, arrow.color, arrow.thickness)]
    if length == 0.0:
        return strokes
    along = (tip - tail) / length
    least: NDArray[np.float64] = np.eye(3)[np.argmin(np.abs(along))]
    side: NDArray[np.float64] = np.cross(along, least)
    side /= float(np.linalg.norm(side))
    other: NDArray[np.float64] = np.cross(along, side)
    for out in (side, -side, other, -other):
        barb: NDArray[np.float64] = tip - arrow.head * (along - _HEAD_SPREAD * out)
        strokes.append(_line(arrow.end, _point(barb), arrow.color, arrow.thickness))
    return strokes


def _point(values: NDArray[np.float64]) -> Vec3:
    x, y, z = values.tolist()
    return x, y, z


class ViewportStage(Stage):
    """Draws pictures of cameras and of the viewport."""

    def paint(self, data: mujoco.MjData, picture: ViewportPicture) -> Bytes:
        """Draw the viewport; return red, green, blue and alpha from the top, shape (height, width, 4)."""
        width, height = picture.size
        view, mode, renderer = picture.view, picture.mode, self._renderer
        if width > renderer.offWidth or height > renderer.offHeight:
            mujoco.mjr_resizeOffscreen(max(width, renderer.offWidth), max(height, renderer.offHeight), renderer)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
        if picture.fit and (bounds := bounds_of(self._model, data, self._model.geom_rgba[:, 3] > 0.0)):
            view = view.framing(*bounds)
        self._model.vis.global_.fovy = view.fovy(width / height)
        aim(self._view, view)
        kinds_of_geoms = mujoco.mjtCatBit.mjCAT_ALL.value
        with showing(mode, self._model, self._option):
            mujoco.mjv_updateScene(self._model, data, self._option, None, self._view, kinds_of_geoms, self._scene)
        for side in self._scene.camera:
            side.forward[:], side.up[:] = view.forward, view.up
        if not self._fast:
            follow_subject(self._scene, self._model, data, self._subjects)
        if mode is ViewMode.UNLIT:
            light_evenly(self._scene)
        add_primitives(self._scene, picture.primitives)
        if picture.selected and (bounds := bounds_of(self._model, data, self._tints.owned_by(picture.selected))):
            add_primitives(self._scene, [outline(bounds)])
        flags, kinds = self._scene.flags, mujoco.mjtRndFlag
        flags[kinds.mjRND_SHADOW] = flags[kinds.mjRND_REFLECTION] = not self._fast and mode is ViewMode.LIT
        flags[kinds.mjRND_SEGMENT] = flags[kinds.mjRND_IDCOLOR] = False
        flags[kinds.mjRND_WIREFRAME] = mode is ViewMode.WIREFRAME
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, self._scene, renderer)
        if picture.overlay:
            font, corner = mujoco.mjtFont.mjFONT_NORMAL, mujoco.mjtGridPos.mjGRID_TOPLEFT
            mujoco.mjr_overlay(font, corner, area, ascii_text(picture.overlay), "", renderer)
        return self._read_colors(area, "RGBA")
