"""The terms of a declaration, which make up the observations of a policy."""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta, Struct

from urlab_client.protocol.enums import CameraMode

__all__ = [
    "AngularVelocity",
    "BaseHeight",
    "CommandTerm",
    "GoalTerm",
    "Gravity",
    "JointPosition",
    "JointVelocity",
    "LastAction",
    "LinearVelocity",
    "NumberTerm",
    "Numbers",
    "PhaseClock",
    "PictureTerm",
    "Positive",
    "SensorTerm",
    "Term",
    "check_clip",
    "check_numbers",
    "listed",
]

Numbers = float | list[float]
"""A single number for all, or one per element."""

Positive = Annotated[float, Meta(gt=0)]


class _Term(Struct, tag_field="term", kw_only=True, forbid_unknown_fields=True, frozen=True):
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
        check_numbers("scale", self.scale)
        check_numbers("offset", self.offset)
        check_clip(self.clip)


class BaseHeight(_Term, tag="base_height", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Height of the free base, metres, world frame; 1 number."""


class Gravity(_Term, tag="gravity", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Direction of gravity, a unit vector in the base frame; 3 numbers."""


class LinearVelocity(_Term, tag="linear_velocity", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Velocity of the free base, m/s, base frame; 3 numbers."""


class AngularVelocity(_Term, tag="angular_velocity", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Angular velocity of the free base, rad/s, base frame; 3 numbers."""


class JointPosition(_Term, tag="joint_position", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Positions of hinge and slide joints, rad or m; one number each.

    Attributes:
        joints: Joint names; those of the action if empty.
    """

    joints: list[str] = []


class JointVelocity(_Term, tag="joint_velocity", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Velocities of hinge and slide joints, rad/s or m/s; one number each.

    Attributes:
        joints: Joint names; those of the action if empty.
    """

    joints: list[str] = []


class SensorTerm(_Term, tag="sensor", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The reading of a sensor, in its own units and frame.

    Attributes:
        sensor: Name of the sensor.
    """

    sensor: str


class CommandTerm(_Term, tag="command", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The command (vx, vy, yaw rate), m/s and rad/s, base frame; 3 numbers. Needs the table `command`."""


class GoalTerm(_Term, tag="goal", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The goal of the policy, such as a position in the world; as many numbers as in the table `goal`.

    Attributes:
        relative_to: Sensor whose reading is subtracted, so that the term is the remaining distance vector. Empty for
            no subtraction.
    """

    relative_to: str = ""


class LastAction(_Term, tag="last_action", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """The network's last output after clipping, zeros at the start; one number per joint of the action."""


class PhaseClock(_Term, tag="clock", kw_only=True, forbid_unknown_fields=True, frozen=True):
    """Sine and cosine of a phase that advances with time; 2 numbers.

    Attributes:
        hz: Cycles per second.
    """

    hz: Positive


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
    | CommandTerm
    | GoalTerm
    | LastAction
    | PhaseClock
)
Term = NumberTerm | PictureTerm


def listed(value: Numbers) -> list[float]:
    """Return numbers as a list; a single number becomes a list of one."""
    return value if isinstance(value, list) else [value]


def check_numbers(name: str, value: Numbers, length: int | None = None) -> None:
    """Check that numbers are present, finite, and either a single one or as many as expected.

    Raises:
        ValueError: A check fails.
    """
    if not value and isinstance(value, list):
        raise ValueError(f"{name} is empty")
    if not all(map(math.isfinite, listed(value))):
        raise ValueError(f"{name} contains NaN or infinity")
    if length is not None and isinstance(value, list) and len(value) != length:
        raise ValueError(f"{name} has {len(value)} numbers; it takes one, or one for each of the action's {length}")


def check_clip(clip: tuple[float, float] | None) -> None:
    """Check that the limits are in order.

    Raises:
        ValueError: The lower limit is not below the upper one.
    """
    if clip is not None and not clip[0] < clip[1]:
        raise ValueError(f"clip must be [low, high] with low < high, not {list(clip)}")
