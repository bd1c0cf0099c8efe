"""`urlab console`: a page in the browser to see and touch a simulation."""

from __future__ import annotations

import asyncio
import webbrowser
from pathlib import Path

from urlab_client._installation import install_command
from urlab_client.cli._arguments import (
    Commands,
    ServerArguments,
    add_address,
    add_keys,
    add_ports,
    make_client,
    port,
)
from urlab_client.cli._failure import CommandError
from urlab_client.cli._mujoco import import_mujoco

__all__ = ["PAGE_PORT", "ConsoleArguments", "add_parser", "run"]

PAGE_PORT = 8355


class ConsoleArguments(ServerArguments):
    """What the command line says."""

    address: str
    host: str
    port: int
    allow_host: list[str]
    open: bool
    recordings: Path


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "console",
        help="show a simulation in the browser, and interact with it",
        description="Serve a page that shows a simulation and lets you interact with it, only on this machine, and "
        "print a link that admits one browser. The page can create more links. Ends with exit code 0 on SIGINT "
        "(Ctrl-C) and SIGTERM.",
        examples=(
            ("urlab console", "the server on this machine, at a link for your browser"),
            ("urlab console sim://quadruped --open", "a simulated robot, opened in the browser"),
            ("urlab console --port 0", "any free port for the page"),
        ),
    )
    add_address(parser)
    add_ports(parser)
    add_keys(parser)
    parser.add_argument(
        "--port", type=port, default=PAGE_PORT, help="port of the page; 0: any free one (default: %(default)s)"
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="interface to bind (default: %(default)s); others need --allow-host. The page is not encrypted: put it "
        "behind a proxy that does, or an SSH tunnel",
    )
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name under which browsers reach the page, besides this machine's own; repeatable",
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument(
        "--recordings",
        type=Path,
        default=Path("recordings"),
        metavar="FOLDER",
        help="where recordings are kept, made with the first one (default: %(default)s)",
    )
    parser.set_defaults(run=run)


def run(arguments: ConsoleArguments) -> int:
    """Serve the page until told to stop.

    Raises:
        CommandError: An option cannot be honoured, or the `web` extra is not installed.
        OSError: The port is in use.
    """
    try:
        import prometheus_client  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]
        import uvicorn  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]

        from urlab_client.web import Access  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise CommandError(f"{error.name or error} is not installed; run: {install_command('web')}") from None
    if arguments.host not in {"127.0.0.1", "::1", "localhost"} and not arguments.allow_host:
        raise CommandError(f"--host {arguments.host}: pass --allow-host NAME, the name under which browsers reach it")
    import_mujoco()
    from urlab_client.cli._pages import ending_well  # noqa: PLC0415

    with ending_well():
        asyncio.run(_serve(arguments))
    return 0


async def _serve(arguments: ConsoleArguments) -> None:
    from prometheus_client import REGISTRY  # noqa: PLC0415

    from urlab_client.aio import URLabClient  # noqa: PLC0415
    from urlab_client.cli._pages import bound, serve  # noqa: PLC0415
    from urlab_client.integrations.telemetry import PrometheusObserver  # noqa: PLC0415
    from urlab_client.web import Access, app  # noqa: PLC0415
    from urlab_client.web.access import LOOPBACK  # noqa: PLC0415

    access = Access(hosts=[*LOOPBACK, *(name.lower() for name in arguments.allow_host)])
    # Each camera is streamed while somebody watches it.
    client = make_client(URLabClient, arguments.address, arguments, live_pictures=False, observe=PrometheusObserver())
    async with client:
        with bound(arguments.host, arguments.port) as listener:
            name = arguments.allow_host[0] if arguments.allow_host else "127.0.0.1"
            link = f"http://{name}:{listener.getsockname()[1]}/?token={access.invite()}"

            def started() -> None:
                print(f"{arguments.address} is shown at {link} (good for one browser); Ctrl-C ends it.", flush=True)
                if arguments.open:
                    webbrowser.open(link)

            site = app(client, access=access, recordings=arguments.recordings, metrics=REGISTRY)
            await serve(site, listener, started)
