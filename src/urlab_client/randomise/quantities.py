"""The fields of a MuJoCo model and the elements for each quantity that can vary."""

from __future__ import annotations

import fnmatch
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import model_names, shown_colours
from urlab_client.protocol.base import Floats
from urlab_client.randomise.declaration import Quantity, Vary
from urlab_client.values.names import NameMap, spellings

Ints = NDArray[np.intp]
Fields = Callable[[str], NDArray[Any]]
"""Returns the array of a model's field, to be written in place; options are called `opt.NAME`."""

QUANTITIES: Final[dict[Quantity, tuple[str, tuple[str, ...]]]] = {
    "friction": ("geom", ("geom_friction",)),
    "mass": ("body", ("body_mass", "body_inertia")),
    "inertia": ("body", ("body_inertia",)),
    "centre_of_mass": ("body", ("body_ipos",)),
    "armature": ("joint", ("dof_armature",)),
    "damping": ("joint", ("dof_damping",)),
    "friction_loss": ("joint", ("dof_frictionloss",)),
    "stiffness": ("joint", ("jnt_stiffness",)),
    "kp": ("actuator", ("actuator_gainprm", "actuator_biasprm")),
    "kv": ("actuator", ("actuator_gainprm", "actuator_biasprm")),
    "strength": ("actuator", ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")),
    "gravity": ("scene", ("opt.gravity",)),
    "position": ("joint", ()),
    "base_position": ("free joint", ()),
    "base_yaw": ("free joint", ()),
    "velocity": ("joint", ()),
    "base_velocity": ("free joint", ()),
    "base_spin": ("free joint", ()),
    "light_position": ("light", ("light_pos",)),
    "light_colour": ("light", ("light_diffuse",)),
    "colour": ("geom", ("geom_rgba",)),
    "specular": ("material", ("mat_specular",)),
    "shininess": ("material", ("mat_shininess",)),
    "reflectance": ("material", ("mat_reflectance",)),
    "camera_position": ("camera", ("cam_pos",)),
    "camera_rotation": ("camera", ("cam_quat",)),
    "camera_fovy": ("camera", ("cam_fovy",)),
}
"""The kind of elements that have a quantity, and its fields in the model; a quantity of the initial state has none."""

START: Final = frozenset(what for what, (_, fields) in QUANTITIES.items() if not fields)
"""Quantities of the initial state of an episode."""

DERIVED_FROM: Final = frozenset(
    {"body_mass", "body_inertia", "body_ipos", "dof_armature", "cam_pos", "cam_quat", "light_pos"}
)
"""Fields from which `mj_setConst` computes others."""

_FIXED, _AFFINE, _NO_BIAS = 0, 1, 0  # mjGAIN_FIXED, mjGAIN_AFFINE and mjBIAS_AFFINE, mjBIAS_NONE
_ANY: Final = (-np.inf, np.inf)
_POSITIVE: Final = (0.0, np.inf)
_FREE: Final = int(mujoco.mjtJoint.mjJNT_FREE)
_SCALAR: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@dataclass(frozen=True, eq=False)
class Elements:
    """Elements of a model that have a quantity, and their names in recordings, in the same order."""

    ids: Ints
    names: tuple[str, ...]


def elements_of(vary: Vary, model: mujoco.MjModel, controlled: frozenset[int], prefixes: NameMap[str]) -> Elements:
    """Return the elements whose quantity varies; there must be one.

    A geom is found by its own name or its body's, a free joint likewise. `controlled` are the actuators that a
    controller with gains drives, `prefixes` what compiled names begin with, by key of the articulation.
    """
    if vary.what == "gravity":
        return Elements(np.zeros(1, dtype=np.intp), ("scene",))
    kind, _ = QUANTITIES[vary.what]
    names = model_names(model, kind.removeprefix("free "))
    aliases = _aliases(model, kind, names)
    written = [list(itertools.chain(*spellings(each, prefixes))) for each in aliases]
    having = [i for i in range(len(names)) if _has(vary.what, model, i, controlled)]
    chosen = [i for i in having if any(fnmatch.filter(written[i], pattern) for pattern in vary.patterns)]
    if not chosen:
        there = ", ".join(dict.fromkeys(alias for i in having for alias in aliases[i] if alias)) or "none"
        raise ValueError(f"no {kind} with a {vary.what} is called {' or '.join(vary.patterns)}; there are: {there}")
    return Elements(np.array(chosen, dtype=np.intp), tuple(names[i] or aliases[i][-1] for i in chosen))


def write(vary: Vary, elements: Elements, drawn: Floats, model: mujoco.MjModel, fields: Fields) -> None:
    """Apply drawn numbers, shape (n elements, width), to the fields of a model.

    The quantity is not in `START`. `model` has the values that do not vary.
    """
    ids, (_, names) = elements.ids, QUANTITIES[vary.what]
    match vary.what:
        case "friction":
            _change(vary, fields("geom_friction")[:, 0], ids, drawn[:, 0])
        case "mass":
            mass = fields("body_mass")
            before = mass[ids].copy()
            _change(vary, mass, ids, drawn[:, 0], _POSITIVE)
            fields("body_inertia")[ids] *= (mass[ids] / before)[:, None]
        case "armature" | "damping" | "friction_loss":
            dofs, owners = _dofs(model, ids)
            _change(vary, fields(names[0]), dofs, drawn[owners, 0], _POSITIVE)
        case "stiffness" | "specular" | "shininess" | "reflectance":
            bounds = _POSITIVE if vary.what == "stiffness" else (0.0, 1.0)
            _change(vary, fields(names[0]), ids, drawn[:, 0], bounds)
        case "kp" | "kv":
            _write_gain(vary.what, ids, drawn[:, 0], model, fields)
        case "inertia" | "strength":
            for name in names:
                fields(name)[ids] *= drawn
        case "gravity":
            gravity = fields("opt.gravity")
            gravity[:] = _changed(vary, gravity, drawn[0])
        case "colour":
            shown = shown_colours(model, fields("geom_rgba"), ids)
            shown[:, :3] = np.clip(_changed(vary, shown[:, :3], drawn), 0.0, 1.0)
            fields("geom_rgba")[ids] = shown
        case "camera_rotation":
            turned = fields("cam_quat")
            for i, vector in zip(ids, drawn, strict=True):
                turned[i] = _rotated(turned[i], vector)
        case _:
            field = fields(names[0])
            values = drawn if field.ndim > 1 else drawn[:, 0]
            field[ids] = _changed(vary, field[ids], values)


def _change(vary: Vary, field: NDArray[Any], ids: Ints, drawn: Floats, bounds: tuple[float, float] = _ANY) -> None:
    field[ids] = np.clip(_changed(vary, field[ids], drawn), *bounds)


def _changed(vary: Vary, values: NDArray[Any], drawn: Floats) -> NDArray[Any]:
    match vary.by:
        case "scale":
            return values * drawn
        case "add":
            return values + drawn
        case "set":
            return np.broadcast_to(drawn, values.shape)


def _write_gain(what: str, ids: Ints, factors: Floats, model: mujoco.MjModel, fields: Fields) -> None:
    """Scale a gain of servos, whose force is gain * ctrl + bias0 + bias1 * length + bias2 * velocity."""
    gain, bias = fields("actuator_gainprm"), fields("actuator_biasprm")
    servos = model.actuator_biastype[ids] == _AFFINE
    for i, factor in zip(ids[servos], factors[servos], strict=True):
        by_position = model.actuator_biasprm[i, 1] != 0.0
        if what == "kp":
            gain[i, 0] *= factor
            bias[i, 1] *= factor
        else:
            bias[i, 2] *= factor
            if not by_position:  # a velocity servo, with gain kv
                gain[i, 0] *= factor


def _has(what: Quantity, model: mujoco.MjModel, i: int, controlled: frozenset[int]) -> bool:
    match what:
        case "mass" | "inertia" | "centre_of_mass":
            return bool(model.body_mass[i] > 0.0)
        case "base_position" | "base_yaw" | "base_velocity" | "base_spin":
            return bool(model.jnt_type[i] == _FREE)
        case "position" | "velocity":
            return bool(model.jnt_type[i] in _SCALAR)
        case "kp" | "kv":
            affine = model.actuator_gaintype[i] == _FIXED and model.actuator_biastype[i] == _AFFINE
            column = 1 if what == "kp" else 2
            return i in controlled or bool(affine and model.actuator_biasprm[i, column] != 0.0)
        case "strength":
            return bool(
                model.actuator_gaintype[i] in (_FIXED, _AFFINE) and model.actuator_biastype[i] in (_NO_BIAS, _AFFINE)
            )
        case _:
            return True


def _aliases(model: mujoco.MjModel, kind: str, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the possible names of each element; a geom or free joint also has that of its body."""
    owners = {"geom": "geom_bodyid", "free joint": "jnt_bodyid"}.get(kind)
    if owners is None:
        return [(name,) for name in names]
    bodies = model_names(model, "body")
    return [(name, bodies[body]) for name, body in zip(names, getattr(model, owners), strict=True)]


def _dofs(model: mujoco.MjModel, joints: Ints) -> tuple[Ints, Ints]:
    """Return the degrees of freedom of joints, and the joint of each."""
    which = [np.flatnonzero(model.dof_jntid == joint) for joint in joints]
    owners = np.repeat(np.arange(len(joints)), [len(found) for found in which])
    return np.concatenate(which).astype(np.intp), owners.astype(np.intp)


def _rotated(quaternion: Floats, vector: Floats) -> Floats:
    """Turn an orientation by a rotation vector in its own frame, radians."""
    turned = np.array(quaternion, dtype=np.float64)
    mujoco.mju_quatIntegrate(turned, np.asarray(vector, dtype=np.float64), 1.0)
    return turned
