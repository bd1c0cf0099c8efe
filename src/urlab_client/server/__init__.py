"""A URLab server without Unreal: the plugin's protocol in front of real MuJoCo.

For tests, demonstrations and offline work; `urlab serve` runs the same server from the command line. Names are
loaded on first access, with MuJoCo.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from urlab_client.server.assets.bundled_robots import bundled_models
    from urlab_client.server.faults import ActiveFault, Corrupt, Cut, Delay, Drop, Fault, Faults, Refuse
    from urlab_client.server.limits import Limits
    from urlab_client.server.open_server import ModelError
    from urlab_client.server.rpc.dispatch import ServedRequest
    from urlab_client.server.simulated import SimulatedServer
    from urlab_client.server.transport.curve_authentication import CurveServer, UnprotectedServer
    from urlab_client.server.transport.endpoint import PortInUse
    from urlab_client.simulation.controller_config import ControllerConfig
    from urlab_client.simulation.opengl import RenderingUnavailable

_NAMES = {
    "server.assets.bundled_robots": ("bundled_models",),
    "server.faults": ("ActiveFault", "Corrupt", "Cut", "Delay", "Drop", "Fault", "Faults", "Refuse"),
    "server.limits": ("Limits",),
    "server.open_server": ("ModelError",),
    "server.rpc.dispatch": ("ServedRequest",),
    "server.simulated": ("SimulatedServer",),
    "server.transport.curve_authentication": ("CurveServer", "UnprotectedServer"),
    "server.transport.endpoint": ("PortInUse",),
    "simulation.controller_config": ("ControllerConfig",),
    "simulation.opengl": ("RenderingUnavailable",),
}
_HOMES = {name: f"urlab_client.{module}" for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load what is asked for: a process that only compiles models starts sooner without the rest."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(_HOMES[name])
    except AttributeError as error:  # as MuJoCo's without OpenGL; `from … import` would say only that there is no name
        raise ImportError(f"cannot load {_HOMES[name]}: {error}") from error
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


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
