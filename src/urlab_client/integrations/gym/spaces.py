"""Observation and action spaces: articulations as Gymnasium spaces, flat or as dictionaries, single or in batches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, cast, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts
from urlab_client.enums import CameraMode
from urlab_client.protocol.base import Floats

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


@dataclass(frozen=True)
class _Articulation:
    layout: ArticulationLayout
    low: Floats
    high: Floats
    widths: Mapping[Field, int]


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

    Actions are the set-points in `ctrl_array`, float32 as in Gymnasium's own MuJoCo environments. Their bounds are the
    actuators' `ctrlrange`, or infinite without one. An articulation without actuators, such as a block to push, has no
    actions. Observations are float64 and unbounded, because joints may overshoot their ranges. Articulations follow
    the order of their keys in `client.articulations`; fields follow the requested order. The flat spaces concatenate
    the dictionaries' entries in that order.

    Attributes:
        keys: Articulation keys, in order.
        observed: Keys of the observed articulations.
        fields: Observed fields, in order.
        mode: `flat` or `dict`.
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
    ) -> None:
        """Map articulations of a compiled scene.

        Args:
            model: The scene.
            prefixes: Prefix of the compiled element names of each articulation, by key.
            fields: Fields to observe.
            mode: `flat` or `dict`.
            observed: Keys of the articulations to observe, or None for all.

        Raises:
            ValueError: A field, the mode or an articulation is unknown, or there is nothing to observe.
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
        layouts = articulation_layouts(model, prefixes)
        self._parts = {key: _part(model, layout) for key, layout in layouts.items()}
        self._where = self._slices()
        ends = list(itertools.accumulate(len(part.low) for part in self._parts.values()))
        self._n_actions = ends[-1]
        self._driven = tuple(key for key, part in self._parts.items() if len(part.low))
        self._actions = {key: slice(a, b) for key, a, b in zip(self._parts, [0, *ends], ends, strict=False)}
        self.action_space: Space = self._make_action_space()
        self.observation_space: Space = self._make_observation_space()

    def layout(self, key: str) -> ArticulationLayout:
        """Return the layout of an articulation's values in the compiled model."""
        return self._parts[key].layout

    def width(self, key: str, field: Field) -> int:
        """Return the length of a field of an articulation."""
        return self._parts[key].widths[field]

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
        return found

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
            return _unbounded(sum(part.widths[field] for part in seen.values() for field in self.fields))
        return dict_space(
            {
                key: dict_space({field: _unbounded(part.widths[field]) for field in self.fields})
                for key, part in seen.items()
            }
        )


def _part(model: mujoco.MjModel, layout: ArticulationLayout) -> _Articulation:
    address = layout.ctrl_adr
    limited = model.actuator_ctrllimited[address].astype(bool)
    low, high = model.actuator_ctrlrange[address].T
    widths: dict[Field, int] = {
        "qpos": len(layout.qpos_adr),
        "qvel": len(layout.qvel_adr),
        "ctrl": len(address),
        "act": len(address),
        "sensors": int(sum(model.sensor_dim[i] for i in layout.sensors.values())),
    }
    return _Articulation(layout, np.where(limited, low, -np.inf), np.where(limited, high, np.inf), widths)


def _bounded(low: Floats, high: Floats) -> Space:
    return spaces.Box(low.astype(np.float32), high.astype(np.float32))


def _unbounded(n: int) -> Space:
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
