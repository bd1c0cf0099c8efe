"""Transports of the MCP server: standard input and output, or HTTP with a token."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Any, cast

from mcp.server.stdio import stdio_server

from urlab_client.aio.background import background_thread
from urlab_client.errors import URLabError
from urlab_client.mcp.agent import Agent

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.types import ASGIApp, Receive, Scope, Send

    from urlab_client.web import Access

_PATH = "/mcp"
_CHUNK_BYTES = 65536


async def serve_stdio(agent: Agent) -> None:
    """Serve one agent on standard input and output until its input ends."""
    lines = cast("Any", _Lines(sys.stdin.fileno()))  # the SDK only iterates over it
    async with stdio_server(stdin=lines) as (reader, writer):
        await agent.server.run(reader, writer, agent.server.create_initialization_options())


class _Lines:
    """Lines of text from a file.

    A thread that reads cannot be interrupted. This one ends with the process, so that Ctrl-C ends the server
    immediately.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        self._loop = asyncio.get_running_loop()
        self._lines: asyncio.Queue[str | URLabError | None] = asyncio.Queue()
        background_thread("urlab-mcp-stdin", self._read, failed=self._put).start()

    def _read(self) -> None:
        rest = b""
        while chunk := os.read(self._file, _CHUNK_BYTES):
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._put(line.decode("utf-8", "replace"))
        self._put(None)

    def _put(self, line: str | URLabError | None) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._lines.put_nowait, line)

    async def __aiter__(self) -> AsyncGenerator[str]:
        while (line := await self._lines.get()) is not None:
            if isinstance(line, URLabError):
                raise line
            yield line


def http_application(agent: Agent, console: ASGIApp | None, access: Access) -> Starlette:
    """Create an application with the agent's server at `/mcp` and the console at all other paths.

    Args:
        agent: The agent.
        console: The console, if any. The caller runs its lifespan.
        access: Host names and token for agents. Separate from the console's access, which allows more.
    """
    from mcp.server.transport_security import TransportSecuritySettings
    from starlette.applications import Starlette

    from urlab_client.web.access import Guarded

    inner = agent.server.streamable_http_app(
        streamable_http_path=_PATH,
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),  # `access` checks that
    )
    guarded = Guarded(inner, access, advice="Send the token that `urlab mcp` printed: `Authorization: Bearer TOKEN`.")

    async def dispatch(scope: Scope, receive: Receive, send: Send) -> None:
        path = str(scope["path"]).removeprefix(scope.get("root_path", ""))
        target = guarded if console is None or path == _PATH else console
        await target(scope, receive, send)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with inner.router.lifespan_context(inner):
            yield

    application = Starlette(lifespan=lifespan)
    application.router.default = dispatch
    return application
