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

_HOMES = {
    "URLabArticulation": "urlab_client.aio.articulation",
    "URLabEntity": "urlab_client.aio.articulation",
    "URLabCameraView": "urlab_client.aio.cameras",
    "URLabClient": "urlab_client.aio.client",
    "URLabController": "urlab_client.aio.controllers",
    "URLabPDController": "urlab_client.aio.controllers",
    "DEFAULT": "urlab_client.aio.defaults",
    "check_address": "urlab_client.aio.launch",
    "Actuator": "urlab_client.aio.model.elements",
    "Body": "urlab_client.aio.model.elements",
    "Joint": "urlab_client.aio.model.elements",
    "ScalarJoint": "urlab_client.aio.model.elements",
    "Sensor": "urlab_client.aio.model.elements",
    "Stream": "urlab_client.aio.streams.stream",
}


def __getattr__(name: str) -> Any:
    """Load what is asked for: a process that only compiles models starts sooner without the rest."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return value


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
