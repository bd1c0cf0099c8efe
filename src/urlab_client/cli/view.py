"""`urlab view`: show a simulation or a recording in MuJoCo's window, in a browser, in Rerun or in Foxglove.

Show a play session while it runs. In live mode, physics runs by itself and this command watches; in direct mode, this
command resets and steps it, with all set-points zero. Opens a session, which takes the server over from the client that
drives it; your own program can call rerun_view(client) or one of its siblings instead. Ctrl-C ends it. --rerun needs
the extra 'urlab-client[rerun]', --foxglove 'urlab-client[foxglove]', --web 'urlab-client[web]'. A recording needs no
server, but the extra 'urlab-client[mcap]': Rerun gets all of it at once, the others show it at its own pace, again and
again. MuJoCo does not check the model in it, so show only recordings from sources that you trust.
"""

from __future__ import annotations

import asyncio
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from urlab_client import aio
from urlab_client.cli import console
from urlab_client.cli._arguments import (
    CAMERA,
    CAMERA_HZ,
    CLIENT,
    STEP_MODE,
    Parser,
    add_usage,
    address_or_recording,
    address_usage,
    cameras,
    make_client,
)
from urlab_client.cli._common import CommandError, counted, import_mujoco, refusing
from urlab_client.cli._watching import announced_wait, interruptible, run_session
from urlab_client.enums import StepMode

if TYPE_CHECKING:
    from urlab_client.integrations.view import ViewStats
    from urlab_client.integrations.view.view import ViewBackend

_PORTS = {"foxglove": 8765, "rerun": 9090}

USAGE = f"""
{address_usage(or_else="; or FILE.mcap, a recording")}
| --viewer  MuJoCo's own window, which needs a display (default)
| --web  the console's page with MuJoCo's web viewer, for browsers
| --rerun  Rerun's window; with --save a file, with --connect another viewer, with --page a page for browsers
| --foxglove  a server that Foxglove connects to
--save FILE  with --rerun: write an .rrd file, show nothing
--connect VIEWER  with --rerun: send to a viewer, rerun+http://HOST:9876/proxy
--page  with --rerun: serve Rerun's page for browsers; Rerun serves it on every interface, to anyone
--port PORT  port for --web, --foxglove or --page
{STEP_MODE.format("=live", "")}
--seconds S  simulated seconds (default: until Ctrl-C)
{CAMERA.format("a camera to show in Rerun or Foxglove")}
{CAMERA_HZ.format(10)}
--sensors  show sensor readings in Rerun or Foxglove
--max-hz HZ=30  states shown per second
{CLIENT}
examples:
urlab view sim://quadruped  MuJoCo's window
urlab view --rerun --camera all  the server on this machine in Rerun, with every camera
urlab view sim://arm --rerun --save arm.rrd --seconds 5  five seconds as a Rerun file
urlab view --foxglove  a server that Foxglove connects to
urlab view run.mcap  a recording in MuJoCo's window
urlab view run.mcap --web  a recording in the console's page, for browsers
"""


KINDS = {"address": address_or_recording}


def run(arguments: Namespace) -> int:
    """Show the simulation until stopped."""
    arguments.where = next((name for name in ("web", "rerun", "foxglove") if getattr(arguments, name)), "viewer")
    if arguments.where != "rerun" and (arguments.save or arguments.connect or arguments.page):
        raise CommandError("--save, --connect and --page require --rerun")
    if sum(map(bool, (arguments.save, arguments.connect, arguments.page))) > 1:
        raise CommandError("give one of --save, --connect and --page")
    recorded = isinstance(arguments.address, Path)
    if recorded:
        arguments.address.stat()  # whether the file exists matters more than whether there is a display
    if arguments.where == "web":
        return _show_console(arguments)
    if arguments.where == "viewer":
        from urlab_client.integrations.view.view import missing_for_window

        missing = missing_for_window()
        if missing:
            raise CommandError(f"{missing}; without a window, use --web, --rerun --page or --foxglove")
    else:
        import_mujoco()
    with refusing(KeyError, ValueError):
        stats = asyncio.run((_view_recording if recorded else _view)(arguments))
    shown = f"{counted(stats.states, 'state')}, {counted(stats.frames, 'picture')} shown"
    print(f"{shown}; {counted(stats.dropped_states, 'state')} skipped")
    return 0


def _show_console(arguments: Namespace) -> int:
    if arguments.camera or arguments.sensors or arguments.seconds is not None:
        raise CommandError(
            "--camera, --sensors and --seconds do not apply to --web, which shows everything until Ctrl-C"
        )
    parser = Parser()
    add_usage(parser, console.USAGE, console.KINDS)
    return console.run(parser.parse_args([str(arguments.address)], arguments))  # the rest has its default


async def _view(arguments: Namespace) -> ViewStats:
    from urlab_client.integrations.view import AsyncView

    client = make_client(aio.URLabClient, arguments.address, arguments, step_mode=arguments.step_mode)
    async with client:
        with announced_wait(client):
            await client.discover()
        if arguments.step_mode == StepMode.DIRECT:
            await client.reset()
        options: dict[str, Any] = {"camera_hz": arguments.camera_hz, "max_hz": arguments.max_hz, "contacts": True}
        view = AsyncView(client, _backend(arguments), "urlab view", cameras=cameras(arguments.camera), **options)
        with interruptible() as stop:
            async with view:
                _announce(arguments, view.address)
                await run_session(client, arguments.seconds, over=lambda: stop.is_set() or view.closed)
    if view.error is not None:
        raise CommandError(f"the view ended: {view.error}")
    return view.stats


async def _view_recording(arguments: Namespace) -> ViewStats:
    from urlab_client.integrations.record import read_run
    from urlab_client.integrations.view.view import show_recording

    run, backend = read_run(arguments.address), _backend(arguments)
    chosen = cameras(arguments.camera or ["all"] * (arguments.where != "viewer"))
    with interruptible() as stop:
        return await asyncio.to_thread(
            show_recording,
            run,
            backend,
            opened=lambda: _announce(arguments, backend.address),
            over=stop.is_set,
            paced=arguments.where != "rerun",
            cameras=run.cameras() if chosen == "all" else chosen,
            max_hz=arguments.max_hz,
            seconds=arguments.seconds,
        )


def _backend(arguments: Namespace) -> ViewBackend:
    if arguments.where == "viewer":
        from urlab_client.integrations.view.view import WindowBackend

        return WindowBackend()
    port = _PORTS[arguments.where] if arguments.port is None else arguments.port
    if arguments.where == "foxglove":
        from urlab_client.integrations.view.foxglove_view import FoxgloveBackend

        return FoxgloveBackend(host="127.0.0.1", port=port, sensors=arguments.sensors)
    from urlab_client.integrations.view.rerun_view import RerunBackend

    target: dict[str, Any] = {"save": arguments.save, "connect": arguments.connect, "web": arguments.page}
    return RerunBackend(**target, web_port=port, sensors=arguments.sensors)


def _announce(arguments: Namespace, address: str) -> None:
    where = arguments.save or arguments.connect or address or f"the {arguments.where} window"
    exposure = " Rerun serves it on every interface of this machine, to anyone." if arguments.page else ""
    print(f"{arguments.address} is shown: {where}; Ctrl-C ends it.{exposure}", flush=True)
