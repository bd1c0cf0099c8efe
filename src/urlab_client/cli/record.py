"""`urlab record`: a run into a file."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from urlab_client.cli._arguments import (
    ADDRESSES,
    Commands,
    ServerArguments,
    add_cameras,
    add_keys,
    add_ports,
    add_step_mode,
    cameras,
    hertz,
    make_client,
    seconds,
)
from urlab_client.cli._failure import CommandError
from urlab_client.cli._mujoco import import_mujoco
from urlab_client.cli._output import progress_bar
from urlab_client.cli._watching import go_on, interruptible
from urlab_client.protocol.enums import StepMode

if TYPE_CHECKING:
    from urlab_client.integrations.record import AsyncRecorder

__all__ = ["add_parser", "run"]

_DROPPED = 1


class RecordArguments(ServerArguments):
    """What the command line says."""

    address: str
    output: Path
    step_mode: StepMode
    duration: float
    keyframe: str | None
    camera: list[str]
    camera_hz: float
    contacts: bool
    overwrite: bool


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "record",
        help="record a running simulation into an MCAP file",
        description="Record states, poses and pictures of a play session into a file that Foxglove opens. In live mode "
        "physics runs by itself and is watched; in direct mode this command resets and steps it, with all set-points "
        "zero or those of the keyframe. Opens a session, which takes the server over from the client that drives it; a "
        "program of your own can call record(client, FILE). Ctrl-C ends the recording early. Exit code 1 when states "
        "were dropped. Needs the extra 'urlab-client[mcap]'.",
    )
    parser.add_argument("address", metavar="ADDRESS", help=ADDRESSES)
    parser.add_argument("output", type=Path, metavar="FILE", help="the file to write, a .mcap file")
    add_ports(parser)
    add_step_mode(parser)
    parser.add_argument(
        "--seconds", type=seconds, default=10.0, metavar="S", help="simulated seconds (default: %(default)s)"
    )
    parser.add_argument("--keyframe", metavar="NAME", help="keyframe to start from, in direct mode")
    add_cameras(parser, "a camera to keep")
    parser.add_argument(
        "--camera-hz", type=hertz, default=30.0, metavar="HZ", help="pictures per second (default: %(default)s)"
    )
    parser.add_argument("--contacts", action="store_true", help="keep contacts, too")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    add_keys(parser)
    parser.set_defaults(run=run)


def run(arguments: RecordArguments) -> int:
    """Record; return 1 if states were dropped, else 0.

    Raises:
        CommandError: The file or an option cannot be used.
        MissingExtra: A library is missing.
    """
    import_mujoco()
    if arguments.output.exists() and not arguments.overwrite:
        raise CommandError(f"{arguments.output} exists; --overwrite replaces it")
    if arguments.keyframe is not None and arguments.step_mode is not StepMode.DIRECT:
        raise CommandError("--keyframe resets the simulation, which needs --step-mode direct")
    import urlab_client.integrations.record  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]  # is it there?

    try:
        recorder = asyncio.run(_record(arguments))
    except KeyError as error:
        raise CommandError(str(error.args[0])) from None
    stats = recorder.stats
    print(
        f"{arguments.output}  {stats.states} states, {stats.frames} pictures, {stats.file_bytes / 2**20:.1f} MiB"
        + (
            f"; dropped {stats.dropped_states} and {stats.dropped_frames}"
            if stats.dropped_states or stats.dropped_frames
            else ""
        )
    )
    return _DROPPED if stats.dropped_states else 0


async def _record(arguments: RecordArguments) -> AsyncRecorder:
    from urlab_client.aio import URLabClient  # noqa: PLC0415
    from urlab_client.integrations.record import record  # noqa: PLC0415

    client = make_client(URLabClient, arguments.address, arguments, step_mode=arguments.step_mode)
    async with client:
        await client.discover()
        recorder = record(
            client,
            arguments.output,
            cameras=cameras(arguments.camera),
            camera_hz=arguments.camera_hz,
            contacts=arguments.contacts,
            overwrite=arguments.overwrite,
        )
        with interruptible() as stop:
            if arguments.step_mode is StepMode.DIRECT:
                await client.reset(arguments.keyframe)
            async with recorder:
                with progress_bar(f"recording {arguments.output.name}", arguments.seconds) as progress:
                    await go_on(
                        client, arguments.seconds, over=lambda: stop.is_set() or recorder.failed, progress=progress
                    )
    return recorder
