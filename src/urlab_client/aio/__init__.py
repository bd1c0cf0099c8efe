"""The async core: `URLabClient` and the classes of the objects that it returns."""

from urlab_client.aio.articulation import URLabArticulation, URLabEntity
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.client import URLabClient
from urlab_client.aio.controllers import URLabController, URLabPDController
from urlab_client.aio.deadline import DEFAULT
from urlab_client.aio.launch import check_address
from urlab_client.aio.model.elements import Actuator, Body, Joint, Sensor
from urlab_client.aio.streams import Stream

__all__ = [
    "DEFAULT",
    "Actuator",
    "Body",
    "Joint",
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
