"""Tools for agents over the Model Context Protocol: a server on the async client and the console's controls.

Requires the extra `mcp`. `urlab mcp` runs it; `Agent` is for programs with their own client or transport.
"""

from urlab_client._installation import need

need("mcp", "mcap", "mink", "PIL", extra="mcp")

from urlab_client.mcp.agent import Agent  # noqa: E402 - its libraries may be missing
from urlab_client.mcp.call import Limits  # noqa: E402

__all__ = ["Agent", "Limits"]
