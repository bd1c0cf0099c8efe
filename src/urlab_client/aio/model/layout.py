"""Addresses of an articulation's values in the compiled model and in the wire's positional arrays, and their units.

MuJoCo has no units; those here apply to models in SI units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import (
    QPOS_WIDTH,
    QVEL_WIDTH,
    control_counts,
    control_starts,
    force_counts,
    model_names,
    spans,
)
from urlab_client.values.descriptions import JointKind, SetPointMeaning
from urlab_client.values.names import NameMap, element_ids, split_prefix

if TYPE_CHECKING:
    import mujoco

FREE = 0  # mjJNT_FREE
JOINT_TRANSMISSIONS = (0, 1)  # mjTRN_JOINT, mjTRN_JOINTINPARENT

Ints = NDArray[np.intp]
_EMPTY: Ints = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, slots=True)
class ArticulationLayout:
    """Elements of one articulation in ascending order of id, and the addresses that gather and scatter its values.

    Attributes:
        joints: Short joint name to id; likewise `actuators`, `sensors` and `bodies`.
        qpos_adr: Addresses of all its coordinates in `mjData.qpos`, in the order of the wire's `qpos`.
        qvel_adr: Addresses of all its velocities in `mjData.qvel`.
        sensor_dims: Length of each sensor's reading, by short name.
        ctrl_adr: Addresses of all its controls in `mjData.ctrl`; an actuator may have several.
        n_out: Total number of outputs of its actuators; an actuator may have several.
        act_from: Positions in the wire's `act` that have an activation.
        act_adr: Their addresses in `mjData.act`.
        root_body: Id of its root body, -1 without a model.
        free_joint: Id of the root's free joint, -1 if it has none. It is the first of `joints`.
    """

    joints: dict[str, int] = field(default_factory=dict[str, int])
    actuators: dict[str, int] = field(default_factory=dict[str, int])
    sensors: dict[str, int] = field(default_factory=dict[str, int])
    bodies: dict[str, int] = field(default_factory=dict[str, int])
    sensor_dims: dict[str, int] = field(default_factory=dict[str, int])
    qpos_adr: Ints = field(default_factory=_EMPTY.copy)
    qvel_adr: Ints = field(default_factory=_EMPTY.copy)
    ctrl_adr: Ints = field(default_factory=_EMPTY.copy)
    act_from: Ints = field(default_factory=_EMPTY.copy)
    act_adr: Ints = field(default_factory=_EMPTY.copy)
    n_out: int = 0
    root_body: int = -1
    free_joint: int = -1


def articulation_layouts(model: mujoco.MjModel, prefixes: Mapping[str, str]) -> dict[str, ArticulationLayout]:
    """Return the layout of each articulation; an element belongs to the longest prefix of its name."""
    keys = list(prefixes.values())
    elements = [_by_owner(model, kind, keys) for kind in ("body", "joint", "actuator", "sensor")]
    return {key: _layout(model, *(owned[prefix] for owned in elements)) for key, prefix in prefixes.items()}


def compiled_ids(model: mujoco.MjModel, kind: str, prefixes: NameMap[str]) -> NameMap[int]:
    """Return the ids of the elements of a kind, such as `body`, by all that users may write for them.

    Args:
        model: The compiled model.
        kind: A kind of `model_names`.
        prefixes: What the compiled names of each articulation's elements begin with, by key.
    """
    return element_ids(model_names(model, kind), prefixes, "keyframe" if kind == "key" else kind)


def _by_owner(model: mujoco.MjModel, kind: str, keys: list[str]) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {key: {} for key in keys}
    names = model_names(model, kind)
    for i, (owner, short) in enumerate(split_prefix(names, keys)):
        if owner is not None:
            found[owner][short] = i
    return found


def _layout(
    model: mujoco.MjModel,
    bodies: dict[str, int],
    joints: dict[str, int],
    actuators: dict[str, int],
    sensors: dict[str, int],
) -> ArticulationLayout:
    joint_ids = np.fromiter(joints.values(), dtype=np.intp)
    kinds = model.jnt_type[joint_ids]
    actuator_ids = np.fromiter(actuators.values(), dtype=np.intp)
    counts = control_counts(model)[actuator_ids]
    ctrl_adr = spans(control_starts(model)[actuator_ids], counts)
    act_adr = np.repeat(model.actuator_actadr[actuator_ids], counts).astype(np.intp)
    act_from = np.flatnonzero(act_adr >= 0)
    root = min(bodies.values(), default=-1)
    free = -1
    if root >= 0 and model.body_jntnum[root] > 0:
        first = int(model.body_jntadr[root])
        # A free joint whose name is not the articulation's has its positions elsewhere on the wire.
        free = first if model.jnt_type[first] == FREE and first == next(iter(joints.values()), -1) else -1
    return ArticulationLayout(
        joints=joints,
        actuators=actuators,
        sensors=sensors,
        bodies=bodies,
        sensor_dims={name: int(model.sensor_dim[i]) for name, i in sensors.items()},
        qpos_adr=spans(model.jnt_qposadr[joint_ids], QPOS_WIDTH[kinds]),
        qvel_adr=spans(model.jnt_dofadr[joint_ids], QVEL_WIDTH[kinds]),
        ctrl_adr=ctrl_adr,
        act_from=act_from,
        act_adr=act_adr[act_from],
        n_out=int(force_counts(model)[actuator_ids].sum()),
        root_body=root,
        free_joint=free,
    )


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
