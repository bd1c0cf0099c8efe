"""Options of the commands that serve pages."""

from __future__ import annotations

import argparse
from pathlib import Path

from urlab_client.cli._arguments import ServerArguments, add_handshake, port
from urlab_client.cli._common import CommandError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class PageArguments(ServerArguments):
    """The parsed command line: options of the page and of the server that it shows."""

    address: str
    host: str
    port: int
    allow_host: list[str]
    open: bool
    recordings: Path


def add_page(parser: argparse.ArgumentParser, default_port: int) -> None:
    """Add the options."""
    add_handshake(parser)
    parser.add_argument(
        "--recordings",
        type=Path,
        default=Path("recordings"),
        metavar="FOLDER",
        help="folder for recordings, created with the first one (default: %(default)s)",
    )
    network = parser.add_argument_group("network")
    network.add_argument(
        "--port", type=port, default=default_port, help="port to serve at; 0: any free one (default: %(default)s)"
    )
    network.add_argument(
        "--host",
        default="127.0.0.1",
        help="interface to bind (default: %(default)s); others need --allow-host. Nothing is encrypted: use a TLS "
        "proxy or an SSH tunnel",
    )
    network.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="host name by which browsers and programs reach the page, besides localhost; repeatable",
    )
    network.add_argument("--open", action="store_true", help="open the page in the browser")


def check_page(arguments: PageArguments) -> None:
    """Refuse an interface that no host name reaches.

    Raises:
        CommandError: The interface is not loopback, and `--allow-host` is missing.
    """
    if arguments.host not in _LOOPBACK and not arguments.allow_host:
        raise CommandError(f"--host {arguments.host}: pass --allow-host NAME, the name by which browsers reach it")


def host_names(arguments: PageArguments) -> list[str]:
    """Return the host names by which the page is reached."""
    return [*_LOOPBACK, *(name.lower() for name in arguments.allow_host)]


def page_url(arguments: PageArguments, number: int) -> str:
    """Return the URL of the page that is served at a port."""
    return f"http://{arguments.allow_host[0] if arguments.allow_host else '127.0.0.1'}:{number}"
