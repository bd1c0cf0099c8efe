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
from typing import TYPE_CHECKING, Any, TypeAlias, cast
from urllib.parse import unquote

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
Tools to look at and drive robots in a MuJoCo simulation. Call look first: it lists robots, hands, objects, cameras,
units and limits. Angles are in radians, lengths in metres, the z axis points up. move_hand and follow take a hand to
poses, also to push and grasp. In mode direct time passes only while run or a movement works; in mode live it passes by
itself unless it is paused. look, explain and log answer without a connection, too. When something does not move, call
explain. apply_scene places several objects at once.
One drives at a time: a person may take the controls at any time, and another agent may have them; then wait. One call
may take {sim:g} s of simulation time and {wall:g} s on the wall.{missing}"""
_RESOURCES = [
    types.Resource(uri=f"urlab://{name}", name=name, description=text, mime_type="application/json")
    for name, text in (
        ("model", "Robots, joints, actuators, sensors, cameras, units and limits, as they are now."),
        ("log", "Calls, errors and events, of people, too; the newest last."),
        ("recordings", "Recordings, the newest first."),
    )
]
_TEMPLATES = [
    types.ResourceTemplate(uri_template=f"urlab://{name}/{{{part}}}", name=name, description=text, mime_type=kind)
    for name, part, text, kind in (
        ("cameras", "+camera", "A picture now; the cameras are those of `look`.", "image/jpeg"),
        ("recordings", "name", "Length, robots, cameras and damage of a recording.", "application/json"),
        ("log", "since", "Entries of the log after one, by its number.", "application/json"),
    )
]
_ADDRESSES = [*(one.uri for one in _RESOURCES), *(one.uri_template for one in _TEMPLATES)]
_PROMPTS = {
    "why_it_does_not_move": (
        "Find out why a robot does not move, and get it to move.",
        {"robot": "Name of the robot"},
        "Find out why {robot} does not move. Call explain first and do what its problems say: start or resume play, "
        "choose another mode, or ask whoever has the controls. Then compare set-points with joint positions in state. "
        "If a set-point was never set, call set_actuators or move_to. If a joint stops before its set-point, it is "
        "obstructed (see contacts) or too weak (see the force limits in look). In mode direct nothing moves unless run "
        "or a movement lets time pass. Take a picture if names do not tell. Report the cause, what you changed, and "
        "the evidence that it moves now.",
    ),
    "pick_and_place": (
        "Pick an object up and put it somewhere else.",
        {"object": "Name of the object", "target": "Where to put it"},
        "Pick {object} up and put it at {target}. Call look for the poses of object and hand, and for the gripper's "
        "limits. Open the gripper and follow three poses: 10 cm above the object, around it with the gripper closed "
        "there, and up again. Check in look that the object has risen with the hand; if not, look at contacts and a "
        "picture, and try again a little lower or turned. Then follow: above the target, down, gripper open, up. "
        "Finish with look, and report how far the object is from the target.",
    ),
}
_TOOLS = declared(tools)
_LARGE = 1e3
_QUESTION = "confirm"
_ASKS_BY_RESULT = "2026-07-28"
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

_Context: TypeAlias = ServerRequestContext[Any]
_Page: TypeAlias = types.PaginatedRequestParams | None


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
            on_list_resources=_list_resources,
            on_list_resource_templates=_list_templates,
            on_read_resource=self._read_resource,
            on_list_prompts=_list_prompts,
            on_get_prompt=_get_prompt,
        )

    async def _list_tools(self, context: _Context, params: _Page) -> types.ListToolsResult:
        return types.ListToolsResult(tools=[one.described for one in self._offered.values()])

    async def _call_tool(
        self, context: _Context, params: types.CallToolRequestParams
    ) -> types.CallToolResult | types.InputRequiredResult:
        console, caller = self._console, self._caller(context)
        call = self._new_call(context, caller)
        began = time.perf_counter()
        try:
            found = self._tool(params.name)
            arguments = found.parse(params.arguments or {})
            if found.wants != "nothing":
                await call.connected()
            if found.wants == "play" and not call.client.manager_present:
                raise LookupError(_NO_PLAY)
            if (question := found.question(arguments)) and (asked := await _ask(context, params, question)):
                return asked
            work = partial(found.function, call, **arguments)
            answer = self._answer(await (call.drive(work) if found.drives else work()))
        except _FAILURES as error:
            text = _message(error)
            if isinstance(error, SessionTakenOver):
                text = RESTARTED if isinstance(error, ServerRestarted) else TAKEN_OVER
            console.view.note("error", caller.name, params.name, text)
            return types.CallToolResult(content=[types.TextContent(text=text)], is_error=True)
        if found.drives:
            milliseconds = 1e3 * (time.perf_counter() - began)
            console.view.note("call", caller.name, params.name, json.dumps(params.arguments or {}), milliseconds)
        return answer

    def _new_call(self, context: _Context, caller: Caller) -> Call:
        return Call(self._console, caller, self._limits, self._models, context.session.report_progress)

    def _caller(self, context: _Context) -> Caller:
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

    async def _read_resource(
        self, context: _Context, params: types.ReadResourceRequestParams
    ) -> types.ReadResourceResult:
        uri, console = str(params.uri), self._console
        kind, _, name = unquote(uri.removeprefix("urlab://")).partition("/")
        try:
            match kind, name:
                case "cameras", str() if name:
                    await self._new_call(context, self._caller(context)).connected()
                    jpeg = base64.b64encode(await tools.jpeg_of(console.client, name)).decode()
                    picture = types.BlobResourceContents(uri=uri, blob=jpeg, mime_type="image/jpeg")
                    return types.ReadResourceResult(contents=[picture])
                case "model", "":
                    shown: Any = console.client.describe()
                case "log", _:
                    shown = console.view.entries_after(int(name or 0))
                case "recordings", _:
                    shown = await console.recordings.describe(name) if name else console.recordings.list()
                case _:
                    raise LookupError(f"No resource has the address {uri!r}, only {', '.join(_ADDRESSES)}.")
        except _FAILURES as error:
            raise MCPError(types.INVALID_PARAMS, _message(error)) from None
        contents = types.TextResourceContents(uri=uri, text=encode(shown).decode(), mime_type="application/json")
        return types.ReadResourceResult(contents=[contents])


async def _list_resources(context: _Context, params: _Page) -> types.ListResourcesResult:
    return types.ListResourcesResult(resources=_RESOURCES)


async def _list_templates(context: _Context, params: _Page) -> types.ListResourceTemplatesResult:
    return types.ListResourceTemplatesResult(resource_templates=_TEMPLATES)


async def _list_prompts(context: _Context, params: _Page) -> types.ListPromptsResult:
    prompts = [
        types.Prompt(
            name=name,
            description=text,
            arguments=[types.PromptArgument(name=one, description=what, required=True) for one, what in takes.items()],
        )
        for name, (text, takes, _) in _PROMPTS.items()
    ]
    return types.ListPromptsResult(prompts=prompts)


async def _get_prompt(context: _Context, params: types.GetPromptRequestParams) -> types.GetPromptResult:
    if params.name not in _PROMPTS:
        raise MCPError(types.INVALID_PARAMS, f"No prompt is called {params.name!r}, only {', '.join(_PROMPTS)}.")
    text, takes, template = _PROMPTS[params.name]
    given = params.arguments or {}
    if given.keys() != takes.keys():
        raise MCPError(types.INVALID_PARAMS, f"{params.name} takes {', '.join(takes)}.")
    content = types.TextContent(text=template.format(**given))
    return types.GetPromptResult(description=text, messages=[types.PromptMessage(role="user", content=content)])


async def _ask(
    context: _Context, params: types.CallToolRequestParams, question: str
) -> types.InputRequiredResult | None:
    """Ask the person at the agent's host, if it can ask: return the question as the result, or None to go on.

    Hosts of the current protocol get the question as the result, and call again with the answer; those of an older one
    are asked while their call waits.

    Raises:
        Stopped: The person does not want it.
    """
    client = context.session.client_params
    offered = None if client is None else client.capabilities.elicitation
    if offered is None or (offered.form is None and offered.url is not None):
        return None
    form = types.ElicitRequestFormParams(message=question, requested_schema={"type": "object", "properties": {}})
    if context.protocol_version >= _ASKS_BY_RESULT:
        answer: Any = (params.input_responses or {}).get(_QUESTION)
        if answer is None:
            return types.InputRequiredResult(input_requests={_QUESTION: types.ElicitRequest(params=form)})
    else:
        answer = await context.session.elicit_form(form.message, form.requested_schema)
    if getattr(answer, "action", "") != "accept":
        raise Stopped(f"A person was asked, and did not agree to {params.name}. Nothing was done.")
    return None


def _message(error: BaseException) -> str:
    return _in_tools(str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error))


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
