"""`client.debug`: drawing into the world."""

from urlab_client.aio.namespaces._ops import DebugOps

__all__ = ["DebugNamespace"]


class DebugNamespace(DebugOps):
    """Debug drawing, in the editor and during play; the play world wins when it runs.

    Positions are metres in MuJoCo's world frame, colours (r, g, b) in [0, 1]. `ttl` is seconds: 0 shows a single
    frame, a negative value stays until `clear_markers`.
    """
