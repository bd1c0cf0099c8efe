"""`client.viewport`: the editor's perspective viewport."""

from urlab_client.aio.namespaces._ops import ViewportOps

__all__ = ["ViewportNamespace"]


class ViewportNamespace(ViewportOps):
    """The editor's perspective viewport. The play window has its own camera."""
