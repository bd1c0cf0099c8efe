"""`urlab demo`: author a level, drive a robot through both clients, and write the results to disk.

The demo starts its own simulated server, so it needs only this package, or uses a running server.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import platform
from collections.abc import Callable, Generator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from urlab_client._extras import need
from urlab_client._whole_files import replaced
from urlab_client.cli._arguments import (
    Commands,
    ServerArguments,
    add_dialect,
    add_keys,
    add_ports,
    count,
    running_address,
)
from urlab_client.cli._common import CommandError, import_mujoco, output

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from urlab_client.cli.demo_runs import DemoRun, Outcome
    from urlab_client.cli.robot_file import RobotFile
    from urlab_client.protocol.base import DialectName

__all__ = ["add_parser", "run"]

_ASYNC_SHARE = 4  # the async run takes a quarter of the steps
_REPORT_EVERY = 20  # steps between two updates of the progress bar


class DemoArguments(ServerArguments):
    """The parsed command line."""

    model: str
    address: str | None
    dialect: DialectName
    output: Path
    steps: int
    no_render: bool


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "demo",
        help="drive a robot end to end; keep a plot, a picture and the configuration",
        description="Start a simulated server, or use a running one, author levels, drive one robot through the "
        "blocking client and two robots through the async client, and write joints.png, last_state.png and run.json. "
        "Needs the extra 'urlab-client[demo]'.",
        examples=(
            ("urlab demo", "the bundled quadruped; results in urlab-demo/"),
            ("urlab demo robot.xml --steps 500 --output run1", "your own model"),
            ("urlab demo arm --no-render", "without a picture of the last state"),
            ("urlab demo robot.xml --address tcp://lab-7", "on a running server, whose play session it ends"),
        ),
    )
    parser.add_argument(
        "model",
        nargs="?",
        default="quadruped",
        metavar="MODEL",
        help="an MJCF file or the name of a bundled robot (default: %(default)s)",
    )
    parser.add_argument(
        "--address",
        type=running_address,
        metavar="ADDRESS",
        help="HOST[:PORT], tcp://HOST[:PORT] or ipc://PATH of a running server (default: start one). The demo ends "
        "play there and opens its own levels; it uploads a model that is not on the server's disk, if the server "
        "accepts uploads",
    )
    add_ports(parser, state=False)
    add_keys(parser)
    add_dialect(parser)
    parser.add_argument(
        "--output", type=Path, default=Path("urlab-demo"), metavar="DIR", help="where to write (default: %(default)s)"
    )
    parser.add_argument(
        "--steps",
        type=count,
        default=2000,
        metavar="N",
        help="steps of the blocking run; the async run takes a quarter (default: %(default)s)",
    )
    parser.add_argument("--no-render", action="store_true", help="do not draw the picture of the last state")
    parser.set_defaults(run=run, mjcf_options=False)


def run(arguments: DemoArguments) -> int:
    """Run the demonstration.

    Raises:
        CommandError: The model or the output folder cannot be used, or the server cannot load the model.
        MissingExtra: A library is missing.
        URLabError: The server refused a request.
    """
    need("matplotlib", "PIL", "rich", extra="demo")
    import_mujoco()

    from urlab_client.cli.demo_controllers import NOTHING_DRIVEN  # noqa: PLC0415
    from urlab_client.cli.demo_runs import drive_one, drive_two  # noqa: PLC0415
    from urlab_client.cli.demo_server import running_server, started_server  # noqa: PLC0415
    from urlab_client.cli.robot_file import read_robot  # noqa: PLC0415

    robot = read_robot(arguments.model)
    folder = _writable(arguments.output)
    steps, fewer = arguments.steps, max(1, arguments.steps // _ASYNC_SHARE)
    console = output()
    address = arguments.address
    place = started_server(robot, arguments.dialect) if address is None else running_server(robot, address, arguments)
    with _warnings_of(robot), place as server, _progress(console) as progress:
        one = drive_one(server, steps, _bar(progress, "blocking client, one robot", steps))
        two = asyncio.run(drive_two(server, fewer, _bar(progress, "async client, two robots", fewer)))
    console.print(_table(robot, [one.outcome, two.outcome]))
    if not one.driven:
        console.print(f"{robot.name}: {NOTHING_DRIVEN}; gravity alone moves it.", soft_wrap=True, highlight=False)
    written = _write(folder, robot, one, two, address=address, render=not arguments.no_render)
    for file, note in written.items():
        console.print(f"{file}  {note}", soft_wrap=True, highlight=False)
    return 0


@contextlib.contextmanager
def _warnings_of(robot: RobotFile) -> Generator[None]:
    """Hide the server's warnings about bundled robots: the only one is about the floor in each copy."""
    logger = logging.getLogger("urlab_client.server")
    before = logger.level
    if robot.bundled:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(_Probed), replaced(folder / "probe"):
            raise _Probed
    except OSError as error:
        raise CommandError(f"--output {folder}: cannot write there: {error.strerror or error}") from None
    return folder


class _Probed(Exception):
    """Raised to discard the probe file."""


def _progress(console: Console) -> Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, console=console)


def _bar(progress: Progress, description: str, steps: int) -> Callable[[], None]:
    """Return a callback to invoke after each step."""
    bar = progress.add_task(description, total=steps)
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if done % _REPORT_EVERY == 0 or done == steps:
            progress.update(bar, completed=done)

    return advance


def _table(robot: RobotFile, outcomes: list[Outcome]) -> Table:
    from rich import box  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    table = Table(title=f"{robot.name}, direct mode", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("client")
    for heading in ("robots", "steps", "sim (s)", "steps/s", "real-\ntime\nfactor"):
        table.add_column(heading, justify="right")
    table.add_column("final base pose\nx y z (m)\nquaternion w x y z", no_wrap=True)
    for outcome in outcomes:
        table.add_row(
            outcome.client,
            str(outcome.robots),
            str(outcome.steps),
            f"{outcome.sim_time:.3f}",
            f"{outcome.steps_per_second:.0f}",
            f"{outcome.real_time_factor:.2f}",
            "\n".join(
                _numbers(values) for pose in outcome.final_base_poses for values in (pose.position, pose.quaternion)
            ),
        )
    return table


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:6.3f}" for value in values)


def _write(
    folder: Path, robot: RobotFile, one: DemoRun, two: DemoRun, *, address: str | None, render: bool
) -> dict[Path, str]:
    """Write the files and return what is in each, or why it is missing."""
    from urlab_client.cli.figures import plot_trace  # noqa: PLC0415
    from urlab_client.cli.picture import NoPicture, draw_state  # noqa: PLC0415

    plot, picture, record = folder / "joints.png", folder / "last_state.png", folder / "run.json"
    plot_trace(one.trace, plot)
    moment = one.outcome.sim_time
    notes = {plot: f"joint positions over the {moment:.3f} s of the blocking run"}
    drawn_by: str | None = None
    if render:
        try:
            drawn_by = draw_state(one.model, one.data, picture)
            notes[picture] = f"last state of the blocking run, after {moment:.3f} s (OpenGL: {drawn_by})"
        except NoPicture as reason:
            notes[picture] = f"not drawn: {reason}"
    else:
        notes[picture] = "not drawn: --no-render"
    if drawn_by is None:
        picture.unlink(missing_ok=True)  # one of an earlier run would show another state
    configuration = _configuration(robot, one, two) | {"address": address, "opengl": drawn_by}
    with replaced(record) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(configuration), indent=2) + b"\n")
    notes[record] = "versions, model, options, seed and results"
    return notes


def _configuration(robot: RobotFile, one: DemoRun, two: DemoRun) -> dict[str, Any]:
    import mujoco  # noqa: PLC0415

    from urlab_client.cli.demo_runs import SEED  # noqa: PLC0415

    option = one.model.opt
    return {
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            "python": platform.python_version(),
            "platform": platform.platform(),
            **{name: version(name) for name in ("urlab-client", "mujoco", "numpy", "pyzmq", "msgspec")},
        },
        "model": {
            "name": robot.name,
            "path": str(robot.path),
            "sha256": hashlib.sha256(robot.path.read_bytes()).hexdigest(),
        },
        "options": {
            "step_mode": "direct",
            "timestep": option.timestep,
            "integrator": mujoco.mjtIntegrator(option.integrator).name,
            "cone": mujoco.mjtCone(option.cone).name,
            "solver": mujoco.mjtSolver(option.solver).name,
            "gravity": option.gravity.tolist(),
        },
        "seed": SEED,
        "controllers": {
            run.outcome.level: [controller.settings for controller in run.controllers] for run in (one, two)
        },
        "runs": [one.outcome, two.outcome],
        "joints_png_and_last_state_png": one.outcome.level,
    }
