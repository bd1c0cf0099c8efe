"""Public enumerations; see `urlab_client.protocol.enums` for their definition."""

from urlab_client.protocol.enums import (
    ActuatorType,
    CameraMode,
    CameraTiming,
    ControllerKind,
    ControlMode,
    ObservationLevel,
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
    "PIEState",
    "StepMode",
    "Transport",
]
