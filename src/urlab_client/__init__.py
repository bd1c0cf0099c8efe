"""Python clients for URLab, the Unreal plugin that embeds MuJoCo.

`URLabClient` here is the blocking one; its async twin is `urlab_client.aio.URLabClient`.
"""

from typing import Any

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
from urlab_client.protocol.errors import (
    ClientClosed,
    ConcurrentReadError,
    ConnectionLost,
    ForkedError,
    OutcomeUnknown,
    ProtocolError,
    ServerUnreachable,
    SessionTakenOver,
    StreamOverflow,
    URLabConnectionError,
    URLabError,
    URLabPIEError,
    URLabRPCError,
    URLabTimeoutError,
    URLabVersionMismatch,
)
from urlab_client.protocol.names import UnknownName
from urlab_client.protocol.types import (
    ActorBounds,
    ActorHierarchyNode,
    ActorInfo,
    BlueprintInfo,
    CameraPose,
    ClientConfig,
    Contact,
    ContactsResult,
    KeyframeInfo,
    MocapPose,
    PIEStartResult,
    PIEStatus,
    RecordingHandle,
    RecordingSummary,
    ReplaySession,
    ReplayStatus,
    SceneActor,
    SceneSnapshot,
    SimOptions,
    URLabAsset,
    URLabBlueprint,
    URLabLightHandle,
    URLabSpawnHandle,
)
from urlab_client.sync import (
    DEFAULT,
    Actuator,
    Body,
    Joint,
    Sensor,
    URLabArticulation,
    URLabCameraView,
    URLabClient,
    URLabController,
    URLabEntity,
    URLabPDController,
)

__version__: str


def __getattr__(name: str) -> Any:
    # Reading the installed metadata costs milliseconds that most programs need not pay.
    if name == "__version__":
        from importlib.metadata import version  # noqa: PLC0415

        return version("urlab-client")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "DEFAULT",
    "ActorBounds",
    "ActorHierarchyNode",
    "ActorInfo",
    "Actuator",
    "ActuatorType",
    "BlueprintInfo",
    "Body",
    "CameraMode",
    "CameraPose",
    "CameraTiming",
    "ClientClosed",
    "ClientConfig",
    "ConcurrentReadError",
    "ConnectionLost",
    "Contact",
    "ContactsResult",
    "ControlMode",
    "ControllerKind",
    "ForkedError",
    "Joint",
    "KeyframeInfo",
    "MocapPose",
    "ObservationLevel",
    "OutcomeUnknown",
    "PIEStartResult",
    "PIEState",
    "PIEStatus",
    "ProtocolError",
    "RecordingHandle",
    "RecordingSummary",
    "ReplaySession",
    "ReplayStatus",
    "SceneActor",
    "SceneSnapshot",
    "Sensor",
    "ServerUnreachable",
    "SessionTakenOver",
    "SimOptions",
    "StepMode",
    "StreamOverflow",
    "Transport",
    "URLabArticulation",
    "URLabAsset",
    "URLabBlueprint",
    "URLabCameraView",
    "URLabClient",
    "URLabConnectionError",
    "URLabController",
    "URLabEntity",
    "URLabError",
    "URLabLightHandle",
    "URLabPDController",
    "URLabPIEError",
    "URLabRPCError",
    "URLabSpawnHandle",
    "URLabTimeoutError",
    "URLabVersionMismatch",
    "UnknownName",
    "__version__",
]
