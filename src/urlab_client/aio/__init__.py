"""The async core: `URLabClient` and the classes of the objects that it returns."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urlab_client.aio.articulation import URLabArticulation, URLabEntity
    from urlab_client.aio.cameras import URLabCameraView
    from urlab_client.aio.client import URLabClient
    from urlab_client.aio.controllers import URLabController, URLabPDController
    from urlab_client.aio.defaults import DEFAULT
    from urlab_client.aio.launch import check_address
    from urlab_client.aio.model.elements import Actuator, Body, Joint, ScalarJoint, Sensor
    from urlab_client.aio.streams.stream import Stream

# Where names are looked for, the light modules first.
_HOMES = ("defaults", "launch", "model.elements", "controllers", "client")


def __getattr__(name: str) -> Any:
    """Load what is asked for: a process that only compiles models starts sooner without the rest."""
    for home in _HOMES if name in __all__ else ():
        module = import_module(f"{__name__}.{home}")
        if hasattr(module, name):
            value = globals()[name] = getattr(module, name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "DEFAULT",
    "Actuator",
    "Body",
    "Joint",
    "ScalarJoint",
    "Sensor",
    "Stream",
    "URLabArticulation",
    "URLabCameraView",
    "URLabClient",
    "URLabController",
    "URLabEntity",
    "URLabPDController",
    "check_address",
]
