"""The MCP server: the tools and resources that one agent gets."""

from __future__ import annotations

import base64
import json
import math
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
from mcp.server import Server
from mcp.server.context import ServerRequestContext
from mcp.shared.exceptions import MCPError
from mcp.types import (
    INVALID_PARAMS,
    CallToolRequestParams,
    CallToolResult,
    ImageContent,
    ListResourcesResult,
    ListToolsResult,
    PaginatedRequestParams,
    ReadResourceRequestParams,
    ReadResourceResult,
    Resource,
    TextContent,
    TextResourceContents,
)
from msgspec import Struct

from urlab_client.mcp.declaration import Declared, Moment, Needs, declared
from urlab_client.mcp.driving import Limits, Stopped
from urlab_client.mcp.editing import Tools
from urlab_client.mcp.toolset import TAKEN_OVER
from urlab_client.protocol.errors import SessionTakenOver, URLabError
from urlab_client.web.console_session import ConsoleSession
from urlab_client.web.driving_lease import NotDriving
from urlab_client.web.ops import encode

if TYPE_CHECKING:
    from starlette.applications import Starlette

__all__ = ["Agent"]

_INSTRUCTIONS = """\
Tools to look at and drive robots in a MuJoCo simulation. Call look first: it lists robots, joints, actuators, cameras,
units and limits. Angles are in radians, lengths in metres, the z axis points up. In mode direct time passes only while
run or move_to work; in mode live it passes by itself unless it is paused. When something does not move, call explain.
A person may watch and take the controls at any time; then wait. One call may take {sim:g} s of simulation time and
{wall:g} s on the wall.{missing}"""
_RESOURCES = {
    "urlab://model": "Robots, joints, actuators, sensors, cameras, units and limits, as they are now.",
    "urlab://log": "Calls, errors and events, of people, too; the newest last.",
}
_LARGE = 1e3
_FAILURES = (URLabError, NotDriving, Stopped, ValueError, TypeError, LookupError, OSError)
_TOOLS = {
    "runtime.set_paused(False)": "play with action='resume'",
    "sim.start()": "play with action='start'",
    "set_ctrl() or ctrl_array before step()": "set_actuators before run",
    "step() was not called": "run was not called",
    "waiting for step()": "waiting for run",
    "Call reset()": "Call reset",
}
"""What the client's advice calls methods, and which tools do that."""


class Agent:
    """An MCP server whose tools act on a console's session.

    Args:
        console: The console application of `urlab_client.web.app()`, or its session.
        limits: What the agent may do.
        models: MJCF files that the agent may import, by the names that it sees.

    Attributes:
        server: The server of the MCP SDK, for a transport of your choice. Serve it while the console's lifespan runs.

    Raises:
        ValueError: The agent may drive, but the client is read-only.
    """

    def __init__(
        self,
        console: Starlette | ConsoleSession,
        limits: Limits | None = None,
        *,
        models: Mapping[str, Path] | None = None,
    ) -> None:
        session: ConsoleSession = console if isinstance(console, ConsoleSession) else console.state.console
        limits = limits or Limits()
        looks_on = session.client.config.read_only
        if looks_on and (limits.drive or limits.edit):
            raise ValueError("an agent drives or edits through a client that has the session, not a read-only one")
        self._tools = Tools(session, limits, models or {})
        self._declared = declared(Tools)
        given = {Needs.NOTHING: True, Needs.SESSION: not looks_on, Needs.DRIVE: limits.drive, Needs.EDIT: limits.edit}
        self._offered = {name: one for name, one in self._declared.items() if given[one.needs]}
        missing = ", ".join(need.value for need, has in given.items() if not has)
        self.server: Server[Any] = Server(
            "urlab",
            version=version("urlab-client"),
            title="URLab",
            instructions=_INSTRUCTIONS.format(
                sim=limits.sim_seconds,
                wall=limits.wall_seconds,
                missing=f" Not allowed: {missing}." if missing else "",
            ),
            on_list_tools=self._list_tools,
            on_call_tool=self._call_tool,
            on_list_resources=self._list_resources,
            on_read_resource=self._read_resource,
        )

    @property
    def idle(self) -> bool:
        """Whether no call drives at the moment."""
        return self._tools.driving.idle

    async def _list_tools(
        self, context: ServerRequestContext[Any], params: PaginatedRequestParams | None
    ) -> ListToolsResult:
        return ListToolsResult(tools=[one.described() for one in self._offered.values()])

    async def _call_tool(self, context: ServerRequestContext[Any], params: CallToolRequestParams) -> CallToolResult:
        console, viewer = self._tools.console, self._tools.driving.viewer
        began = time.perf_counter()
        try:
            found = self._tool(params.name)
            arguments = found.parse(params.arguments or {})
            await self._tools.connected()
            if found.takes_progress:
                arguments["progress"] = context.session.report_progress
            answer = self._answer(await getattr(self._tools, found.name)(**arguments))
        except _FAILURES as error:
            text = _in_tools(str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error))
            if isinstance(error, SessionTakenOver):
                text = TAKEN_OVER
            console.note("error", viewer.name, params.name, text)
            return CallToolResult(content=[TextContent(text=text)], is_error=True)
        if found.needs in {Needs.DRIVE, Needs.EDIT}:
            milliseconds = 1e3 * (time.perf_counter() - began)
            console.note("call", viewer.name, params.name, json.dumps(params.arguments or {}), milliseconds)
        return answer

    def _tool(self, name: str) -> Declared:
        if name in self._offered:
            return self._offered[name]
        if name in self._declared:
            option = self._declared[name].needs.value
            raise LookupError(f"{name} is not allowed here. Ask whoever started `urlab mcp` to start it with {option}.")
        raise LookupError(f"No tool is called {name!r}. There are: {', '.join(self._offered)}.")

    def _answer(self, result: Struct | tuple[Struct, bytes]) -> CallToolResult:
        """Return a result with its structure, its text, and its picture if there is one.

        Raises:
            ValueError: A number in it is not finite.
        """
        shown, jpeg = result if isinstance(result, tuple) else (result, None)
        client = self._tools.client
        when = Moment(client.sim_time, client.step_count, str(client.step_mode))
        structure = _short(msgspec.to_builtins(shown) | msgspec.to_builtins(when))
        content: list[TextContent | ImageContent] = [TextContent(text=json.dumps(structure))]
        if jpeg is not None:
            content.append(ImageContent(data=base64.b64encode(jpeg).decode(), mime_type="image/jpeg"))
        return CallToolResult(content=list(content), structured_content=structure)

    async def _list_resources(
        self, context: ServerRequestContext[Any], params: PaginatedRequestParams | None
    ) -> ListResourcesResult:
        return ListResourcesResult(
            resources=[
                Resource(uri=uri, name=uri.partition("//")[2], description=text, mime_type="application/json")
                for uri, text in _RESOURCES.items()
            ]
        )

    async def _read_resource(
        self, context: ServerRequestContext[Any], params: ReadResourceRequestParams
    ) -> ReadResourceResult:
        uri = str(params.uri)
        if uri not in _RESOURCES:
            raise MCPError(INVALID_PARAMS, f"No resource has the address {uri!r}, only {' and '.join(_RESOURCES)}.")
        shown = self._tools.client.describe() if uri == "urlab://model" else list(self._tools.console.entries)
        contents = TextResourceContents(uri=uri, text=encode(shown).decode(), mime_type="application/json")
        return ReadResourceResult(contents=[contents])


def _short(value: Any) -> Any:
    """Return what a result is made of with six digits of each number, and tools where it speaks of methods."""
    match value:
        case float() if math.isfinite(value):
            return float(f"{value:.6g}") if abs(value) < _LARGE else round(value, 3)  # such as times
        case float():
            raise ValueError("The simulation has diverged: some values are not finite. Call reset.")
        case str():
            return _in_tools(value)
        case dict():
            return {key: _short(part) for key, part in cast("dict[str, Any]", value).items()}
        case list() | tuple():
            return [_short(part) for part in cast("list[Any]", value)]
        case _:
            return value


def _in_tools(text: str) -> str:
    for method, named in _TOOLS.items():
        text = text.replace(method, named)
    return text
