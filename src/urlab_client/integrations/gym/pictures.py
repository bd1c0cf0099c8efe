"""Pictures of a batch. Its simulations have no server, so this process draws them in the same way."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from urlab_client._mujoco import model_names
from urlab_client.aio.background import background_thread
from urlab_client.aio.client import URLabClient
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.randomise.declaration import CameraLatency
from urlab_client.simulation.appearance import Appearance, Tints
from urlab_client.simulation.cameras import Instant, Latency, SceneCamera
from urlab_client.simulation.drawing import Stage
from urlab_client.simulation.opengl import Backend, need_backend
from urlab_client.simulation.painting import Painter, Visible
from urlab_client.values.names import cleaned_name
from urlab_client.values.pictures import Pixels, decode_camera, observed_pixels

_DEADLINE_S: Final = 30.0
"""Longest wait for one picture after the previous one. The first picture includes creating the context."""
_UNSEEN: Final = 0
"""Snapshot number; unused here."""


@dataclass(frozen=True, eq=False)
class PictureScene:
    """A scene as its server draws it.

    Attributes:
        model: The compiled scene.
        cameras: Cameras to draw, by the names that environments use.
        owners: Actor name of the articulation that owns each body, by body id.
    """

    model: mujoco.MjModel
    cameras: Mapping[str, SceneCamera]
    owners: Mapping[int, str]

    @classmethod
    def of(cls, client: URLabClient, model: mujoco.MjModel, cameras: Sequence[str]) -> PictureScene:
        """Return the scene of a client, with cameras by `ARTICULATION/CAMERA` or the name of a scene-level one."""
        owners = {
            body.id: articulation.compiled_prefix
            for articulation in client.articulations.values()
            for body in articulation.bodies.values()
        }
        return cls(model, {name: _camera(client, model, name) for name in cameras}, owners)

    def mode(self, camera: str) -> CameraMode:
        """Return the mode of a camera."""
        return CameraMode(self.cameras[camera].mode)

    def stage(self, model: mujoco.MjModel, backend: Backend) -> Stage:
        """Return what draws a model of the scene, in the thread that draws."""
        appearance = Appearance.of(model)
        return Stage(model, backend, Tints(model, appearance.classes, self.owners), appearance.quality)

    def paint(self, stage: Stage, data: mujoco.MjData, cameras: Sequence[str]) -> list[Pixels]:
        """Draw what some cameras see, in that thread."""
        return [self._picture(stage, data, name) for name in cameras]

    def _picture(self, stage: Stage, data: mujoco.MjData, name: str) -> Pixels:
        camera, mode = self.cameras[name], self.mode(name)
        if mode is CameraMode.REAL:  # no wire between the two, so no pass over the pixels to swap colours
            return stage.pixels(data, camera, mode, "RGBA")
        pixels = np.ascontiguousarray(stage.pixels(data, camera, mode))
        return decode_camera(pixels.data.cast("B"), mode, *camera.resolution, where=name).pixels


class BatchPictures:
    """The cameras of a batch. Draws given states with the same code, and so the same pixels, as their server.

    An OpenGL context belongs to one thread, so this object draws in a dedicated thread; its methods may be called from
    any thread. More threads would not speed up software rendering, which already uses all processors.
    """

    def __init__(self, scene: PictureScene, observed: Sequence[str], latencies: Mapping[str, CameraLatency]) -> None:
        """Look up the cameras that `observe` shows, some of which have a latency.

        Raises:
            RenderingUnavailable: There are such cameras, and this machine cannot draw.
        """
        self._scene = scene
        self._observed = observed
        self.delays: dict[str, CameraDelayInForce] = {
            name: CameraDelayInForce(
                delay_s=late.delay_s, jitter_s=late.jitter_s, clock="sim", on_state_change=True, max_fps=0.0
            )
            for name, late in latencies.items()
        }
        self._latencies: dict[tuple[str, int], Latency] = {}
        self._shown: dict[tuple[str, int], Floats] = {}
        self._painter: Painter[Stage] | None = None
        if observed:
            self._made_painter()

    def begin(self, i: int, seed: int, visible: Visible) -> None:
        """Begin an episode of copy `i`. Delayed cameras show its start without delay; `seed` is that of the jitter."""
        for name, delay in self.delays.items():
            self._latencies[name, i] = Latency(delay, seed)
            self._shown[name, i] = visible.state

    def observe(self, indices: Sequence[int], times: Sequence[float], copies: Sequence[Visible]) -> dict[str, Any]:
        """Return the camera observations of some copies after an action, by camera, at these simulation times."""
        drawn = self.draw([name for name in self._observed if name not in self.delays], copies)
        for name in self.delays:
            shown = [
                Visible(self._revealed(name, i, time, visible), visible.look)
                for i, time, visible in zip(indices, times, copies, strict=True)
            ]
            drawn |= self.draw([name], shown)
        return {
            name: np.stack([observed_pixels(frame, self._scene.mode(name)) for frame in drawn[name]])
            for name in self._observed
        }

    def draw(self, cameras: Sequence[str], copies: Sequence[Visible]) -> dict[str, list[Pixels]]:
        """Return the pictures of some copies by camera, in the format of `URLabCameraView.latest_frame`.

        Raises:
            RenderingUnavailable: This machine cannot draw.
            TimeoutError: A picture took too long.
        """
        if not cameras:
            return {}
        painter, scene = self._made_painter(), self._scene
        drawn = [painter.submit(lambda stage, data: scene.paint(stage, data, cameras), visible) for visible in copies]
        try:
            pictures = [picture.result(_DEADLINE_S) for picture in drawn]
        except TimeoutError:
            raise TimeoutError(f"drawing a picture of the batch took longer than {_DEADLINE_S:g} s") from None
        finally:
            for picture in drawn:
                picture.cancel()
        return {name: [of[number] for of in pictures] for number, name in enumerate(cameras)}

    def close(self) -> None:
        """Free the context, until something is drawn again."""
        painter, self._painter = self._painter, None
        if painter is not None:
            painter.close()

    def _made_painter(self) -> Painter[Stage]:
        if self._painter is None:
            need_backend()
            self._painter = Painter(
                self._scene.model,
                need_backend,
                self._scene.stage,
                lambda run: background_thread("urlab-pictures", run),
            )
            finalizer = weakref.finalize(self, self._painter.close)
            finalizer.atexit = False  # the painter has an exit hook of its own, which must run before the driver's
        return self._painter

    def _revealed(self, name: str, i: int, time: float, visible: Visible) -> Floats:
        """Record the state of a copy for a delayed camera, and return the state that the camera shows now."""
        latency, now = self._latencies[name, i], Instant(time, 0.0)
        if not latency.withholds:
            return visible.state
        if not latency.skips(now):
            latency.see(_UNSEEN, now, 0.0, visible.state)
        seen = latency.revealed(now)
        if seen is not None:
            self._shown[name, i] = seen.state
        return self._shown[name, i]


def _camera(client: URLabClient, model: mujoco.MjModel, name: str) -> SceneCamera:
    """Return a camera as the server draws it."""
    view = client.camera(name)
    owners = [robot.compiled_prefix for robot in client.articulations.values() if view in robot.cameras.values()]
    prefix = f"{owners[0]}_" if owners else ""
    for i, compiled in enumerate(model_names(model, "camera")):
        short = compiled.removeprefix(prefix)
        if compiled.startswith(prefix) and view.name in (short, cleaned_name(short)):
            return SceneCamera(name=view.name, id=i, mode=str(view.mode), resolution=view.resolution, fovy=view.fovy)
    raise URLabError(f"The compiled scene at {client.address} has no camera {name!r}, although the server lists it.")
