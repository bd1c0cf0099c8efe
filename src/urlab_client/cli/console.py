"""`urlab console`: a page in the browser to see and touch a simulation."""

from __future__ import annotations

import asyncio
import socket
import webbrowser
from contextlib import suppress
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
    with suppress(KeyboardInterrupt):  # Ctrl-C in the moment before uvicorn listens for it
        asyncio.run(_serve(arguments))
    return 0


async def _serve(arguments: ConsoleArguments) -> None:
    import uvicorn  # noqa: PLC0415
    from prometheus_client import REGISTRY  # noqa: PLC0415

    from urlab_client.aio import URLabClient  # noqa: PLC0415
    from urlab_client.integrations.telemetry import PrometheusObserver  # noqa: PLC0415
    from urlab_client.web import Access, app  # noqa: PLC0415
    from urlab_client.web.access import LOOPBACK  # noqa: PLC0415

    access = Access(hosts=[*LOOPBACK, *(name.lower() for name in arguments.allow_host)])
    # Each camera is streamed while somebody watches it.
    client = make_client(URLabClient, arguments.address, arguments, live_pictures=False, observe=PrometheusObserver())
    async with client:
        with _bound(arguments.host, arguments.port) as listener:
            name = arguments.allow_host[0] if arguments.allow_host else "127.0.0.1"
            link = f"http://{name}:{listener.getsockname()[1]}/?token={access.invite()}"
            config = uvicorn.Config(
                app(client, access=access, recordings=arguments.recordings, metrics=REGISTRY),
                log_config=None,
                access_log=False,
                ws="websockets-sansio",
                ws_max_size=1024 * 1024,
                timeout_graceful_shutdown=1,
                proxy_headers=False,
                server_header=False,
            )

            class Server(uvicorn.Server):
                async def startup(self, sockets: list[socket.socket] | None = None) -> None:
                    await super().startup(sockets)
                    if self.started:  # from here on Ctrl-C ends it in good order
                        print(
                            f"{arguments.address} is shown at {link} (good for one browser); Ctrl-C ends it.",
                            flush=True,
                        )
                        if arguments.open:
                            webbrowser.open(link)

            try:
                await Server(config).serve(sockets=[listener])
                await asyncio.sleep(0)
            except asyncio.CancelledError:
                # uvicorn repeats the signal that ended it, and what asyncio makes of it must not break off the closing.
                task = asyncio.current_task()
                if task is None or task.uncancel():
                    raise


def _bound(host: str, number: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends small messages at once only on sockets that say they are TCP; others wait for the peer, up to 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, number))
        listener.listen()  # before the link is printed: whoever is quick waits, and is not refused
    except OSError as error:
        listener.close()
        raise OSError(
            error.errno, f"port {number} of {host} cannot be used: {error.strerror}; --port 0 takes any free one"
        ) from None
    return listener
