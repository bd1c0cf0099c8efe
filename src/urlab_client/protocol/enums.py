"""Enumerations of the wire, for every layer. Each member is a `str` equal to what travels.

A server may send a value that no enum knows; such a value stays a plain `str` wherever a type reads
`SomeEnum | str`, see `known`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final, TypeVar

__all__ = [
    "LATER_MODE_NAMES",
    "ActuatorType",
    "CameraMode",
    "CameraTiming",
    "ControlMode",
    "ControllerKind",
    "ObservationLevel",
    "OutOfRange",
    "PIEState",
    "StepMode",
    "Transport",
    "known",
]

E = TypeVar("E", bound=StrEnum)


class StepMode(StrEnum):
    """What advances physics."""

    AUTO = "auto"
    DIRECT = "direct"
    PUPPET = "puppet"
    LIVE = "live"

    @classmethod
    def _missing_(cls, value: object) -> StepMode | None:
        return next((mode for mode, later in LATER_MODE_NAMES.items() if later == value), None)


LATER_MODE_NAMES: Final[Mapping[StepMode, str]] = {
    StepMode.LIVE: "freerun",
    StepMode.DIRECT: "stepped",
    StepMode.PUPPET: "statepushed",
}
"""What servers after the beta call the modes."""


class ControlMode(StrEnum):
    """Who turns set-points into actuator signals."""

    UE_CONTROLLER = "ue_controller"
    RAW = "raw"


class ActuatorType(StrEnum):
    """MJCF actuator element. The plugin reports `<general>` as `MOTOR`; the client goes by its gain and bias."""

    MOTOR = "motor"
    POSITION = "position"
    VELOCITY = "velocity"
    INT_VELOCITY = "intvelocity"
    DAMPER = "damper"
    CYLINDER = "cylinder"
    MUSCLE = "muscle"
    ADHESION = "adhesion"
    DC_MOTOR = "dcmotor"


class ControllerKind(StrEnum):
    """Kind of the controller attached to an articulation."""

    PD = "pd"
    PASSTHROUGH = "passthrough"

    @classmethod
    def _missing_(cls, value: object) -> ControllerKind | None:
        # The plugin calls its passthrough controller "base".
        return cls.PASSTHROUGH if value == "base" else None


class CameraMode(StrEnum):
    """What a camera's pixels mean."""

    REAL = "real"
    DEPTH = "depth"
    SEMANTIC = "semantic"
    INSTANCE = "instance"


class CameraTiming(StrEnum):
    """Which frame a step reply carries: one rendered after the step, or the newest at hand."""

    SYNC = "sync"
    LATEST = "latest"


class ObservationLevel(StrEnum):
    """How much state the server serialises per step."""

    MINIMAL = "minimal"
    STANDARD = "standard"
    FULL = "full"


class OutOfRange(StrEnum):
    """What becomes of a set-point outside the range of its actuator. Not of the wire."""

    ERROR = "error"
    """It is refused."""
    CLAMP = "clamp"
    """The nearest value in the range takes its place."""
    ALLOW = "allow"
    """It is sent as it is; MuJoCo clamps controls that have a range."""


class PIEState(StrEnum):
    """Where Play-In-Editor stands."""

    READY = "ready"
    COMPILE_FAILED = "compile_failed"
    TIMEOUT = "timeout"
    OFF = "off"
    COMPILING = "compiling"


class Transport(StrEnum):
    """How requests travel."""

    ZMQ = "zmq"
    SHM = "shm"


def known(enum: type[E], value: str) -> E | str:
    """Return the member of `enum` equal to `value`, or `value` itself when a newer server invented it."""
    try:
        return enum(value)
    except ValueError:
        return value
