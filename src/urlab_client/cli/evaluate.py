"""`urlab evaluate`: measure a policy over many seeded episodes."""

from __future__ import annotations

import argparse
import asyncio
import logging
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from urlab_client.aio.launch import with_model_options, with_option
from urlab_client.cli._arguments import Commands, count, seconds
from urlab_client.cli._common import CommandError, import_mujoco, json_line, output, progress_bar

if TYPE_CHECKING:
    from collections.abc import Callable

    from urlab_client.integrations.policy import Evaluation, Outcome
    from urlab_client.randomise import Randomisation

logger: logging.Logger = logging.getLogger("urlab_client.cli")

_MODEST: Final = ""
_MOST_COPIES: Final = 64


class EvaluateArguments(argparse.Namespace):
    """The parsed command line."""

    policy: Path
    task: str | None
    robot: str | None
    declaration: Path | None
    episodes: int
    seconds: float | None
    seed: int
    randomise: str | None
    confidence: float
    json: bool


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "evaluate",
        help="measure how good a policy is, with confidence intervals",
        description="Run a policy for many episodes, each with its own seed, and print its success rate with Wilson's "
        "score interval, and its return with a bootstrap interval. With --task, the network maps observations of a "
        "registered task to actions, as learning libraries export it; if the task observes pictures, the network's "
        "inputs are named after the observations, such as 'arm/qpos' or 'cameras/arm/overview'. Without --task, a TOML "
        "file beside the network declares what it observes, as for run-policy, and an episode without a fall is a "
        "success. Needs the extra 'urlab-client[onnx]', and with --task also 'urlab-client[gym]'.",
        examples=(
            ("urlab evaluate reach.onnx --task urlab/Reach-v0 --episodes 100", "on a task, in a batch"),
            (
                "urlab evaluate walk.onnx --randomise",
                "on the robot of walk.toml, with small variations of masses, friction and more",
            ),
            (
                "urlab evaluate walk.onnx --randomise go.toml --json",
                "vary as a file declares; all episodes as JSON",
            ),
        ),
    )
    parser.add_argument("policy", type=Path, metavar="POLICY", help="the network, a .onnx file")
    parser.add_argument("--task", metavar="ID", help="a registered task, such as urlab/Reach-v0")
    parser.add_argument(
        "--declaration",
        type=Path,
        metavar="FILE",
        help="the .toml file (default: the one beside POLICY with the same name)",
    )
    parser.add_argument(
        "--robot", metavar="ROBOT", help="an MJCF file or the name of a bundled robot (default: as declared)"
    )
    parser.add_argument("--episodes", type=count, default=100, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--seconds", type=seconds, metavar="S", help="simulated seconds per episode, without --task (default: 10)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the evaluation (default: 0)")
    parser.add_argument(
        "--randomise",
        nargs="?",
        const=_MODEST,
        metavar="FILE",
        help="vary the robot in each episode as a TOML file declares; without FILE, vary friction by 30 %%, damping "
        "by 20 %%, masses and strengths by 10 %%, and initial joint positions by 0.05",
    )
    parser.add_argument(
        "--confidence", type=float, default=0.95, metavar="P", help="coverage of the intervals (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON, with the outcome and seed of each episode")
    parser.set_defaults(run=run)


def run(arguments: EvaluateArguments) -> int:
    """Evaluate the policy; return 0.

    Raises:
        CommandError: An option cannot be used.
        MissingExtra: A library is missing.
        URLabError: A file is invalid, or the policy does not fit.
    """
    import_mujoco()
    if not 0 < arguments.confidence < 1:
        raise CommandError(f"--confidence must be between 0 and 1, not {arguments.confidence:g}")
    if arguments.seed < 0:
        raise CommandError(f"--seed must be at least 0, not {arguments.seed}")
    declared = _declared(arguments.randomise)
    with progress_bar(arguments.policy.name, arguments.episodes) as progress:
        done = 0

        def show(_: Outcome) -> None:
            nonlocal done
            done += 1
            progress(done)

        if arguments.task is None:
            found = asyncio.run(_on_robot(arguments, declared, show))
        else:
            found = _in_task(arguments, arguments.task, declared, show)
    if arguments.json:
        print(json_line(found))
    else:
        _print(arguments, found)
    return 0


def _declared(given: str | None) -> Randomisation | None:
    from urlab_client.randomise.declaration import MODEST, Randomisation

    if given is None or given == _MODEST:
        return None if given is None else MODEST
    try:
        return Randomisation.of(given)
    except (OSError, ValueError) as error:
        raise CommandError(f"--randomise: {error}") from None


def _in_task(
    arguments: EvaluateArguments, task: str, declared: Randomisation | None, show: Callable[[Outcome], None]
) -> Evaluation:
    for name in ("robot", "declaration", "seconds"):
        if getattr(arguments, name) is not None:
            raise CommandError(f"--{name} cannot be combined with --task, which determines it")
    from gymnasium.vector import AutoresetMode

    from urlab_client.integrations.gym import TASKS, URLabBatchEnv
    from urlab_client.integrations.policy import (
        OnnxDictNetwork,
        OnnxNetwork,
        PolicyFileError,
        evaluate_in,
    )

    if task not in TASKS:
        raise CommandError(f"--task: no task is called {task!r}; there are: {', '.join(TASKS)}")
    kind = TASKS[task]
    evaluated = partial(
        evaluate_in,
        episodes=arguments.episodes,
        seed=arguments.seed,
        confidence=arguments.confidence,
        on_episode=show,
    )
    options: dict[str, Any] = {"task": kind(), "randomise": declared, "autoreset_mode": AutoresetMode.DISABLED}
    env = URLabBatchEnv(kind.scene_address, min(arguments.episodes, _MOST_COPIES), **options)
    with closing(env):
        space = env.single_observation_space
        if kind.cameras:
            ((_, box),) = cast("dict[str, Any]", env.single_action_space).items()
            return evaluated(env, OnnxDictNetwork(arguments.policy, space, len(box.low)))
        network = OnnxNetwork(arguments.policy)
        wanted = {"inputs": space.shape, "outputs": env.single_action_space.shape}
        for name, shape in wanted.items():
            if getattr(network, name) not in (None, (shape or (0,))[0]):
                raise PolicyFileError(
                    f"{network.path} has {getattr(network, name)} {name}, but {task} has {(shape or (0,))[0]}."
                )
        return evaluated(env, network)


async def _on_robot(
    arguments: EvaluateArguments, declared: Randomisation | None, show: Callable[[Outcome], None]
) -> Evaluation:
    from urlab_client.aio import URLabClient
    from urlab_client.integrations.policy import evaluate_on, load

    policy = load(arguments.policy, arguments.declaration)
    model = arguments.robot or policy.spec.robot
    actor = Path(model).stem
    address = with_model_options(policy.spec.simulated(model, actor))
    if declared is None:
        logger.warning("nothing varies, so all episodes are the same; --randomise varies the robot")
    else:
        address = with_option(address, "randomise", declared.to_json())
    async with URLabClient(address, step_mode="direct", mujoco_version_check=False) as client:
        await client.discover()
        return await evaluate_on(
            client,
            policy,
            articulation=actor,
            episodes=arguments.episodes,
            seconds=arguments.seconds or 10.0,
            seed=arguments.seed,
            confidence=arguments.confidence,
            on_episode=show,
        )


def _print(arguments: EvaluateArguments, found: Evaluation) -> None:
    from rich import box
    from rich.table import Table

    table = Table(
        title=f"{arguments.policy.name}, {len(found.outcomes)} episodes, seed {arguments.seed}",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    table.add_column("")
    for heading in ("mean", f"{found.confidence:.0%} interval"):
        table.add_column(heading, justify="right")
    if (rate := found.success_rate) is not None:
        table.add_row("success rate", f"{rate.value:.1%}", f"{rate.low:.1%} to {rate.high:.1%}")
    for name, estimate in (("return", found.mean_return), ("actions", found.mean_actions)):
        table.add_row(name, f"{estimate.value:.2f}", f"{estimate.low:.2f} to {estimate.high:.2f}")
    output().print(table)
