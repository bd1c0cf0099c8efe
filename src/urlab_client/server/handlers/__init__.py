"""The op handlers. Importing this package registers all of them; ops without one answer `unsupported`."""

from urlab_client.server.handlers import recording, runtime, scene, session, viewport
from urlab_client.server.rpc.dispatch import HANDLERS

__all__ = ["HANDLERS", "recording", "runtime", "scene", "session", "viewport"]
