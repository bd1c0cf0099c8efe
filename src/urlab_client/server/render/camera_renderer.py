"""Camera images, drawn with MuJoCo's renderer in a separate thread.

The handler of `step` asks a `CameraRenderer` for frames. The first frame triggers the search for OpenGL, in a child
process, because a broken driver may end the process that loads it. A machine without OpenGL serves no frames;
everything else works.
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
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.protocol.messages.session import CameraChoice, CameraFrame
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.dialects import ALPHA, Dialect
from urlab_client.server.render.viewport_picture import ViewportPicture, ViewportStage
from urlab_client.server.system.threads import Health, ended
from urlab_client.simulation.appearance import Appearance, RenderQuality, Tints
from urlab_client.simulation.cameras import Instant, Latency, Past, SceneCamera
from urlab_client.simulation.opengl import RenderingUnavailable, need_backend, search_backend

logger: logging.Logger = logging.getLogger("urlab_client.server")

Bytes = NDArray[np.uint8]
Look = Mapping[str, NDArray[Any]]
"""Names of the model fields that pictures depend on."""

LATEST_S: Final = 1.0 / 30.0
"""Age up to which a frame counts as the latest."""

FRAMES_DEADLINE_S: Final = 30.0
"""Longest wait for the frames of a step; the first ones include the search for OpenGL."""

_VISIBLE: Final = (
    mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)
"""The parts of a state that pictures depend on."""

GIVEN_UP: Final = 8
"""Maximum number of abandoned states in the queue; beyond it, older frames are returned."""

MAX_FAILED: Final = 3
"""After so many failures in a row drawing is given up until the next play session."""


@dataclass(eq=False)
class _Camera:
    info: SceneCamera
    mode: CameraMode
    frame: CameraFrame | None = None
    drawn_at: float = -float("inf")
    latency: Latency | None = None

    def stale(self, now: float) -> bool:
        return self.frame is None or now - self.drawn_at > LATEST_S


@dataclass(frozen=True)
class Shot:
    """A frame that a request asks for.

    Attributes:
        key: The camera as the request names it, the frame's key in the reply.
        sync: Draw the state after the step, rather than hand over the latest frame.
        late: The camera's latency, if it has one.
        least: Number of the oldest acceptable snapshot.
        older: Whether an older frame is acceptable if the state is not drawn in time.
    """

    key: str
    camera: _Camera
    sync: bool
    late: Latency | None = None
    least: float = 0.0
    older: bool = False


@dataclass(eq=False)
class Exposure:
    """A state to be drawn, and the cameras to draw.

    Attributes:
        taken_at: Time of the state, monotonic seconds.
        frame_id: Number of its snapshot; None in dialects whose pictures do not carry it.
        past: Receiver of the delayed frame, if the camera has a latency.
        look: Values of the model fields that vary.
        done: Set when the cameras have their frames, or never will.
    """

    cameras: Sequence[_Camera]
    data: mujoco.MjData
    taken_at: float
    frame_id: int | None = None
    past: Past | None = None
    look: Look | None = None
    done: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True)
class Film:
    """The states from which the frames of a request are drawn.

    Attributes:
        taken_at: When it was captured, monotonic seconds.
        captured: The same time as Unix seconds.
        number: Number of the state's snapshot.
        past: What delayed cameras show; cameras without a state to show yet are missing.
    """

    taken_at: float
    captured: float
    number: int
    jobs: Sequence[Exposure]
    past: Mapping[Latency, Past]

    def frame(self, shot: Shot) -> CameraFrame | None:
        """Return the frame for a shot, once `jobs` are done; None without one that is new enough."""
        if shot.late is not None:
            past = self.past.get(shot.late)
            return None if past is None else past.frame
        frame = shot.camera.frame
        if frame is None or (frame.frame_id or 0) < shot.least:
            return None
        asked = any(shot.camera in job.cameras for job in self.jobs if job.past is None)
        in_time = not asked or shot.camera.drawn_at >= self.taken_at
        return frame if in_time or shot.older or not shot.sync else None

    def snapshot(self, shot: Shot) -> int:
        """Return the number of the snapshot in the frame for a shot, or of an earlier one."""
        past = None if shot.late is None else self.past.get(shot.late)
        return self.number if past is None else past.frame_id

    def capture_time(self, shot: Shot) -> float:
        """Return the time of the state in the frame for a shot, Unix seconds."""
        past = None if shot.late is None else self.past.get(shot.late)
        return self.captured if past is None else past.captured


@dataclass(eq=False)
class Painting:
    """A state to be drawn as a picture of the viewport.

    Attributes:
        look: Values of the model fields that vary.
        pixels: Red, green, blue and alpha from the top, shape (height, width, 4); None until it is drawn.
        done: Set when it is drawn, or never will be.
    """

    picture: ViewportPicture
    data: mujoco.MjData
    look: Look | None = None
    pixels: Bytes | None = None
    done: threading.Event = field(default_factory=threading.Event)


class CameraRenderer:
    """Draws the cameras of one scene; all share one OpenGL context, which belongs to a separate thread."""

    def __init__(
        self,
        scene: CompiledScene,
        modes: Mapping[tuple[str, str], CameraMode],
        appearance: Appearance,
        health: Health | None = None,
        *,
        names: Mapping[str, str] = MappingProxyType({}),
        varied: Sequence[str] = (),
        dialect: Dialect = ALPHA,
    ) -> None:
        """Prepare for a scene. Drawing, and the search for OpenGL, begin with the first request for a frame.

        Args:
            modes: Meaning of the pixels by articulation key and camera name; `real` by default.
            names: Names of articulations in requests and replies, by key; the key itself by default.
            varied: Fields of the model that pictures depend on, and that change from reset to reset.
        """
        self._scene = scene
        self._health = Health() if health is None else health
        self._quality: RenderQuality = appearance.quality
        owners = {body: index.key for index in scene.articulations for body in index.bodies.tolist()}
        self._tints = Tints(scene.model, appearance.classes, owners)
        self._stamped = dialect.camera_forms
        self._by_name: dict[str, _Camera] = {}
        self._bare: dict[str, _Camera] = {}
        for index in scene.articulations:
            for info in index.cameras:
                camera = _Camera(info, modes.get((index.key, info.name), CameraMode.REAL))
                robot = names.get(index.key, index.key)
                self._by_name[f"{robot}/{dialect.camera_part(info.name)}"] = camera
                self._bare[dialect.camera_key(robot, info.name)] = camera  # the last of several
        self._varied = tuple(varied)
        self._episode = 0
        self._model: mujoco.MjModel | None = None
        self._spare: list[mujoco.MjData] = []  # making one takes longer than copying a state
        self._queue: queue.SimpleQueue[Exposure | Painting | None] = queue.SimpleQueue()
        self._pending: set[Exposure | Painting] = set()
        self._given_up: list[Exposure] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._drawing = False
        self._ready = threading.Event()
        self._broken = False
        self._closed = False

    @property
    def keys(self) -> list[str]:
        """All cameras as `ARTICULATION/CAMERA`."""
        return list(self._by_name)

    def shots(self, include_cameras: CameraChoice, *, fresh: bool = False) -> list[Shot]:
        """Return what a request's `include_cameras` asks for; unknown names are left out.

        Args:
            fresh: Whether every picture is to show the state after the step.
        """
        if isinstance(include_cameras, bool):
            cameras = self._bare if include_cameras else {}
            return [Shot(key, camera, sync=fresh, late=_late(camera), older=fresh) for key, camera in cameras.items()]
        shots: list[Shot] = []
        for key, kind in include_cameras.items():
            camera = self._by_name.get(key) or self._bare.get(key)
            if camera is not None and kind is not None:
                now = isinstance(kind, str) and kind.lower() == "sync"
                late = None if now else _late(camera)
                # The request wants a picture of some snapshot or a later one: the current one will do.
                least = 0.0 if isinstance(kind, str) or not self._stamped else kind.get("frame_id", 0.0)
                later = self._stamped and not isinstance(kind, str)
                older = fresh and not later
                shots.append(Shot(key, camera, sync=fresh or later or now, late=late, least=least, older=older))
        return shots

    def stream_shots(self, keys: Iterable[str]) -> list[Shot]:
        """Return what the streams of cameras, by `ARTICULATION/CAMERA`, show; unknown ones are left out."""
        cameras = {key: self._by_name[key] for key in keys if key in self._by_name}
        return [Shot(key, camera, sync=True, late=_late(camera)) for key, camera in cameras.items()]

    def newest(self, key: str) -> int:
        """Return the number of the newest snapshot that a camera has drawn, by `ARTICULATION/CAMERA`; else 0."""
        frame = self._by_name[key].frame
        return 0 if frame is None else frame.frame_id or 0

    def latency(self, key: str) -> CameraDelayInForce | None:
        """Return the latency of a camera as it was set; None if it was not."""
        latency = self._by_name[key].latency
        return None if latency is None else latency.settings

    def delay(self, key: str, settings: CameraDelayInForce, seed: int) -> None:
        """Set the latency of a camera, by `ARTICULATION/CAMERA`; the caller holds the engine's lock."""
        camera = self._by_name[key]
        camera.latency = Latency(settings, seed, camera.latency)

    @property
    def delays(self) -> bool:
        """Whether a camera shows what it saw some time ago, so that `see` has to be called."""
        return any(_late(camera) is not None for camera in self._by_name.values())

    def see(self, frame_id: int, episode: int) -> None:
        """Let the delayed cameras see the state; the caller holds the engine's lock."""
        now = self._now()
        if episode != self._episode:
            self._episode = episode
            for camera in self._by_name.values():
                if camera.latency is not None:
                    camera.latency.forget()
        late = [late for camera in self._by_name.values() if (late := _late(camera)) and not late.skips(now)]
        if not late:
            return
        model, data = self._scene.model, self._scene.data
        state = np.empty(mujoco.mj_stateSize(model, _VISIBLE))
        mujoco.mj_getState(model, data, state, _VISIBLE)
        captured = time.time()
        for latency in late:
            latency.see(frame_id, now, captured, state)

    def frame_bytes(self, include_cameras: CameraChoice) -> int:
        """Return the size of the pixels that a request's `include_cameras` asks for."""
        sizes = (shot.camera.info.resolution for shot in self.shots(include_cameras))
        return sum(4 * width * height for width, height in sizes)

    def resolutions(self) -> dict[str, tuple[int, int]]:
        """Return width and height of all cameras by `ARTICULATION/CAMERA`."""
        return {key: camera.info.resolution for key, camera in self._by_name.items()}

    def capture(self, shots: Iterable[Shot], frame_id: int = 0) -> Film:
        """Copy the states that `frames` draws; the caller holds the engine's lock.

        Args:

        Returns:
            The argument for `frames`.
        """
        self._given_up = [job for job in self._given_up if not job.done.is_set()]
        now, draw = self._now(), not self._broken and len(self._given_up) < GIVEN_UP
        look = self._copy_look()
        jobs: list[Exposure] = []
        past: dict[Latency, Past] = {}
        cameras: list[_Camera] = []
        for shot in shots:
            if shot.late is None:
                if shot.camera not in cameras and (shot.sync or shot.camera.stale(now.wall)):
                    cameras.append(shot.camera)
            elif shot.late not in past and (seen := shot.late.revealed(now)) is not None:
                past[shot.late] = seen
                if seen.frame is None and draw:
                    jobs.append(Exposure([shot.camera], self._past_state(seen), now.wall, seen.frame_id, seen, look))
        if cameras and draw:
            number = frame_id if self._stamped else None
            jobs.append(Exposure(cameras, self._copy_state(), now.wall, number, look=look))
        return Film(now.wall, time.time(), frame_id, jobs, past)

    def frames(
        self, shots: Sequence[Shot], film: Film, wait_s: float = FRAMES_DEADLINE_S
    ) -> dict[str, CameraFrame] | None:
        """Draw the missing frames and return all frames by the request's keys; None if there are none.

        Without OpenGL, or if drawing fails or takes too long, cameras are left out; the log gives the reason.

        Args:
            wait_s: Seconds that drawing may take before frames are left out, or older ones taken; what was begun
                is drawn all the same. They begin when OpenGL has been found, which no request can hurry.
        """
        drawing = [job for job in film.jobs if self._submit(job)]
        if drawing:
            self._ready.wait(FRAMES_DEADLINE_S)
        deadline = time.monotonic() + wait_s
        if not all(job.done.wait(max(0.0, deadline - time.monotonic())) for job in drawing):
            self._given_up.extend(drawing)
            if wait_s >= FRAMES_DEADLINE_S:
                logger.warning("no camera images within %g s; continuing without them", wait_s)
        return {shot.key: frame for shot in shots if (frame := film.frame(shot)) is not None} or None

    def capture_viewport(self, picture: ViewportPicture) -> Painting:
        """Copy the state that `paint` draws; the caller holds the engine's lock."""
        return Painting(picture, self._copy_state(), self._copy_look())

    def paint(self, job: Painting) -> Bytes:
        """Draw a picture of the viewport.

        Returns:
            Red, green, blue and alpha from the top, shape (height, width, 4).

        Raises:
            RenderingUnavailable: The picture cannot be drawn.
        """
        need_backend()
        if not self._submit(job):
            raise RenderingUnavailable(
                "play ended before the picture was drawn" if self._closed else "drawing failed; see the log"
            )
        if not job.done.wait(FRAMES_DEADLINE_S):
            raise RenderingUnavailable(f"no picture within {FRAMES_DEADLINE_S:g} s")
        if job.pixels is None:
            raise RenderingUnavailable("the picture was not drawn; see the log if play has not ended")
        return job.pixels

    def close(self, timeout: float = 1.0) -> bool:
        """Stop drawing and release waiting callers. Idempotent.

        Returns:
            False if it was still drawing then.
        """
        with self._lock:
            self._closed = True
            self._ready.set()
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

    def _copy_look(self) -> Look | None:
        model = self._scene.model
        return {name: np.array(getattr(model, name)) for name in self._varied} if self._varied else None

    def _past_state(self, past: Past) -> mujoco.MjData:
        data = self._copy_state()  # whatever the past does not hold is as it is now
        mujoco.mj_setState(self._scene.model, data, past.state, _VISIBLE)
        return data

    def _now(self) -> Instant:
        return Instant(float(self._scene.data.time), time.monotonic())

    def _submit(self, job: Exposure | Painting) -> bool:
        with self._lock:
            if self._closed or self._broken:
                return False
            self._pending.add(job)
            self._queue.put(job)
            if self._thread is None:
                self._thread = self._health.thread("urlab-render", self._run)
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
                with ViewportStage(self._model, backend, self._tints, self._quality) as stage:
                    atexit.register(self.close)  # after the driver's own hook, so before it at the end
                    self._ready.set()
                    self._draw(stage)
        except Exception:
            logger.exception("camera images are left out from now on: drawing failed")
        finally:
            with self._lock:
                self._broken = True
                self._ready.set()
                self._release()

    def _draw(self, stage: ViewportStage) -> None:
        failed = 0
        while (job := self._queue.get()) is not None:
            try:
                for name, values in (job.look or {}).items():
                    getattr(self._model, name)[...] = values
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

    def _draw_job(self, stage: ViewportStage, job: Exposure | Painting) -> None:
        if isinstance(job, Painting):
            job.pixels = stage.paint(job.data, job.picture)
            return
        for camera in job.cameras:
            if self._closed:
                return
            frame = stage.draw(job.data, camera.info, camera.mode)
            if job.frame_id is not None:
                frame.frame_id, frame.sim_time = job.frame_id, float(job.data.time)
            if job.past is not None:
                job.past.frame = frame
                continue
            camera.frame = frame
            camera.drawn_at = job.taken_at


def _late(camera: _Camera) -> Latency | None:
    return camera.latency if camera.latency is not None and camera.latency.withholds else None
