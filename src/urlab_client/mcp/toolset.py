"""What all tools share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import anyio

from urlab_client.mcp.driving import Driving, Limits
from urlab_client.protocol.errors import URLabConnectionError
from urlab_client.web.console_session import ConsoleSession

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient

__all__ = ["TAKEN_OVER", "Toolset"]

TAKEN_OVER = "Another program has taken the server over. Ask a person to take it back in the console."

_PATIENCE_S = 10.0


class Toolset:
    """The session that tools act on.

    Args:
        console: The session, which people may watch.
        limits: What the agent may do.
    """

    def __init__(self, console: ConsoleSession, limits: Limits) -> None:
        self.console = console
        self.client: URLabClient = console.client
        self.limits = limits
        self.driving: Driving = Driving(console, limits)
        self._known = ""

    async def connected(self) -> None:
        """Wait until the console's session is open, and read where the simulation stands when it is a new one.

        Raises:
            URLabConnectionError: It is not, and why.
        """
        with self.console.bell() as changed, anyio.move_on_after(_PATIENCE_S):
            while self.console.link.state not in {"connected", "taken_over"}:  # which only a person ends
                changed.clear()
                await changed.wait()
        link = self.console.link
        if link.state == "taken_over":
            raise URLabConnectionError(TAKEN_OVER)
        if link.state != "connected":
            raise URLabConnectionError(
                f"There is no connection to {self.client.address}: {(link.reason or link.state).rstrip('.?')}.",
                hint="It is tried again all the time. Call again later.",
            )
        if self._known != self.client.session_id:
            await self.client.resync()
            self._known = self.client.session_id

    def robot(self, name: str) -> URLabArticulation:
        """Return a robot.

        Raises:
            LookupError: There is none of that name; the text says which there are, or that play does not run.
        """
        if not self.client.manager_present:
            raise LookupError("No play session runs, so there are no robots. Call play with action='start'.")
        return self.client.articulations[name]
