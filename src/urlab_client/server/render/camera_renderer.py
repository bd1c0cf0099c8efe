"""Camera images, drawn with MuJoCo's renderer in a thread of their own.

The handler of `step` asks a `CameraRenderer` for frames. The first frame triggers the search for OpenGL, in a child
process, because a broken driver may end the process that loads it. A machine without OpenGL serves no frames;
everything else goes on.
"""

from __future__ import annotations

import atexit
import copy
import logging
import queue
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.dialects import ALPHA, Dialect
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.messages.session import CameraChoice, CameraFrame
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.compile.scene_index import SceneCamera
from urlab_client.server.render.drawing import RenderQuality, Stage
from urlab_client.server.render.opengl import RenderingUnavailable, need_backend, search_backend
from urlab_client.server.render.tints import Tints
from urlab_client.server.render.viewport_picture import ViewportPicture
from urlab_client.server.system.health import Health
from urlab_client.server.system.thread_join import ended

__all__ = ["CameraRenderer", "Exposure", "Painting", "Shot"]

logger = logging.getLogger("urlab_client.server")

Bytes = NDArray[np.uint8]

LATEST_S: Final = 1.0 / 30.0
"""Age up to which a frame is the latest."""

FRAMES_DEADLINE_S: Final = 30.0
"""Longest wait for the frames of a step; the first ones include the search for OpenGL."""

MAX_FAILED: Final = 3
"""After so many failures in a row drawing is given up until the next play session."""


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
        self._tints = Tints(scene, classes)
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
            backend = search_backend()
            if isinstance(backend, str):
                logger.warning("camera images are left out: %s", backend)
                return
            with self._lock:
                self._drawing = not self._closed
            if self._drawing and self._model is not None:
                with Stage(self._model, backend, self._tints, self._quality) as stage:
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

    def _draw(self, stage: Stage) -> None:
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

    def _draw_job(self, stage: Stage, job: Exposure | Painting) -> None:
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
