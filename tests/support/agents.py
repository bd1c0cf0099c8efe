"""Agents in the test's own process, on a simulated server over real sockets."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import Any

from jsonschema import Draft202012Validator
from mcp import Client
from mcp.types import CallToolResult

from urlab_client.aio import URLabClient
from urlab_client.console.session import ConsoleSession
from urlab_client.mcp import Agent, Limits
from urlab_client.server import SimulatedServer
from urlab_client.web import Access, app

ALL = Limits(drive=True, edit=True)


class Desk:
    """An agent and what it sits at.

    Attributes:
        client: The client that the tools use.
        console: What people see.
        agent: The server.
        mcp: The agent's end.
    """

    def __init__(self, client: URLabClient, console: ConsoleSession, agent: Agent, mcp: Client) -> None:
        self.client = client
        self.console = console
        self.agent = agent
        self.mcp = mcp
        self._schemas: dict[str, dict[str, Any] | None] = {}

    async def call(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Call a tool that succeeds, and return its structured result."""
        result = await self.mcp.call_tool(tool, arguments)
        assert not result.is_error, text_of(result)
        assert json.loads(text_of(result)) == result.structured_content
        if not self._schemas:
            self._schemas = {one.name: one.output_schema for one in (await self.mcp.list_tools()).tools}
        Draft202012Validator(self._schemas[tool] or {}).validate(result.structured_content)
        return dict(result.structured_content or {})

    async def refused(self, tool: str, **arguments: Any) -> str:
        """Call a tool that fails, and return what it says."""
        result = await self.mcp.call_tool(tool, arguments)
        assert result.is_error, result.structured_content
        return text_of(result)


def text_of(result: CallToolResult) -> str:
    return str(getattr(result.content[0], "text", ""))


@contextlib.asynccontextmanager
async def desk(
    server: SimulatedServer,
    limits: Limits = ALL,
    *,
    step_mode: str = "direct",
    recordings: Path = Path("recordings"),
    models: dict[str, Path] | None = None,
    handshake: Callable[[], bytes] | None = None,
) -> AsyncGenerator[Desk]:
    """Put an agent at a server; with a handshake it looks on."""
    # Patience with a time that stands still is the client's own deadline.
    options = {"step_mode": step_mode} if handshake is None else {"read_only": True}
    client = URLabClient(**server.client_options() | options, live_pictures=False, rcv_timeout_ms=1000)
    site = app(client, access=Access(tokens=False), handshake=handshake, recordings=recordings)
    agent = Agent(site, limits, models=models)
    async with (
        client,
        site.router.lifespan_context(site),
        Client(agent.server, read_timeout_seconds=60) as mcp,
    ):
        await site.state.console.opened()  # without which `look` says within a second that there is no connection
        yield Desk(client, site.state.console, agent, mcp)
