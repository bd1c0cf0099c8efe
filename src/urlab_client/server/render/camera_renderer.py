"""Camera images, drawn with MuJoCo's renderer in a thread of their own.

The handler of `step` asks a `CameraRenderer` for frames. The first frame triggers the search for OpenGL, in a child
process, because a broken driver may end the process that loads it. A machine without OpenGL serves no frames;
everything else goes on.

The colours of the segmentation modes are reproducible. The group of an articulation is the CRC-32 of its class name,
that of a prop the CRC-32 of its mesh file's stem or its shape. A tint's seed is 1 + (group) for `semantic` and
1 + ((group * 2654435761 mod 2^32) xor body id) for `instance`, with 31 bits kept of what is in the outer brackets. With
h(base) the radical inverse of the seed, hue is h(7), saturation 0.5 + 0.5 h(3) and value 0.6 + 0.4 h(5). Tints are
flat; the background is black.
"""

from __future__ import annotations

import atexit
import colorsys
import contextlib
import copy
import importlib
import logging
import os
import queue
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from types import MappingProxyType, TracebackType
from typing import Any, Final, Literal, Self, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._children import APART
from urlab_client.protocol.dialects import ALPHA, Dialect
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.messages.session import CameraChoice, CameraFrame
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.compile.scene_index import SceneCamera
from urlab_client.server.editor.viewport import ViewMode
from urlab_client.server.render.viewport_picture import (
    ViewportPicture,
    add_primitives,
    aim,
    ascii_text,
    bounds_of,
    light_evenly,
    outline,
    showing,
)
from urlab_client.server.system.health import Health
from urlab_client.server.system.thread_join import ended

__all__ = [
    "NO_HIT_CM",
    "Backend",
    "CameraRenderer",
    "Exposure",
    "Painting",
    "RenderQuality",
    "RenderingUnavailable",
    "Shot",
    "find_backend",
    "need_backend",
    "tint",
]

logger = logging.getLogger("urlab_client.server")

Bytes = NDArray[np.uint8]

RenderQuality: TypeAlias = Literal["auto", "fast", "high"]
"""`fast` leaves out smooth edges, shadows, reflections and blending between mipmaps, and draws round shapes a little
coarser; `high` does not; `auto` is `fast` where the processor draws and `high` elsewhere."""

NO_HIT_CM: Final = 1e8
"""Depth where a ray meets nothing, centimetres."""

NEAR_M: Final = 0.001
"""Near clip distance of every camera."""

LATEST_S: Final = 1.0 / 30.0
"""Age up to which a frame is the latest."""

FRAMES_DEADLINE_S: Final = 30.0
"""Longest wait for the frames of a step; the first ones include the search for OpenGL."""

MAX_FAILED: Final = 3
"""After so many failures in a row drawing is given up until the next play session."""

_PROBE_DEADLINE_S: Final = 60.0

_SLICES: Final = 16
_STACKS: Final = 8
"""How finely round shapes are drawn when it has to be fast; MuJoCo's own numbers are 28 and 16."""

_OPAQUE: Final = np.array(0xFF000000, "<u4")

_CHOICE: Final = "MUJOCO_GL"
_DISABLED: Final = ("disable", "disabled", "off", "false", "0")
_PACKAGES: Final = "apt install libegl1 libgl1-mesa-dri, or libosmesa6"
_SOFTWARE: Final = ("llvmpipe", "softpipe", "swrast", "software", "swiftshader")

_PROBE: Final = """
import mujoco
import numpy
from mujoco.{name} import GLContext
from OpenGL import GL

context = GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
scene = mujoco.MjvScene(model, 10)
camera = mujoco.MjvCamera()
camera.distance = 3
mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
area = mujoco.MjrRect(0, 0, 16, 16)
mujoco.mjr_render(area, scene, renderer)
pixels = numpy.zeros((16, 16, 3), numpy.uint8)
mujoco.mjr_readPixels(pixels, None, area, renderer)
if not pixels.any():
    raise SystemExit("it draws nothing")
print(GL.glGetString(GL.GL_RENDERER).decode(errors="replace"))
"""


# OpenGL


class RenderingUnavailable(URLabError):
    """No picture can be drawn: this machine has no OpenGL, drawing failed, or it took too long."""


@dataclass(frozen=True)
class Backend:
    """A way to OpenGL that works on this machine.

    Attributes:
        name: `egl`, `osmesa`, `cgl` or `glfw`: the module of MuJoCo that makes contexts.
        renderer: What draws, as the driver calls it.
    """

    name: str
    renderer: str

    @property
    def software(self) -> bool:
        """Whether the processor draws."""
        return self.name == "osmesa" or any(name in self.renderer.lower() for name in _SOFTWARE)


def find_backend() -> Backend | None:
    """Return what draws on this machine; None when nothing does.

    `MUJOCO_GL` names the only one to try, or disables drawing. The answer is looked for once per process.
    """
    found = _search()
    return found if isinstance(found, Backend) else None


def need_backend() -> Backend:
    """Return what draws on this machine.

    Raises:
        RenderingUnavailable: Nothing does; the message says why and what to install.
    """
    found = _search()
    if isinstance(found, Backend):
        return found
    raise RenderingUnavailable(f"nothing can be drawn here: {found}")


def _search() -> Backend | str:
    """Return what draws, or why nothing does."""
    with _probing:
        return _find(os.environ.get(_CHOICE, "").lower().strip())


_probing = threading.Lock()


@cache
def _find(choice: str) -> Backend | str:
    if choice in _DISABLED:
        return f"{_CHOICE}={choice} disables OpenGL; unset it"
    reasons: list[str] = []
    for name in _candidates(choice):
        found = _probe(name)
        if isinstance(found, Backend):
            logger.info("pictures are drawn with %s by %s", found.name, found.renderer)
            return found
        reasons.append(f"{name}: {found}")
    advice = _PACKAGES if sys.platform == "linux" else "install a graphics driver"
    return f"no OpenGL works here: {advice} ({'; '.join(reasons)})"


def _candidates(choice: str) -> Sequence[str]:
    if choice in ("egl", "osmesa", "cgl", "glfw"):
        return (choice,)
    if sys.platform == "linux":
        return ("glfw",) if choice == "glx" else ("egl", "osmesa")
    return ("cgl",) if sys.platform == "darwin" else ("glfw",)


def _probe(name: str) -> Backend | str:
    """Draw in a child process; return what drew, or why nothing did."""
    environment = {**os.environ, _CHOICE: "disable", "PYTHONSAFEPATH": "1"}
    environment.pop("PYOPENGL_PLATFORM", None)
    try:
        child = subprocess.run(  # noqa: S603 - a script of this module
            [sys.executable, "-c", _PROBE.format(name=name)],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_PROBE_DEADLINE_S,
            check=False,
            **APART,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if child.returncode == 0:
        return Backend(name, child.stdout.decode(errors="replace").strip())
    lines = child.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else f"the probe ended with code {child.returncode}"


# Cameras


@dataclass(eq=False)
class _Camera:
    info: SceneCamera
    mode: CameraMode
    frame: CameraFrame | None = None
    drawn_at: float = -float("inf")

    def stale(self, now: float) -> bool:
        return self.frame is None or now - self.drawn_at > LATEST_S


@dataclass(frozen=True)
class Shot:
    """A frame that a request asks for.

    Attributes:
        key: The camera as the request names it, the frame's key in the reply.
        camera: The camera.
        sync: Draw the state after the step, rather than hand over the latest frame.
    """

    key: str
    camera: _Camera
    sync: bool


@dataclass(eq=False)
class Exposure:
    """A state to be drawn, and the cameras to draw.

    Attributes:
        cameras: The cameras.
        data: The state.
        taken_at: When it was the state, monotonic seconds.
        frame_id: Number of its snapshot; None in dialects whose pictures do not tell.
        done: Set when the cameras have their frames, or never will.
    """

    cameras: Sequence[_Camera]
    data: mujoco.MjData
    taken_at: float
    frame_id: int | None = None
    done: threading.Event = field(default_factory=threading.Event)


@dataclass(eq=False)
class Painting:
    """A state of which a picture of the viewport is to be drawn.

    Attributes:
        picture: What it shows.
        data: The state.
        pixels: Red, green, blue and alpha from the top, shape (height, width, 4); None until it is drawn.
        done: Set when it is drawn, or never will be.
    """

    picture: ViewportPicture
    data: mujoco.MjData
    pixels: Bytes | None = None
    done: threading.Event = field(default_factory=threading.Event)


class CameraRenderer:
    """Draws the cameras of one scene; all share one OpenGL context, which belongs to a thread of its own."""

    def __init__(
        self,
        scene: CompiledScene,
        modes: Mapping[tuple[str, str], CameraMode],
        classes: Mapping[str, str],
        quality: RenderQuality = "auto",
        health: Health | None = None,
        *,
        names: Mapping[str, str] = MappingProxyType({}),
        dialect: Dialect = ALPHA,
    ) -> None:
        """Prepare for a scene; nothing is drawn, and no OpenGL looked for, before a frame is wanted.

        Args:
            scene: The scene.
            modes: What the pixels mean by articulation key and camera name; the others are `real`.
            classes: By actor name, the class or mesh that the colours of `semantic` and `instance` go by.
            quality: How well to draw.
            health: Told when the thread that draws dies.
            names: What articulations are called in requests and replies, by key; that, for those not mentioned.
            dialect: Decides what cameras are called there.
        """
        self._scene = scene
        self._health = Health() if health is None else health
        self._quality: RenderQuality = quality
        self._tints = _Tints(scene, classes)
        self._stamped = dialect.camera_forms
        self._by_name: dict[str, _Camera] = {}
        self._bare: dict[str, _Camera] = {}
        for index in scene.articulations:
            for info in index.cameras:
                camera = _Camera(info, modes.get((index.key, info.name), CameraMode.REAL))
                robot = names.get(index.key, index.key)
                self._by_name[f"{robot}/{dialect.camera_part(info.name)}"] = camera
                self._bare[dialect.camera_key(robot, info.name)] = camera  # of several, the last
        self._model: mujoco.MjModel | None = None
        self._spare: list[mujoco.MjData] = []  # making one takes longer than copying a state
        self._queue: queue.SimpleQueue[Exposure | Painting | None] = queue.SimpleQueue()
        self._pending: set[Exposure | Painting] = set()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._drawing = False
        self._broken = False
        self._closed = False

    @property
    def keys(self) -> list[str]:
        """All cameras as `ARTICULATION/CAMERA`."""
        return list(self._by_name)

    def shots(self, include_cameras: CameraChoice, *, fresh: bool = False) -> list[Shot]:
        """Return what a request's `include_cameras` asks for; unknown names are left out.

        Args:
            include_cameras: The request's field.
            fresh: Whether every picture is to show the state after the step.
        """
        if isinstance(include_cameras, bool):
            return [Shot(key, camera, sync=fresh) for key, camera in self._bare.items()] if include_cameras else []
        shots: list[Shot] = []
        for key, kind in include_cameras.items():
            camera = self._by_name.get(key) or self._bare.get(key)
            if camera is not None and kind is not None:
                # A picture from some snapshot on is asked for: that of now is one, if there is any.
                later = self._stamped and not isinstance(kind, str)
                sync = fresh or later or (isinstance(kind, str) and kind.lower() == "sync")
                shots.append(Shot(key, camera, sync=sync))
        return shots

    def frame_bytes(self, include_cameras: CameraChoice) -> int:
        """Return the size of the pixels that a request's `include_cameras` asks for."""
        sizes = (shot.camera.info.resolution for shot in self.shots(include_cameras))
        return sum(4 * width * height for width, height in sizes)

    def resolutions(self) -> dict[str, tuple[int, int]]:
        """Return width and height of all cameras by `ARTICULATION/CAMERA`."""
        return {key: camera.info.resolution for key, camera in self._by_name.items()}

    def capture(self, shots: Iterable[Shot], frame_id: int = 0) -> Exposure | None:
        """Copy the state that `frames` draws; the caller holds the engine's lock.

        Args:
            shots: What is asked for.
            frame_id: Number of the state's snapshot.

        Returns:
            What to hand to `frames`; None if nothing has to be drawn.
        """
        now = time.monotonic()
        cameras = list(dict.fromkeys(shot.camera for shot in shots if shot.sync or shot.camera.stale(now)))
        if not cameras or self._broken:
            return None
        return Exposure(cameras, self._copy_state(), now, frame_id if self._stamped else None)

    def frames(self, shots: Sequence[Shot], job: Exposure | None) -> dict[str, CameraFrame] | None:
        """Draw what has to be drawn and return the frames by the request's keys; None without any.

        Without OpenGL, or when drawing fails or takes too long, cameras are left out; the log says why.

        Args:
            shots: What is asked for.
            job: What `capture` returned.
        """
        if job is not None and self._submit(job) and not job.done.wait(FRAMES_DEADLINE_S):
            logger.warning("no camera images within %g s; continuing without them", FRAMES_DEADLINE_S)
        frames = {
            shot.key: shot.camera.frame
            for shot in shots
            if shot.camera.frame is not None and (not shot.sync or job is None or shot.camera.drawn_at >= job.taken_at)
        }
        return frames or None

    def capture_viewport(self, picture: ViewportPicture) -> Painting:
        """Copy the state that `paint` draws; the caller holds the engine's lock."""
        return Painting(picture, self._copy_state())

    def paint(self, job: Painting) -> Bytes:
        """Draw a picture of the viewport.

        Args:
            job: What `capture_viewport` returned.

        Returns:
            Red, green, blue and alpha from the top, shape (height, width, 4).

        Raises:
            RenderingUnavailable: It cannot be drawn.
        """
        need_backend()
        if not self._submit(job):
            raise RenderingUnavailable(
                "play ended before the picture was drawn" if self._closed else "drawing failed; the log says why"
            )
        if not job.done.wait(FRAMES_DEADLINE_S):
            raise RenderingUnavailable(f"no picture within {FRAMES_DEADLINE_S:g} s")
        if job.pixels is None:
            raise RenderingUnavailable("the picture was not drawn; if play has not ended, the log says why")
        return job.pixels

    def close(self, timeout: float = 1.0) -> bool:
        """Stop drawing and release whoever waits. Safe to call twice.

        Args:
            timeout: Seconds to wait for the thread.

        Returns:
            False when it was still drawing then.
        """
        with self._lock:
            self._closed = True
            self._release()
            thread = self._thread
            drawing = self._drawing
        if thread is None or not drawing:  # a search for OpenGL under way ends by itself, and touches nothing here
            return True
        atexit.unregister(self.close)
        self._queue.put(None)
        return ended(thread, timeout)

    def _copy_state(self) -> mujoco.MjData:
        if self._model is None:
            self._model = copy.copy(self._scene.model)  # its own visual settings, and no eye on changing options
        try:
            data = self._spare.pop()
        except IndexError:
            data = mujoco.MjData(self._model)
        mujoco.mj_copyData(data, self._model, self._scene.data)
        return data

    def _submit(self, job: Exposure | Painting) -> bool:
        with self._lock:
            if self._closed or self._broken:
                return False
            self._pending.add(job)
            self._queue.put(job)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="urlab-render", daemon=True)
                self._thread.start()
        return True

    def _release(self) -> None:
        while self._pending:
            self._pending.pop().done.set()

    def _run(self) -> None:
        try:
            backend = _search()
            if isinstance(backend, str):
                logger.warning("camera images are left out: %s", backend)
                return
            with self._lock:
                self._drawing = not self._closed
            if self._drawing and self._model is not None:
                with _Stage(self._model, backend, self._tints, self._quality) as stage:
                    atexit.register(self.close)  # after the driver's own hook, so before it at the end
                    self._draw(stage)
        except Exception:
            logger.exception("camera images are left out from now on: drawing failed")
        except BaseException as error:  # noqa: BLE001 - who asks for images hears of it by the next request
            self._health.report(error)
        finally:
            with self._lock:
                self._broken = True
                self._release()

    def _draw(self, stage: _Stage) -> None:
        failed = 0
        while (job := self._queue.get()) is not None:
            try:
                stage.prepare(job.data)
                self._draw_job(stage, job)
                failed = 0
            except Exception:
                failed += 1
                if failed == MAX_FAILED:
                    raise
                logger.exception("an image is left out: it could not be drawn")
            if self._closed:
                return
            self._spare.append(job.data)
            with self._lock:
                self._pending.discard(job)
            job.done.set()

    def _draw_job(self, stage: _Stage, job: Exposure | Painting) -> None:
        if isinstance(job, Painting):
            job.pixels = stage.paint(job.data, job.picture)
            return
        for camera in job.cameras:
            if self._closed:
                return
            frame = stage.draw(job.data, camera.info, camera.mode)
            if job.frame_id is not None:
                frame.frame_id, frame.sim_time = job.frame_id, float(job.data.time)
            camera.frame = frame
            camera.drawn_at = job.taken_at


class _Stage:
    """The OpenGL context and what is drawn with it. Everything happens on the thread that made it."""

    def __init__(self, model: mujoco.MjModel, backend: Backend, tints: _Tints, quality: RenderQuality) -> None:
        """Make the context.

        Args:
            model: A model of its own, whose visual settings are adjusted.
            backend: What draws.
            tints: Colours of the segmentation modes.
            quality: How well to draw.
        """
        self._model = model
        self._tints = tints
        self._fast = quality == "fast" or (quality == "auto" and backend.software)
        if self._fast:
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0
            model.vis.quality.numslices, model.vis.quality.numstacks = _SLICES, _STACKS
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:] = 0  # marks for the modeller, not things to be seen
        self._view = mujoco.MjvCamera()
        self._scene = mujoco.MjvScene(model, maxgeom=max(10_000, 2 * model.ngeom + 1000))
        width, height = model.vis.global_.offwidth, model.vis.global_.offheight
        self._gl: Any = importlib.import_module(f"mujoco.{backend.name}").GLContext(width, height)
        self._gl.make_current()
        self._renderer: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._renderer)
        self._renderer.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._opengl: Any = importlib.import_module("OpenGL.GL")  # only now: the context's module chooses its platform
        if self._fast:
            self._simplify_textures()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with contextlib.suppress(Exception):  # a driver that is in trouble is so here, too
            self._renderer.free()
            self._gl.free()

    def prepare(self, data: mujoco.MjData) -> None:
        """Bring what is drawn up to the state: after a step it is that of the step's beginning."""
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)
        mujoco.mj_flex(self._model, data)
        mujoco.mj_tendon(self._model, data)

    def draw(self, data: mujoco.MjData, camera: SceneCamera, mode: CameraMode) -> CameraFrame:
        """Draw what a camera sees."""
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = camera.id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, self._view, everything, self._scene)
        for side in self._scene.camera:
            _bring_near(side)
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
            return _frame(camera, "float32", _centimetres(depth, self._scene.camera[0])[::-1])
        if mode is CameraMode.REAL:
            return _frame(camera, "bgra8", self._read_colors(area, "BGRA"))
        colors = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_readPixels(colors, None, area, self._renderer)
        return _frame(camera, "bgra8", self._segments(colors[::-1], mode))

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

    def _simplify_textures(self) -> None:
        """Sample one mipmap of a texture, and none of a cube, which is seen enlarged: a third of the time."""
        gl, renderer = self._opengl, self._renderer
        for texture, kind in zip(renderer.texture, renderer.textureType, strict=True):
            if texture:
                flat = kind == mujoco.mjtTexture.mjTEXTURE_2D
                target = gl.GL_TEXTURE_2D if flat else gl.GL_TEXTURE_CUBE_MAP
                gl.glBindTexture(target, int(texture))
                sampling = gl.GL_LINEAR_MIPMAP_NEAREST if flat else gl.GL_LINEAR
                gl.glTexParameteri(target, gl.GL_TEXTURE_MIN_FILTER, sampling)

    def _read_colors(self, area: mujoco.MjrRect, order: str) -> Bytes:
        """Return what was drawn, opaque, from the top, shape (height, width, 4).

        Args:
            area: What to read.
            order: `BGRA` or `RGBA`.
        """
        shape = (area.height, area.width)
        if self._renderer.offSamples:  # MuJoCo alone can read a buffer with several samples a pixel
            colors = np.empty((*shape, 3), np.uint8)
            mujoco.mjr_readPixels(colors, None, area, self._renderer)
            pixels = np.full((*shape, 4), 255, np.uint8)
            pixels[:, :, :3] = colors[::-1, :, ::-1] if order == "BGRA" else colors[::-1]
            return pixels
        gl = self._opengl
        read = np.empty((*shape, 4), np.uint8)
        gl.glReadPixels(0, 0, area.width, area.height, getattr(gl, f"GL_{order}"), gl.GL_UNSIGNED_BYTE, array=read)
        words = read.view("<u4")[::-1]  # one pass turns the picture over and makes it opaque
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


def _frame(camera: SceneCamera, dtype: str, pixels: NDArray[Any]) -> CameraFrame:
    width, height = camera.resolution
    return CameraFrame(width=width, height=height, dtype=dtype, data=pixels.tobytes())


# Tints


class _Tints:
    """Whose the geoms are, and their colours in the segmentation modes, blue, green, red."""

    def __init__(self, scene: CompiledScene, classes: Mapping[str, str]) -> None:
        self._scene = scene
        self._classes = classes
        self._found: dict[CameraMode, Bytes] = {}

    def of(self, mode: CameraMode) -> Bytes:
        """Return the colours, shape (ngeom, 3); what belongs to no actor is black."""
        if mode not in self._found:
            self._found[mode] = self._compute(mode)
        return self._found[mode]

    def owned_by(self, actor: str) -> NDArray[np.bool_]:
        """Return which geoms belong to an actor, by its name; shape (ngeom,)."""
        return np.array([owner == actor for owner in self._owners], np.bool_)

    @cached_property
    def _owners(self) -> list[str]:
        """Name of the actor that a geom belongs to; empty for none."""
        model = self._scene.model
        bodies: dict[int, str] = {entity.body: self._owner(entity.name) for entity in self._scene.entities}
        for index in self._scene.articulations:
            bodies.update(dict.fromkeys(index.bodies.tolist(), index.key))
        return [
            bodies.get(body) or self._owner(model.geom(geom).name)
            for geom, body in enumerate(model.geom_bodyid.tolist())
        ]

    def _compute(self, mode: CameraMode) -> Bytes:
        model = self._scene.model
        colors = np.zeros((model.ngeom, 3), np.uint8)
        for geom, (owner, body) in enumerate(zip(self._owners, model.geom_bodyid.tolist(), strict=True)):
            if owner:
                group = zlib.crc32(self._classes.get(owner, owner).encode())
                red, green, blue = tint(group, body if mode is CameraMode.INSTANCE else None)
                colors[geom] = blue, green, red
        return colors

    def _owner(self, name: str) -> str:
        """Return the actor whose name a compiled name begins with; the longest, if several do."""
        return max(
            (actor for actor in self._classes if name.startswith(f"{actor}_") or name == actor), key=len, default=""
        )


def tint(group: int, body: int | None) -> tuple[int, int, int]:
    """Return red, green, blue of a group, for `semantic`, or of one of its bodies, for `instance`.

    Args:
        group: 32-bit hash of the group's name.
        body: Body id; None for the whole group.
    """
    mixed = group if body is None else group * 2654435761 % 2**32 ^ body
    seed = (mixed & 0x7FFFFFFF) + 1
    hue, saturation, value = _inverse(seed, 7), 0.5 + 0.5 * _inverse(seed, 3), 0.6 + 0.4 * _inverse(seed, 5)
    red, green, blue = (round(255.0 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value))
    return red, green, blue


def _inverse(seed: int, base: int) -> float:
    """Return the radical inverse: the seed's digits mirrored at the point."""
    result, share = 0.0, 1.0
    while seed > 0:
        share /= base
        seed, digit = divmod(seed, base)
        result += digit * share
    return result
