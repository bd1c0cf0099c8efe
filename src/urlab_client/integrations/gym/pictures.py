"""Pictures of a batch, whose simulations have no server that could draw them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.base import Floats
from urlab_client.server.render.opengl import free_context, make_context, need_backend

__all__ = ["BatchPictures"]


class BatchPictures:
    """Draws what one camera sees, for any state of a model, on the thread that made it.

    Args:
        model: The compiled scene.
        camera: Name of the camera, `ARTICULATION/CAMERA`; the first one of the scene for None.

    Raises:
        ValueError: There is no such camera.
        ImportError: Nothing here can draw.
    """

    def __init__(self, model: mujoco.MjModel, camera: str | None) -> None:
        names = [model.camera(i).name for i in range(model.ncam)]
        wanted = names[0] if camera is None and names else (camera or "").replace("/", "_")
        if wanted not in names:
            raise ValueError(f"no camera is called {camera!r}; the scene has {', '.join(names) or 'none'}")
        self._model = copy.copy(model)
        self._data = mujoco.MjData(model)
        self._view = mujoco.MjvCamera()
        self._view.type, self._view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, names.index(wanted)
        width, height = (int(pixels) for pixels in model.cam_resolution[self._view.fixedcamid])
        width, height = (width, height) if width > 1 else (640, 480)
        self._area = mujoco.MjrRect(0, 0, width, height)
        self._gl = make_context(need_backend(), width, height)
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model, maxgeom=max(10_000, 2 * model.ngeom + 1000))
        self._context: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        mujoco.mjr_resizeOffscreen(width, height, self._context)

    def draw(self, qpos: Floats, look: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """Return the picture of a state, shape (H, W, 3), RGB.

        Args:
            qpos: Positions of the scene, shape (nq,).
            look: Fields of the model that differ from the model as given, the same ones each time.
        """
        for name, values in look.items():
            getattr(self._model, name)[...] = values
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        mujoco.mj_tendon(self._model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        self._gl.make_current()
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._view, everything, self._scene)
        mujoco.mjr_render(self._area, self._scene, self._context)
        pixels = np.empty((self._area.height, self._area.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._area, self._context)
        return np.ascontiguousarray(pixels[::-1])

    def close(self) -> None:
        """Free the context."""
        self._context.free()
        free_context(self._gl)
