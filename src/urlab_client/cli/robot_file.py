"""What the demo needs to know about an MJCF file to place the robot sensibly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from urlab_client._mujoco import actuator_count, control_starts
from urlab_client.cli._failure import CommandError, one_line
from urlab_client.server.assets.bundled_robots import bundled_models, unknown_model
from urlab_client.server.assets.importer import mujoco_messages
from urlab_client.server.compile.bounds import box_around

__all__ = ["RobotFile", "read_robot"]

_HOME = "home"
_CLEARANCE_M = 0.002
_SIDE_STEP = 1.4  # distance between two robots, in widths of one


@dataclass(frozen=True)
class RobotFile:
    """An MJCF file.

    Attributes:
        name: Bundled name, or the file's stem.
        path: Absolute path.
        bundled: Whether it ships with this package.
        needs_floor: Whether the scene has to add a floor: the robot can fall, and the file has none.
        home: Hinge and slide positions of its `home` keyframe by joint name; empty without one.
        home_ctrl: Set-points of that keyframe by actuator name.
        lift: Metres to raise the robot by, so that no part of it is below an added floor at z = 0.
        spacing: Metres between two such robots.
    """

    name: str
    path: Path
    bundled: bool
    needs_floor: bool
    home: dict[str, float]
    home_ctrl: dict[str, float]
    lift: float
    spacing: float


def read_robot(model: str) -> RobotFile:
    """Read a bundled robot or an MJCF file.

    Raises:
        CommandError: There is no such robot, or MuJoCo rejects it.
    """
    bundled = bundled_models()
    path = Path(model)
    if model in bundled and not path.is_file():
        path = bundled[model]
    if not path.is_file():
        raise CommandError(unknown_model(model))
    path = path.resolve()
    try:
        with mujoco_messages():  # the server repeats MuJoCo's messages about the model
            compiled = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise CommandError(f"MuJoCo rejects {path}: {one_line(error)}") from None
    return _describe(model if model in bundled else path.stem, path, compiled)


def _describe(name: str, path: Path, model: mujoco.MjModel) -> RobotFile:
    data = mujoco.MjData(model)
    home, home_ctrl = _take_home(model, data)
    mujoco.mj_forward(model, data)
    shaped = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    low, high = box_around(model, data, shaped) if shaped.any() else (np.zeros(3), np.zeros(3))
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).tolist()
    grounded = bool((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any() or model.nhfield)
    needs_floor = bool(free) and not grounded
    width = float(max(high[0] - low[0], high[1] - low[1]))
    return RobotFile(
        name=name,
        path=path,
        bundled=path in bundled_models().values(),
        needs_floor=needs_floor,
        home=home,
        home_ctrl=home_ctrl,
        lift=max(0.0, _CLEARANCE_M - float(low[2])) if needs_floor else 0.0,
        spacing=_SIDE_STEP * width,
    )


def _take_home(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[dict[str, float], dict[str, float]]:
    """Put the joints, not the base, into the `home` keyframe; return its positions and set-points by name."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, _HOME)
    if key < 0:
        return {}, {}
    mujoco.mj_resetDataKeyframe(model, data, key)
    for base in model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]:
        data.qpos[base : base + 7] = model.qpos0[base : base + 7]
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [joint for joint in map(model.joint, range(model.njnt)) if joint.name and int(joint.type[0]) in scalar]
    actuators = [actuator for actuator in map(model.actuator, range(actuator_count(model))) if actuator.name]
    starts = control_starts(model)
    return (
        {joint.name: float(data.qpos[joint.qposadr[0]]) for joint in joints},
        {actuator.name: float(data.ctrl[starts[actuator.id]]) for actuator in actuators},
    )
