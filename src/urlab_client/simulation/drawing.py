"""Drawing what a camera sees, in an OpenGL context."""

from __future__ import annotations

import contextlib
import importlib
from types import TracebackType
from typing import Any, Final, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.session import CameraFrame
from urlab_client.simulation.appearance import RenderQuality, Tints
from urlab_client.simulation.cameras import SceneCamera
from urlab_client.simulation.opengl import Backend, free_context, make_context

Bytes = NDArray[np.uint8]


NO_HIT_CM: Final = 1e8
"""Depth where a ray meets nothing, centimetres."""

NEAR_M: Final = 0.001
"""Near clip distance of every camera."""

_SLICES: Final = 16

_STACKS: Final = 8
"""Slices and stacks of round shapes in `fast` quality; MuJoCo's own numbers are 28 and 16."""

_OPAQUE: Final = np.array(0xFF000000, "<u4")

# A directional light shines everywhere, but its shadows are drawn around its position only, as far as
# `vis.map.shadowclip` times the model's extent. A robot that walks away from there loses its shadow, or parts of it.
_WIDER: Final = 8.0
_WIDE_M: Final = 5.0

_SEEN_COSINE: Final = 0.5
"""Half the cone, 60 degrees, in which a geom counts as seen."""


class Stage:
    """The OpenGL context and what is drawn with it. Everything happens on the thread that made it."""

    def __init__(self, model: mujoco.MjModel, backend: Backend, tints: Tints, quality: RenderQuality) -> None:
        """Create the context.

        Args:
            model: A model that nothing else uses; its visual settings are adjusted.
            backend: The way to OpenGL.
            tints: Colours of the segmentation modes.
            quality: Rendering quality.
        """
        self._model = model
        self._tints = tints
        self._fast = quality == "fast" or (quality == "auto" and backend.software)
        if self._fast:
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0
            model.vis.quality.numslices, model.vis.quality.numstacks = _SLICES, _STACKS
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0  # aids for the modeller, invisible to a camera
        self._subjects = moving_geoms(model)
        self._view = mujoco.MjvCamera()
        self._scene = mujoco.MjvScene(model, maxgeom=max(10_000, 2 * model.ngeom + 1000))
        width, height = model.vis.global_.offwidth, model.vis.global_.offheight
        self._gl = make_context(backend, width, height)
        self._renderer: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._renderer.shadowClip = shadow_clip(self._renderer.shadowClip)
        self._renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._opengl: Any = importlib.import_module("OpenGL.GL")  # only now: the context's module chooses its platform
        if self._fast:
            simplify_textures(self._renderer, self._opengl)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with contextlib.suppress(Exception):  # a failing driver may fail here, too
            self._renderer.free()
            free_context(self._gl, sound=kind is None)

    def prepare(self, data: mujoco.MjData) -> None:
        """Update derived quantities that drawing needs: after a step they belong to its beginning."""
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)
        mujoco.mj_flex(self._model, data)
        mujoco.mj_tendon(self._model, data)

    def draw(self, data: mujoco.MjData, camera: SceneCamera, mode: CameraMode) -> CameraFrame:
        """Draw what a camera sees."""
        width, height = camera.resolution
        pixels = self.pixels(data, camera, mode)
        dtype = "float32" if mode is CameraMode.DEPTH else "bgra8"
        return CameraFrame(width=width, height=height, dtype=dtype, data=pixels.tobytes())

    def pixels(self, data: mujoco.MjData, camera: SceneCamera, mode: CameraMode, order: str = "BGRA") -> NDArray[Any]:
        """Draw what a camera sees; return it from the top, as the wire has it unless `order` says otherwise.

        Args:
            data: The state, after `prepare`.
            camera: The camera.
            mode: What the pixels mean.
            order: Of mode `real`: `BGRA` or `RGBA`.

        Returns:
            Blue, green, red and alpha, shape (height, width, 4), uint8; of depth centimetres, shape (height, width),
            float32.
        """
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = camera.id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._view, everything, self._scene)
        for side in self._scene.camera:
            _bring_near(side)
        if not self._fast:
            follow_subject(self._scene, self._model, data, self._subjects)
        flags, kinds = self._scene.flags, mujoco.mjtRndFlag
        flags[kinds.mjRND_SHADOW] = flags[kinds.mjRND_REFLECTION] = not self._fast
        flags[kinds.mjRND_WIREFRAME] = False
        flags[kinds.mjRND_SEGMENT] = flags[kinds.mjRND_IDCOLOR] = mode is not CameraMode.REAL
        width, height = camera.resolution
        area = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(area, self._scene, self._renderer)
        if mode is CameraMode.DEPTH:
            depth = np.empty((height, width), np.float32)
            mujoco.mjr_readPixels(None, depth, area, self._renderer)
            return _centimetres(depth, self._scene.camera[0])[::-1]
        if mode is CameraMode.REAL:
            return self._read_colors(area, order)
        colors = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(colors, None, area, self._renderer)
        return self._segments(colors[::-1], mode)

    def _read_colors(self, area: mujoco.MjrRect, order: str) -> Bytes:
        """Return what was drawn, opaque, from the top, shape (height, width, 4).

        Args:
            area: The area to read.
            order: `BGRA` or `RGBA`.
        """
        shape = (area.height, area.width)
        if self._renderer.offSamples:  # only MuJoCo can read a buffer with several samples per pixel
            colors = np.empty((*shape, 3), np.uint8)
            mujoco.mjr_readPixels(colors, None, area, self._renderer)
            pixels = np.full((*shape, 4), 255, np.uint8)
            for channel in range(3):  # by pixel it takes four times as long
                pixels[:, :, 2 - channel if order == "BGRA" else channel] = colors[::-1, :, channel]
            return pixels
        gl = self._opengl
        read = np.empty((*shape, 4), np.uint8)
        gl.glReadPixels(0, 0, area.width, area.height, getattr(gl, f"GL_{order}"), gl.GL_UNSIGNED_BYTE, array=read)
        words = read.view("<u4")[::-1]  # one pass flips the picture and makes it opaque
        return np.bitwise_or(words, _OPAQUE).view(np.uint8)

    def _segments(self, colors: Bytes, mode: CameraMode) -> Bytes:
        """Replace MuJoCo's consecutive ids, 0 for nothing, by tints."""
        palette = np.zeros((self._scene.ngeom + 1, 4), np.uint8)
        palette[:, 3] = 255
        tints, geoms = self._tints.of(mode), int(mujoco.mjtObj.mjOBJ_GEOM)
        for drawn in self._scene.geoms[: self._scene.ngeom]:
            if drawn.segid >= 0 and drawn.objtype == geoms:
                palette[drawn.segid + 1, :3] = tints[drawn.objid]
        ids = colors.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32)
        return palette[ids]


def simplify_textures(renderer: Any, gl: Any) -> None:
    """Sample one mipmap of a texture, and none of a cube, which is seen enlarged: a third of the time.

    Args:
        renderer: `MjrContext` whose textures these are.
        gl: `OpenGL.GL`, imported after the context was made.
    """
    for texture, kind in zip(renderer.texture, renderer.textureType, strict=True):
        if texture:
            flat = kind == mujoco.mjtTexture.mjTEXTURE_2D
            target = gl.GL_TEXTURE_2D if flat else gl.GL_TEXTURE_CUBE_MAP
            gl.glBindTexture(target, int(texture))
            sampling = gl.GL_LINEAR_MIPMAP_NEAREST if flat else gl.GL_LINEAR
            gl.glTexParameteri(target, gl.GL_TEXTURE_MIN_FILTER, sampling)


def _bring_near(camera: Any) -> None:
    """Move the near clip plane without changing the view; the frustum's sizes are those at that plane."""
    if camera.orthographic:
        return
    ratio = NEAR_M / camera.frustum_near
    camera.frustum_near = NEAR_M
    camera.frustum_center *= ratio
    camera.frustum_width *= ratio
    camera.frustum_bottom *= ratio
    camera.frustum_top *= ratio


def _centimetres(depth: NDArray[np.float32], camera: Any) -> NDArray[np.float32]:
    """Return the distance along the optical axis from a depth buffer that is 1 near and 0 far."""
    near, far = np.float32(camera.frustum_near), np.float32(camera.frustum_far)
    if camera.orthographic:
        metres = far - depth.astype(np.float64) * (far - near)
    else:
        # In single precision, as MuJoCo makes its projection matrix: the rounding shows at a distance.
        scale = np.float32(0.5) * (far + near) / (far - near) - np.float32(0.5)
        metres = np.float32(2.0) * far * near / (far - near) * np.float32(0.5) / (depth.astype(np.float64) + scale)
    return np.where(depth > 0.0, metres * 100.0, NO_HIT_CM).astype("<f4")


def shadow_clip(own: float) -> float:
    """Return how far shadows should reach, metres, if MuJoCo would draw them up to `own`.

    The ground is speckled where they end, so that small scenes have them end outside the picture.
    """
    return max(own, min(_WIDER * own, _WIDE_M))


def moving_geoms(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the geoms of bodies that are not welded to the world; of a scene without them, all but planes."""
    bounded = model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
    moving = bounded & (model.body_weldid[model.geom_bodyid] != 0)
    return np.flatnonzero(moving if moving.any() else bounded)


def follow_subject(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.intp]) -> None:
    """Move the suns of a scene along the ground to a place above what the camera sees; their light does not change.

    The positions in `data` are computed. `geoms` are those of `moving_geoms`.
    """
    if not geoms.size:
        return
    camera: Any = scene.camera[0]
    places = data.geom_xpos[geoms]
    away = places - camera.pos
    seen = away @ camera.forward > _SEEN_COSINE * np.linalg.norm(away, axis=1)
    if not seen.any():
        return
    far = float(np.linalg.norm(np.ptp(places[seen], axis=0)))
    middle = (places[seen].min(axis=0) + places[seen].max(axis=0)) / 2.0
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    for light in scene.lights[: scene.nlight]:
        if light.type == directional and light.castshadow and not light.headlight:
            light.pos[:] = middle - max(model.stat.extent, far) * light.dir
