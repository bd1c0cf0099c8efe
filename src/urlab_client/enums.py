"""Public enumerations; see `urlab_client.protocol.enums` for their definition."""

from urlab_client.protocol.enums import (
    ActuatorType,
    CameraMode,
    CameraTiming,
    ControllerKind,
    ControlMode,
    ObservationLevel,
    OutOfRange,
    PIEState,
    StepMode,
    Transport,
)

__all__ = [
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
]
