"""`urlab console`: a page in the browser that shows a simulation and lets people interact with it.

Serve a page that shows a simulation and lets you interact with it, only on this machine, and print a link that admits
one browser. Enter in the terminal prints another link, and the page can create more; a key in URLAB_CONSOLE_KEY admits
programs, such as Prometheus. A recording needs no server; MuJoCo does not check the model in it, so show only
recordings from sources that you trust. Exits with code 0 on SIGINT (Ctrl-C) and SIGTERM.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import logging
import os
import signal
import sys
import time
import webbrowser
from argparse import Namespace
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from urlab_client import aio
from urlab_client._installation import install_command
from urlab_client._platform.threads import daemon
from urlab_client.cli._arguments import (
    PAGE,
    WATCHER,
    address_or_recording,
    address_usage,
    check_page,
    host_names,
    make_client,
    page_url,
)
from urlab_client.cli._common import CommandError, import_mujoco

_PORT = 8355
_KEY = "URLAB_CONSOLE_KEY"
_KEY_CHARACTERS = 16
_BACKGROUND_S = 1.0

USAGE = f"""
{address_usage(or_else="; or FILE.mcap, a recording")}
{PAGE.format(_PORT)}
--json-log  write the log as lines of JSON
{WATCHER}
examples:
urlab console  the server on this machine, at a link for your browser
urlab console sim://quadruped --open  a simulated robot, opened in the browser
urlab console run.mcap  a recording, with its curves and its time line
urlab console --port 0  any free port for the page
urlab console --handshake robot.hello  watch alongside the driving client
urlab console --public-url https://lab.example/robots/  behind a proxy, which has that address
"""

KINDS = {"address": address_or_recording}


def run(arguments: Namespace) -> int:
    """Serve the page until stopped."""
    try:
        import prometheus_client  # noqa: F401  # pyright: ignore[reportUnusedImport]
        import uvicorn  # noqa: F401  # pyright: ignore[reportUnusedImport]

        from urlab_client.web import Access  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise CommandError(f"{error.name or error} is not installed; run: {install_command('web')}") from None
    check_page(arguments)
    if any(len(key) < _KEY_CHARACTERS for key in _keys()):
        raise CommandError(f"${_KEY}: a key must have at least {_KEY_CHARACTERS} characters")
    if arguments.json_log:
        _log_json()
    import_mujoco()
    if isinstance(arguments.address, Path) and (arguments.handshake or arguments.mjcf_options):
        raise CommandError("--handshake and --mjcf-options are for servers, not for a recording")
    from urlab_client.cli._pages import graceful_exit

    with graceful_exit():
        asyncio.run(_serve(arguments))
    return 0


def _keys() -> list[str]:
    return os.environ.get(_KEY, "").split()


def _log_json() -> None:
    """Write what this program and its libraries log, from INFO, as lines of JSON to standard error."""
    logging.getLogger("urlab_client").handlers.clear()  # the one for people
    lines = logging.StreamHandler()
    lines.setFormatter(_JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[lines], force=True)


class _JsonLines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line = {"at": at, "level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line)


def _print_links(new_link: Callable[[], str]) -> None:
    """Print a link for each line that somebody enters in the terminal."""
    if hasattr(signal, "SIGTTIN"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN})  # in the background, reading fails instead
    while True:
        try:  # not a method of stdin, whose lock would hinder the program's end
            entered = os.read(sys.stdin.fileno(), 1024)
        except OSError:  # in the background, from which the shell may bring it back
            time.sleep(_BACKGROUND_S)
            continue
        if not entered:
            return
        print(f"{new_link()} (good for one browser)", flush=True)


async def _serve(arguments: Namespace) -> None:
    from prometheus_client import REGISTRY

    from urlab_client.cli._pages import bound, serve
    from urlab_client.console.session import ConsoleSession
    from urlab_client.integrations.telemetry import PrometheusObserver
    from urlab_client.web import Access
    from urlab_client.web.application import application_of

    access = Access(hosts=host_names(arguments), keys=_keys())
    recording = arguments.address if isinstance(arguments.address, Path) else None
    handshake = None if arguments.handshake is None else arguments.handshake.read_bytes
    async with contextlib.AsyncExitStack() as stack:
        server: dict[str, Any] = {}
        if recording is not None:
            from urlab_client.console.replay import recorded_handshake
            from urlab_client.integrations.record import read_run
            from urlab_client.server import SimulatedServer

            recorded = await asyncio.to_thread(lambda: recorded_handshake(read_run(recording)))
            handshake = functools.partial(bytes, recorded)
            bare = await stack.enter_async_context(SimulatedServer())  # without robots, it answers and no more
            server = {**bare.client_options(), "read_only": True}
        # Each camera is streamed while a browser shows it.
        options: dict[str, Any] = {"live_pictures": False, "observe": PrometheusObserver()}
        if server:
            client = aio.URLabClient(**server, **options)
        else:
            client = make_client(aio.URLabClient, str(arguments.address), arguments, **options)
        await stack.enter_async_context(client)
        with bound(arguments.host, _PORT if arguments.port is None else arguments.port) as listener:
            url = page_url(arguments, listener.getsockname()[1])

            def new_link() -> str:
                return f"{url}/?token={access.invite()}"

            def started() -> None:
                link, more = new_link(), " Enter prints another link," if sys.stdin and sys.stdin.isatty() else ""
                print(
                    f"{arguments.address} is shown at {link} (good for one browser);{more} Ctrl-C ends it.", flush=True
                )
                if arguments.open:
                    webbrowser.open(link)
                if more:
                    failed = functools.partial(logging.getLogger("urlab_client.web").exception, "no more links: %r")
                    daemon("urlab-console-links", _print_links, new_link, failed=failed).start()

            session = ConsoleSession(client, recordings=arguments.recordings, handshake=handshake, replayed=recording)
            await serve(
                application_of(session, access, REGISTRY), listener, started, public_url=arguments.public_url or ""
            )
