"""Controllers: from set-points to `mjData.ctrl`, for servers and for batches of copies of a scene."""

from __future__ import annotations

import ctypes
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import control_counts
from urlab_client.enums import ControllerKind
from urlab_client.simulation.controller_config import GAINS, ControllerConfig

_SCALAR_JOINTS: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_JOINT_TRANSMISSIONS: Final = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


def float32(value: float) -> float:
    """Round `value` to single precision, as every number passing through the plugin's engine is."""
    return ctypes.c_float(value).value


def float32_array(values: Sequence[float] | Float64s) -> Float32s:
    """Round to single precision."""
    with np.errstate(over="ignore"):  # beyond the range of float32 lies infinity, as in C
        return np.asarray(values, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Actuated:
    """The actuators of an articulation, as a controller needs them.

    Attributes:
        actuators: Actuator ids.
        actuator_names: Short actuator names, parallel to the ids.
        ctrl_adr: Index into `mjData.ctrl` of every control, in actuator order.
    """

    actuators: NDArray[Any]
    actuator_names: tuple[str, ...]
    ctrl_adr: NDArray[Any]


@dataclass(frozen=True, slots=True)
class _Binding:
    """Actuators of an articulation that drive a hinge or slide joint, in actuator order."""

    names: tuple[str, ...]
    ids: NDArray[np.intp]
    places: NDArray[np.intp]  # into the articulation's controls
    ctrl_adr: NDArray[np.intp]
    qpos_adr: NDArray[np.intp]
    qvel_adr: NDArray[np.intp]
    lower: Float32s
    upper: Float32s


def first_controls(model: mujoco.MjModel, actuators: NDArray[Any]) -> NDArray[np.intp]:
    """Position of each actuator's first control among those of all of them."""
    counts = control_counts(model)[actuators].astype(np.intp)
    return np.cumsum(counts) - counts


def _bind(model: mujoco.MjModel, articulation: Actuated) -> _Binding:
    ids = np.asarray(articulation.actuators, dtype=np.intp)
    joints = model.actuator_trnid[ids, 0]
    bound = np.isin(model.actuator_trntype[ids], _JOINT_TRANSMISSIONS) & (control_counts(model)[ids] == 1)
    bound[bound] = np.isin(model.jnt_type[joints[bound]], _SCALAR_JOINTS)
    places, which = first_controls(model, ids)[bound], joints[bound].astype(np.intp)
    limited = model.jnt_limited[which].astype(bool)
    ranges = float32_array(model.jnt_range[which])
    return _Binding(
        names=tuple(itertools.compress(articulation.actuator_names, bound)),
        ids=ids[bound],
        places=places,
        ctrl_adr=articulation.ctrl_adr[places].astype(np.intp),
        qpos_adr=model.jnt_qposadr[which].astype(np.intp),
        qvel_adr=model.jnt_dofadr[which].astype(np.intp),
        lower=np.where(limited, ranges[:, 0], np.float32(-np.inf)),
        upper=np.where(limited, ranges[:, 1], np.float32(np.inf)),
    )


class Controller(ABC):
    """Turns the set-points of the actuators it bound into controls.

    It binds actuators with one control that drive a hinge or slide joint through a joint transmission, and never writes
    the others.

    Attributes:
        enabled: Whether the engine uses it; every successful `configure` with a map switches it on.
    """

    kind: ClassVar[str]
    """Name of the controller on the wire."""

    enabled: bool

    def __init__(self, model: mujoco.MjModel, articulation: Actuated) -> None:
        self.enabled = True
        self._binding = _bind(model, articulation)

    @property
    def bound(self) -> tuple[str, ...]:
        """Short names of the bound actuators, in actuator order."""
        return self._binding.names

    @property
    def bound_actuators(self) -> NDArray[np.intp]:
        """Ids of the bound actuators, in that order."""
        return self._binding.ids

    @property
    def active(self) -> bool:
        """Whether it writes controls: enabled and bound to at least one actuator."""
        return self.enabled and bool(self._binding.names)

    @abstractmethod
    def write(self, set_points: Float32s | Float64s, qpos: Float64s, qvel: Float64s, ctrl: Float64s) -> None:
        """Write the bound actuators' entries of `ctrl`. All arrays may have leading axes, the same ones.

        Args:
            set_points: Selected set-points of the articulation, shape (…, n controls).
            qpos: `mjData.qpos`, shape (…, nq).
            qvel: `mjData.qvel`, shape (…, nv).
            ctrl: `mjData.ctrl`, shape (…, nu), written in place.
        """

    def configure(self, params: Mapping[str, object]) -> None:
        """Change parameters; those left out, unknown ones and values of a wrong type change nothing."""
        del params

    def params(self) -> dict[str, Any]:
        """Return all current parameters as they go on the wire."""
        return {}

    def schema(self) -> dict[str, Any]:
        """Return parameter name to `{type, dtype, min}`."""
        return {}


class PassthroughController(Controller):
    """Writes the set-point of each bound actuator to its control."""

    kind = "base"

    def write(self, set_points: Float32s | Float64s, qpos: Float64s, qvel: Float64s, ctrl: Float64s) -> None:
        """Copy the bound set-points."""
        del qpos, qvel
        ctrl[..., self._binding.ctrl_adr] = set_points.take(self._binding.places, axis=-1)


class PDController(Controller):
    """`kp * (target - q) - kv * qdot`, clamped to the torque limit, in single precision.

    The target is the set-point, clamped to the joint's range where the joint is limited. `default_*` are what the gains
    were filled from; changing a default later changes no actuator.

    Attributes:
        factors: By what gains are multiplied besides, by name, shape (…, n bound), with the leading axes of `write`.
    """

    factors: Mapping[str, Float32s]

    kind = "pd"

    def __init__(self, model: mujoco.MjModel, articulation: Actuated, config: ControllerConfig) -> None:
        super().__init__(model, articulation)
        self._defaults = {name: float32(getattr(config, name)) for name in GAINS}
        count = len(self.bound)
        self._gains = {name: np.full(count, self._defaults[name], dtype=np.float32) for name in GAINS}
        self._rows = {name: row for row, name in enumerate(self.bound)}
        self.factors = {}

    def write(self, set_points: Float32s | Float64s, qpos: Float64s, qvel: Float64s, ctrl: Float64s) -> None:
        """Write the bound actuators' torques or forces."""
        binding, gains = self._binding, self._gains
        with np.errstate(all="ignore"):  # overflow and NaN follow IEEE, as in the plugin
            target = set_points.take(binding.places, axis=-1)
            np.minimum(target, binding.upper, out=target)
            np.maximum(target, binding.lower, out=target)
            target -= qpos.take(binding.qpos_adr, axis=-1).astype(np.float32)
            target *= self._in_force("kp")
            target -= self._in_force("kv") * qvel.take(binding.qvel_adr, axis=-1).astype(np.float32)
            limit = gains["torque_limit"]
            np.minimum(target, limit, out=target)
            np.maximum(target, -limit, out=target)
        ctrl[..., binding.ctrl_adr] = target

    def _in_force(self, name: str) -> Float32s:
        factor = self.factors.get(name)
        return self._gains[name] if factor is None else self._gains[name] * factor

    def configure(self, params: Mapping[str, object]) -> None:
        """Change gains and defaults and switch on; negative values are taken as they are."""
        self.enabled = True
        for name in GAINS:
            default = params.get(f"default_{name}")
            if isinstance(default, (int, float)):
                self._defaults[name] = float32(default)
            values = params.get(name)
            if isinstance(values, Mapping):
                for actuator, value in cast("Mapping[object, object]", values).items():
                    row = self._rows.get(actuator) if isinstance(actuator, str) else None
                    if row is not None and isinstance(value, (int, float)):
                        self._gains[name][row] = float32(value)

    def params(self) -> dict[str, Any]:
        """Return the six parameters: three maps by short actuator name, three defaults."""
        per_actuator = {name: dict(zip(self.bound, self._gains[name].tolist(), strict=True)) for name in GAINS}
        return {**per_actuator, **{f"default_{name}": value for name, value in self._defaults.items()}}

    def schema(self) -> dict[str, Any]:
        """Return the schema of the six parameters."""
        return {
            **{name: {"type": "per_joint", "dtype": "float32", "min": 0.0} for name in GAINS},
            **{f"default_{name}": {"type": "scalar", "dtype": "float32", "min": 0.0} for name in GAINS},
        }


def attach_controller(model: mujoco.MjModel, articulation: Actuated, config: ControllerConfig) -> Controller:
    """Return a new controller of an articulation's actuators."""
    if config.kind is ControllerKind.PD:
        return PDController(model, articulation, config)
    return PassthroughController(model, articulation)
