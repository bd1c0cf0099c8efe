"""`urlab record`: record a run to a file.

Record states, poses and pictures of a play session to a file that Foxglove opens. In live mode, physics runs by itself
and this command watches; if it is paused, it runs until the end of the recording. In direct mode, this command resets
and steps it, with all set-points zero or those of the keyframe. With --task, it runs episodes of a task, with actions
of zero, and records rewards, success and goals, too. Opens a session, which takes the server over from the client that
drives it; your own program can call record(client, FILE) instead. Ctrl-C ends the recording early. Exit code 1 if
states were dropped or a camera sent no picture. Needs the extra 'urlab-client[mcap]', and with --task also
'urlab-client[gym]'.
"""

from __future__ import annotations

import asyncio
import contextlib
from argparse import Namespace
from typing import TYPE_CHECKING, Any

from urlab_client import aio
from urlab_client.cli._arguments import (
    CAMERA,
    CAMERA_HZ,
    CLIENT,
    STEP_MODE,
    TASK,
    address_usage,
    make_client,
    task_named,
)
from urlab_client.cli._common import CommandError, check_recording, counted, import_mujoco, progress_bar, refusing
from urlab_client.cli._watching import announced_wait, interruptible, recording_options, run_session, task_environment
from urlab_client.enums import StepMode

if TYPE_CHECKING:
    from urlab_client.integrations.record import AsyncRecorder, Recorder

_INCOMPLETE = 1
_ROUNDING_S = 1e-9

USAGE = f"""
{address_usage("ADDRESS?", "a simulated server for --task, else tcp://localhost")}
OUTPUT  the file to write, a .mcap file
{TASK.format("")}
--seed SEED=0  with --task: seed of the episodes
{STEP_MODE.format("", " (default: live; direct with --task)")}
--seconds S=10  simulated seconds
--keyframe NAME  keyframe to start from, in direct mode
{CAMERA.format("a camera to record")}
{CAMERA_HZ.format(30)}
--contacts  also record contacts
--overwrite  replace OUTPUT if it exists
{CLIENT}
examples:
urlab record run.mcap --seconds 30  thirty seconds of the server on this machine, in live mode
urlab record sim://arm run.mcap --step-mode direct --camera all
    a simulated robot, stepped by this command, with every camera
urlab record go.mcap --task my_tasks:Go --camera all  episodes of a task of your own, on a simulated robot
urlab record lab-pc:5559 run.mcap --camera arm/wrist --camera-hz 15  another machine and one of its cameras
"""


def run(arguments: Namespace) -> int:
    """Record; return 1 if states were dropped or a camera sent no picture, else 0."""
    import_mujoco()
    if arguments.keyframe is not None and arguments.task is not None:
        raise CommandError("--keyframe cannot be combined with --task, which determines the start")
    if arguments.task is not None and arguments.step_mode == StepMode.LIVE:
        raise CommandError("--step-mode live cannot be combined with --task, whose episodes this command steps")
    if arguments.keyframe is not None and arguments.step_mode != StepMode.DIRECT:
        raise CommandError("--keyframe resets the simulation, which needs --step-mode direct")
    if arguments.task is None:
        arguments.address = arguments.address or "tcp://localhost"
    check_recording(arguments.output, arguments)
    if arguments.camera and (arguments.address is None or arguments.address.startswith("sim://")):
        from urlab_client.simulation.opengl import need_backend

        need_backend()  # the server that this command starts renders on this machine
    with refusing(KeyError):
        recorder = asyncio.run(_record(arguments)) if arguments.task is None else _record_task(arguments)
    stats = recorder.stats
    held = f"{counted(stats.states, 'state')}, {counted(stats.frames, 'picture')}, {stats.file_bytes / 2**20:.1f} MiB"
    text = f"{arguments.output}  {held}"
    if stats.dropped_states or stats.dropped_frames:
        text += f"; dropped {stats.dropped_states} and {stats.dropped_frames}"
    print(text)
    return _INCOMPLETE if stats.dropped_states or recorder.without_pictures else 0


def _record_task(arguments: Namespace) -> Recorder:
    """Run episodes of a task with actions of zero, or the nearest that the action space allows."""
    import gymnasium
    import numpy as np

    from urlab_client.integrations.record import record

    with task_environment(arguments, task_named(arguments.task)) as env:
        recorder = record(env.client, arguments.output, **recording_options(arguments))
        spaces: Any = gymnasium.spaces
        space = spaces.flatten_space(env.action_space)
        still = spaces.unflatten(env.action_space, np.clip(np.zeros(space.shape, space.dtype), space.low, space.high))
        seed, done, over = arguments.seed, 0.0, True
        with (
            contextlib.suppress(KeyboardInterrupt),
            recorder,
            progress_bar(f"recording {arguments.output.name}", arguments.seconds) as progress,
        ):
            while done < arguments.seconds - _ROUNDING_S and not recorder.failed:
                before = env.client.sim_time
                if over:
                    env.reset(seed=seed)
                    seed, over = None, False
                    continue
                *_, terminated, truncated, info = env.step(still)
                over = terminated or truncated
                done += info["sim_time"] - before
                progress(done)
    return recorder


async def _record(arguments: Namespace) -> AsyncRecorder:
    from urlab_client.integrations.record import record

    client = make_client(aio.URLabClient, arguments.address, arguments, step_mode=arguments.step_mode or StepMode.LIVE)
    async with client:
        with announced_wait(client):
            await client.discover()
        recorder = record(client, arguments.output, **recording_options(arguments))
        with interruptible() as stop:
            async with recorder:
                if arguments.step_mode == StepMode.DIRECT:
                    await client.reset(arguments.keyframe)
                with progress_bar(f"recording {arguments.output.name}", arguments.seconds) as progress:
                    await run_session(
                        client, arguments.seconds, over=lambda: stop.is_set() or recorder.failed, progress=progress
                    )
    return recorder
