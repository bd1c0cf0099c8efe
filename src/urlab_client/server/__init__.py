"""A URLab server without Unreal: the plugin's protocol in front of real MuJoCo.

For tests, demonstrations and offline work; `urlab serve` runs the same server from the command line. Importing this
package imports MuJoCo.
"""

from urlab_client.server.assets.bundled_robots import bundled_models
from urlab_client.server.faults import ActiveFault, Corrupt, Cut, Delay, Drop, Fault, Faults, Refuse
from urlab_client.server.initial_level import ModelError
from urlab_client.server.limits import Limits
from urlab_client.server.physics.controllers import ControllerConfig
from urlab_client.server.render.opengl import RenderingUnavailable
from urlab_client.server.rpc.dispatch import ServedRequest
from urlab_client.server.simulated import SimulatedServer
from urlab_client.server.transport.curve_authentication import CurveServer, UnprotectedServer
from urlab_client.server.transport.endpoint import PortInUse

__all__ = [
    "ActiveFault",
    "ControllerConfig",
    "Corrupt",
    "CurveServer",
    "Cut",
    "Delay",
    "Drop",
    "Fault",
    "Faults",
    "Limits",
    "ModelError",
    "PortInUse",
    "Refuse",
    "RenderingUnavailable",
    "ServedRequest",
    "SimulatedServer",
    "UnprotectedServer",
    "bundled_models",
]
