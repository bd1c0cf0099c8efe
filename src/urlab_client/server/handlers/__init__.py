"""The op handlers. Importing this package registers all of them; ops without one answer `unsupported`."""

from urlab_client.server.handlers import (
    cameras,
    control,
    debug,
    outliner,
    recording,
    runtime,
    scene,
    session,
    sim,
    uploads,
    viewport,
)
from urlab_client.server.rpc.dispatch import HANDLERS

__all__ = [
    "HANDLERS",
    "cameras",
    "control",
    "debug",
    "outliner",
    "recording",
    "runtime",
    "scene",
    "session",
    "sim",
    "uploads",
    "viewport",
]
