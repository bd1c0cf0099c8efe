"""The namespaces."""

from toylab.aio.namespaces.scene import Scene

__all__ = ["Scene"]
