"""Whether this machine can draw pictures, and with which backend."""

from __future__ import annotations

import atexit
import importlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from urlab_client._platform.signals import APART
from urlab_client.errors import URLabError

logger: logging.Logger = logging.getLogger("urlab_client.server")


_PROBE_DEADLINE_S: Final = 60.0

_CHOICE: Final = "MUJOCO_GL"

_DISABLED: Final = ("disable", "disabled", "off", "false", "0")

ADVICE: Final = (
    "apt install libegl1 libgl1-mesa-dri, or libosmesa6" if sys.platform == "linux" else "install a graphics driver"
)
"""Advice for machines without a working OpenGL."""

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


class RenderingUnavailable(URLabError):
    """No picture can be drawn: this machine has no OpenGL, drawing failed, or it took too long."""


@dataclass(frozen=True)
class Backend:
    """A working OpenGL backend.

    Attributes:
        name: `egl`, `osmesa`, `cgl` or `glfw`: the module of MuJoCo that makes contexts.
        renderer: Name of the renderer, from the driver.
    """

    name: str
    renderer: str

    @property
    def software(self) -> bool:
        """Whether it renders in software."""
        return self.name == "osmesa" or any(name in self.renderer.lower() for name in _SOFTWARE)


def find_backend() -> Backend | None:
    """Return the OpenGL backend of this machine; None if there is none.

    `MUJOCO_GL` names the only one to try, or disables drawing. The search runs once per process.
    """
    found = search_backend()
    return found if isinstance(found, Backend) else None


def need_backend() -> Backend:
    """Return the OpenGL backend of this machine.

    Raises:
        RenderingUnavailable: There is none; the message says why and what to install.
    """
    found = search_backend()
    if isinstance(found, Backend):
        return found
    raise RenderingUnavailable(f"nothing can be drawn here: {found}")


def make_context(backend: Backend, width: int, height: int) -> Any:
    """Return a context of a size in pixels, current in this thread.

    GLFW, which makes them on Windows, has one state for all threads: two that make or free contexts at the same time
    crash.
    """
    with _contexts:
        idle = _idle.get(os.getpid(), []) if backend.name == _REUSED else []
        module = importlib.import_module(f"mujoco.{backend.name}")
        context = idle.pop() if idle else module.GLContext(width, height)
        context.make_current()
    return context


def free_context(context: Any, *, sound: bool) -> None:
    """Free a context, in the thread that uses it.

    Args:
        context: The context.
        sound: Whether the next one to make a context may have this one instead, in which the driver has compiled its
            shaders: with software rendering that takes ten times as long as a picture.
    """
    with _contexts:
        idle = _idle.setdefault(os.getpid(), [])  # those of a process are not its forks'
        if sound and type(context).__module__ == f"mujoco.{_REUSED}" and len(idle) < _MOST_IDLE:
            egl = importlib.import_module("OpenGL.EGL")
            display = importlib.import_module(f"mujoco.{_REUSED}").EGL_DISPLAY
            egl.eglMakeCurrent(display, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
            egl.eglReleaseThread()
            idle.append(context)
            atexit.unregister(_free_idle)
            atexit.register(_free_idle)  # after the driver's own hook, so before it at the end
        else:
            context.free()


def _free_idle() -> None:
    with _contexts:
        for context in _idle.pop(os.getpid(), ()):
            context.free()


_REUSED: Final = "egl"
"""The backend whose contexts have no size and may change threads."""

_MOST_IDLE: Final = 2

_contexts = threading.Lock()
_idle: dict[int, list[Any]] = {}


def search_backend() -> Backend | str:
    """Return the backend, or why there is none."""
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
    return f"no OpenGL works here: {ADVICE} ({'; '.join(reasons)})"


def _candidates(choice: str) -> Sequence[str]:
    if choice in ("egl", "osmesa", "cgl", "glfw"):
        return (choice,)
    if sys.platform == "linux":
        return ("glfw",) if choice == "glx" else ("egl", "osmesa")
    return ("cgl",) if sys.platform == "darwin" else ("glfw",)


def _probe(name: str) -> Backend | str:
    """Draw in a child process; return the renderer, or why it failed."""
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
    return why_it_failed(child)


def why_it_failed(child: subprocess.CompletedProcess[bytes]) -> str:
    """Return the last line of what a Python program said before it exited with an error, or else its exit code.

    What a crash leaves last on standard error, such as a line of Python's fault handler, is no reason.
    """
    lines = child.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if child.returncode == 1 and lines else f"it exited with code {child.returncode}"
