"""`urlab run-policy`: a network from an ONNX file drives a robot."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urlab_client.aio.launch import with_model_options
from urlab_client.cli._arguments import (
    Commands,
    ServerArguments,
    add_address,
    add_cameras,
    add_keys,
    add_ports,
    cameras,
    make_client,
    one_of,
    seconds,
)
from urlab_client.cli._common import CommandError, check_ending, import_mujoco, json_line, output, progress_bar
from urlab_client.enums import StepMode

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient
    from urlab_client.integrations.policy import Policy, PolicyRun
    from urlab_client.protocol.base import Floats

_FELL = 1
_SEED = 0


class RunPolicyArguments(ServerArguments):
    """The parsed command line."""

    policy: Path
    address: str | None
    declaration: Path | None
    robot: str | None
    seconds: float
    twist: list[float] | None
    goal: list[float] | None
    step_mode: StepMode | None
    compare: bool
    record: Path | None
    camera: list[str]
    overwrite: bool
    json: bool


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "run-policy",
        help="let a network from an ONNX file drive a robot",
        description="Run a policy: a network in an ONNX file, and a TOML file beside it that declares what the network "
        "observes and what its outputs mean. Refuses to start if the robot, step mode, timestep or controller is not "
        "the one that the policy requires. Without an address it starts a simulated server; with one it opens a "
        "session, which takes the server over from the client that drives it. Exit code 1 if the robot fell. Needs "
        "the extra 'urlab-client[onnx]'.",
        examples=(
            ("urlab run-policy walk.onnx", "simulates the robot that walk.toml beside it names"),
            (
                "urlab run-policy walk.onnx --command 0.5 0 0 --seconds 20 --compare",
                "walk forward at 0.5 m/s; compare with zero and random outputs",
            ),
            (
                "urlab run-policy walk.onnx tcp://localhost --record walk.mcap",
                "drive the robot of a running server, and record it",
            ),
        ),
    )
    parser.add_argument("policy", type=Path, metavar="POLICY", help="the network, a .onnx file")
    add_address(parser, default=None, otherwise="a simulated server for --robot")
    parser.add_argument(
        "--declaration",
        type=Path,
        metavar="FILE",
        help="the .toml file (default: the one beside POLICY with the same name)",
    )
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="an MJCF file or the name of a bundled robot to simulate; with an address, the articulation to drive "
        "(default: as declared)",
    )
    parser.add_argument(
        "--seconds", type=seconds, default=10.0, metavar="S", help="simulated seconds (default: %(default)s)"
    )
    parser.add_argument(
        "--command",
        dest="twist",
        type=float,
        nargs=3,
        metavar=("VX", "VY", "WZ"),
        help="velocity to follow: m/s forward, m/s to the left, rad/s to the left (default: as declared)",
    )
    parser.add_argument(
        "--goal",
        type=float,
        nargs="+",
        metavar="NUMBER",
        help="goal to reach, with as many numbers as the declaration's table [goal] has (default: as declared)",
    )
    parser.add_argument(
        "--step-mode",
        type=one_of(StepMode.DIRECT, StepMode.LIVE),
        metavar="MODE",
        help="direct or live (default: the first mode that the declaration allows)",
    )
    parser.add_argument("--compare", action="store_true", help="run zero and random outputs first, for comparison")
    parser.add_argument(
        "--record", type=Path, metavar="FILE", help="record the policy's run into a .mcap file (extra 'mcap')"
    )
    add_cameras(parser, "with --record: a camera to record")
    parser.add_argument("--overwrite", action="store_true", help="with --record: replace FILE if it exists")
    parser.add_argument("--json", action="store_true", help="print JSON")
    add_ports(parser)
    add_keys(parser)
    parser.set_defaults(run=run)


def run(arguments: RunPolicyArguments) -> int:
    """Run the policy; return 1 if the robot fell, else 0.

    Raises:
        CommandError: An option cannot be used.
        MissingExtra: A library is missing.
        URLabError: A file is invalid, the policy does not fit, or the server cannot be reached.
    """
    import_mujoco()
    _check_record(arguments)
    from urlab_client.integrations.policy import load

    policy = load(arguments.policy, arguments.declaration)
    if arguments.twist is not None:
        try:
            policy.command = arguments.twist
        except ValueError as error:
            raise CommandError(f"--command: {error}") from None
    if arguments.goal is not None:
        try:
            policy.goal = arguments.goal
        except ValueError as error:
            raise CommandError(f"--goal: {error}") from None
    runs = asyncio.run(_run(arguments, policy))
    if arguments.json:
        print(json_line(runs))
    else:
        _print(runs)
    return _FELL if runs["policy"].falls else 0


def _check_record(arguments: RunPolicyArguments) -> None:
    if arguments.record is None:
        if arguments.camera or arguments.overwrite:
            raise CommandError("--camera and --overwrite require --record")
        return
    check_ending(arguments.record, ".mcap")
    if arguments.record.exists() and not arguments.overwrite:
        raise CommandError(f"{arguments.record} exists; --overwrite replaces it")
    import urlab_client.integrations.record  # noqa: F401  # pyright: ignore[reportUnusedImport]  # fail early


async def _run(arguments: RunPolicyArguments, policy: Policy) -> dict[str, PolicyRun]:
    """Return the result of each run, by the name of its actor."""
    from urlab_client.aio import URLabClient
    from urlab_client.integrations.policy import require
    from urlab_client.integrations.policy import run as run_policy

    address, articulation = _where(arguments, policy)
    step_mode = arguments.step_mode or policy.spec.step_modes[0]
    client = make_client(URLabClient, address, arguments, step_mode=step_mode)
    actors = {**(_baselines(policy) if arguments.compare else {}), "policy": policy}
    runs: dict[str, PolicyRun] = {}
    async with client:
        await client.discover()
        require(client, policy, articulation)
        for name, actor in actors.items():
            with progress_bar(name, arguments.seconds) as progress:

                def show(so_far: PolicyRun, progress: Callable[[float], None] = progress) -> None:
                    progress(so_far.sim_time)

                async with _recorded(client, arguments if actor is policy else None):
                    runs[name] = await run_policy(
                        client, actor, articulation=articulation, seconds=arguments.seconds, on_action=show
                    )
    return runs


def _where(arguments: RunPolicyArguments, policy: Policy) -> tuple[str, str | None]:
    """Return the address, and the articulation if it is not the declared one."""
    if arguments.address is not None:
        return arguments.address, arguments.robot
    model = arguments.robot or policy.spec.robot
    actor = Path(model).stem  # a server names an actor after its file
    return with_model_options(policy.spec.simulated(model, actor)), actor


def _baselines(policy: Policy) -> dict[str, Policy]:
    """Return policies to compare with: the same declaration and command, with zero and random outputs."""
    from urlab_client.integrations.policy import Policy

    low, high = policy.spec.action.clip
    size = len(policy.spec.action.joints)
    rng = np.random.default_rng(_SEED)

    def zero(observation: object) -> Floats:
        return np.zeros(size)

    def random(observation: object) -> Floats:
        return rng.uniform(low, high, size)

    baselines = {
        name: Policy(policy.spec, network, source=name) for name, network in (("zero", zero), ("random", random))
    }
    for baseline in baselines.values():
        if policy.spec.command is not None:
            baseline.command = policy.command
        if policy.spec.goal is not None:
            baseline.goal = policy.goal
    return baselines


@contextlib.asynccontextmanager
async def _recorded(client: URLabClient, arguments: RunPolicyArguments | None) -> AsyncGenerator[None]:
    """Record while the block runs, if `--record` was given."""
    if arguments is None or arguments.record is None:
        yield
        return
    from urlab_client.integrations.record import record

    try:
        async with record(client, arguments.record, cameras=cameras(arguments.camera), overwrite=arguments.overwrite):
            yield
    except KeyError as error:
        raise CommandError(f"--camera: {error.args[0]}") from None


def _print(runs: dict[str, PolicyRun]) -> None:
    from rich import box
    from rich.table import Table

    last = runs["policy"]
    table = Table(
        title=f"{last.articulation}, {last.step_mode} mode, {last.sim_time:.1f} s of simulation",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    table.add_column("outputs")
    live = last.step_mode is StepMode.LIVE
    speed = "late\nactions" if live else "physics\nsteps/s"
    reaches = last.goal_error is not None
    goal = ("goal\nerror",) if reaches else ()
    for heading in ("mean\nreward", "forward\n(m)", "velocity\nerror (m/s)", "falls", *goal, "actions/s", speed):
        table.add_column(heading, justify="right")
    for name, found in runs.items():
        table.add_row(
            name,
            f"{found.reward:.3f}",
            f"{found.forward:.2f}",
            f"{found.velocity_error:.3f}",
            str(found.falls),
            *((f"{found.goal_error:.4f}",) if found.goal_error is not None else ()),
            f"{found.actions / found.wall_time:.0f}",
            str(found.late) if live else f"{found.steps_per_second:.0f}",
        )
    output().print(table)
