"""`client.farm`: sharing servers among clients."""

from urlab_client.aio.namespaces._ops import FarmOps

__all__ = ["FarmNamespace"]


class FarmNamespace(FarmOps):
    """Sharing servers among clients. Servers of the alpha do not support it."""
