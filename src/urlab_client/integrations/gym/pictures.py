"""Pictures of a batch, whose simulations have no server that could draw them: this process does, as servers do."""

from __future__ import annotations

import atexit
import copy
import queue
import threading
import weakref
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.client import URLabClient
from urlab_client.integrations.gym.episode import client_camera
from urlab_client.integrations.gym.spaces import Space, camera_space
from urlab_client.protocol.base import Floats
from urlab_client.protocol.dialects import cleaned_name
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.pixels import Pixels, decode_camera
from urlab_client.server.compile.scene_index import SceneCamera
from urlab_client.server.render.appearance import Appearance
from urlab_client.server.render.drawing import Stage
from urlab_client.server.render.opengl import Backend, need_backend
from urlab_client.server.render.tints import Tints

__all__ = ["VISIBLE", "BatchPictures", "PictureScene", "Visible"]

_DEADLINE_S: Final = 30.0
"""Longest wait for one picture after the one before; the first one includes the making of a context."""

_JOIN_S: Final = 1.0

VISIBLE: Final = ("qpos", "mocap_pos", "mocap_quat")
"""The part of the state of copies that pictures depend on, in MuJoCo's order."""

_STATE: Final = (
    mujoco.mjtState.mjSTATE_QPOS.value
    | mujoco.mjtState.mjSTATE_MOCAP_POS.value
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
)


@dataclass(frozen=True)
class Visible:
    """What pictures of one copy depend on.

    Attributes:
        state: The fields `VISIBLE` of `MjData`, flat, one behind the other.
        look: Fields of the model that differ from the model as compiled, the same ones each time.
    """

    state: Floats
    look: Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class PictureScene:
    """A scene as its server draws it.

    Attributes:
        model: The compiled scene.
        cameras: Cameras that are to be drawn, as environments name them.
        owners: By body id the articulation that it is of, by its actor name.
    """

    model: mujoco.MjModel
    cameras: Mapping[str, SceneCamera]
    owners: Mapping[int, str]

    @classmethod
    def of(cls, client: URLabClient, model: mujoco.MjModel, cameras: Sequence[str]) -> PictureScene:
        """Return what a client knows of the scene.

        Args:
            client: After `discover()`.
            model: Its model.
            cameras: The cameras, as `ARTICULATION/CAMERA` or as the name of a scene-level one.

        Raises:
            KeyError: There is no such camera.
            URLabError: The compiled scene does not have one that the server lists.
        """
        owners = {
            body.id: articulation.compiled_prefix
            for articulation in client.articulations.values()
            for body in articulation.bodies.values()
        }
        return cls(model, {name: _camera(client, model, name) for name in cameras}, owners)

    def mode(self, camera: str) -> CameraMode:
        """Return what a camera's pixels mean."""
        return CameraMode(self.cameras[camera].mode)

    def space(self, camera: str) -> Space:
        """Return the space of a camera's pictures."""
        return camera_space(self.mode(camera), self.cameras[camera].resolution)


class BatchPictures:
    """Draws what cameras see in any states of a scene: the code, and so the pictures, are those of its server.

    A context of OpenGL belongs to a thread, so that this has one of its own; call it from whichever you like. More
    threads would draw no faster where the processor draws: that uses all of it as it is.

    Args:
        scene: The scene.

    Raises:
        RenderingUnavailable: Nothing here can draw.
    """

    def __init__(self, scene: PictureScene) -> None:
        self._thread = _Thread(scene, need_backend())
        forget = weakref.finalize(self, self._thread.stop)
        forget.atexit = False  # the thread sees to that, before the driver ends

    def draw(self, cameras: Sequence[str], copies: Sequence[Visible]) -> dict[str, list[Pixels]]:
        """Return the pictures of some copies by camera, as `URLabCameraView.latest_frame` has them.

        Args:
            cameras: Names in `PictureScene.cameras`.
            copies: What the copies look like.

        Raises:
            TimeoutError: A picture took too long.
        """
        drawn = [self._thread.submit(cameras, visible) for visible in copies]
        try:
            pictures = [picture.result(_DEADLINE_S) for picture in drawn]
        except TimeoutError:
            raise TimeoutError(f"no picture of the batch within {_DEADLINE_S:g} s") from None
        finally:
            for picture in drawn:
                picture.cancel()
        return {name: [of[number] for of in pictures] for number, name in enumerate(cameras)}

    def close(self) -> None:
        """Free the context. Safe to call twice."""
        self._thread.close()


class _Thread:
    """The thread that draws one copy after another."""

    def __init__(self, scene: PictureScene, backend: Backend) -> None:
        self._scene = scene
        self._backend = backend
        self._jobs: queue.SimpleQueue[tuple[Sequence[str], Visible, Future[list[Pixels]]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="urlab-pictures", daemon=True)
        self._thread.start()

    def submit(self, cameras: Sequence[str], visible: Visible) -> Future[list[Pixels]]:
        """Begin to draw one copy."""
        drawn: Future[list[Pixels]] = Future()
        self._jobs.put((cameras, visible, drawn))
        return drawn

    def stop(self) -> None:
        """Let the thread free what it draws with, and end."""
        atexit.unregister(self.close)
        self._jobs.put(None)

    def close(self) -> None:
        """Do what `stop` does, and wait a bounded time for it."""
        self.stop()
        self._thread.join(_JOIN_S)

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
                        atexit.register(self.close)  # after the driver's own hook, so before it at the end
                    drawn.set_result(painter.paint(cameras, visible))
                except BaseException as error:  # noqa: BLE001 - who asked for the pictures hears of it
                    drawn.set_exception(error)


class _Painter:
    """What draws in one thread."""

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
    """Return a camera as the server draws it.

    Raises:
        KeyError: There is no such camera.
        URLabError: The compiled scene does not have it.
    """
    view = client_camera(client, name)
    key, slash, _ = name.partition("/")
    prefix = f"{client.articulations[key].compiled_prefix}_" if slash else ""
    for i in range(model.ncam):
        compiled = str(model.camera(i).name)
        short = compiled.removeprefix(prefix)
        if compiled.startswith(prefix) and view.name in (short, cleaned_name(short)):
            return SceneCamera(name=view.name, id=i, mode=str(view.mode), resolution=view.resolution, fovy=view.fovy)
    raise URLabError(f"The compiled scene at {client.address} has no camera {name!r}, though the server lists it.")
