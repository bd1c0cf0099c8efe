"""From staged set-points to `mjData.ctrl`, one articulation at a time.

For the engine, which applies them before every sub-step, and for the op handlers, which stage and configure. Nothing
here locks or steps: the caller holds the engine's lock.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Final, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import control_counts
from urlab_client.enums import ControllerKind
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.controller_text import ControllerText

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


def float32(value: float) -> float:
    """Round `value` to single precision, as every number passing through the plugin's engine is."""
    return ctypes.c_float(value).value


def _float32_array(values: Sequence[float] | Float64s) -> Float32s:
    with np.errstate(over="ignore"):  # beyond the range of float32 lies infinity, as in C
        return np.asarray(values, dtype=np.float32)


class ControlSource(StrEnum):
    """Whose set-points reach the actuators."""

    ZMQ = "zmq"
    UI = "ui"


class SetPoints:
    """Staged set-points of one articulation, one number per control; they persist until overwritten.

    Attributes:
        network: Written by `step` and the control topic, shape (n controls,).
        ui: Written by the application that embeds the server; no op writes them, shape (n controls,).
        source: Which of the two is applied.
    """

    __slots__ = ("_places", "network", "source", "ui")

    network: Float32s | Float64s
    ui: Float32s | Float64s
    source: ControlSource

    def __init__(self, neutral: Sequence[float] | Float64s, places: Mapping[str, int], *, exact: bool = False) -> None:
        """Start from neutral controls.

        Args:
            neutral: Controls after a reset, in the articulation's order, shape (n controls,).
            places: Short and compiled actuator names to the position of the actuator's first control.
            exact: Keep what is staged by position as it is; else everything is rounded to float32.
        """
        self.network = np.array(neutral, dtype=np.float64) if exact else _float32_array(neutral).copy()
        self.ui = self.network.copy()
        self.source = ControlSource.ZMQ
        folded: dict[str, int] = {}
        for name, place in places.items():
            folded.setdefault(name.casefold(), place)
        self._places = {**folded, **places}

    @property
    def selected(self) -> Float32s | Float64s:
        """The set-points of the source in force, shape (n controls,)."""
        return self.network if self.source is ControlSource.ZMQ else self.ui

    def stage(self, values: Sequence[float] | Float64s) -> None:
        """Stage network set-points by position; surplus ones are ignored, missing ones keep their value."""
        with np.errstate(over="ignore"):  # beyond the range of float32 lies infinity, as in C
            self.stage_quietly(values)

    def stage_quietly(self, values: Sequence[float] | Float64s) -> None:
        """`stage` without silencing overflow warnings, for callers that have silenced them for many articulations."""
        if len(values) == len(self.network):
            self.network[:] = values
        else:
            count = min(len(values), len(self.network))
            self.network[:count] = values[:count]

    def stage_named(self, values: Mapping[str, float]) -> None:
        """Stage network set-points by short or compiled actuator name; unknown names are ignored.

        A name stands for the actuator's first control; the further ones of a multi-input actuator have positions only.
        """
        places = self._places
        for name, value in values.items():
            place = places.get(name)
            if place is None:
                place = places.get(name.casefold())
            if place is not None:
                self.network[place] = float32(value)


@dataclass(slots=True)
class Twist:
    """Commanded base velocity, stored and reported only; nothing in the simulation reads it.

    Attributes:
        vx: Forward velocity, m/s, base frame.
        vy: Leftward velocity, m/s, base frame.
        yaw_rate: rad/s, base frame.
        actions: Bit field of pressed action keys, bits 0 to 9.
    """

    vx: float = 0.0
    vy: float = 0.0
    yaw_rate: float = 0.0
    actions: int = 0

    def set(self, linear: Sequence[float], angular: Sequence[float]) -> None:
        """Store `linear[0]`, `linear[1]` (m/s) and `angular[2]` (rad/s) as float32; missing elements are 0."""
        self.vx = float32(linear[0]) if len(linear) > 0 else 0.0
        self.vy = float32(linear[1]) if len(linear) > 1 else 0.0
        self.yaw_rate = float32(angular[2]) if len(angular) > 2 else 0.0

    @property
    def linear(self) -> tuple[float, float, float]:
        """(vx, vy, 0), m/s."""
        return (self.vx, self.vy, 0.0)

    @property
    def angular(self) -> tuple[float, float, float]:
        """(0, 0, yaw rate), rad/s."""
        return (0.0, 0.0, self.yaw_rate)


@dataclass(frozen=True, slots=True)
class ControllerConfig:
    """Controller the server's configuration attaches to an articulation.

    Attributes:
        kind: `pd` or `passthrough`.
        kp: Proportional gain every bound actuator starts with (N m/rad, N/m).
        kv: Derivative gain every bound actuator starts with (N m s/rad, N s/m).
        torque_limit: Bound on the magnitude of the output (N m, N); 0 means no output at all.
    """

    kind: ControllerKind = ControllerKind.PD
    kp: float = 100.0
    kv: float = 5.0
    torque_limit: float = 200.0

    def __post_init__(self) -> None:
        # A plain string, too, is the kind of its name; anything else is a ValueError here.
        object.__setattr__(self, "kind", ControllerKind(self.kind))

    @classmethod
    def of(cls, text: ControllerText) -> ControllerConfig:
        """Return what a line of text describes."""
        return cls(text.kind, **text.gains)


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


def _first_controls(model: mujoco.MjModel, actuators: NDArray[Any]) -> list[int]:
    """Position of each actuator's first control among those of all of them."""
    starts: list[int] = []
    total = 0
    counts = control_counts(model)
    for actuator in actuators:
        starts.append(total)
        total += int(counts[actuator])
    return starts


def _bind(model: mujoco.MjModel, articulation: Actuated) -> _Binding:
    scalar_joints = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joint_transmissions = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    names: list[str] = []
    ids: list[int] = []
    places: list[int] = []
    joints: list[int] = []
    starts = _first_controls(model, articulation.actuators)
    counts = control_counts(model)
    for actuator, name, place in zip(articulation.actuators, articulation.actuator_names, starts, strict=True):
        if int(model.actuator_trntype[actuator]) not in joint_transmissions or counts[actuator] != 1:
            continue
        joint = int(model.actuator_trnid[actuator, 0])
        if int(model.jnt_type[joint]) in scalar_joints:
            names.append(name)
            ids.append(int(actuator))
            places.append(place)
            joints.append(joint)
    where = np.array(places, dtype=np.intp)
    which = np.array(joints, dtype=np.intp)
    limited = model.jnt_limited[which].astype(bool)
    ranges = _float32_array(model.jnt_range[which])
    return _Binding(
        names=tuple(names),
        ids=np.array(ids, dtype=np.intp),
        places=where,
        ctrl_adr=articulation.ctrl_adr[where].astype(np.intp),
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


_GAINS: Final = ("kp", "kv", "torque_limit")


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
        self._defaults = {name: float32(getattr(config, name)) for name in _GAINS}
        count = len(self.bound)
        self._gains = {name: np.full(count, self._defaults[name], dtype=np.float32) for name in _GAINS}
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
        for name in _GAINS:
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
        per_actuator = {name: dict(zip(self.bound, self._gains[name].tolist(), strict=True)) for name in _GAINS}
        return {**per_actuator, **{f"default_{name}": value for name, value in self._defaults.items()}}

    def schema(self) -> dict[str, Any]:
        """Return the schema of the six parameters."""
        return {
            **{name: {"type": "per_joint", "dtype": "float32", "min": 0.0} for name in _GAINS},
            **{f"default_{name}": {"type": "scalar", "dtype": "float32", "min": 0.0} for name in _GAINS},
        }


class ArticulationControl:
    """Everything that is commanded about one articulation: set-points, controller and twist.

    Attributes:
        index: Where the articulation lives in the model.
        set_points: Its staged set-points.
        controller: Its controller, or None.
        twist: Its commanded twist.
    """

    index: ArticulationIndex
    set_points: SetPoints
    controller: Controller | None
    twist: Twist

    def __init__(
        self,
        model: mujoco.MjModel,
        index: ArticulationIndex,
        neutral: Float64s,
        config: ControllerConfig | None = None,
        *,
        exact: bool = False,
    ) -> None:
        """Bind to a compiled model.

        Args:
            model: The `mujoco.MjModel`.
            index: The articulation.
            neutral: `mjData.ctrl` of the whole model after a reset, shape (nu,).
            config: Controller to attach; None for raw controls.
            exact: Keep set-points as they are; else they are rounded to float32.
        """
        self.index = index
        places: dict[str, int] = {}
        for name, place in zip(index.actuator_names, _first_controls(model, index.actuators), strict=True):
            places[f"{index.prefix}{name}"] = place
        places.update({name: places[f"{index.prefix}{name}"] for name in index.actuator_names})
        self._ctrl_places = _contiguous(index.ctrl_adr.astype(np.intp))
        self.set_points = SetPoints(neutral[self._ctrl_places], places, exact=exact)
        self.controller = _attach(model, index, config)
        self.twist = Twist()

    def controlled(self, *, raw: bool = False) -> bool:
        """Whether a controller decides the controls, unless the request is `raw`."""
        return not raw and self.controller is not None and self.controller.active

    def apply(self, qpos: Float64s, qvel: Float64s, ctrl: Float64s, *, raw: bool = False) -> None:
        """Write the articulation's entries of `ctrl` (shape (nu,)) for the state `qpos`, `qvel`.

        Args:
            qpos: `mjData.qpos`, shape (nq,).
            qvel: `mjData.qvel`, shape (nv,).
            ctrl: `mjData.ctrl`, written in place, not clamped to `ctrlrange`.
            raw: Bypass the controller.
        """
        controller = self.controller
        if controller is not None and controller.active and not raw:
            controller.write(self.set_points.selected, qpos, qvel, ctrl)
        else:
            ctrl[self._ctrl_places] = self.set_points.selected


def _contiguous(places: NDArray[np.intp]) -> slice | NDArray[np.intp]:
    """Return places as a slice if they follow each other: that is written three times as fast."""
    ordered: list[int] = places.tolist()
    if ordered and ordered == list(range(ordered[0], ordered[0] + len(ordered))):
        return slice(ordered[0], ordered[0] + len(ordered))
    return places


def _attach(model: mujoco.MjModel, index: ArticulationIndex, config: ControllerConfig | None) -> Controller | None:
    if config is None:
        return None
    actuated = Actuated(index.actuators, index.actuator_names, index.ctrl_adr)
    if config.kind is ControllerKind.PD:
        return PDController(model, actuated, config)
    return PassthroughController(model, actuated)
