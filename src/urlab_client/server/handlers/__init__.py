"""The op handlers. Importing this package registers all of them; ops without one answer `unsupported`."""

from urlab_client.server.dispatch import HANDLERS
from urlab_client.server.handlers import outliner, runtime, scene, session, sim

__all__ = ["HANDLERS", "outliner", "runtime", "scene", "session", "sim"]
