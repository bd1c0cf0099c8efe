"""`urlab mcp`: tools for agents, over the Model Context Protocol.

Serve tools for agents over the Model Context Protocol, on standard input and output or, with --http, at an address on
this machine. Without --allow-drive and --allow-edit, an agent can only look, and does not take a running server over
from another client. The console shows what the agent does; a person who acts there takes the controls from the agent.
The agent need not wait for the server: tools say what is missing, and work once it is there. Messages for
you, such as the console's link, go to standard error. Exits with code 0 when its input ends, on SIGINT
(Ctrl-C) and on SIGTERM.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import sys
import webbrowser
from argparse import Namespace
from collections.abc import Coroutine
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from urlab_client import aio
from urlab_client.cli._arguments import PAGE, WATCHER, address_usage, check_page, host_names, make_client, page_url
from urlab_client.cli._common import CommandError, import_mujoco, sigterm_interrupts
from urlab_client.enums import StepMode
from urlab_client.errors import ServerUnreachable, URLabError

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from urlab_client.console.session import ConsoleSession
    from urlab_client.mcp import Agent
    from urlab_client.web import Access

AGENT_PORT = 8356
_TOKEN = "URLAB_MCP_TOKEN"  # noqa: S105 - a variable's name

USAGE = f"""
{address_usage("ADDRESS=sim://arm")}
{PAGE.format(AGENT_PORT)}
--http  serve streamable HTTP at /mcp, to clients that present the printed token, or one of those in ${_TOKEN},
    separated by spaces; without --http, the console uses any free port unless you pass --port
--agents N=1  with --http: print N tokens, one for each agent, unless ${_TOKEN} has them; one agent drives at a time
--no-console  do not serve the console
what the agent may do:
--allow-drive  move robots, reset, pause, record
--allow-edit  import, place, move and remove robots and bodies
--take-over  without these two: open a session on a running server to look at it; ends another client's session
--max-seconds S=10  simulated seconds per call
--max-wall S=60  wall-clock seconds per call
--step-mode live|direct  direct: time passes only while a tool steps; live: physics runs by itself (default: with
    --allow-drive direct, otherwise unchanged)
--models FOLDER  folder of MJCF files that may be imported by name, besides the bundled robots
{WATCHER}
examples:
urlab mcp sim://quadruped --allow-drive  a simulated robot for an agent that starts this command
urlab mcp tcp://localhost --handshake robot.hello  watch alongside the driving client
urlab mcp tcp://localhost --allow-drive  drive a running server; another client's session ends
urlab mcp --http --allow-drive --allow-edit  at an address, with all tools
urlab mcp --http --public-url https://lab.example/robots/  behind a proxy, which has that address
"""


def run(arguments: Namespace) -> int:
    """Serve until the input ends or a signal arrives."""
    import urlab_client.mcp  # noqa: F401  # pyright: ignore[reportUnusedImport]  # reports a missing extra

    check_page(arguments)
    _check_permissions(arguments)
    if arguments.models is not None and not arguments.models.is_dir():
        raise CommandError(f"--models {arguments.models}: no such folder")
    import_mujoco()
    with contextlib.suppress(KeyboardInterrupt), sigterm_interrupts():
        asyncio.run(_serve(arguments))
    return 0


def _check_permissions(arguments: Namespace) -> None:
    """Refuse contradictory options, and refuse to end another client's session only to look."""
    if arguments.agents > 1 and not arguments.http:
        raise CommandError("--agents requires --http: standard input and output serve one agent")
    takes = arguments.allow_drive or arguments.allow_edit or arguments.take_over
    if arguments.handshake is not None and takes:
        raise CommandError("--handshake is for an agent that only looks: leave out --allow-… and --take-over")
    if arguments.handshake is not None and arguments.step_mode is not None:
        raise CommandError("--step-mode: leave it out with --handshake, because the driving client chooses the mode")
    if arguments.handshake is None and not takes and not arguments.address.startswith("sim://"):
        raise CommandError(
            f"{arguments.address}: an agent that only looks does not take a server over from another client. Pass "
            "--handshake FILE to watch alongside the driving client, --take-over if there is none, or --allow-drive"
        )


async def _serve(arguments: Namespace) -> None:
    from urlab_client.console.session import ConsoleSession
    from urlab_client.mcp import Agent, Limits
    from urlab_client.mcp.transports import serve_stdio

    mode = arguments.step_mode or (StepMode.DIRECT if arguments.allow_drive else StepMode.AUTO)
    client = make_client(aio.URLabClient, arguments.address, arguments, live_pictures=False, step_mode=mode)
    async with client:
        handshake = None if arguments.handshake is None else arguments.handshake.read_bytes
        session = ConsoleSession(client, recordings=arguments.recordings, handshake=handshake)
        limits = Limits(
            drive=arguments.allow_drive,
            edit=arguments.allow_edit,
            sim_seconds=arguments.max_seconds,
            wall_seconds=arguments.max_wall,
        )
        agent = Agent(session, limits, models=_models(arguments.models))
        async with session.open():
            if arguments.http:
                serving = _serve_http(arguments, agent, session)
            elif not arguments.no_console:
                serving = _serve_stdio_and_console(arguments, agent, session)
            else:
                serving = serve_stdio(agent)
            failure = None
            if arguments.address.startswith("sim://"):
                failure = await _serve_unless_start_fails(serving, session)
            else:
                await serving
    if failure is not None:
        raise failure  # outside of the session, whose tasks would wrap it


async def _serve_unless_start_fails(serving: Coroutine[Any, Any, None], session: ConsoleSession) -> URLabError | None:
    """Serve while the simulated server starts, and return its failure.

    It is final, whereas a server that somebody else starts may come later.
    """
    served, opened = asyncio.create_task(serving), asyncio.create_task(session.opened())
    try:
        await asyncio.wait((served, opened), return_when=asyncio.FIRST_COMPLETED)
        if not served.done():
            await opened
        await served
    except ServerUnreachable as error:
        return error
    finally:
        served.cancel()
        opened.cancel()
        await asyncio.wait((served, opened))
    return None


async def _serve_stdio_and_console(arguments: Namespace, agent: Agent, session: ConsoleSession) -> None:
    from urlab_client.cli._pages import bound, serve
    from urlab_client.mcp.transports import serve_stdio

    access, console = _console(arguments, session)
    with bound(arguments.host, _port(arguments)) as listener:
        served = asyncio.create_task(serve_stdio(agent))
        ended = asyncio.Event()
        served.add_done_callback(lambda _: ended.set())
        try:
            url = page_url(arguments, listener.getsockname()[1])
            started = partial(_print_link, arguments, url, access)
            await serve(console, listener, started, ended, public_url=arguments.public_url or "", lifespan=False)
        finally:
            served.cancel()
            await asyncio.wait((served,))
    if not served.cancelled():
        await served  # raises its failure


def _console(arguments: Namespace, session: ConsoleSession) -> tuple[Access, Starlette]:
    from urlab_client.web import Access
    from urlab_client.web.application import application_of

    access = Access(hosts=host_names(arguments))
    return access, application_of(session, access)


def _port(arguments: Namespace) -> int:
    if arguments.port is not None:
        return arguments.port
    return AGENT_PORT if arguments.http else 0  # a second agent on this machine serves a console, too


async def _serve_http(arguments: Namespace, agent: Agent, session: ConsoleSession) -> None:
    from urlab_client.cli._pages import bound, serve
    from urlab_client.mcp.transports import http_application
    from urlab_client.web import Access

    access, console = _console(arguments, session)
    given = os.environ.get(_TOKEN, "").split()
    tokens = given or [secrets.token_urlsafe(32) for _ in range(arguments.agents)]
    with bound(arguments.host, _port(arguments)) as listener:
        url = page_url(arguments, listener.getsockname()[1])

        def started() -> None:
            shown = [f"a token of ${_TOKEN}"] if given else [f"Authorization: Bearer {token}" for token in tokens]
            for one in shown:
                print(f"Agent: {url}/mcp with {one}", file=sys.stderr, flush=True)
            if not arguments.no_console:
                _print_link(arguments, url, access)

        own = Access(hosts=access.hosts, keys=tokens)
        application = http_application(agent, None if arguments.no_console else console, own)
        await serve(application, listener, started, public_url=arguments.public_url or "")


def _print_link(arguments: Namespace, url: str, access: Access) -> None:
    link = f"{url}/?token={access.invite()}"
    print(f"Console: {link} (good for one browser); Ctrl-C ends it.", file=sys.stderr, flush=True)
    if arguments.open:
        webbrowser.open(link)


def _models(folder: Path | None) -> dict[str, Path]:
    """Return the models that can be imported by name: those in the folder, and the bundled robots."""
    from urlab_client.server.assets.bundled_robots import bundled_models

    own = {} if folder is None else {file.stem: file.resolve() for file in sorted(folder.glob("*.xml"))}
    return {**bundled_models(), **own}
