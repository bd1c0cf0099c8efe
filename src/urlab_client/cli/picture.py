"""A picture of one simulation state, for `urlab demo`.

A child process draws it: MuJoCo reads the environment variable that chooses the OpenGL library when it is imported,
and a broken driver may crash the process that loads it. This module is both parent and child.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from urlab_client.cli._files import replaced
from urlab_client.server.compile.bounds import Box, box_around
from urlab_client.server.render.opengl import ADVICE

if TYPE_CHECKING:
    import mujoco

__all__ = ["NoPicture", "draw_state"]

WIDTH, HEIGHT = 1280, 960
_CHOICE = "MUJOCO_GL"
_DEADLINE_S = 120.0  # a software renderer on a busy machine

_FOVY = 36.0
_ELEVATION = -24.0  # steep enough that the floor fills the picture to its upper edge
_AZIMUTH = 128.0
_MARGIN = 1.15
_NEAREST_M = 0.1
_HIDDEN_GROUP = 5
_LEVEL = 0.99  # cosine of a floor's slope
_WIDE = 5.0  # metres from its middle to its edge; a smaller plane is a table
_FLOOR_RGBA = (0.42, 0.46, 0.5, 1.0)
_GAP_M = 0.001  # between the lowest part and the floor, which would show through each other
_SUN = (-0.45, -0.35, -1.0)


class NoPicture(Exception):
    """No picture could be drawn; the text says why and what would help."""


def draw_state(model: mujoco.MjModel, data: mujoco.MjData, path: Path) -> str:
    """Write a PNG of a state and return the OpenGL platform that drew it.

    Args:
        model: The model.
        data: The state; only positions are used.
        path: The PNG file.

    Raises:
        NoPicture: No OpenGL library works here.
    """
    import mujoco  # noqa: PLC0415

    with tempfile.TemporaryDirectory(prefix="urlab-picture-") as name:
        folder = Path(name)
        mujoco.mj_saveModel(model, str(folder / "model.mjb"))
        np.savez(folder / "state.npz", qpos=data.qpos, mocap_pos=data.mocap_pos, mocap_quat=data.mocap_quat)
        reasons: list[str] = []
        for platform in _platforms():
            reason = _draw_in_child(folder, platform)
            if reason is None:
                with replaced(path) as temporary:
                    temporary.write_bytes((folder / "picture.png").read_bytes())
                return platform or "default"
            reasons.append(f"{platform or 'default'}: {reason}")
    chosen = os.environ.get(_CHOICE)
    problem = (
        f"OpenGL does not work with {_CHOICE}={chosen}: unset it, or" if chosen else "No OpenGL library works here:"
    )
    raise NoPicture(f"{problem} {ADVICE} ({'; '.join(reasons)})")


def _platforms() -> Sequence[str]:
    chosen = os.environ.get(_CHOICE)
    if chosen:
        return (chosen,)
    return ("egl", "osmesa") if sys.platform == "linux" else ("",)


def _draw_in_child(folder: Path, platform: str) -> str | None:
    """Return None if the picture was drawn, otherwise the reason why not."""
    environment = dict(os.environ)
    if platform:
        environment[_CHOICE] = platform
    if platform in ("egl", "osmesa"):
        environment["PYOPENGL_PLATFORM"] = platform
    try:
        child = subprocess.run(  # noqa: S603 - this very module
            [sys.executable, "-m", "urlab_client.cli.picture", str(folder)],
            env=environment,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_DEADLINE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"nothing drawn within {_DEADLINE_S:g} s"
    if child.returncode == 0:
        return None
    lines = child.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else f"the renderer exited with code {child.returncode}"


# What follows runs in the child.


def _main(folder: Path) -> None:
    import mujoco  # noqa: PLC0415
    from PIL import Image  # noqa: PLC0415

    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
    data = mujoco.MjData(model)
    with np.load(folder / "state.npz") as state:
        data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = state["qpos"], state["mocap_pos"], state["mocap_quat"]
    mujoco.mj_forward(model, data)
    Image.fromarray(_render(model, data)).save(folder / "picture.png")


def _render(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
    import mujoco  # noqa: PLC0415

    from urlab_client.server.render.sunlight import follow_subject, moving_geoms, shadow_clip  # noqa: PLC0415

    box = _subject(model, data)
    floors = _floors(model, data)
    for twin in _coplanar_twins(floors):  # each robot's file may bring its own
        model.geom_group[twin] = _HIDDEN_GROUP
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    model.vis.global_.fovy = _FOVY
    model.vis.quality.offsamples = 8
    model.vis.quality.shadowsize = 4096
    model.vis.map.shadowclip = shadow_clip(model.vis.map.shadowclip * model.stat.extent) / model.stat.extent
    model.vis.headlight.ambient[:] = 0.35
    model.vis.headlight.diffuse[:] = 0.45
    model.vis.headlight.specular[:] = 0.1
    camera = _camera(*box)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera)
        scene = renderer.scene
        if not floors:
            middle = [*((box[0] + box[1]) / 2)[:2], _ground(model, data) - _GAP_M]
            _add_floor(scene, np.array(middle), reach=model.vis.map.zfar * model.stat.extent)
        if model.nlight == 0:
            _add_sun(scene, box)
        follow_subject(scene, model, data, moving_geoms(model))
        return renderer.render()


def _subject(model: mujoco.MjModel, data: mujoco.MjData) -> Box:
    """Return the box around what moves, or around everything where nothing does."""
    import mujoco  # noqa: PLC0415

    shaped = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    shown = shaped & (model.geom_rgba[:, 3] > 0)
    moving = shown & (model.body_weldid[model.geom_bodyid] != 0)
    chosen = next((geoms for geoms in (moving, shown, shaped) if geoms.any()), None)
    return (-np.ones(3), np.ones(3)) if chosen is None else box_around(model, data, chosen)


def _ground(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the height of the lowest point of all, metres."""
    import mujoco  # noqa: PLC0415

    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    heights: list[float] = data.geom_xpos[planes, 2].tolist()
    if not planes.all():
        heights.append(float(box_around(model, data, ~planes)[0][2]))
    return min(heights, default=0.0)


def _floors(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, float]:
    """Return the height of each wide plane that faces up, by geom."""
    import mujoco  # noqa: PLC0415

    planes: list[int] = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).tolist()
    sizes = np.where(model.geom_size[:, :2] > 0, model.geom_size[:, :2], np.inf).min(axis=1)
    level = data.geom_xmat[:, 8] > _LEVEL
    return {plane: float(data.geom_xpos[plane, 2]) for plane in planes if level[plane] and sizes[plane] >= _WIDE}


def _coplanar_twins(floors: dict[int, float]) -> list[int]:
    seen: set[float] = set()
    twins: list[int] = []
    for plane, height in floors.items():
        if round(height, 4) in seen:
            twins.append(plane)
        seen.add(round(height, 4))
    return twins


def _camera(low: NDArray[np.float64], high: NDArray[np.float64]) -> Any:
    """Return the camera that shows the whole box as large as it can."""
    import mujoco  # noqa: PLC0415

    azimuth, elevation = np.radians([_AZIMUTH, _ELEVATION])
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(right, forward)
    corners = np.array([*itertools.product(*zip(low, high, strict=True))]) - (low + high) / 2
    tangent = np.tan(np.radians(_FOVY / 2)) / _MARGIN
    needed = np.maximum(np.abs(corners @ right) * HEIGHT / WIDTH, np.abs(corners @ up)) / tangent - corners @ forward
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (low + high) / 2
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    camera.distance = max(float(needed.max()), _NEAREST_M)
    return camera


def _add_floor(scene: Any, middle: NDArray[np.float64], *, reach: float) -> None:
    import mujoco  # noqa: PLC0415

    if scene.ngeom >= scene.maxgeom:
        return
    floor = scene.geoms[scene.ngeom]
    size, level, color = np.array([reach, reach, 1.0]), np.eye(3).ravel(), np.array(_FLOOR_RGBA, np.float32)
    mujoco.mjv_initGeom(floor, mujoco.mjtGeom.mjGEOM_PLANE, size, middle, level, color)
    scene.ngeom += 1


def _add_sun(scene: Any, box: Box) -> None:
    import mujoco  # noqa: PLC0415

    low, high = box
    direction = np.array(_SUN) / np.linalg.norm(_SUN)
    sun = scene.lights[scene.nlight]
    sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    sun.pos[:] = (low + high) / 2 - 3 * float(np.linalg.norm(high - low)) * direction
    sun.dir[:] = direction
    sun.ambient[:], sun.diffuse[:], sun.specular[:] = 0.0, 0.6, 0.2
    sun.castshadow = 1
    sun.headlight = 0
    scene.nlight += 1


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
