"""Observation and action spaces: articulations as Gymnasium spaces, flat or as dictionaries, single or in batches."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, cast, get_args

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from urlab_client._mujoco import control_counts
from urlab_client.aio.arguments import collection, finite_array, numbers
from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts, compiled_ids, driven_joint
from urlab_client.enums import CameraMode
from urlab_client.errors import UnknownKeyframe
from urlab_client.protocol.base import Floats
from urlab_client.values.names import NameMap, UnknownName, lasting_names

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
        low, high = numbers("actions: clip", self.clip, 2)
        if not low < high:
            raise ValueError(f"actions: clip must be (low, high) with low < high, not {self.clip}")
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if not isinstance(value, str) or name == "scale":
                finite_array(f"actions: {name}", np.ravel(value))


def fields_of(observations: str | Sequence[str]) -> tuple[Field, ...]:
    """Return the fields of an observation level, or the given field names."""
    if not isinstance(observations, str):
        return tuple(collection("observations", observations))  # type: ignore[return-value]  # SpaceMapping rejects others
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
        names: Name of each articulation in dictionaries, by key: its actor id where the key is a name of the engine.
        observed: Keys of the observed articulations.
        fields: Observed fields, in order.
        mode: `flat` or `dict`.
        prefixes: Prefix of the compiled element names of each articulation, by key.
        action_space: `Box(n,)`, or `Dict` of one `Box` per articulation.
        observation_space: `Box(n,)`, or `Dict` of one `Dict` of fields per articulation.
        n_actions: Number of actuator inputs: the length of `flat`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        prefixes: NameMap[str],
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
            prefixes: Prefix of the compiled element names of each articulation, by key, and its aliases.
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
        self.names: dict[str, str] = lasting_names(prefixes)
        self.prefixes: NameMap[str] = prefixes
        self.observed: tuple[str, ...] = self.keys if observed is None else self._keys("cannot observe", observed)
        self.fields: tuple[Field, ...] = tuple(fields)
        self.mode: SpaceMode = mode
        self._model = model
        self._targets = targets
        self._layouts = prefixes.over(articulation_layouts(model, prefixes))
        self._ids: dict[str, NameMap[int]] = {}
        ends = list(itertools.accumulate(len(layout.ctrl_adr) for layout in self._layouts.values()))
        inputs = {key: slice(a, b) for key, a, b in zip(prefixes, [0, *ends], ends, strict=False) if b > a}
        self._inputs = prefixes.over(inputs)
        self.n_actions: int = ends[-1]
        # Of all articulations in their order, shape (n_actions,).
        self._low, self._high = np.full((2, self.n_actions), np.inf) * [[-1.0], [1.0]]
        self._scale, self._offset = np.ones(self.n_actions), np.zeros(self.n_actions)
        self._clip = self._low.copy(), self._high.copy()
        for key, where in self._inputs.items():
            self._low[where], self._high[where] = self._bounds(key)
        declared = dict.fromkeys(self._inputs, actions) if isinstance(actions, Actions) else dict(actions or {})
        for key, each in zip(self._keys("actions of", declared), declared.values(), strict=True):
            self._declare(key, each)
        self.action_space: Space = self._make_action_space()
        widths = [(key, field, self.width(key, field)) for key in self.observed for field in self.fields]
        ends = list(itertools.accumulate(width for *_, width in widths))
        self._where = {
            (key, field): slice(end - width, end) for (key, field, width), end in zip(widths, ends, strict=True)
        }
        self.observation_space: Space = self._make_observation_space()

    def layout(self, key: str) -> ArticulationLayout:
        """Return the layout of an articulation's values in the compiled model."""
        return self._layouts[key]

    def id(self, kind: str, name: str) -> int:
        """Return the id of an element of the compiled model: a `body`, `site`, `geom`, `joint` or `key`.

        Raises:
            UnknownName: No element, or more than one, has this name.
        """
        if kind not in self._ids:
            self._ids[kind] = compiled_ids(self._model, kind, self.prefixes)
        return self._ids[kind][name]

    def width(self, key: str, field: Field) -> int:
        """Return the length of a field of an articulation."""
        layout = self._layouts[key]
        match field:
            case "qpos":
                return len(layout.qpos_adr)
            case "qvel":
                return len(layout.qvel_adr)
            case "ctrl" | "act":
                return len(layout.ctrl_adr)
            case "sensors":
                return sum(layout.sensor_dims.values())

    def keyframe_id(self, name: str) -> int:
        """Return the id of a keyframe, by its own name or that of the compiled scene.

        Raises:
            UnknownKeyframe: No keyframe, or more than one, has this name.
        """
        try:
            return self.id("key", name)
        except UnknownName as error:
            raise UnknownKeyframe("unknown_keyframe", str(error)) from None

    def held(self, keyframe: str | None) -> dict[str, Floats]:
        """Return the set-points that hold a keyframe, or the initial state, by articulation, shape (n_ctrl,).

        They are its `ctrl`, 0 in the initial state, and the positions of the joints that a PD controller drives.

        Raises:
            UnknownKeyframe: No keyframe, or more than one, has this name.
        """
        model, key = self._model, -1 if keyframe is None else self.keyframe_id(keyframe)
        ctrl, qpos = (np.zeros(model.nu), model.qpos0) if key < 0 else (model.key_ctrl[key], model.key_qpos[key])
        found: dict[str, Floats] = {}
        for name in self._inputs:
            found[name] = np.array(ctrl[self.layout(name).ctrl_adr], dtype=np.float64)
            for place, joint in self._driven_joints(name):
                found[name][place] = qpos[model.jnt_qposadr[joint]]
        return found

    def flat(self, action: Any) -> Floats:
        """Return actions as one array, shape (…, n_actions): the articulations with actuators in their order.

        Raises:
            ValueError: The action has the wrong shape, or contains NaN or infinity.
        """
        if self.mode == "flat":
            whole = np.asarray(action, dtype=np.float64)
            _check_width("the action", whole, self.n_actions)
        else:
            parts = {
                self._inputs.key(name) if name in self._inputs else name: np.asarray(part, dtype=np.float64)
                for name, part in action.items()
            }
            if parts.keys() != self._inputs.keys():
                wanted = ", ".join(self.names[key] for key in self._inputs)
                raise ValueError(f"the action needs one entry for each of {wanted}, not {sorted(action)}")
            for key, where in self._inputs.items():
                _check_width(f"the action of {key}", parts[key], where.stop - where.start)
            whole = np.concatenate([parts[key] for key in self._inputs], axis=-1)
        if not np.isfinite(whole).all():
            raise ValueError(f"the action contains NaN or infinity: {whole}")
        return whole

    def actions(self, key: str) -> Actions:
        """Return how the actions of an articulation become set-points, with one number per actuator input."""
        where = self._inputs.get(key, slice(0))
        low, high = (
            float(next(iter(bound[where]), end)) for bound, end in zip(self._clip, (-np.inf, np.inf), strict=True)
        )
        return Actions(scale=self._scale[where].tolist(), offset=self._offset[where].tolist(), clip=(low, high))

    def joint_names(self, key: str, model: mujoco.MjModel) -> list[str]:
        """Return the names of the hinge and slide joints of an articulation: joints with a scalar position."""
        return [name for name, i in self.layout(key).joints.items() if model.jnt_type[i] in _HINGE_AND_SLIDE]

    def scalar_joints(self, key: str, model: mujoco.MjModel) -> NDArray[np.intp]:
        """Return the ids of the joints in `joint_names`."""
        joints = self.layout(key).joints
        return np.array([joints[name] for name in self.joint_names(key, model)], dtype=np.intp)

    def set_points(self, action: Any) -> NameMap[Floats]:
        """Return the set-points of each articulation, shape (…, n_ctrl), from an action.

        Raises:
            ValueError: The action has the wrong shape, or contains NaN or infinity.
        """
        return self._inputs.over(self.split(self.scaled(self.flat(action))))

    def scaled(self, flat: Floats) -> Floats:
        """Return the set-points of all articulations, shape (…, n_actions), from actions likewise."""
        low, high = self._clip
        return self._offset + self._scale * np.minimum(np.maximum(flat, low), high)  # np.clip takes thrice as long

    def split(self, flat: Floats) -> dict[str, Floats]:
        """Return the part of each articulation with actuators, as a view, shape (…, n_ctrl)."""
        return {key: flat[..., where] for key, where in self._inputs.items()}

    def _keys(self, problem: str, names: Iterable[str]) -> tuple[str, ...]:
        """Return the keys of articulations by their names."""
        known = self.prefixes
        if missing := {*names} - known.with_aliases().keys():
            raise ValueError(f"{problem} {', '.join(sorted(missing))}; the articulations are: {', '.join(known)}")
        return tuple(map(known.key, names))

    def _declare(self, key: str, actions: Actions) -> None:
        """Let the actions of an articulation become set-points as declared."""
        where = self._inputs.get(key, slice(0))
        offset = actions.offset
        if isinstance(offset, str):
            offset = self.held(offset).get(key, np.zeros(0))
        try:
            self._scale[where], self._offset[where] = actions.scale, offset
        except ValueError:
            raise ValueError(
                f"actions of {key}: scale and offset take one number, or one for each of the "
                f"{len(self._low[where])} inputs"
            ) from None
        for bound, clip, value in zip((self._low, self._high), self._clip, actions.clip, strict=True):
            bound[where] = clip[where] = value

    def observe(self, read: Callable[[str, Field], Floats]) -> Observation:
        """Assemble an observation from `read(key, field)`, which returns arrays of shape (…, n)."""
        if self.mode == "dict":
            return {
                self.names[key]: {field: np.array(read(key, field)) for field in self.fields} for key in self.observed
            }
        parts = [read(key, field) for key in self.observed for field in self.fields]
        return np.concatenate(parts, axis=-1) if parts else np.zeros(0)

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
        key = self.prefixes.key(key) if key in self.prefixes else key
        if key not in self.observed:
            raise ValueError(f"{key!r} is not observed; the observed articulations are: {', '.join(self.observed)}")
        if self.mode == "dict":
            return observation[self.names[key]][field]
        return observation[..., self._where[key, field]]

    def _make_action_space(self) -> Space:
        if self.mode == "dict":
            bounds = {self.names[key]: _bounded(self._low[at], self._high[at]) for key, at in self._inputs.items()}
            return dict_space(bounds)
        return _bounded(self._low, self._high)

    def _make_observation_space(self) -> Space:
        if self.mode == "flat":
            return unbounded(sum(where.stop - where.start for where in self._where.values()))
        return dict_space(
            {
                self.names[key]: dict_space({field: unbounded(self.width(key, field)) for field in self.fields})
                for key in self.observed
            }
        )

    def _bounds(self, key: str) -> tuple[Floats, Floats]:
        """Return the lowest and highest set-points of an articulation."""
        model, address = self._model, self.layout(key).ctrl_adr
        limited = model.actuator_ctrllimited[address].astype(bool)
        low, high = np.array(model.actuator_ctrlrange[address], dtype=np.float64).T
        for place, joint in self._driven_joints(key):
            limited[place], (low[place], high[place]) = model.jnt_limited[joint], model.jnt_range[joint]
        return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)

    def _driven_joints(self, key: str) -> Iterator[tuple[int, int]]:
        """Yield the place among an articulation's controls and the joint of each actuator that a controller drives."""
        place, counts = 0, control_counts(self._model)
        for actuator in self.layout(key).actuators.values():
            joint = driven_joint(self._model, actuator) if actuator in self._targets else None
            if joint is not None:
                yield place, joint
            place += int(counts[actuator])


def _check_width(what: str, values: Floats, width: int) -> None:
    if values.ndim == 0 or values.shape[-1] != width:
        raise ValueError(f"{what} has shape {values.shape}; its last axis must be {width} long")


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
    return spaces.Dict([*entries.items()])  # of a mapping, Gymnasium would sort the names


def with_cameras(mapping: SpaceMapping, cameras: Mapping[str, Space]) -> Space:
    """Return a mapping's observation space with an entry `cameras` that holds the pictures by camera."""
    if not cameras:
        return mapping.observation_space
    if mapping.mode != "dict":
        raise ValueError("a flat observation cannot contain images: use space_mode='dict' with cameras")
    if "cameras" in mapping.names.values():
        raise ValueError("an articulation is named 'cameras', which is the entry for images: give it another actor id")
    observed = cast("Mapping[str, Space]", mapping.observation_space)
    return dict_space({**observed, "cameras": dict_space(cameras)})


def camera_space(mode: CameraMode | str, resolution: tuple[int, int]) -> Space:
    """Return the space of `observed_pixels`: depth in metres, RGB as in `render`, or BGRA of segmentations."""
    width, height = resolution
    if mode == CameraMode.DEPTH:
        return spaces.Box(0.0, np.inf, (height, width), dtype=np.float32)
    return spaces.Box(0, 255, (height, width, 3 if mode == CameraMode.REAL else 4), dtype=np.uint8)
