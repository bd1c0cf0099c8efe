"""Pictures of a batch. Its simulations have no server, so this process draws them in the same way."""

from __future__ import annotations

import atexit
import contextlib
import copy
import queue
import weakref
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.background import background_thread
from urlab_client.aio.client import URLabClient
from urlab_client.enums import CameraMode
from urlab_client.errors import URLabError
from urlab_client.integrations.gym.episode import client_camera
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.randomise.declaration import CameraLatency
from urlab_client.simulation.appearance import Appearance, Tints
from urlab_client.simulation.cameras import Instant, Latency, SceneCamera
from urlab_client.simulation.drawing import Stage
from urlab_client.simulation.opengl import Backend, need_backend
from urlab_client.values.names import cleaned_name
from urlab_client.values.pictures import Pixels, decode_camera, observed_pixels

_DEADLINE_S: Final = 30.0
"""Longest wait for one picture after the previous one. The first picture includes creating the context."""

_JOIN_S: Final = 1.0

_UNSEEN: Final = 0
"""Snapshot number; unused here."""

VISIBLE: Final = ("qpos", "mocap_pos", "mocap_quat")
"""Fields of the state that pictures depend on, in MuJoCo's order."""

_STATE: Final = (
    mujoco.mjtState.mjSTATE_QPOS.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)


@dataclass(frozen=True)
class Visible:
    """What pictures of one copy depend on.

    Attributes:
        state: The fields `VISIBLE` of `MjData`, flattened and concatenated.
        look: Fields that differ from the compiled model; the same fields each time.
    """

    state: Floats
    look: Mapping[str, NDArray[Any]]


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
        self._thread: _Thread | None = None
        if observed:
            self._drawing()

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
        drawn = [self._drawing().submit(cameras, visible) for visible in copies]
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
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.close()

    def _drawing(self) -> _Thread:
        if self._thread is None:
            self._thread = _Thread(self._scene, need_backend())
            finalizer = weakref.finalize(self, self._thread.stop)
            finalizer.atexit = False  # the thread registers its own exit hook, which must run before the driver's
        return self._thread

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


class _Thread:
    """The thread that draws one copy after another."""

    def __init__(self, scene: PictureScene, backend: Backend) -> None:
        self._scene = scene
        self._backend = backend
        self._jobs: queue.SimpleQueue[tuple[Sequence[str], Visible, Future[list[Pixels]]] | None] = queue.SimpleQueue()
        self._failure: BaseException | None = None
        self._thread = background_thread("urlab-pictures", self._run, failed=self._die)
        self._thread.start()

    def submit(self, cameras: Sequence[str], visible: Visible) -> Future[list[Pixels]]:
        """Begin to draw one copy."""
        drawn: Future[list[Pixels]] = Future()
        self._jobs.put((cameras, visible, drawn))
        if self._failure is not None:
            self._fail_waiting(self._failure)
        return drawn

    def stop(self) -> None:
        """Tell the thread to free its context and exit."""
        atexit.unregister(self.close)
        self._jobs.put(None)

    def close(self) -> None:
        """Stop the thread and wait for a limited time until it exits."""
        self.stop()
        self._thread.join(_JOIN_S)

    def _die(self, error: URLabError) -> None:
        self._failure = error
        self._fail_waiting(error)

    def _fail_waiting(self, error: BaseException) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                job = self._jobs.get_nowait()
                if job is not None and job[2].set_running_or_notify_cancel():
                    job[2].set_exception(error)

    def _run(self) -> None:
        with ExitStack() as context:
            painter: _Painter | None = None
            while (job := self._jobs.get()) is not None:
                cameras, visible, drawn = job
                if not drawn.set_running_or_notify_cancel():
                    continue
                try:
                    if painter is None:
                        painter = _Painter(self._scene, self._backend, context)
                        atexit.register(self.close)  # registered after the driver's hook, so it runs before it
                    drawn.set_result(painter.paint(cameras, visible))
                except BaseException as error:  # noqa: BLE001 - the future raises it in the caller
                    drawn.set_exception(error)


class _Painter:
    """Draws pictures in one thread."""

    def __init__(self, scene: PictureScene, backend: Backend, context: ExitStack) -> None:
        appearance = Appearance.of(scene.model)
        self._scene = scene
        self._model = copy.copy(scene.model)  # drawing adjusts its visual settings
        self._data = mujoco.MjData(self._model)
        tints = Tints(self._model, appearance.classes, scene.owners)
        self._stage = context.enter_context(Stage(self._model, backend, tints, appearance.quality))

    def paint(self, cameras: Sequence[str], visible: Visible) -> list[Pixels]:
        for name, values in visible.look.items():
            getattr(self._model, name)[...] = values
        mujoco.mj_setState(self._model, self._data, visible.state, _STATE)
        self._stage.prepare(self._data)
        return [self._picture(name) for name in cameras]

    def _picture(self, name: str) -> Pixels:
        camera, mode = self._scene.cameras[name], self._scene.mode(name)
        pixels = np.ascontiguousarray(self._stage.pixels(self._data, camera, mode))
        return decode_camera(pixels.data.cast("B"), mode, *camera.resolution, where=name).pixels


def _camera(client: URLabClient, model: mujoco.MjModel, name: str) -> SceneCamera:
    """Return a camera as the server draws it."""
    view = client_camera(client, name)
    key, slash, _ = name.partition("/")
    prefix = f"{client.articulations[key].compiled_prefix}_" if slash else ""
    for i in range(model.ncam):
        compiled = str(model.camera(i).name)
        short = compiled.removeprefix(prefix)
        if compiled.startswith(prefix) and view.name in (short, cleaned_name(short)):
            return SceneCamera(name=view.name, id=i, mode=str(view.mode), resolution=view.resolution, fovy=view.fovy)
    raise URLabError(f"The compiled scene at {client.address} has no camera {name!r}, although the server lists it.")
