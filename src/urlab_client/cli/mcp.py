"""`urlab mcp`: tools for agents, over the Model Context Protocol."""

from __future__ import annotations

import asyncio
import os
import secrets
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from urlab_client.cli._arguments import (
    Commands,
    ServerArguments,
    add_address,
    add_keys,
    add_ports,
    make_client,
    one_of,
    port,
    seconds,
)
from urlab_client.cli._failure import CommandError
from urlab_client.cli._mujoco import import_mujoco
from urlab_client.protocol.enums import StepMode

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from urlab_client.mcp import Agent, Limits
    from urlab_client.web import Access

__all__ = ["AGENT_PORT", "McpArguments", "add_parser", "run"]

AGENT_PORT = 8356
_TOKEN = "URLAB_MCP_TOKEN"  # noqa: S105 - a variable's name


class McpArguments(ServerArguments):
    """What the command line says."""

    address: str
    allow_drive: bool
    allow_edit: bool
    step_mode: StepMode | None
    max_seconds: float
    max_wall: float
    models: Path | None
    recordings: Path
    http: bool
    host: str
    port: int
    allow_host: list[str]
    console: bool
    open: bool


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "mcp",
        help="let an agent look at a simulation, and drive it if you allow that",
        description="Serve tools for agents over the Model Context Protocol, on standard input and output or, with "
        "--http, at an address on this machine. Without --allow-drive and --allow-edit an agent can only look. The "
        "console shows what it does; whoever acts there takes the controls from the agent. Messages for you, as the "
        "console's link, are on standard error. Ends with exit code 0 when its input ends, on SIGINT (Ctrl-C) and on "
        "SIGTERM.",
        examples=(
            ("urlab mcp sim://quadruped --allow-drive", "a simulated robot for an agent that starts this command"),
            ("urlab mcp tcp://localhost", "look at a server that runs already; another client's session ends"),
            ("urlab mcp --http --allow-drive --allow-edit", "at an address, with all tools"),
        ),
    )
    add_address(parser, default="sim://arm")
    add_ports(parser)
    add_keys(parser)
    allowed = parser.add_argument_group("what the agent may do")
    allowed.add_argument("--allow-drive", action="store_true", help="move robots, reset, pause, record")
    allowed.add_argument("--allow-edit", action="store_true", help="import, place, move and remove robots and bodies")
    allowed.add_argument(
        "--max-seconds", type=seconds, default=10.0, metavar="S", help="simulation time per call (default: %(default)g)"
    )
    allowed.add_argument(
        "--max-wall", type=seconds, default=60.0, metavar="S", help="time on the wall per call (default: %(default)g)"
    )
    allowed.add_argument(
        "--step-mode",
        type=one_of(StepMode.LIVE, StepMode.DIRECT),
        metavar="MODE",
        help="direct: time passes only while a tool lets it; live (default: direct with --allow-drive, else as it is)",
    )
    allowed.add_argument(
        "--models",
        type=Path,
        metavar="FOLDER",
        help="folder of MJCF files that may be imported by name, besides the robots that are included",
    )
    allowed.add_argument(
        "--recordings", type=Path, default=Path("recordings"), metavar="FOLDER", help="default: %(default)s"
    )
    network = parser.add_argument_group("network")
    network.add_argument(
        "--http",
        action="store_true",
        help=f"serve streamable HTTP at /mcp, for whoever brings the printed token, or that of ${_TOKEN}",
    )
    network.add_argument(
        "--port",
        type=port,
        default=AGENT_PORT,
        help="port of /mcp and the console; 0: any free one (default: %(default)s, or any free one without --http)",
    )
    network.add_argument(
        "--host", default="127.0.0.1", help="interface to bind (default: %(default)s); others need --allow-host"
    )
    network.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name under which agents and browsers come, besides this machine's own; repeatable",
    )
    network.add_argument("--no-console", dest="console", action="store_false", help="do not show the console")
    network.add_argument("--open", action="store_true", help="open the console in the browser")
    parser.set_defaults(run=run)


def run(arguments: McpArguments) -> int:
    """Serve until the input ends, or a signal says so.

    Raises:
        MissingExtra: The `mcp` extra is not installed.
        CommandError: An option cannot be honoured.
        OSError: The port is in use.
    """
    from urlab_client.mcp import Limits  # noqa: PLC0415

    if arguments.host not in {"127.0.0.1", "::1", "localhost"} and not arguments.allow_host:
        raise CommandError(f"--host {arguments.host}: pass --allow-host NAME, the name under which agents come")
    if arguments.models is not None and not arguments.models.is_dir():
        raise CommandError(f"--models {arguments.models}: there is no such folder")
    import_mujoco()
    limits = Limits(
        drive=arguments.allow_drive,
        edit=arguments.allow_edit,
        sim_seconds=arguments.max_seconds,
        wall_seconds=arguments.max_wall,
    )
    from urlab_client.cli._pages import ending_well  # noqa: PLC0415

    with ending_well():
        asyncio.run(_serve(arguments, limits))
    return 0


async def _serve(arguments: McpArguments, limits: Limits) -> None:
    from urlab_client.aio import URLabClient  # noqa: PLC0415
    from urlab_client.mcp import Agent  # noqa: PLC0415
    from urlab_client.web import Access, app  # noqa: PLC0415
    from urlab_client.web.access import LOOPBACK  # noqa: PLC0415

    hosts = [*LOOPBACK, *(name.lower() for name in arguments.allow_host)]
    access = Access(hosts=hosts)
    mode = arguments.step_mode or (StepMode.DIRECT if arguments.allow_drive else StepMode.AUTO)
    client = make_client(URLabClient, arguments.address, arguments, live_pictures=False, step_mode=mode)
    async with client:
        if arguments.address.startswith("sim://"):  # which fails for good reasons; a server may still come
            await client.discover()
        console = app(client, access=access, recordings=arguments.recordings)
        agent = Agent(console, limits, models=_models(arguments.models))
        async with console.router.lifespan_context(console):
            if arguments.http:
                await _serve_http(arguments, agent, console, access)
            else:
                await _serve_stdio(arguments, agent, console, access)


async def _serve_stdio(arguments: McpArguments, agent: Agent, console: Starlette, access: Access) -> None:
    from urlab_client.cli._pages import bound, serve  # noqa: PLC0415
    from urlab_client.mcp.doors import serve_stdio  # noqa: PLC0415

    if not arguments.console:
        await serve_stdio(agent)
        return
    # A second agent on this machine brings a console, too.
    number = 0 if arguments.port == AGENT_PORT else arguments.port
    with bound(arguments.host, number) as listener:
        served = asyncio.create_task(serve_stdio(agent))
        ended = asyncio.Event()
        served.add_done_callback(lambda _: ended.set())
        try:
            link = _link(arguments, listener.getsockname()[1], access)
            await serve(console, listener, lambda: _tell(arguments, link), ended, lifespan=False)
        finally:
            served.cancel()
            await asyncio.wait((served,))
    if not served.cancelled():
        await served  # raises what it failed with


async def _serve_http(arguments: McpArguments, agent: Agent, console: Starlette, access: Access) -> None:
    from urlab_client.cli._pages import bound, serve  # noqa: PLC0415
    from urlab_client.mcp.doors import http_application  # noqa: PLC0415
    from urlab_client.web import Access  # noqa: PLC0415

    token = os.environ.get(_TOKEN, "") or secrets.token_urlsafe(32)
    own = Access(hosts=access.hosts, tokens=False)
    with bound(arguments.host, arguments.port) as listener:
        number = listener.getsockname()[1]
        link = _link(arguments, number, access)

        def started() -> None:
            shown = f"the token in ${_TOKEN}" if os.environ.get(_TOKEN) else f"Authorization: Bearer {token}"
            print(f"Agents: {_url(arguments, number)}/mcp with {shown}", file=sys.stderr, flush=True)
            if arguments.console:
                _tell(arguments, link)

        application = http_application(agent, console if arguments.console else None, token, own)
        await serve(application, listener, started)


def _tell(arguments: McpArguments, link: str) -> None:
    print(f"Console: {link} (good for one browser); Ctrl-C ends it.", file=sys.stderr, flush=True)
    if arguments.open:
        webbrowser.open(link)


def _link(arguments: McpArguments, number: int, access: Access) -> str:
    return f"{_url(arguments, number)}/?token={access.invite()}"


def _url(arguments: McpArguments, number: int) -> str:
    return f"http://{arguments.allow_host[0] if arguments.allow_host else '127.0.0.1'}:{number}"


def _models(folder: Path | None) -> dict[str, Path]:
    """Return what can be imported by name: what is in the folder, and the robots that are included."""
    from urlab_client.server.assets.bundled_robots import bundled_models  # noqa: PLC0415

    own = {} if folder is None else {file.stem: file.resolve() for file in sorted(folder.glob("*.xml"))}
    return {**bundled_models(), **own}
