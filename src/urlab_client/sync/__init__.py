"""The blocking façade: the async core's API without `await`, for scripts and notebooks."""

from urlab_client.aio.articulation import URLabEntity
from urlab_client.aio.defaults import DEFAULT
from urlab_client.aio.launch import check_address
from urlab_client.aio.model.elements import Actuator, Body, Joint, ScalarJoint, Sensor
from urlab_client.sync.articulation import URLabArticulation
from urlab_client.sync.cameras import URLabCameraView
from urlab_client.sync.client import URLabClient
from urlab_client.sync.controllers import URLabController, URLabPDController
from urlab_client.sync.streams import Stream

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
