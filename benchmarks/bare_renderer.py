"""The rasteriser by itself: MuJoCo draws one scene again and again, camera by camera, and reads the pixels.

Run as a script by the rows that measure drawing, in a process of its own, because a context of OpenGL would change what
other rows measure. It leaves out what the server does in the quality `fast`: shadows, reflections, smooth edges, the
blending of mipmaps, and half the slices of round shapes.
"""

from __future__ import annotations

import importlib
import itertools
import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from urlab_client.simulation.drawing import simplify_textures


def _main(backend: str, path: str, cameras: Sequence[str], width: int, height: int) -> None:
    context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
    context.make_current()
    model = mujoco.MjModel.from_binary_path(path)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    quality = model.vis.quality
    quality.offsamples = quality.shadowsize = 0
    quality.numslices, quality.numstacks = 16, 8
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    views = itertools.cycle([model.camera(camera).id for camera in cameras])
    scene, option, everything = mujoco.MjvScene(model, 10_000), mujoco.MjvOption(), mujoco.mjtCatBit.mjCAT_ALL.value
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    renderer: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
    simplify_textures(renderer, importlib.import_module("OpenGL.GL"))  # only now: the context chooses its platform
    area, pixels = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
    for line in sys.stdin:
        times: list[float] = []
        busy = time.process_time()
        for _ in range(int(line)):
            started = time.perf_counter()
            view.fixedcamid = next(views)
            mujoco.mjv_updateScene(model, data, option, None, view, everything, scene)
            mujoco.mjr_render(area, scene, renderer)
            mujoco.mjr_readPixels(pixels, None, area, renderer)
            times.append(time.perf_counter() - started)
        print(json.dumps([times, time.process_time() - busy]), flush=True)
    renderer.free()
    context.free()


if __name__ == "__main__":
    _main(sys.argv[1], sys.argv[2], sys.argv[3].split(","), int(sys.argv[4]), int(sys.argv[5]))
