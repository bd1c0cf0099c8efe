"""Camera images, drawn with MuJoCo's renderer in a separate thread.

The handler of `step` asks a `CameraRenderer` for frames. The first frame triggers the search for OpenGL, in a child
process, because a broken driver may end the process that loads it. A machine without OpenGL serves no frames;
everything else works.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, wait
from dataclasses import dataclass
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
from urlab_client.server.system.threads import Health
from urlab_client.simulation.appearance import Appearance, RenderQuality, Tints
from urlab_client.simulation.cameras import Instant, Latency, Past, SceneCamera
from urlab_client.simulation.drawing import Stage
from urlab_client.simulation.opengl import Backend, RenderingUnavailable, need_backend, search_backend
from urlab_client.simulation.painting import Painter, Visible, visible_state

logger: logging.Logger = logging.getLogger("urlab_client.server")

Bytes = NDArray[np.uint8]

LATEST_S: Final = 1.0 / 30.0
"""Age up to which a frame counts as the latest."""

FRAMES_DEADLINE_S: Final = 30.0
"""Longest wait for the frames of a step; the first ones include the search for OpenGL."""

GIVEN_UP: Final = 8
"""Maximum number of abandoned states in the queue; beyond it, older frames are returned."""


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


@dataclass(frozen=True, eq=False)
class Exposure:
    """A state to be drawn, and the cameras to draw.

    Attributes:
        taken_at: Time of the state, monotonic seconds.
        frame_id: Number of its snapshot; None in dialects whose pictures do not carry it.
        past: Receiver of the delayed frame, if the camera has a latency.
    """

    cameras: Sequence[_Camera]
    visible: Visible
    taken_at: float
    frame_id: int | None = None
    past: Past | None = None

    def draw(self, stage: Stage, data: mujoco.MjData) -> None:
        """Give the cameras, or the past state, their frames. For the thread that draws."""
        for camera in self.cameras:
            frame = stage.draw(data, camera.info, camera.mode)
            if self.frame_id is not None:
                frame.frame_id, frame.sim_time = self.frame_id, float(data.time)
            if self.past is not None:
                self.past.frame = frame
            else:
                camera.frame, camera.drawn_at = frame, self.taken_at


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
        self._painter: Painter[ViewportStage] | None = None
        self._given_up: list[Future[None]] = []
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
        state = visible_state(self._scene.model, self._scene.data)
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

    def capture(self, shots: Iterable[Shot], frame_id: int) -> Film:
        """Copy the states that `frames` draws; the caller holds the engine's lock.

        Args:

        Returns:
            The argument for `frames`.
        """
        self._given_up = [drawn for drawn in self._given_up if not drawn.done()]
        now, draw = self._now(), not self._made_painter().ended and len(self._given_up) < GIVEN_UP
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
                    jobs.append(Exposure([shot.camera], Visible(seen.state, look), now.wall, seen.frame_id, seen))
        if cameras and draw:
            number = frame_id if self._stamped else None
            state = visible_state(self._scene.model, self._scene.data)
            jobs.append(Exposure(cameras, Visible(state, look), now.wall, number))
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
        painter = self._made_painter()
        drawing = [painter.submit(job.draw, job.visible) for job in film.jobs]
        if drawing:
            painter.ready.wait(FRAMES_DEADLINE_S)
        if wait(drawing, max(0.0, wait_s)).not_done:
            self._given_up.extend(drawing)
            if wait_s >= FRAMES_DEADLINE_S:
                logger.warning("no camera images within %g s; continuing without them", wait_s)
        return {shot.key: frame for shot in shots if (frame := film.frame(shot)) is not None} or None

    def capture_viewport(self) -> Visible:
        """Copy the state that `paint` draws; the caller holds the engine's lock."""
        self._made_painter()
        return Visible(visible_state(self._scene.model, self._scene.data), self._copy_look())

    def paint(self, visible: Visible, picture: ViewportPicture) -> Bytes:
        """Draw a picture of the viewport.

        Returns:
            Red, green, blue and alpha from the top, shape (height, width, 4).

        Raises:
            RenderingUnavailable: The picture cannot be drawn.
        """
        need_backend()
        drawn = self._made_painter().submit(lambda stage, data: stage.paint(data, picture), visible)
        try:
            return drawn.result(FRAMES_DEADLINE_S)
        except CancelledError:
            raise RenderingUnavailable("play ended before the picture was drawn") from None
        except TimeoutError:
            raise RenderingUnavailable(f"no picture within {FRAMES_DEADLINE_S:g} s") from None
        except Exception as error:
            raise RenderingUnavailable("the picture was not drawn; see the log") from error

    def close(self, timeout: float = 1.0) -> bool:
        """Stop drawing and release waiting callers. Idempotent.

        Returns:
            False if it was still drawing then.
        """
        self._closed = True
        return self._painter is None or self._painter.close(timeout)

    def _made_painter(self) -> Painter[ViewportStage]:
        if self._painter is None:
            tints, quality = self._tints, self._quality
            self._painter = Painter(
                self._scene.model,
                _found_backend,
                lambda model, backend: ViewportStage(model, backend, tints, quality),
                lambda run: self._health.thread("urlab-render", run),
            )
            if self._closed:
                self._painter.close()
        return self._painter

    def _copy_look(self) -> dict[str, NDArray[Any]]:
        return {name: np.array(getattr(self._scene.model, name)) for name in self._varied}

    def _now(self) -> Instant:
        return Instant(float(self._scene.data.time), time.monotonic())


def _late(camera: _Camera) -> Latency | None:
    return camera.latency if camera.latency is not None and camera.latency.withholds else None


def _found_backend() -> Backend | None:
    backend = search_backend()
    if isinstance(backend, Backend):
        return backend
    logger.warning("camera images are left out: %s", backend)
    return None
