"""`urlab evaluate`: measure a policy over many seeded episodes.

Run a policy for many episodes, each with its own seed, and print its success rate with Wilson's score interval, and its
return with a bootstrap interval. With --task, the network maps observations of a registered task to actions, as
learning libraries export it; if the task observes pictures, the network's inputs are named after the observations, such
as 'arm/qpos' or 'cameras/arm/overview'. Without --task, a TOML file beside the network declares what it observes, as
for run-policy, and an episode without a fall is a success. Needs the extra 'urlab-client[onnx]', and with --task also
'urlab-client[gym]'.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from urlab_client import aio
from urlab_client.aio.launch import with_model_options, with_option
from urlab_client.cli._arguments import POLICY, TASK, policy_task
from urlab_client.cli._common import CommandError, aligned, import_mujoco, json_line, progress_bar, refusing

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task
    from urlab_client.integrations.policy import Evaluation, Outcome
    from urlab_client.randomise import Randomisation

logger: logging.Logger = logging.getLogger("urlab_client.cli")

_MODEST = ""
_MOST_COPIES = 64

USAGE = f"""
{POLICY}
--robot ROBOT  an MJCF file or the name of a bundled robot (default: as declared)
{TASK.format(" (default: as declared)")}
--episodes N=100  number of episodes
--seconds S  simulated seconds per episode, without --task (default: 10)
--seed SEED=0  seed of the evaluation
--randomise VARIATION?  vary the robot in each episode as a TOML file declares; without it, vary friction by 30 %%,
    damping by 20 %%, masses and strengths by 10 %%, and initial joint positions by 0.05
--confidence P=0.95  coverage of the intervals
--json  print JSON, with the outcome and seed of each episode
examples:
urlab evaluate reach.onnx --task urlab/Reach-v0 --episodes 100  on a task, in a batch
urlab evaluate walk.onnx --randomise
    on the robot of walk.toml, with small variations of masses, friction and more
urlab evaluate walk.onnx --randomise go.toml --json  vary as a file declares; all episodes as JSON
"""


def run(arguments: Namespace) -> int:
    """Evaluate the policy; return 0."""
    import_mujoco()
    if not 0 < arguments.confidence < 1:
        raise CommandError(f"--confidence must be between 0 and 1, not {arguments.confidence:g}")
    declared = _declared(arguments.randomise)
    network, kind, history = policy_task(arguments, "robot", "seconds")
    with progress_bar(arguments.policy.name, arguments.episodes) as progress:
        number = itertools.count(1)

        def show(_: Outcome) -> None:
            progress(next(number))

        options: dict[str, Any] = {
            "episodes": arguments.episodes,
            "seed": arguments.seed,
            "confidence": arguments.confidence,
            "on_episode": show,
        }
        if kind is None:
            found = asyncio.run(_on_robot(arguments, declared, options))
        else:
            found = _in_task(
                min(arguments.episodes, _MOST_COPIES), network, kind, declared, {**options, "history": history}
            )
    if arguments.json:
        print(json_line(found))
    else:
        _print(arguments, found)
    return 0


def _declared(given: str | None) -> Randomisation | None:
    from urlab_client.randomise.declaration import MODEST, Randomisation

    if given is None or given == _MODEST:
        return None if given is None else MODEST
    with refusing(OSError, ValueError, option="--randomise"):
        return Randomisation.of(given)


def _in_task(
    num_envs: int, path: Path, kind: type[Task], declared: Randomisation | None, options: dict[str, Any]
) -> Evaluation:
    from gymnasium.vector import AutoresetMode

    from urlab_client.integrations.gym import URLabBatchEnv
    from urlab_client.integrations.policy import evaluate_in, task_network

    mode = AutoresetMode.DISABLED
    with closing(
        URLabBatchEnv(kind.scene_address, num_envs, task=kind(), randomise=declared, autoreset_mode=mode)
    ) as env:
        spaces = env.single_observation_space, env.single_action_space
        network: Any = task_network(path, *spaces, options["history"])
        return evaluate_in(env, network, **options)


async def _on_robot(arguments: Namespace, declared: Randomisation | None, options: dict[str, Any]) -> Evaluation:
    from urlab_client.integrations.policy import evaluate_on, load

    policy = load(arguments.policy, arguments.declaration)
    model = arguments.robot or policy.spec.robot
    actor = Path(model).stem
    address = with_model_options(policy.spec.simulated(model, actor))
    if declared is None:
        logger.warning("nothing varies, so all episodes are the same; --randomise varies the robot")
    else:
        address = with_option(address, "randomise", declared.to_json())
    async with aio.URLabClient(address, step_mode="direct", mujoco_version_check=False) as client:
        await client.discover()
        return await evaluate_on(client, policy, articulation=actor, seconds=arguments.seconds or 10.0, **options)


def _print(arguments: Namespace, found: Evaluation) -> None:
    title = f"{arguments.policy.name}, {len(found.outcomes)} episodes, seed {arguments.seed}"
    rows = [("", "mean", f"{found.confidence:.0%} interval")]
    if (rate := found.success_rate) is not None:
        rows.append(("success rate", f"{rate.value:.1%}", f"{rate.low:.1%} to {rate.high:.1%}"))
    for name, estimate in (("return", found.mean_return), ("actions", found.mean_actions)):
        rows.append((name, f"{estimate.value:.2f}", f"{estimate.low:.2f} to {estimate.high:.2f}"))
    print(title, aligned(rows, right=(1, 2)), sep="\n")
