"""Units of joints, set-points and sensor readings. MuJoCo has no units; these apply to models in SI units."""

from __future__ import annotations

from typing import TYPE_CHECKING

from urlab_client.aio.model.layout import JOINT_TRANSMISSIONS
from urlab_client.values.descriptions import JointKind, SetPointMeaning

if TYPE_CHECKING:
    import mujoco

JOINT_KINDS: tuple[JointKind, ...] = ("free", "ball", "slide", "hinge")  # by mjtJoint

_JOINT_UNITS = {"slide": "m", "hinge": "rad"}
_FORCE_UNITS = {"slide": "N", "hinge": "N m"}

# By mjtSensor name without its prefix. The units of joint and actuator sensors depend on the joint.
_SENSOR_UNITS = {
    "TOUCH": "N",
    "ACCELEROMETER": "m/s²",
    "VELOCIMETER": "m/s",
    "GYRO": "rad/s",
    "FORCE": "N",
    "TORQUE": "N m",
    "MAGNETOMETER": "T",
    "RANGEFINDER": "m",
    "CAMPROJECTION": "pixel",
    "BALLANGVEL": "rad/s",
    "TENDONPOS": "m",
    "TENDONVEL": "m/s",
    "TENDONACTFRC": "N",
    "TENDONLIMITPOS": "m",
    "TENDONLIMITVEL": "m/s",
    "TENDONLIMITFRC": "N",
    "FRAMEPOS": "m",
    "FRAMELINVEL": "m/s",
    "FRAMEANGVEL": "rad/s",
    "FRAMELINACC": "m/s²",
    "FRAMEANGACC": "rad/s²",
    "SUBTREECOM": "m",
    "SUBTREELINVEL": "m/s",
    "SUBTREEANGMOM": "kg m²/s",
    "GEOMDIST": "m",
    "GEOMFROMTO": "m",
    "E_POTENTIAL": "J",
    "E_KINETIC": "J",
    "CLOCK": "s",
}
_OF_JOINTS = frozenset({"JOINTPOS", "JOINTVEL", "JOINTACTFRC", "JOINTLIMITPOS", "JOINTLIMITVEL", "JOINTLIMITFRC"})
_OF_ACTUATORS = frozenset({"ACTUATORPOS", "ACTUATORVEL", "ACTUATORFRC"})


def joint_unit(kind: JointKind) -> str:
    """Return the unit of a joint's position; empty if the position is not a single number."""
    return _JOINT_UNITS.get(kind, "")


def sensor_kind(model: mujoco.MjModel, sensor: int) -> str:
    """Return the MJCF element of a sensor: `accelerometer`, `framepos`, …."""
    return _sensor(model, sensor).lower()


def sensor_unit(model: mujoco.MjModel, sensor: int) -> str:
    """Return the unit of a sensor's reading; empty if it has none."""
    what, of = _sensor(model, sensor), int(model.sensor_objid[sensor])
    if what in _OF_JOINTS or what in _OF_ACTUATORS:
        joint = of if what in _OF_JOINTS else driven_joint(model, of)
        return "" if joint is None else _of_joint(JOINT_KINDS[int(model.jnt_type[joint])], what)
    return _SENSOR_UNITS.get(what, "")


def set_point_meaning(model: mujoco.MjModel, actuator: int) -> tuple[SetPointMeaning, str]:
    """Return the meaning of an actuator's set-point, derived from its gain and bias, and its unit if known.

    An actuator with affine bias is a position or velocity servo. One without bias turns the set-point into a force.
    """
    import mujoco

    joint = driven_joint(model, actuator)
    kind = None if joint is None else JOINT_KINDS[int(model.jnt_type[joint])]
    unit, force = ("", "") if kind is None else (_JOINT_UNITS.get(kind, ""), _FORCE_UNITS.get(kind, ""))
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    plain = int(model.actuator_gaintype[actuator]) == mujoco.mjtGain.mjGAIN_FIXED.value
    if not plain:
        return "", ""
    if int(model.actuator_biastype[actuator]) == mujoco.mjtBias.mjBIAS_AFFINE.value:
        if bias[1]:
            integrates = int(model.actuator_dyntype[actuator]) == mujoco.mjtDyn.mjDYN_INTEGRATOR.value
            word: SetPointMeaning = "velocity" if integrates else "position"
        else:
            word = "velocity" if bias[2] else ""
        scaled = bool(word) and gain[0] == -(bias[1] or bias[2])
        ratio = float(model.actuator_gear[actuator][0])
        return word, f"{unit}{'/s' if word == 'velocity' else ''}" if scaled and unit and ratio == 1.0 else ""
    if int(model.actuator_biastype[actuator]) == mujoco.mjtBias.mjBIAS_NONE.value:
        return "force", force if gain[0] == 1.0 else ""
    return "", ""


def driven_joint(model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the id of the joint that an actuator drives, or None for other transmissions."""
    found = model.actuator_trntype[actuator] in JOINT_TRANSMISSIONS
    return int(model.actuator_trnid[actuator][0]) if found else None


def _sensor(model: mujoco.MjModel, sensor: int) -> str:
    import mujoco

    return mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_")


def _of_joint(kind: JointKind, what: str) -> str:
    if what.endswith("FRC"):
        return _FORCE_UNITS.get(kind, "")
    unit = _JOINT_UNITS.get(kind, "")
    return f"{unit}/s" if unit and what.endswith("VEL") else unit
