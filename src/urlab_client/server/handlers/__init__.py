"""The op handlers. Importing this package registers all of them; ops without one answer `unsupported`."""

from urlab_client.server.dispatch import HANDLERS
from urlab_client.server.handlers import debug, options, outliner, recording, runtime, scene, session, sim, viewport

__all__ = ["HANDLERS", "debug", "options", "outliner", "recording", "runtime", "scene", "session", "sim", "viewport"]
