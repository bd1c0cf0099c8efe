"""`urlab run-policy`: a network from an ONNX file drives a robot.

Run a policy: a network in an ONNX file, and a TOML file beside it that declares what the network observes and what its
outputs mean. Refuses to start if the robot, step mode, timestep or controller is not the one that the policy requires.
Without an address it starts a simulated server; with one it opens a session, which takes the server over from the
client that drives it. With --task, or if the declaration names a task, the network maps observations of the task
to actions, as for evaluate, and one episode runs. With --robot, --command, --goal, --step-mode or --compare, the
declaration's terms drive the robot instead. Exit code 1 if the robot fell, or the episode of the task was terminated
without success. Needs the extra 'urlab-client[onnx]', and for tasks also 'urlab-client[gym]'.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urlab_client import aio
from urlab_client.aio.launch import with_model_options
from urlab_client.cli._arguments import CLIENT, POLICY, RECORD, TASK, address_usage, make_client, policy_task
from urlab_client.cli._common import aligned, check_recording, import_mujoco, json_line, progress_bar, refusing
from urlab_client.cli._watching import recorded, recording_options, task_environment
from urlab_client.enums import StepMode

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task
    from urlab_client.integrations.policy import Policy, PolicyRun
    from urlab_client.protocol.base import Floats

_FELL = 1
_SEED = 0
_ROUNDING_S = 1e-9

USAGE = f"""
{POLICY}
{address_usage("ADDRESS?", "a simulated server for --robot or --task")}
--robot ROBOT  an MJCF file or the name of a bundled robot to simulate; with an address, the articulation to drive
    (default: as declared)
{TASK.format(" (default: as declared)")}
--seconds S=10  simulated seconds
--command VX VY WZ  velocity to follow: m/s forward, m/s to the left, rad/s to the left (default: as declared)
--goal NUMBER+  goal to reach, with as many numbers as the declaration's table [goal] has (default: as declared)
--step-mode direct|live  what advances physics (default: the first mode that the declaration allows)
--compare  run zero and random outputs first, for comparison
{RECORD}
--json  print JSON
{CLIENT}
examples:
urlab run-policy walk.onnx  simulates the robot that walk.toml beside it names
urlab run-policy walk.onnx --command 0.5 0 0 --seconds 20 --compare
    walk forward at 0.5 m/s; compare with zero and random outputs
urlab run-policy go.onnx --task my_tasks:Go  an episode of a task of your own, by a network trained for it
urlab run-policy walk.onnx tcp://localhost --record walk.mcap  drive the robot of a running server, and record it
"""


def run(arguments: Namespace) -> int:
    """Run the policy; return 1 if the robot fell, else 0."""
    import_mujoco()
    check_recording(arguments.record, arguments)
    network, kind, history = policy_task(arguments, "robot", "command", "goal", "step_mode", "compare")
    if kind is not None:
        return _in_task(arguments, network, kind, history)
    from urlab_client.integrations.policy import load

    policy = load(arguments.policy, arguments.declaration)
    for name, given in (("command", arguments.command), ("goal", arguments.goal)):
        if given is not None:
            with refusing(ValueError, option=f"--{name}"):
                setattr(policy, name, given)
    runs = asyncio.run(_run(arguments, policy))
    if arguments.json:
        print(json_line(runs))
    else:
        _print(runs)
    return _FELL if runs["policy"].falls else 0


def _in_task(arguments: Namespace, path: Path, kind: type[Task], history: int) -> int:
    """Run one episode of a task; return 1 if it was terminated without success, else 0."""
    from urlab_client.integrations.policy import joined, task_network

    name = arguments.task or kind.__name__
    with (
        task_environment(arguments, kind, max_episode_steps=sys.maxsize) as env,
        contextlib.ExitStack() as stack,
        progress_bar(name, arguments.seconds) as progress,
    ):
        network: Any = task_network(path, env.observation_space, env.action_space, history)
        if arguments.record is not None:
            from urlab_client.integrations.record import record

            with refusing(KeyError, option="--camera"):
                stack.enter_context(record(env.client, arguments.record, **recording_options(arguments)))
        observation, info = env.reset(seed=_SEED)
        seen, total, actions, terminated = [observation] * history, 0.0, 0, False
        began, done = info["sim_time"], 0.0  # a keyframe may have a time
        while not terminated and done < arguments.seconds - _ROUNDING_S:
            seen = [*seen[1:], observation]
            observation, reward, terminated, _, info = env.step(network(joined(seen)))
            total, actions = total + reward, actions + 1
            done = info["sim_time"] - began
            progress(done)
    success = info.get("success")
    found = {"actions": actions, "sim_time": done, "return": total, "success": success}
    if arguments.json:
        print(json_line({**found, "terminated": terminated}))
    else:
        print(f"{arguments.policy.name} in {name}, {done:.1f} s of simulation")
        row = str(actions), f"{total:.3f}", "" if success is None else str(success), str(terminated)
        print(aligned([("actions", "return", "success", "terminated"), row], right=range(4)))
    return _FELL if terminated and not success else 0


async def _run(arguments: Namespace, policy: Policy) -> dict[str, PolicyRun]:
    """Return the result of each run, by the name of its actor."""
    from urlab_client.integrations.policy import require
    from urlab_client.integrations.policy import run as run_policy

    address, articulation = _where(arguments, policy)
    step_mode = arguments.step_mode or policy.spec.step_modes[0]
    client = make_client(aio.URLabClient, address, arguments, step_mode=step_mode)
    actors = {**(_baselines(policy) if arguments.compare else {}), "policy": policy}
    runs: dict[str, PolicyRun] = {}
    async with client:
        await client.discover()
        require(client, policy, articulation)
        for name, actor in actors.items():
            with progress_bar(name, arguments.seconds) as progress:

                def show(so_far: PolicyRun, progress: Callable[[float], None] = progress) -> None:
                    progress(so_far.sim_time)

                async with recorded(client, arguments) if actor is policy else contextlib.nullcontext():
                    runs[name] = await run_policy(
                        client, actor, articulation=articulation, seconds=arguments.seconds, on_action=show
                    )
    return runs


def _where(arguments: Namespace, policy: Policy) -> tuple[str, str | None]:
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


def _print(runs: dict[str, PolicyRun]) -> None:
    last = runs["policy"]
    live = last.step_mode is StepMode.LIVE
    walks = any(found.distance for found in runs.values())  # a fixed base neither walks nor falls
    rows: list[list[str]] = []
    for name, found in runs.items():
        cells = {"outputs": name}
        if walks:
            cells |= {"mean reward": f"{found.reward:.3f}", "forward (m)": f"{found.forward:.2f}"}
            cells |= {"velocity error (m/s)": f"{found.velocity_error:.3f}", "falls": str(found.falls)}
        if found.goal_error is not None:
            cells["goal error"] = f"{found.goal_error:.4f}"
        cells["actions/s"] = f"{found.actions / found.wall_time:.0f}"
        cells |= {"late actions": str(found.late)} if live else {"physics steps/s": f"{found.steps_per_second:.0f}"}
        rows += [[*cells.values()]] if rows else [[*cells], [*cells.values()]]
    print(f"{last.articulation}, {last.step_mode} mode, {last.sim_time:.1f} s of simulation")
    print(aligned(rows, right=range(1, len(rows[0]))))
