"""The MCP server: the tools and resources of an agent."""

from __future__ import annotations

import base64
import json
import math
import time
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
from mcp import types
from mcp.server import Server
from mcp.server.context import ServerRequestContext
from mcp.shared.exceptions import MCPError
from msgspec import Struct

from urlab_client.console.lease import NotDriving
from urlab_client.console.messages import encode
from urlab_client.console.session import ConsoleSession
from urlab_client.errors import ServerRestarted, SessionTakenOver, URLabError
from urlab_client.mcp import tools
from urlab_client.mcp.call import RESTARTED, TAKEN_OVER, Call, Caller, Limits, Stopped
from urlab_client.mcp.declaration import Declared, Needs, declared
from urlab_client.mcp.results import Moment

if TYPE_CHECKING:
    from starlette.applications import Starlette

_INSTRUCTIONS = """\
Tools to look at and drive robots in a MuJoCo simulation. Call look first: it lists robots, joints, actuators, cameras,
units and limits. Angles are in radians, lengths in metres, the z axis points up. In mode direct time passes only while
run or move_to work; in mode live it passes by itself unless it is paused. When something does not move, call explain.
One drives at a time: a person may take the controls at any time, and another agent may have them; then wait. One call
may take {sim:g} s of simulation time and {wall:g} s on the wall.{missing}"""
_RESOURCES = {
    "urlab://model": "Robots, joints, actuators, sensors, cameras, units and limits, as they are now.",
    "urlab://log": "Calls, errors and events, of people, too; the newest last.",
}
_TOOLS = declared(tools)
_LARGE = 1e3
_MOST_CALLERS = 100  # each client of the older protocol opens a session, and may not report its end
_FAILURES = (URLabError, NotDriving, Stopped, ValueError, TypeError, LookupError, OSError, RecursionError)
_NO_PLAY = "No play session runs, so there are no robots. Call play with action='start'."
_METHODS = {
    "client.sim.start()": "play with action='start'",
    "runtime.set_paused(False)": "play with action='resume'",
    "sim.start()": "play with action='start'",
    "set_ctrl() or ctrl_array before step()": "set_actuators before run",
    "run_for: ": "run: ",
    "step() was not called": "run was not called",
    "waiting for step()": "waiting for run",
    "Call reset()": "Call reset",
}
"""Methods in the client's hints, and the tools that correspond to them."""


class Agent:
    """An MCP server whose tools act on a console's session.

    Args:
        console: The console application of `urlab_client.web.app()`, or its session.
        limits: Permissions and limits of the agent.
        models: MJCF files that the agent may import, by the names shown to it.

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
        self._console = session
        self._limits = limits
        self._models = models or {}
        given = {Needs.NOTHING: True, Needs.SESSION: not looks_on, Needs.DRIVE: limits.drive, Needs.EDIT: limits.edit}
        self._offered = {name: one for name, one in _TOOLS.items() if given[one.needs]}
        self._callers: dict[tuple[str, ...], Caller] = {}
        missing = ", ".join(need.value for need, has in given.items() if not has)
        self.server: Server[Any] = Server(
            "urlab",
            version=version("urlab-client"),
            title="URLab",
            instructions=_INSTRUCTIONS.format(
                sim=limits.sim_seconds,
                wall=limits.wall_seconds,
                missing=f" Not allowed, unless a person starts `urlab mcp` with: {missing}." if missing else "",
            ),
            on_list_tools=self._list_tools,
            on_call_tool=self._call_tool,
            on_list_resources=self._list_resources,
            on_read_resource=self._read_resource,
        )

    async def _list_tools(
        self, context: ServerRequestContext[Any], params: types.PaginatedRequestParams | None
    ) -> types.ListToolsResult:
        return types.ListToolsResult(tools=[one.described for one in self._offered.values()])

    async def _call_tool(
        self, context: ServerRequestContext[Any], params: types.CallToolRequestParams
    ) -> types.CallToolResult:
        console, caller = self._console, self._caller(context)
        call = Call(console, caller, self._limits, self._models, context.session.report_progress)
        began = time.perf_counter()
        try:
            found = self._tool(params.name)
            arguments = found.parse(params.arguments or {})
            await call.connected()
            if found.play and not call.client.manager_present:
                raise LookupError(_NO_PLAY)
            work = partial(found.function, call, **arguments)
            answer = self._answer(await (call.drive(work) if found.drives else work()))
        except _FAILURES as error:
            text = _in_tools(str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error))
            if isinstance(error, SessionTakenOver):
                text = RESTARTED if isinstance(error, ServerRestarted) else TAKEN_OVER
            console.view.note("error", caller.name, params.name, text)
            return types.CallToolResult(content=[types.TextContent(text=text)], is_error=True)
        if found.drives:
            milliseconds = 1e3 * (time.perf_counter() - began)
            console.view.note("call", caller.name, params.name, json.dumps(params.arguments or {}), milliseconds)
        return answer

    def _caller(self, context: ServerRequestContext[Any]) -> Caller:
        """Return the caller, identified by token, session, if any, and program.

        Current clients open no session, so two of the same program that share a token count as one. If there are too
        many callers, the one that has been idle longest is forgotten unless it has the controls; it returns under
        another name.
        """
        client = context.session.client_params
        request = context.request
        name = "" if client is None else client.client_info.name
        token = "" if request is None else str(request.scope.get("urlab_key"))
        session = "" if request is None else request.headers.get("mcp-session-id", "")
        who = name, token, session
        caller = self._callers.pop(who, None) or Caller(self._console.new_agent_name(name))
        self._callers[who] = caller  # moves it to the end of the order of idleness
        if len(self._callers) > _MOST_CALLERS:
            holder = self._console.lease.holder
            del self._callers[next(known for known, one in self._callers.items() if one is not holder)]
        return caller

    def _tool(self, name: str) -> Declared:
        if name in self._offered:
            return self._offered[name]
        if name in _TOOLS:
            option = _TOOLS[name].needs.value
            raise LookupError(f"{name} is not allowed here. Ask whoever started `urlab mcp` to start it with {option}.")
        raise LookupError(f"No tool is called {name!r}. There are: {', '.join(self._offered)}.")

    def _answer(self, result: Struct | tuple[Struct, bytes]) -> types.CallToolResult:
        """Return a result with its structured content, its text, and its picture, if any.

        Raises:
            ValueError: A number in the result is not finite.
        """
        shown, jpeg = result if isinstance(result, tuple) else (result, None)
        client = self._console.client
        when = Moment(client.sim_time, client.step_count, str(client.step_mode))
        structure = _short(msgspec.to_builtins(shown) | msgspec.to_builtins(when))
        content: list[types.TextContent | types.ImageContent] = [types.TextContent(text=json.dumps(structure))]
        if jpeg is not None:
            content.append(types.ImageContent(data=base64.b64encode(jpeg).decode(), mime_type="image/jpeg"))
        return types.CallToolResult(content=list(content), structured_content=structure)

    async def _list_resources(
        self, context: ServerRequestContext[Any], params: types.PaginatedRequestParams | None
    ) -> types.ListResourcesResult:
        return types.ListResourcesResult(
            resources=[
                types.Resource(uri=uri, name=uri.partition("//")[2], description=text, mime_type="application/json")
                for uri, text in _RESOURCES.items()
            ]
        )

    async def _read_resource(
        self, context: ServerRequestContext[Any], params: types.ReadResourceRequestParams
    ) -> types.ReadResourceResult:
        uri = str(params.uri)
        if uri not in _RESOURCES:
            raise MCPError(
                types.INVALID_PARAMS, f"No resource has the address {uri!r}, only {' and '.join(_RESOURCES)}."
            )
        shown = self._console.client.describe() if uri == "urlab://model" else list(self._console.view.entries)
        contents = types.TextResourceContents(uri=uri, text=encode(shown).decode(), mime_type="application/json")
        return types.ReadResourceResult(contents=[contents])


def _short(value: Any) -> Any:
    """Return the parts of a result with numbers rounded to six digits, and names of tools instead of methods."""
    match value:
        case float() if math.isfinite(value):
            return float(f"{value:.6g}") if abs(value) < _LARGE else round(value, 3)  # for example times
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
    for method, named in _METHODS.items():
        text = text.replace(method, named)
    return text
