"""Enumerations of the wire, for every layer. Each member is a `str` equal to the value on the wire.

A server may send a value that no enum contains. Where a type is `SomeEnum | str`, such a value stays a plain `str`; see
`known`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final, Literal, Self, TypeAlias, TypeVar

__all__ = [
    "ActuatorType",
    "CameraMode",
    "CameraTiming",
    "ControlMode",
    "ControllerKind",
    "EncodingName",
    "ObservationLevel",
    "ObservationLevelName",
    "OutOfRange",
    "PIEState",
    "StepMode",
    "StepModeName",
    "Transport",
    "TransportName",
]

E = TypeVar("E", bound=StrEnum)


class Word(StrEnum):
    """One of several words; the error about any other word lists them."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        *words, last = map(repr, map(str, cls))
        raise ValueError(f"{value!r:.80} is not a valid {cls.__name__}: use {', '.join(words)} or {last}.")


class StepMode(Word):
    """What advances physics."""

    AUTO = "auto"
    DIRECT = "direct"
    PUPPET = "puppet"
    LIVE = "live"

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        found = next((mode for mode, later in LATER_MODE_NAMES.items() if later == value), None)
        return super()._missing_(value) if found is None else cls(found)


LATER_MODE_NAMES: Final[Mapping[StepMode, str]] = {
    StepMode.LIVE: "freerun",
    StepMode.DIRECT: "stepped",
    StepMode.PUPPET: "statepushed",
}
"""Names of the modes on servers after the beta."""


StepModeName: TypeAlias = Literal["auto", "direct", "puppet", "live"]
"""A step mode, by name."""


class ControlMode(Word):
    """What turns set-points into actuator signals."""

    UE_CONTROLLER = "ue_controller"
    RAW = "raw"


class ActuatorType(Word):
    """MJCF actuator element. The plugin reports `<general>` as `MOTOR`; the client classifies it by gain and bias."""

    MOTOR = "motor"
    POSITION = "position"
    VELOCITY = "velocity"
    INT_VELOCITY = "intvelocity"
    DAMPER = "damper"
    CYLINDER = "cylinder"
    MUSCLE = "muscle"
    ADHESION = "adhesion"
    DC_MOTOR = "dcmotor"


class ControllerKind(Word):
    """Kind of the controller attached to an articulation."""

    PD = "pd"
    PASSTHROUGH = "passthrough"

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        # The plugin calls its passthrough controller "base".
        return cls("passthrough") if value == "base" else super()._missing_(value)


class CameraMode(Word):
    """Meaning of a camera's pixels."""

    REAL = "real"
    DEPTH = "depth"
    SEMANTIC = "semantic"
    INSTANCE = "instance"


class CameraTiming(Word):
    """Which frame a step reply carries: one rendered after the step, or the newest available."""

    SYNC = "sync"
    LATEST = "latest"


class ObservationLevel(Word):
    """Amount of state in each step reply."""

    MINIMAL = "minimal"
    STANDARD = "standard"
    FULL = "full"


ObservationLevelName: TypeAlias = Literal["minimal", "standard", "full"]
"""An observation level, by name."""


class OutOfRange(Word):
    """Handling of a set-point outside the range of its actuator. Client-side only."""

    ERROR = "error"
    """Raise an error."""
    CLAMP = "clamp"
    """Use the nearest value in the range."""
    ALLOW = "allow"
    """Send it unchanged; MuJoCo clamps controls that have a range."""


class PIEState(Word):
    """State of Play-In-Editor."""

    READY = "ready"
    COMPILE_FAILED = "compile_failed"
    TIMEOUT = "timeout"
    OFF = "off"
    COMPILING = "compiling"


class Transport(Word):
    """Transport of requests."""

    ZMQ = "zmq"
    SHM = "shm"


TransportName: TypeAlias = Literal["zmq", "shm"]
"""A transport, by name."""

EncodingName: TypeAlias = Literal["msgpack", "json"]
"""An encoding of requests and replies, by name."""


def known(enum: type[E], value: str) -> E | str:
    """Return the member of `enum` equal to `value`, or `value` itself if it is unknown."""
    try:
        return enum(value)
    except ValueError:
        return value
