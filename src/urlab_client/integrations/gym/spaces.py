"""Observation and action spaces: articulations as Gymnasium spaces, flat or as dictionaries, single or in batches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, cast, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client._mujoco import control_counts
from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts, driven_joint
from urlab_client.aio.model.mirror import model_names
from urlab_client.enums import CameraMode
from urlab_client.errors import UnknownKeyframe
from urlab_client.protocol.base import Floats
from urlab_client.values.names import compiled_names

if TYPE_CHECKING:
    import mujoco

SpaceMode = Literal["flat", "dict"]
Field = Literal["qpos", "qvel", "ctrl", "act", "sensors"]
Space = spaces.Space[Any]
Observation = Any
"""An array of shape (…, n) in flat mode, otherwise a dictionary of arrays by articulation and field."""

FIELDS: Final[tuple[Field, ...]] = get_args(Field)
LEVELS: Final[Mapping[str, tuple[Field, ...]]] = {"minimal": ("qpos", "qvel"), "standard": FIELDS}
"""Fields of the observation levels that consist of arrays."""

_HINGE_AND_SLIDE: Final = (2, 3)


@dataclass(frozen=True, slots=True)
class Actions:
    """How actions become set-points: `offset + scale * clip(action)`, with one number for each actuator input.

    The bounds of the action space are those of `clip`. A set-point is in the unit of the actuator, or of the joint if
    a PD controller drives it.

    Attributes:
        scale: Change of the set-points per unit of action, a single number or one per input.
        offset: Set-points for an action of 0: a single number, one per input, or the name of a keyframe, whose
            set-points are its `ctrl`, or its joint positions where a PD controller drives the joints.
        clip: Lowest and highest action; actions beyond them are clipped.
    """

    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] | str = 0.0
    clip: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        if not self.clip[0] < self.clip[1]:
            raise ValueError(f"actions: clip must be (low, high) with low < high, not {self.clip}")
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if not isinstance(value, str) and not np.isfinite(value).all():
                raise ValueError(f"actions: {name} contains NaN or infinity")


@dataclass(frozen=True)
class _Articulation:
    layout: ArticulationLayout
    low: Floats
    high: Floats
    widths: Mapping[Field, int]
    scale: Floats
    offset: Floats
    clip: tuple[float, float] | None


def fields_of(observations: str | Sequence[str]) -> tuple[Field, ...]:
    """Return the fields of an observation level, or the given field names."""
    if not isinstance(observations, str):
        return tuple(observations)  # type: ignore[return-value]  # SpaceMapping rejects unknown names
    if observations not in LEVELS:
        raise ValueError(
            f"observations must be {' or '.join(map(repr, LEVELS))}, or a sequence of fields, not {observations!r}"
        )
    return LEVELS[observations]


class SpaceMapping:
    """Mapping of the articulations of a scene to an action space and an observation space.

    Actions are float32, as in Gymnasium's own MuJoCo environments. Without a declaration they are the set-points in
    `ctrl_array`, bounded by the actuators' `ctrlrange`, or by the range of the joint if a PD controller drives it, or
    infinite without a range. An articulation without actuators, such as a block to push, has no actions. Observations
    are float64 and unbounded, because joints may overshoot their ranges. Articulations follow the order of their keys
    in `client.articulations`; fields follow the requested order. The flat spaces concatenate the dictionaries' entries
    in that order.

    Attributes:
        keys: Articulation keys, in order.
        observed: Keys of the observed articulations.
        fields: Observed fields, in order.
        mode: `flat` or `dict`.
        prefixes: Prefix of the compiled element names of each articulation, by key.
        action_space: `Box(n,)`, or `Dict` of one `Box` per articulation.
        observation_space: `Box(n,)`, or `Dict` of one `Dict` of fields per articulation.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        prefixes: Mapping[str, str],
        fields: Sequence[Field],
        mode: SpaceMode = "flat",
        observed: Sequence[str] | None = None,
        *,
        actions: Actions | Mapping[str, Actions] | None = None,
        targets: frozenset[int] = frozenset(),
    ) -> None:
        """Map articulations of a compiled scene.

        Args:
            model: The scene.
            prefixes: Prefix of the compiled element names of each articulation, by key.
            fields: Fields to observe.
            mode: `flat` or `dict`.
            observed: Keys of the articulations to observe, or None for all.
            actions: How actions become set-points, for all articulations or by key; None for set-points themselves.
            targets: Ids of the actuators whose set-points are joint positions, because a controller drives them.

        Raises:
            ValueError: A field, the mode or an articulation is unknown, there is nothing to observe, or the actions
                have the wrong length.
            UnknownKeyframe: No keyframe, or more than one, has the name that the actions give.
        """
        unknown = [field for field in fields if field not in FIELDS]
        if unknown or not fields:
            raise ValueError(f"observations must be one or more of {', '.join(FIELDS)}, not {list(fields)!r}")
        if mode not in get_args(SpaceMode):
            raise ValueError(f"space_mode must be 'flat' or 'dict', not {mode!r}")
        self.keys: tuple[str, ...] = tuple(prefixes)
        self.observed: tuple[str, ...] = self.keys if observed is None else tuple(observed)
        if missing := set(self.observed) - set(self.keys):
            raise ValueError(
                f"cannot observe {', '.join(sorted(missing))}; the articulations are: {', '.join(self.keys)}"
            )
        self.fields: tuple[Field, ...] = tuple(fields)
        self.mode: SpaceMode = mode
        self._model = model
        self.prefixes: dict[str, str] = dict(prefixes)
        self._targets = targets
        self._parts = {key: _part(model, each, targets) for key, each in articulation_layouts(model, prefixes).items()}
        self._driven = tuple(key for key, part in self._parts.items() if len(part.low))
        if actions is not None:
            declared = dict.fromkeys(self.keys, actions) if isinstance(actions, Actions) else actions
            if wrong := declared.keys() - self._parts.keys():
                raise ValueError(
                    f"actions of {', '.join(sorted(wrong))}; the articulations are: {', '.join(self.keys)}"
                )
            self._parts |= {key: self._scaled(key, each) for key, each in declared.items()}
        self._where = self._slices()
        ends = list(itertools.accumulate(len(part.low) for part in self._parts.values()))
        self._n_actions = ends[-1]
        self._actions = {key: slice(a, b) for key, a, b in zip(self._parts, [0, *ends], ends, strict=False)}
        self.action_space: Space = self._make_action_space()
        self.observation_space: Space = self._make_observation_space()

    def layout(self, key: str) -> ArticulationLayout:
        """Return the layout of an articulation's values in the compiled model."""
        return self._parts[key].layout

    def width(self, key: str, field: Field) -> int:
        """Return the length of a field of an articulation."""
        return self._parts[key].widths[field]

    def keyframe_id(self, name: str) -> int:
        """Return the id of a keyframe, by its own name or that of the compiled scene.

        Raises:
            UnknownKeyframe: No keyframe, or more than one, has this name.
        """
        known = model_names(self._model, "key")
        wanted = {name, *compiled_names(name, self.prefixes)}
        found = [i for i, full in enumerate(known) if full in wanted]
        if len(found) != 1:
            raise UnknownKeyframe(
                "unknown_keyframe", f"{name!r} does not name exactly one of {', '.join(known) or 'none'}"
            )
        return found[0]

    def held(self, keyframe: str | None) -> dict[str, Floats]:
        """Return the set-points that hold a keyframe, or the initial state, by articulation, shape (n_ctrl,).

        They are its `ctrl`, 0 in the initial state, and the positions of the joints that a PD controller drives.

        Raises:
            UnknownKeyframe: No keyframe, or more than one, has this name.
        """
        model, key = self._model, -1 if keyframe is None else self.keyframe_id(keyframe)
        ctrl, qpos = (np.zeros(model.nu), model.qpos0) if key < 0 else (model.key_ctrl[key], model.key_qpos[key])
        found: dict[str, Floats] = {}
        for name in self._driven:
            found[name] = np.array(ctrl[self.layout(name).ctrl_adr], dtype=np.float64)
            for place, joint in _driven_joints(model, self.layout(name), self._targets):
                found[name][place] = qpos[model.jnt_qposadr[joint]]
        return found

    def flat(self, action: Any) -> Floats:
        """Return actions as one array, shape (…, n_actions): the articulations with actuators in their order."""
        if self.mode == "dict":
            return np.concatenate([np.asarray(action[key], dtype=np.float64) for key in self._driven], axis=-1)
        return np.asarray(action, dtype=np.float64)

    @property
    def n_actions(self) -> int:
        """Number of actuator inputs: the length of `flat`."""
        return self._n_actions

    def actions(self, key: str) -> Actions:
        """Return how the actions of an articulation become set-points, with one number per actuator input."""
        part = self._parts[key]
        clip = (-np.inf, np.inf) if part.clip is None else part.clip
        return Actions(scale=part.scale.tolist(), offset=part.offset.tolist(), clip=clip)

    def joint_names(self, key: str, model: mujoco.MjModel) -> list[str]:
        """Return the names of the hinge and slide joints of an articulation: joints with a scalar position."""
        return [name for name, i in self._parts[key].layout.joints.items() if model.jnt_type[i] in _HINGE_AND_SLIDE]

    def scalar_joints(self, key: str, model: mujoco.MjModel) -> NDArray[np.intp]:
        """Return the ids of the joints in `joint_names`."""
        joints = self._parts[key].layout.joints
        return np.array([joints[name] for name in self.joint_names(key, model)], dtype=np.intp)

    def set_points(self, action: Any) -> dict[str, Floats]:
        """Return the set-points of each articulation, shape (…, n_ctrl), from an action.

        Raises:
            ValueError: The action has the wrong shape, or contains NaN or infinity.
        """
        if self.mode == "dict":
            if set(action) != set(self._driven):
                wanted = ", ".join(self._driven)
                raise ValueError(f"the action needs one entry for each of {wanted}, not {sorted(action)}")
            found = {key: np.asarray(action[key], dtype=np.float64) for key in self._driven}
        else:
            whole = np.asarray(action, dtype=np.float64)
            if whole.ndim == 0 or whole.shape[-1] != self._n_actions:
                raise ValueError(f"the action has shape {whole.shape}; its last axis must be {self._n_actions} long")
            found = {key: whole[..., where] for key, where in self._actions.items() if key in self._driven}
        for key, values in found.items():
            n_ctrl = len(self._parts[key].low)
            if values.ndim == 0 or values.shape[-1] != n_ctrl:
                raise ValueError(f"the action of {key} has shape {values.shape}; its last axis must be {n_ctrl} long")
            if not np.isfinite(values).all():
                raise ValueError(f"the action of {key} contains NaN or infinity: {values}")
            part = self._parts[key]
            if part.clip is not None:
                found[key] = part.offset + part.scale * np.clip(values, *part.clip)
        return found

    def _scaled(self, key: str, actions: Actions) -> _Articulation:
        """Return an articulation whose actions become set-points as declared."""
        part = self._parts[key]
        offset = self.held(actions.offset)[key] if isinstance(actions.offset, str) else actions.offset
        try:
            scale, offset = (
                np.broadcast_to(np.asarray(v, np.float64), part.low.shape) for v in (actions.scale, offset)
            )
        except ValueError:
            raise ValueError(
                f"actions of {key}: scale and offset take one number, or one for each of the {len(part.low)} inputs"
            ) from None
        low, high = (np.full(part.low.shape, bound) for bound in actions.clip)
        return replace(part, low=low, high=high, scale=scale, offset=offset, clip=actions.clip)

    def observe(self, read: Callable[[str, Field], Floats]) -> Observation:
        """Assemble an observation from `read(key, field)`, which returns arrays of shape (…, n)."""
        if self.mode == "dict":
            return {key: {field: np.array(read(key, field)) for field in self.fields} for key in self.observed}
        return np.concatenate([read(key, field) for key in self.observed for field in self.fields], axis=-1)

    def field(self, observation: Observation, key: str, field: Field) -> Floats:
        """Return the view of one field in an observation of either mode, shape (…, n).

        Reward and termination functions that use this and `[..., i]` work with single and vector environments.

        Raises:
            ValueError: The field or the articulation is not observed.
        """
        if field not in self.fields:
            raise ValueError(
                f"{field!r} is not observed: the environment was made with observations={list(self.fields)!r}"
            )
        if key not in self.observed:
            raise ValueError(f"{key!r} is not observed; the observed articulations are: {', '.join(self.observed)}")
        if self.mode == "dict":
            return observation[key][field]
        return observation[..., self._where[key, field]]

    def _slices(self) -> dict[tuple[str, Field], slice]:
        where: dict[tuple[str, Field], slice] = {}
        at = 0
        for key in self.observed:
            part = self._parts[key]
            for field in self.fields:
                where[key, field] = slice(at, at + part.widths[field])
                at += part.widths[field]
        return where

    def _make_action_space(self) -> Space:
        if self.mode == "dict":
            parts = {key: self._parts[key] for key in self._driven}
            return dict_space({key: _bounded(part.low, part.high) for key, part in parts.items()})
        parts = self._parts.values()
        return _bounded(np.concatenate([part.low for part in parts]), np.concatenate([part.high for part in parts]))

    def _make_observation_space(self) -> Space:
        seen = {key: self._parts[key] for key in self.observed}
        if self.mode == "flat":
            return unbounded(sum(part.widths[field] for part in seen.values() for field in self.fields))
        return dict_space(
            {
                key: dict_space({field: unbounded(part.widths[field]) for field in self.fields})
                for key, part in seen.items()
            }
        )


def _driven_joints(
    model: mujoco.MjModel, layout: ArticulationLayout, targets: frozenset[int]
) -> Iterator[tuple[int, int]]:
    """Yield the place among an articulation's controls and the joint of each actuator in `targets`."""
    place, counts = 0, control_counts(model)
    for actuator in layout.actuators.values():
        joint = driven_joint(model, actuator) if actuator in targets else None
        if joint is not None:
            yield place, joint
        place += int(counts[actuator])


def _part(model: mujoco.MjModel, layout: ArticulationLayout, targets: frozenset[int]) -> _Articulation:
    address = layout.ctrl_adr
    limited = model.actuator_ctrllimited[address].astype(bool)
    low, high = np.array(model.actuator_ctrlrange[address], dtype=np.float64).T
    for place, joint in _driven_joints(model, layout, targets):
        limited[place], (low[place], high[place]) = model.jnt_limited[joint], model.jnt_range[joint]
    widths: dict[Field, int] = {
        "qpos": len(layout.qpos_adr),
        "qvel": len(layout.qvel_adr),
        "ctrl": len(address),
        "act": len(address),
        "sensors": int(sum(model.sensor_dim[i] for i in layout.sensors.values())),
    }
    low, high = np.where(limited, low, -np.inf), np.where(limited, high, np.inf)
    return _Articulation(layout, low, high, widths, np.ones(len(address)), np.zeros(len(address)), None)


def _bounded(low: Floats, high: Floats) -> Space:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32))


def unbounded(n: int) -> Space:
    """Return the space of `n` numbers without bounds."""
    return spaces.Box(-np.inf, np.inf, (n,), dtype=np.float64)


def mapped(function: Callable[[NDArray[Any]], NDArray[Any]], tree: Any) -> Any:
    """Return a tree of dictionaries with a function applied to its arrays."""
    if isinstance(tree, Mapping):
        return {key: mapped(function, entry) for key, entry in cast("Mapping[str, Any]", tree).items()}
    return function(tree)


def dict_space(entries: Mapping[str, Space]) -> Space:
    """Return a `Dict` of spaces, in the given order."""
    return spaces.Dict(dict(entries))


def with_cameras(mapping: SpaceMapping, cameras: Mapping[str, Space]) -> Space:
    """Return a mapping's observation space with an entry `cameras` that holds the pictures by camera."""
    if not cameras:
        return mapping.observation_space
    if mapping.mode != "dict":
        raise ValueError("a flat observation cannot contain images: use space_mode='dict' with cameras")
    if "cameras" in mapping.keys:
        raise ValueError("an articulation is named 'cameras', which is the entry for images: give it another actor id")
    observed = cast("Mapping[str, Space]", mapping.observation_space)
    return dict_space({**observed, "cameras": dict_space(cameras)})


def camera_space(mode: CameraMode | str, resolution: tuple[int, int]) -> Space:
    """Return the space of `observed_pixels`: depth in metres, RGB as in `render`, or BGRA of segmentations."""
    width, height = resolution
    if mode == CameraMode.DEPTH:
        return spaces.Box(0.0, np.inf, (height, width), dtype=np.float32)
    return spaces.Box(0, 255, (height, width, 3 if mode == CameraMode.REAL else 4), dtype=np.uint8)
