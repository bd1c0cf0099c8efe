"""Python clients for URLab, the Unreal plugin that embeds MuJoCo.

`URLabClient` in this package is the blocking client; the async client is `urlab_client.aio.URLabClient`. Here are the
names that most programs need; `urlab_client.errors`, `.types`, `.events` and `.enums` have all of them.
Names are loaded on first access, so importing the package is cheap.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urlab_client.enums import (
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
    from urlab_client.errors import (
        ClientClosed,
        ConnectionLost,
        ControlClaimed,
        NoActiveManager,
        NotControlOwner,
        OutcomeUnknown,
        ServerRestarted,
        ServerUnreachable,
        SessionTakenOver,
        StreamOverflow,
        UnknownName,
        URLabConnectionError,
        URLabError,
        URLabPIEError,
        URLabRPCError,
        URLabTimeoutError,
        URLabVersionMismatch,
    )
    from urlab_client.events import ClientEvent
    from urlab_client.sync import (
        DEFAULT,
        Actuator,
        Body,
        Joint,
        ScalarJoint,
        Sensor,
        Stream,
        URLabArticulation,
        URLabCameraView,
        URLabClient,
        URLabController,
        URLabEntity,
        URLabPDController,
        check_address,
    )
    from urlab_client.types import (
        ActorInfo,
        BlueprintInfo,
        CameraSample,
        ClientObserver,
        PIEStartResult,
        PIEStatus,
        RecordingHandle,
        RecordingSummary,
        ReplaySession,
        ReplayStatus,
        RowSample,
        SimOptions,
        StateSnapshot,
        URLabAsset,
        URLabBlueprint,
        URLabLightHandle,
        URLabSpawnHandle,
    )

__version__: str

# Where a name is looked for, the light modules first. Earlier programs import from here what only these modules list.
_HOMES = ("enums", "errors", "types", "events", "sync")


def __getattr__(name: str) -> Any:
    if name in {"aio", "protocol", *_HOMES}:
        return import_module(f"urlab_client.{name}")
    if name.startswith("_") and name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = _load(name)
    return value


def _load(name: str) -> Any:
    if name == "__version__":
        # Reading the installed metadata costs milliseconds that most programs need not pay.
        return import_module("importlib.metadata").version("urlab-client")
    try:
        for home in _HOMES:
            module = import_module(f"urlab_client.{home}")
            if name in module.__all__:
                return getattr(module, name)
    except ImportError as error:
        # A file is missing or belongs to another package. Failures of a dependency are raised unchanged.
        if found := import_module("urlab_client._installation").conflict():
            raise ImportError(f"cannot load urlab_client.{name}: {found}") from error
        raise
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, "aio", "enums", "errors", "events", "sync", "types"})


__all__ = [
    "DEFAULT",
    "ActorInfo",
    "Actuator",
    "ActuatorType",
    "BlueprintInfo",
    "Body",
    "CameraMode",
    "CameraSample",
    "CameraTiming",
    "ClientClosed",
    "ClientEvent",
    "ClientObserver",
    "ConnectionLost",
    "ControlClaimed",
    "ControlMode",
    "ControllerKind",
    "Joint",
    "NoActiveManager",
    "NotControlOwner",
    "ObservationLevel",
    "OutcomeUnknown",
    "PIEStartResult",
    "PIEState",
    "PIEStatus",
    "RecordingHandle",
    "RecordingSummary",
    "ReplaySession",
    "ReplayStatus",
    "RowSample",
    "ScalarJoint",
    "Sensor",
    "ServerRestarted",
    "ServerUnreachable",
    "SessionTakenOver",
    "SimOptions",
    "StateSnapshot",
    "StepMode",
    "Stream",
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
    "check_address",
]
