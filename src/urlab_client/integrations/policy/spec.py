"""The TOML file of a network, which declares its observations and the meaning of its outputs.

Decoding is strict: an unknown key, a wrong type or an invalid value raises a `PolicyFileError` that names the file, the
key and the valid choices. Whether joints and sensors exist is checked against a robot: see `mapping`.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast, get_args
from urllib.parse import urlencode

import msgspec
import numpy as np
from msgspec import Meta, Struct

from urlab_client.enums import CameraMode, StepMode
from urlab_client.errors import URLabError
from urlab_client.protocol.base import Floats


class PolicyFileError(URLabError, ValueError):
    """The files of a policy cannot be used. The message names the file, the place in it and the valid choices."""


Numbers = float | list[float]
"""A single number for all, or one per element."""

Positive = Annotated[float, Meta(gt=0)]


class _Term(Struct, tag_field="term", kw_only=True, forbid_unknown_fields=True, frozen=True, omit_defaults=True):
    """One part of an observation: `clip((value - offset) * scale)`.

    Attributes:
        scale: Factor, a single number or one per value.
        offset: Offset subtracted before scaling, a single number or one per value.
        clip: Lowest and highest result.
        input: Name of the network input that the values belong to, after those of earlier terms; empty if the network
            has only one input.
    """

    scale: Numbers = 1.0
    offset: Numbers = 0.0
    clip: tuple[float, float] | None = None
    input: str = ""

    def __post_init__(self) -> None:
        _check_numbers("scale", self.scale)
        _check_numbers("offset", self.offset)
        _check_clip(self.clip)


class BaseHeight(_Term, tag="base_height", frozen=True):
    """Height of the free base, metres, world frame; 1 number."""


class Gravity(_Term, tag="gravity", frozen=True):
    """Direction of gravity, a unit vector in the base frame; 3 numbers."""


class LinearVelocity(_Term, tag="linear_velocity", frozen=True):
    """Velocity of the free base, m/s, base frame; 3 numbers."""


class AngularVelocity(_Term, tag="angular_velocity", frozen=True):
    """Angular velocity of the free base, rad/s, base frame; 3 numbers."""


class JointPosition(_Term, tag="joint_position", kw_only=True, frozen=True):
    """Positions of hinge and slide joints, rad or m; one number each.

    Attributes:
        joints: Joint names; those of the action if empty.
    """

    joints: list[str] = []


class JointVelocity(_Term, tag="joint_velocity", kw_only=True, frozen=True):
    """Velocities of hinge and slide joints, rad/s or m/s; one number each.

    Attributes:
        joints: Joint names; those of the action if empty.
    """

    joints: list[str] = []


class SensorTerm(_Term, tag="sensor", kw_only=True, frozen=True):
    """The reading of a sensor, in its own units and frame.

    Attributes:
        sensor: Name of the sensor.
    """

    sensor: str


class CommandTerm(_Term, tag="command", frozen=True):
    """The command (vx, vy, yaw rate), m/s and rad/s, base frame; 3 numbers. Needs the table `command`."""


class GoalTerm(_Term, tag="goal", kw_only=True, frozen=True):
    """The goal of the policy, such as a position in the world; as many numbers as in the table `goal`.

    Attributes:
        relative_to: Sensor whose reading is subtracted, so that the term is the remaining distance vector. Empty for
            no subtraction.
    """

    relative_to: str = ""


class LastAction(_Term, tag="last_action", frozen=True):
    """The network's last output after clipping, zeros at the start; one number per joint of the action."""


class PhaseClock(_Term, tag="clock", kw_only=True, frozen=True):
    """Sine and cosine of a phase that advances with time; 2 numbers.

    Attributes:
        hz: Cycles per second.
    """

    hz: Positive


class FieldTerm(_Term, tag="field", kw_only=True, frozen=True):
    """A field of the robot as environments observe it: all of its numbers, in the order of its arrays.

    Attributes:
        field: `qpos`, `qvel`, `ctrl`, `act` or `sensors`.
    """

    field: Literal["qpos", "qvel", "ctrl", "act", "sensors"]


class PictureTerm(Struct, tag_field="term", tag="picture", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The picture of a camera of the robot, in its own network input and in the format of environments.

    `real` is RGB, uint8 of shape (H, W, 3). `depth` is in metres, float32 of shape (H, W). `semantic` and `instance`
    are BGRA, uint8 of shape (H, W, 4).

    Attributes:
        camera: Name of the camera.
        input: Name of the network input.
        size: Width and height, pixels.
        mode: Meaning of the pixels.
    """

    camera: str
    input: Annotated[str, Meta(min_length=1)]
    size: tuple[Annotated[int, Meta(ge=1)], Annotated[int, Meta(ge=1)]]
    mode: CameraMode = CameraMode.REAL


NumberTerm = (
    BaseHeight
    | Gravity
    | LinearVelocity
    | AngularVelocity
    | JointPosition
    | JointVelocity
    | SensorTerm
    | FieldTerm
    | CommandTerm
    | GoalTerm
    | LastAction
    | PhaseClock
)
Term = NumberTerm | PictureTerm


class Action(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True, omit_defaults=True):
    """Meaning of the network's outputs: `offset + scale * clip(output)`, one output per joint.

    Attributes:
        kind: `joint_position` for targets in rad or m, `torque` for N m or N.
        via: How the robot reaches the targets. `controller`: the articulation's PD controller acts before each physics
            step, with `gains`. `client`: this client acts before each physics step, with `gains`. `actuators`:
            set-points go directly to the actuators, which are position servos for targets and motors for torques.
        joints: Joint names, in the order of the outputs.
        scale: Factor, a single number or one per joint.
        offset: Joint position or torque for an output of 0, a single number or one per joint.
        clip: Lowest and highest output; outputs beyond them are clipped.
    """

    kind: Literal["joint_position", "torque"] = "joint_position"
    via: Literal["controller", "client", "actuators"]
    joints: Annotated[list[str], Meta(min_length=1)]
    scale: Numbers = 1.0
    offset: Numbers = 0.0
    clip: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        if len(set(self.joints)) != len(self.joints):
            raise ValueError("joints contains a joint twice")
        _check_numbers("scale", self.scale, len(self.joints))
        _check_numbers("offset", self.offset, len(self.joints))
        _check_clip(self.clip)
        if self.kind == "torque" and self.via != "actuators":
            raise ValueError(f"kind = 'torque' requires via = 'actuators', not {self.via!r}")


class Gains(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Gains of the PD law: `clamp(kp (target - position) - kv velocity)`.

    Attributes:
        kp: Position gain, N m/rad or N/m, a single number or one per joint of the action.
        kv: Velocity gain, N m s/rad or N s/m, a single number or one per joint of the action.
        torque_limit: Largest torque or force, N m or N, a single number or one per joint of the action.
    """

    kp: Numbers
    kv: Numbers
    torque_limit: Numbers

    def __post_init__(self) -> None:
        for name in ("kp", "kv", "torque_limit"):
            value: Numbers = getattr(self, name)
            _check_numbers(name, value)
            if min(_listed(value)) < 0:
                raise ValueError(f"{name} must be 0 or more")


class Goal(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The goals the network was trained for, in its own units and frame, for example metres in the world frame.

    Attributes:
        default: Goal used if none is given.
        low: Lowest value of each component.
        high: Highest value of each component.
    """

    default: Annotated[tuple[float, ...], Meta(min_length=1)]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.default) == len(self.low) == len(self.high):
            raise ValueError("default, low and high must have the same length")
        if not self.contains(np.array(self.default)):
            raise ValueError(f"default {list(self.default)} is not between low and high")

    def contains(self, values: Floats) -> bool:
        """Return whether values have the right number and are between `low` and `high`."""
        return values.shape == (len(self.default),) and bool(np.all((values >= self.low) & (values <= self.high)))


class Command(Goal, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The commands the network was trained for: (vx, vy, yaw rate), m/s and rad/s, base frame."""

    default: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]


class Fall(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Limits beyond which the robot has fallen, which ends an attempt.

    Attributes:
        height: Lowest height of the free base, metres.
        upright: Lowest cosine of the tilt.
    """

    height: float = -math.inf
    upright: Annotated[float, Meta(ge=-1, le=1)] = -1.0


_Weight = Annotated[float, Meta(ge=0)]


class TrackingReward(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Reward per action for a robot with a free base that follows a command, as used in training.

    `alive + velocity exp(-|Δv|² / velocity_width) + yaw exp(-Δω² / yaw_width) + level exp(-|g_xy|² / level_width)`
    `- bounce v_z² - roll |ω_xy|² - change |Δoutput|² - spread Σ q²`, and 0 after a fall.

    Attributes:
        alive: Reward for each action before a fall.
        velocity: Weight of the horizontal velocity, base frame.
        velocity_width: Width of the velocity term, (m/s)².
        yaw: Weight of the yaw rate.
        yaw_width: Width of the yaw term, (rad/s)².
        level: Weight of a level base.
        level_width: Width of the level term, squared sine of the tilt.
        bounce: Penalty on vertical velocity, per (m/s)².
        roll: Penalty on roll and pitch rates, per (rad/s)².
        change: Penalty on changes of the outputs.
        spread: Penalty on the positions of `spread_joints`, per rad².
        spread_joints: Joint names.
    """

    alive: float = 0.0
    velocity: _Weight = 1.0
    velocity_width: Positive = 0.1
    yaw: _Weight = 0.0
    yaw_width: Positive = 0.1
    level: _Weight = 0.0
    level_width: Positive = 0.1
    bounce: _Weight = 0.0
    roll: _Weight = 0.0
    change: _Weight = 0.0
    spread: _Weight = 0.0
    spread_joints: list[str] = []


class PolicySpec(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True, omit_defaults=True):
    """A policy's declaration.

    Attributes:
        robot: Articulation that the policy controls: key, actor id or class name.
        step_modes: Supported step modes.
        timestep: Physics timestep the policy was trained with, seconds.
        decimation: Physics steps per action.
        task: The task that the network was trained for: its id, or `module:Class`. Empty for none.
        keyframe: Keyframe to start from, or None for the initial state.
        history: Number of observations in one network input, oldest first.
        observation: Terms of one observation, in order. Only a file that names a task may have none.
        action: Meaning of the outputs.
        gains: Gains of the PD law; required unless the action goes via `actuators`.
        command: Supported commands; required by the term `command`.
        goal: Supported goals; required by the term `goal`.
        fall: Limits beyond which the robot has fallen. Without them it never falls.
        reward: Training reward, for the figures of a run.
    """

    robot: str
    step_modes: Annotated[list[StepMode], Meta(min_length=1)]
    timestep: Positive
    decimation: Annotated[int, Meta(ge=1)]
    task: str = ""
    keyframe: str | None = None
    history: Annotated[int, Meta(ge=1)] = 1
    observation: list[Term] = []
    action: Action
    gains: Gains | None = None
    command: Command | None = None
    goal: Goal | None = None
    fall: Fall | None = None
    reward: TrackingReward | None = None

    def __post_init__(self) -> None:
        if not self.observation and not self.task:
            raise ValueError("a policy needs at least one [[observation]]")
        if bad := [str(mode) for mode in self.step_modes if mode not in (StepMode.DIRECT, StepMode.LIVE)]:
            raise ValueError(f"step_modes can contain 'direct' and 'live', not {bad[0]!r}")
        if self.action.via == "client" and StepMode.LIVE in self.step_modes:
            raise ValueError(
                "step_modes cannot contain 'live' with action.via = 'client': only a controller keeps pace with physics"
            )
        if (self.gains is None) is not (self.action.via == "actuators"):
            verb = "does not use" if self.gains else "needs"
            raise ValueError(f"action.via = {self.action.via!r} {verb} the table [gains]")
        if self.gains is not None:
            for name in ("kp", "kv", "torque_limit"):
                _check_numbers(f"gains.{name}", getattr(self.gains, name), len(self.action.joints))
        self._check_inputs()
        if self.command is None and (self.reward or any(isinstance(term, CommandTerm) for term in self.observation)):
            raise ValueError("the term 'command' and the table [reward] need the table [command]")
        if self.goal is None and any(isinstance(term, GoalTerm) for term in self.observation):
            raise ValueError("the term 'goal' needs the table [goal]")

    def _check_inputs(self) -> None:
        if self.named and not all(term.input for term in self.observation):
            raise ValueError("either every term of the observation has an `input`, or none has")
        pictures = [term.input for term in self.pictures]
        others = {term.input for term in self.observation if not isinstance(term, PictureTerm)}
        if twice := [name for name in pictures if pictures.count(name) > 1 or name in others]:
            raise ValueError(f"a picture needs its own input, but several terms use {twice[0]!r}")
        if pictures and self.history > 1:
            raise ValueError("history must be 1 with the term 'picture'")

    @property
    def named(self) -> bool:
        """Whether the network has named inputs."""
        return any(term.input for term in self.observation)

    @property
    def pictures(self) -> list[PictureTerm]:
        """The terms that are pictures."""
        return [term for term in self.observation if isinstance(term, PictureTerm)]

    def simulated(self, model: str, actor: str) -> str:
        """Return the `sim://` address of a server with one robot and everything the policy needs.

        Args:
            model: Model, as in a `sim://` address.
            actor: Actor name of the robot on the server.
        """
        options = [("controller", f"{actor}=pd")] if self.action.via == "controller" else []
        sizes = {"x".join(map(str, term.size)) for term in self.pictures}
        options += [("camera-size", size) for size in sorted(sizes)[:1]]  # other sizes must be set in the MJCF
        options += [("camera-mode", f"{actor}/{term.camera}={term.mode}") for term in self.pictures]
        return f"sim://{model}{'?' if options else ''}{urlencode(options)}"

    @property
    def period(self) -> float:
        """Seconds between two actions."""
        return self.timestep * self.decimation

    def to_toml(self) -> str:
        """Return the declaration as the text of a TOML file, without what has its default value."""
        entries: dict[str, Any] = msgspec.to_builtins(self)
        tables = {f"[{name}]": entries.pop(name) for name in [*entries] if isinstance(entries[name], dict)}
        terms = [("[[observation]]", term) for term in entries.pop("observation", [])]
        parts = [("", entries), *terms, *tables.items()]
        lines = ([head, *(f"{name} = {_toml(value)}" for name, value in part.items())] for head, part in parts)
        return "\n\n".join("\n".join(filter(None, part)) for part in lines) + "\n"


def _toml(value: Any) -> str:
    """Return a string, a number or a list as a TOML value."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, cast('Sequence[Any]', value)))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


def _listed(value: Numbers) -> list[float]:
    """Return numbers as a list; a single number becomes a list of one."""
    return value if isinstance(value, list) else [value]


def _check_numbers(name: str, value: Numbers, length: int | None = None) -> None:
    """Check that numbers are present, finite, and either a single one or as many as expected."""
    if not value and isinstance(value, list):
        raise ValueError(f"{name} is empty")
    if not all(map(math.isfinite, _listed(value))):
        raise ValueError(f"{name} contains NaN or infinity")
    if length is not None and isinstance(value, list) and len(value) != length:
        raise ValueError(f"{name} has {len(value)} numbers; it takes one, or one for each of the action's {length}")


def _check_clip(clip: tuple[float, float] | None) -> None:
    """Check that the lower limit is below the upper one."""
    if clip is not None and not clip[0] < clip[1]:
        raise ValueError(f"clip must be [low, high] with low < high, not {list(clip)}")


def read_spec(path: Path) -> PolicySpec:
    """Read a policy's TOML file.

    Raises:
        PolicyFileError: The file cannot be read, is not TOML, or does not declare a policy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise PolicyFileError(
            f"{path}: cannot be read: {reason}.", hint="A policy is a .onnx file with a .toml file beside it."
        ) from None
    return parse_spec(text, str(path))


def parse_spec(text: str, source: str) -> PolicySpec:
    """Parse a declaration; `source` names it in errors.

    Raises:
        PolicyFileError: The text is not TOML, or does not declare a policy.
    """
    try:
        raw = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{source}: not TOML: {error}.") from None
    try:
        return msgspec.convert(raw, PolicySpec)
    except msgspec.ValidationError as error:
        problem, separator, path = str(error).rpartition(" - at `")
        where = path.rstrip("`").removeprefix("$").removeprefix(".") if separator else ""
        message = problem if separator else str(error)
        at = f" {where}:" if where else ""
        raise PolicyFileError(f"{source}:{at} {message}.", hint=_advice(raw, message, where)) from None


_TERMS: Final[dict[str, type[Struct]]] = {str(kind.__struct_config__.tag): kind for kind in get_args(Term)}
_TABLES: Final[dict[str, type[Struct]]] = {
    "": PolicySpec,
    "action": Action,
    "gains": Gains,
    "command": Command,
    "goal": Goal,
    "fall": Fall,
    "reward": TrackingReward,
}


def _advice(raw: dict[str, Any], problem: str, where: str) -> str | None:
    """Return a hint that lists the valid names at a place in the file, or None if it is not a choice of names."""
    if where.startswith("observation"):
        if where.endswith("term") or "`term`" in problem:
            return f"Terms are {', '.join(_TERMS)}."
        index = where.partition("[")[2].partition("]")[0]
        given: Any = raw["observation"][int(index)] if index.isdigit() else None
        term = _TERMS.get(str(cast("dict[str, Any]", given).get("term"))) if isinstance(given, dict) else None
        if term is None or "field" not in problem:
            return None
        return f"Its keys are term, {', '.join(term.__struct_fields__)}."
    if not where and any(key in problem for key in ("normal", "obs_rms", "vec_norm")):
        return (
            "Observations are normalised by the `offset` and `scale` of each term, clip((value - offset) * scale): the "
            "mean, and 1 / the standard deviation. Or export the normaliser as part of the network."
        )
    table = _TABLES.get(where)
    return None if table is None or "field" not in problem else f"Its keys are {', '.join(table.__struct_fields__)}."
