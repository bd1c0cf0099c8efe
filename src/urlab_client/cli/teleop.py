"""`urlab teleop`: move a robot's hand with the keyboard, and record each episode.

Move a robot's hand with the keys of this terminal, by inverse kinematics within its joint limits. The simulation is
stepped in real time; an episode begins with the first key. With --record, each episode is saved with the outcome that
you mark with a key, and `urlab convert` makes a LeRobot dataset of the episodes that were not discarded. Opens a
session, which takes the server over from the client that drives it. `urlab console` supports gamepads. Needs the extra
'urlab-client[teleop]', and with --task also 'urlab-client[gym]'.
"""

from __future__ import annotations

import asyncio
import codecs
import contextlib
import importlib
import os
import select
import sys
from argparse import Namespace
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from urlab_client import aio
from urlab_client.aio.launch import with_model_options
from urlab_client.cli._arguments import CLIENT, RECORD, TASK, address_usage, make_client, task_named
from urlab_client.cli._common import CommandError, check_recording, import_mujoco, refusing
from urlab_client.cli._watching import interruptible, recorded

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Task
    from urlab_client.integrations.teleop import TeleopCommand, TeleopTally, TeleopView

_SHOWN_S = 0.1
_MOST = 1024

USAGE = f"""
{address_usage("ADDRESS?", "a simulated server for --task, else tcp://localhost")}
{TASK.format("")}
--robot KEY  the articulation (default: the only one)
--site NAME  the hand, a site of the robot (default: the only one)
--gripper NAME  actuator of the gripper (default: the one that does not move the hand)
--speed M/S=0.25  largest speed of the hand
--turn-speed RAD/S=1  largest turn rate of the hand
--episodes N  end after N episodes that were not discarded
--seconds S  simulated seconds after which an episode ends
--seed SEED=0  seed of initial states and goals
{RECORD}
{CLIENT}
examples:
urlab teleop --task urlab/Reach-v0 --record reach.mcap  a task on a simulated robot, recorded
urlab teleop sim://arm  try it, without a recording
urlab teleop tcp://localhost --robot arm --site grip --record run.mcap --camera arm/wrist
    the robot of a running server, with pictures
"""


def run(arguments: Namespace) -> int:
    """Teleoperate; return 0."""
    import_mujoco()
    check_recording(arguments.record, arguments)
    import urlab_client.integrations.teleop  # noqa: F401  # pyright: ignore[reportUnusedImport]

    task = None if arguments.task is None else task_named(arguments.task)()
    with refusing(KeyError, ValueError), terminal_keys() as keys:
        tally = asyncio.run(_teleoperate(arguments, task, keys))
    where = "" if arguments.record is None else f"{arguments.record}  "
    print(f"{where}{_counts(tally)}")
    return 0


async def _teleoperate(arguments: Namespace, task: Task | None, keys: Callable[[], str]) -> TeleopTally:
    from urlab_client.integrations.teleop import HandControl, KeyboardOperator, TeleopCommand, teleoperate

    address = arguments.address
    if address is None:
        address = "tcp://localhost" if task is None else with_model_options(task.scene_address)
    client = make_client(aio.URLabClient, address, arguments, step_mode="direct")
    async with client:
        await client.discover()
        hand = HandControl(
            client,
            arguments.robot,
            site=arguments.site,
            gripper=arguments.gripper,
            speed=arguments.speed,
            turn_speed=arguments.turn_speed,
        )
        operator, status = KeyboardOperator(keys), _StatusLine()
        with interruptible() as stop:
            _print_keys()

            def operate(view: TeleopView) -> TeleopCommand:
                status.show(view)
                return TeleopCommand(verdict="quit") if stop.is_set() else operator(view)

            async with recorded(client, arguments) as recorder:
                try:
                    return await teleoperate(
                        client,
                        operate,
                        hand=hand,
                        task=task,
                        recorder=recorder,
                        episodes=arguments.episodes,
                        seconds=arguments.seconds,
                        seed=arguments.seed,
                        paced=True,
                    )
                finally:
                    status.end()


def _print_keys() -> None:
    from urlab_client.integrations.teleop.keyboard import HELP

    for key, what in HELP:
        print(f"{key:>14}  {what}", flush=True)


def _counts(tally: TeleopTally) -> str:
    return f"{tally.success} success, {tally.failure} failure, {tally.discarded} discarded"


_WINDOWS_ARROWS: Final = {"H": "\x1b[A", "P": "\x1b[B", "K": "\x1b[D", "M": "\x1b[C"}


@contextlib.contextmanager
def terminal_keys() -> Generator[Callable[[], str]]:
    """Yield a function that returns the characters typed since its last call; restore the terminal afterwards."""
    if not sys.stdin.isatty():
        raise CommandError("keys are read from a terminal, and standard input is not one")
    if os.name == "nt":
        console: Any = importlib.import_module("msvcrt")

        def typed() -> str:
            found = ""
            while console.kbhit() and len(found) < _MOST:
                key = console.getwch()
                # Keys without a character come in two parts; an arrow is returned as other terminals send it.
                found += _WINDOWS_ARROWS.get(console.getwch(), "") if key in "\0\xe0" else key
            return found

        yield typed
        return
    # By name: type checkers know these modules on one kind of system only.
    termios: Any = importlib.import_module("termios")
    tty: Any = importlib.import_module("tty")
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    decode = codecs.getincrementaldecoder("utf-8")(errors="replace").decode
    tty.setcbreak(descriptor)

    def read() -> str:
        if not select.select([descriptor], [], [], 0)[0]:
            return ""
        data = os.read(descriptor, _MOST)
        if not data:
            raise CommandError("the terminal is gone")
        return decode(data)

    try:
        yield read
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class _StatusLine:
    """A status line on standard error."""

    def __init__(self) -> None:
        self._shown_at = -np.inf
        self._on = sys.stderr.isatty()

    def show(self, view: TeleopView) -> None:
        """Rewrite the line, at most every 0.1 seconds."""
        now = asyncio.get_running_loop().time()
        if not self._on or now - self._shown_at < _SHOWN_S:
            return
        self._shown_at = now
        parts = [f"episode {view.episode}", f"{view.time:.1f} s", f"hand {_numbers(view.position)}"]
        parts += [f"{name} {_numbers(np.atleast_1d(value))}" for name, value in view.goal.items()]
        parts += ["success"] if view.success else []
        parts += ["at the edge of reach"] if view.blocked else []
        sys.stderr.write(f"\r{'  '.join(parts)}  [{_counts(view.tally)}]\x1b[K")
        sys.stderr.flush()

    def end(self) -> None:
        """Go to the next line."""
        if self._on and np.isfinite(self._shown_at):
            sys.stderr.write("\n")


def _numbers(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return " ".join(f"{value:+.3f}" for value in values)
