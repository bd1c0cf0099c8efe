"""`urlab run-policy`: a network from an ONNX file drives a robot.

Run a policy: a network in an ONNX file, and a TOML file beside it that declares what the network observes and what its
outputs mean. Refuses to start if the robot, step mode, timestep or controller is not the one that the policy requires.
Without an address it starts a simulated server; with one it opens a session, which takes the server over from the
client that drives it. With --task, the network maps observations of a task to actions, as for evaluate, and one episode
runs. Exit code 1 if the robot fell, or the episode of the task was terminated without success. Needs the extra
'urlab-client[onnx]', and with --task also 'urlab-client[gym]'.
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
from urlab_client.cli._arguments import CLIENT, POLICY, RECORD, TASK, address_usage, cameras, make_client, task_named
from urlab_client.cli._common import (
    CommandError,
    aligned,
    check_recording,
    import_mujoco,
    json_line,
    progress_bar,
    refusing,
)
from urlab_client.cli._watching import recorded
from urlab_client.enums import StepMode

if TYPE_CHECKING:
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
{TASK}
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
    if arguments.task is not None:
        return _in_task(arguments)
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


def _in_task(arguments: Namespace) -> int:
    """Run one episode of a task; return 1 if it was terminated without success, else 0."""
    for name in ("declaration", "robot", "command", "goal", "step_mode", "compare"):
        if getattr(arguments, name):
            raise CommandError(f"--{name.replace('_', '-')} cannot be combined with --task, which determines it")
    kind = task_named(arguments.task)
    from urlab_client.integrations.gym import URLabEnv
    from urlab_client.integrations.policy import task_network
    from urlab_client.integrations.record import record
    from urlab_client.sync.client import URLabClient as BlockingClient

    address = arguments.address or with_model_options(kind.scene_address)
    client = make_client(BlockingClient, address, arguments, step_mode="direct")
    with client, contextlib.ExitStack() as stack:
        client.discover()
        env = stack.enter_context(contextlib.closing(URLabEnv(client, task=kind(), max_episode_steps=sys.maxsize)))
        network: Any = task_network(arguments.policy, env.observation_space, env.action_space)
        if arguments.record is not None:
            options: dict[str, Any] = {"camera_hz": arguments.camera_hz, "overwrite": arguments.overwrite}
            with refusing(KeyError, option="--camera"):
                stack.enter_context(record(client, arguments.record, cameras=cameras(arguments.camera), **options))
        progress = stack.enter_context(progress_bar(arguments.task, arguments.seconds))
        observation, info = env.reset(seed=_SEED)
        total, actions, terminated = 0.0, 0, False
        while not terminated and info["sim_time"] < arguments.seconds - _ROUNDING_S:
            observation, reward, terminated, _, info = env.step(network(observation))
            total, actions = total + reward, actions + 1
            progress(info["sim_time"])
    success = info.get("success")
    found = {"actions": actions, "sim_time": info["sim_time"], "return": total, "success": success}
    if arguments.json:
        print(json_line({**found, "terminated": terminated}))
    else:
        print(f"{arguments.policy.name} in {arguments.task}, {info['sim_time']:.1f} s of simulation")
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
