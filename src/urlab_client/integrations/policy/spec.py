"""The file beside a network that says what it sees and what its outputs mean.

Decoding is strict: an unknown key, a wrong type or a value that cannot work is a `PolicyFileError` that names the file,
the key, and what would be right. Whether joints and sensors exist is known only with a robot: see `mapping`.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args
from urllib.parse import urlencode

import msgspec
from msgspec import Meta, Struct

from urlab_client.integrations.policy.terms import (
    CommandTerm,
    GoalTerm,
    Numbers,
    PictureTerm,
    Positive,
    Term,
    check_clip,
    check_numbers,
    listed,
)
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import URLabError

__all__ = [
    "Action",
    "Command",
    "Fall",
    "Gains",
    "Goal",
    "PolicyFileError",
    "PolicySpec",
    "TrackingReward",
    "parse_spec",
    "read_spec",
]


class PolicyFileError(URLabError, ValueError):
    """A policy's files cannot be used; says which file, where in it, and what would be right."""


class Action(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """What the network's outputs mean: `offset + scale * clip(output)`, one for each joint.

    Attributes:
        kind: `joint_position` for targets in rad or m, `torque` for N m or N.
        via: Who brings joints to their targets. `controller`: the articulation's PD controller, before each physics
            step, with `gains`. `client`: this client, before each physics step, with `gains`. `actuators`: set-points
            go straight to the actuators, which are position servos for targets and motors for torques.
        joints: Joint names, in the order of the outputs.
        scale: Factor, one or one for each joint.
        offset: Joint position or torque for an output of 0, one or one for each joint.
        clip: Lowest and highest output that is used.
    """

    kind: Literal["joint_position", "torque"] = "joint_position"
    via: Literal["controller", "client", "actuators"]
    joints: Annotated[list[str], Meta(min_length=1)]
    scale: Numbers = 1.0
    offset: Numbers = 0.0
    clip: tuple[float, float] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        if len(set(self.joints)) != len(self.joints):
            raise ValueError("joints names a joint twice")
        check_numbers("scale", self.scale, len(self.joints))
        check_numbers("offset", self.offset, len(self.joints))
        check_clip(self.clip)
        if self.kind == "torque" and self.via != "actuators":
            raise ValueError(f"torques go via 'actuators', not via {self.via!r}")


class Gains(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Gains of the PD law: `clamp(kp (target - position) - kv velocity)`.

    Attributes:
        kp: N m/rad or N/m, one or one for each joint of the action.
        kv: N m s/rad or N s/m, likewise.
        torque_limit: N m or N, likewise.
    """

    kp: Numbers
    kv: Numbers
    torque_limit: Numbers

    def __post_init__(self) -> None:
        for name in ("kp", "kv", "torque_limit"):
            value: Numbers = getattr(self, name)
            check_numbers(name, value)
            if min(listed(value)) < 0:
                raise ValueError(f"{name} is 0 or more")


class Command(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The commands the network was trained for: (vx, vy, yaw rate), m/s and rad/s, base frame.

    Attributes:
        default: Used when none is given.
        low: Lowest of each.
        high: Highest of each.
    """

    default: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(low <= value <= high for low, value, high in zip(self.low, self.default, self.high, strict=True)):
            raise ValueError(f"default {list(self.default)} is not between low and high")


class Goal(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The goals the network was trained for, in units and frame of its own: metres in the world's frame, for example.

    Attributes:
        default: Used when none is given.
        low: Lowest of each number.
        high: Highest of each number.
    """

    default: Annotated[list[float], Meta(min_length=1)]
    low: list[float]
    high: list[float]

    def __post_init__(self) -> None:
        if not len(self.default) == len(self.low) == len(self.high):
            raise ValueError("default, low and high need the same number of numbers")
        if not all(low <= value <= high for low, value, high in zip(self.low, self.default, self.high, strict=True)):
            raise ValueError(f"default {self.default} is not between low and high")


class Fall(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """When the robot has fallen, which ends an attempt.

    Attributes:
        height: Of the free base, metres, below which it has.
        upright: Cosine of the tilt below which it has.
    """

    height: float = -math.inf
    upright: Annotated[float, Meta(ge=-1, le=1)] = -1.0


_Weight = Annotated[float, Meta(ge=0)]


class TrackingReward(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """How well a robot with a free base follows its command; what the network was trained on, per action.

    `alive + velocity exp(-|Δv|² / velocity_width) + yaw exp(-Δω² / yaw_width) + level exp(-|g_xy|² / level_width)`
    `- bounce v_z² - roll |ω_xy|² - change |Δoutput|² - spread Σ q²`, and 0 after a fall.

    Attributes:
        alive: For each action before a fall.
        velocity: For the horizontal velocity, base frame.
        velocity_width: (m/s)².
        yaw: For the yaw rate.
        yaw_width: (rad/s)².
        level: For a level base.
        level_width: Square of the sine of the tilt.
        bounce: Against vertical velocity, per (m/s)².
        roll: Against roll and pitch rates, per (rad/s)².
        change: Against changes of the outputs.
        spread: Against positions of `spread_joints`, per rad².
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


class PolicySpec(Struct, kw_only=True, forbid_unknown_fields=True, frozen=True):
    """A policy's declaration.

    Attributes:
        robot: The articulation it was made for: key, actor id or class name.
        step_modes: Step modes it can work in.
        timestep: Physics timestep it was made for, seconds.
        decimation: Physics steps per action.
        keyframe: Keyframe to start from; the initial state without.
        history: Observations that the network sees at once, oldest first.
        observation: What one observation consists of, in order.
        action: What the outputs mean.
        gains: Of the PD law; needed unless the action goes via `actuators`.
        command: Commands it understands; needed by the term `command`.
        goal: Goals it can reach; needed by the term `goal`.
        fall: When it has fallen; never without.
        reward: What it was trained on, for the figures of a run.
    """

    robot: str
    step_modes: Annotated[list[StepMode], Meta(min_length=1)]
    timestep: Positive
    decimation: Annotated[int, Meta(ge=1)]
    keyframe: str | None = None
    history: Annotated[int, Meta(ge=1)] = 1
    observation: Annotated[list[Term], Meta(min_length=1)]
    action: Action
    gains: Gains | None = None
    command: Command | None = None
    goal: Goal | None = None
    fall: Fall | None = None
    reward: TrackingReward | None = None

    def __post_init__(self) -> None:
        if bad := [str(mode) for mode in self.step_modes if mode not in (StepMode.DIRECT, StepMode.LIVE)]:
            raise ValueError(f"step_modes must be 'direct' and 'live', not {bad[0]!r}")
        if self.action.via == "client" and StepMode.LIVE in self.step_modes:
            raise ValueError(
                "step_modes cannot have 'live' with action.via = 'client': only a controller keeps pace with physics"
            )
        if (self.gains is None) is not (self.action.via == "actuators"):
            what = "has no use for" if self.gains else "needs"
            raise ValueError(f"action.via = {self.action.via!r} {what} the table [gains]")
        if self.gains is not None:
            for name in ("kp", "kv", "torque_limit"):
                check_numbers(f"gains.{name}", getattr(self.gains, name), len(self.action.joints))
        self._check_inputs()
        if self.command is None and (self.reward or any(isinstance(term, CommandTerm) for term in self.observation)):
            raise ValueError("the term 'command' and the table [reward] need the table [command]")
        if self.goal is None and any(isinstance(term, GoalTerm) for term in self.observation):
            raise ValueError("the term 'goal' needs the table [goal]")

    def _check_inputs(self) -> None:
        if self.named and not all(term.input for term in self.observation):
            raise ValueError("each term of the observation needs its `input`, or none has one")
        pictures = [term.input for term in self.pictures]
        others = {term.input for term in self.observation if not isinstance(term, PictureTerm)}
        if twice := [name for name in pictures if pictures.count(name) > 1 or name in others]:
            raise ValueError(f"a picture needs an input of its own, but {twice[0]!r} is of several terms")
        if pictures and self.history > 1:
            raise ValueError("history must be 1 with the term 'picture'")

    @property
    def named(self) -> bool:
        """Whether the network has several inputs, told apart by name."""
        return any(term.input for term in self.observation)

    @property
    def pictures(self) -> list[PictureTerm]:
        """The terms that are pictures."""
        return [term for term in self.observation if isinstance(term, PictureTerm)]

    def simulated(self, model: str, actor: str) -> str:
        """Return the `sim://` address of a server that has what the policy needs, of one robot.

        Args:
            model: What `sim://` takes.
            actor: What a server calls it.
        """
        options = [("controller", f"{actor}=pd")] if self.action.via == "controller" else []
        sizes = {"x".join(map(str, term.size)) for term in self.pictures}
        options += [("camera-size", size) for size in sorted(sizes)[:1]]  # more sizes are the MJCF's to say
        options += [("camera-mode", f"{actor}/{term.camera}={term.mode}") for term in self.pictures]
        return f"sim://{model}{'?' if options else ''}{urlencode(options)}"

    @property
    def period(self) -> float:
        """Seconds between two actions."""
        return self.timestep * self.decimation


def read_spec(path: Path) -> PolicySpec:
    """Read a policy's TOML file.

    Raises:
        PolicyFileError: It cannot be read, is not TOML, or does not declare a policy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
        raise PolicyFileError(
            f"{path}: cannot be read: {reason}.", hint="A policy is a .onnx file and a .toml file beside it."
        ) from None
    return parse_spec(text, str(path))


def parse_spec(text: str, source: str) -> PolicySpec:
    """Read a declaration; `source` names it in errors.

    Raises:
        PolicyFileError: It is not TOML, or does not declare a policy.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise PolicyFileError(f"{source}: not TOML: {error}.") from None
    try:
        return msgspec.convert(raw, PolicySpec)
    except msgspec.ValidationError as error:
        problem, separator, path = str(error).rpartition(" - at `")
        where = path.rstrip("`").removeprefix("$").removeprefix(".") if separator else ""
        said = problem if separator else str(error)
        at = f" {where}:" if where else ""
        raise PolicyFileError(f"{source}:{at} {said}.", hint=_advice(raw, said, where)) from None


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
    """Say what would be right at a place of the file, where that is a choice of names."""
    if where.startswith("observation"):
        if where.endswith("term") or "`term`" in problem:
            return f"Terms are {', '.join(_TERMS)}."
        index = where.partition("[")[2].partition("]")[0]
        term = _TERMS.get(raw["observation"][int(index)].get("term")) if index.isdigit() else None
        return (
            None
            if term is None or "field" not in problem
            else f"Its keys are term, {', '.join(term.__struct_fields__)}."
        )
    if not where and any(key in problem for key in ("normal", "obs_rms", "vec_norm")):
        return (
            "Observations are normalised by the `offset` and `scale` of each term, clip((value - offset) * scale): the "
            "mean, and 1 / the standard deviation. Or export the normaliser as part of the network."
        )
    table = _TABLES.get(where)
    return None if table is None or "field" not in problem else f"Its keys are {', '.join(table.__struct_fields__)}."
