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
from urlab_client.server.editor.markers import Primitive, Stroke, box
from urlab_client.server.editor.viewport import ViewMode, ViewportCamera
from urlab_client.simulation.drawing import Bytes, Stage, follow_subject
from urlab_client.values.rotation import IDENTITY, Vec3, rotate

logger: logging.Logger = logging.getLogger("urlab_client.server")

SELECTED: Final[Vec3] = (1.0, 0.55, 0.05)
"""Colour of the box around the selected actor."""

Bounds: TypeAlias = tuple[Vec3, Vec3]
"""Lowest and highest corner of an axis-aligned box, metres."""

_LINE_PIXELS: Final = 2.0
"""Width of a line of thickness 1, pixels."""

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


def outline(bounds: Bounds) -> Primitive:
    """Return the box around the selected actor."""
    low, high = np.array(bounds)
    return box(_point((low + high) / 2.0), _point((high - low) / 2.0), IDENTITY, SELECTED)


def add_primitives(scene: mujoco.MjvScene, primitives: Sequence[Primitive]) -> None:
    """Add debug drawing to a scene; geoms that do not fit are omitted with a warning."""
    for stroke in itertools.chain.from_iterable(primitives):
        if scene.ngeom >= scene.maxgeom:
            logger.warning("debug drawing is left out of a picture: more than %d geoms", scene.maxgeom)
            return
        _put(stroke, scene.geoms[scene.ngeom])
        scene.ngeom += 1


def _put(stroke: Stroke, geom: Any) -> None:
    axes = [rotate(stroke.rotation, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    turn = np.array(axes).T.ravel()
    rgba = np.array([*stroke.color, 1.0], np.float32)
    mujoco.mjv_initGeom(geom, stroke.kind, np.array(stroke.size), np.array(stroke.at), turn, rgba)
    if stroke.end is not None:
        width = max(1.0, _LINE_PIXELS * stroke.size[0])
        mujoco.mjv_connector(geom, stroke.kind, width, np.array(stroke.at), np.array(stroke.end))
    geom.emission, geom.specular = 0.6, 0.0  # about its own colour, whatever the lights
    geom.label = ascii_text(stroke.text)[:_LABEL_BYTES]
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR


def ascii_text(text: str) -> str:
    """Return the text in the characters of MuJoCo's font, others as question marks."""
    return "".join(letter if " " <= letter <= "~" or letter == "\n" else "?" for letter in text)


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
