"""`client.debug`: drawing into the world."""

from urlab_client.aio.namespaces._ops import DebugOps

__all__ = ["DebugNamespace"]


class DebugNamespace(DebugOps):
    """Debug drawing in the editor and during play; during play it draws into the play world.

    Positions are metres in MuJoCo's world frame, colours (r, g, b) in [0, 1]. `ttl` is in seconds: 0 shows a marker for
    a single frame, a negative value until `clear_markers`.
    """
