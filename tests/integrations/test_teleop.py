"""Teleoperation: velocities of a hand, keys that move it, and recordings of episodes with what became of them."""

from __future__ import annotations

import csv
import io
import math
import os
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from children import child
from waiting import DEADLINE_S, eventually

from urlab_client import URLabError
from urlab_client.aio import URLabClient
from urlab_client.cli import main
from urlab_client.cli import teleop as cli_teleop
from urlab_client.cli.teleop import _StatusLine, terminal_keys
from urlab_client.integrations.gym import Reach
from urlab_client.integrations.record import read_run, record, transitions_of
from urlab_client.integrations.teleop import (
    HandControl,
    KeyboardOperator,
    TeleopCommand,
    TeleopTally,
    TeleopView,
    teleoperate,
)
from urlab_client.server import SimulatedServer

VIEW: Any = None
"""What a keyboard's operator does not look at."""


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True) as made:
        yield made


@pytest.fixture
async def client(server: SimulatedServer) -> AsyncIterator[URLabClient]:
    async with URLabClient(**server.client_options(), step_mode="direct") as made:
        await made.discover()
        await made.reset()
        yield made


def towards(view: TeleopView) -> TeleopCommand:
    """Go straight to the target; a success after a moment there."""
    ahead = view.goal["target"] - view.position
    if np.linalg.norm(ahead) < 0.005:
        return TeleopCommand(verdict="success")
    return TeleopCommand(linear=tuple(ahead / 0.05))


async def test_the_hand_moves_as_fast_as_it_is_told_and_keeps_its_orientation(client: URLabClient) -> None:
    hand = HandControl(client, speed=0.2)
    start, upright = hand.ik.pose()
    for _ in range(50):
        assert hand.drive((0.0, 3.0, 0.0), gripper=1.0, dt=0.02)  # longer than 1 counts as 1
        await client.step(10)
    at, turned = hand.target
    assert at - start == pytest.approx([0.0, 0.2, 0.0], abs=1e-6)
    await client.run_for(0.5)
    assert hand.ik.pose()[0] == pytest.approx(at, abs=0.005)
    assert abs(turned @ upright) == pytest.approx(1.0)
    assert hand.gripper == "gripper"
    assert client.articulations["arm"].get_ctrl()["gripper"] == 0.04
    for _ in range(25):
        hand.drive((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), dt=0.02)
        await client.step(10)
    await client.run_for(0.5)
    w, x, y, z = hand.ik.pose()[1]
    assert 2 * math.atan2(z, w) == pytest.approx(0.5, abs=0.02)
    assert abs(x) + abs(y) < 0.02
    for n in range(80):
        hand.drive((0.0, 0.0, 0.0), (0.0, 0.0, (-1.0) ** n), dt=0.02)
    assert np.linalg.norm(hand.target[1]) == pytest.approx(1.0, abs=1e-9), "rounding does not add up"


async def test_the_target_stops_at_the_edge_and_does_not_run_ahead(client: URLabClient) -> None:
    hand = HandControl(client, speed=1.0)
    before = hand.ik.pose()[0]
    assert hand.drive((1.0, 0.0, 0.0), dt=1.0)
    assert np.linalg.norm(hand.target[0] - before) == pytest.approx(0.1)
    set_points = client.articulations["arm"].get_ctrl()
    for _ in range(100):
        hand.drive((1.0, 0.0, 0.0), dt=0.02)
        await client.step(10)
    assert hand.blocked
    assert client.articulations["arm"].get_ctrl() != set_points
    assert hand.drive((-1.0, 0.0, 0.0), dt=0.02)
    await client.reset()
    hand.hold()
    assert hand.target[0] == pytest.approx(before, abs=1e-6)


async def test_holding_sends_the_set_points_of_where_the_hand_is(client: URLabClient) -> None:
    robot = client.articulations["arm"]
    hand = HandControl(client)
    for _ in range(20):
        hand.drive((0.0, 1.0, 0.0), gripper=1.0, dt=0.02)
        await client.step(10)
    opening = robot.get_ctrl()["gripper"]
    robot.set_ctrl({name: 0.0 for name in hand.set_points if name != "gripper"})
    hand.blocked = True
    hand.hold()
    assert not hand.blocked
    assert robot.get_ctrl().items() >= hand.set_points.items()
    assert robot.get_ctrl()["gripper"] == opening > 0.0
    there = hand.target[0]
    await client.run_for(0.5)
    assert hand.ik.pose()[0] == pytest.approx(there, abs=0.005)


async def test_bad_velocities_and_names_are_refused(client: URLabClient) -> None:
    hand = HandControl(client, "arm", site="grip", gripper="gripper")
    before, set_points = hand.target[0], client.articulations["arm"].get_ctrl()
    for arguments, said in (
        ({"linear": (math.nan, 0, 0)}, "linear takes finite numbers"),
        ({"linear": (0, 0, 0), "angular": (0, 0)}, "angular takes 3 numbers"),
        ({"linear": (0, 0, 0), "gripper": math.inf}, "gripper takes a finite number"),
    ):
        with pytest.raises(ValueError, match=said):
            hand.drive(**arguments, dt=0.02)
    with pytest.raises(ValueError, match="dt must be above 0"):
        hand.drive((1, 0, 0), dt=0.0)
    assert (hand.target[0] == before).all()
    assert client.articulations["arm"].get_ctrl() == set_points
    with pytest.raises(KeyError, match="no site 'hand'"):
        HandControl(client, "arm", site="hand")
    for limit in ({"episodes": 0}, {"seconds": -1.5}, {"seconds": math.nan}):
        ((name, value),) = limit.items()
        with pytest.raises(ValueError, match=f"{name} must be above 0 or None, not {value:g}"):
            await teleoperate(client, towards, **limit)
    assert repr(hand) == "<HandControl of 'grip' of 'arm'>"
    with pytest.raises(ValueError, match="hz must be above 0 and at most"):
        await teleoperate(client, towards, hz=5000.0)


async def test_the_hand_is_one_of_the_named_robot_though_another_begins_with_its_name(tmp_path: Path) -> None:
    longer = tmp_path / "arm_longer.xml"
    body = '<body><joint/><geom size="0.1"/><site name="tip"/></body>'
    longer.write_text(f'<mujoco model="arm_longer"><worldbody>{body}</worldbody></mujoco>')
    with SimulatedServer("arm", longer, play=True) as server:
        async with URLabClient(**server.client_options(), step_mode="direct") as client:
            await client.discover()
            assert HandControl(client, "arm").ik.frame == "grip"
            with pytest.raises(KeyError, match=r"'longer_tip'.*Known: 'grip'"):
                HandControl(client, "arm", site="longer_tip")


async def test_episodes_are_recorded_with_outcome_and_goal(client: URLabClient, tmp_path: Path) -> None:
    def operate(view: TeleopView) -> TeleopCommand:
        if view.episode == 1 and view.time > 0.1:
            return TeleopCommand(verdict="discarded")
        if view.episode == 2 and view.time > 0.1:
            return TeleopCommand(verdict="failure")
        return towards(view)

    file = tmp_path / "reach.mcap"
    async with record(client, file, pose_hz=0) as recorder:
        tally = await teleoperate(
            client, operate, hand=HandControl(client, speed=0.5), task=Reach(), recorder=recorder, episodes=3
        )
        await client.reset()
        await client.step(10)  # an episode that nobody judged
    assert tally == TeleopTally(success=2, failure=1, discarded=1)

    run = read_run(file)
    marks = {mark.episode: mark for mark in run.summary().outcomes}
    assert [mark.outcome for mark in marks.values()] == ["success", "discarded", "failure", "success"]
    kept, good = transitions_of(run), transitions_of(run, only="success")
    assert set(kept.episode.tolist()) == {0, 2, 3}
    assert set(good.episode.tolist()) == {0, 3}
    assert set(transitions_of(run, only="all").episode.tolist()) == {0, 1, 2, 3, 4}
    for episode in (0, 3):
        rows = kept.episode == episode
        target = np.array(marks[episode].goal["target"])
        assert (kept.columns["goal/target"].values[rows] == target).all()
        last = kept.columns["arm/sensors"]
        hand = [last.names.index(f"grip_position.{axis}") for axis in range(3)]
        assert np.linalg.norm(last.values[rows][-1][hand] - target) < 0.02

    table = tmp_path / "reach.csv"
    assert main(["convert", str(file), str(table), "--episodes", "success"]) == 0
    with table.open(encoding="utf-8") as lines:
        found = list(csv.DictReader(lines))
    assert len(found) == len(good)
    assert float(found[0]["goal/target/2"]) == marks[0].goal["target"][2]


async def test_what_is_broken_off_is_discarded(client: URLabClient, tmp_path: Path) -> None:
    def operate(view: TeleopView) -> TeleopCommand:
        if view.time > 0.1:
            return TeleopCommand(verdict="quit")
        return TeleopCommand(gripper=1.0)

    async with record(client, tmp_path / "run.mcap", pose_hz=0) as recorder:
        assert await teleoperate(client, operate, recorder=recorder) == TeleopTally(discarded=1)
        with pytest.raises(ValueError, match="outcome must be one of success, failure, discarded, not 'won'"):
            await recorder.mark("won")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="goal 'target' takes finite numbers"):
            await recorder.mark("success", goal={"target": [math.nan]})
    with pytest.raises(URLabError, match="No recording is under way"):
        await recorder.mark("success")
    assert len(transitions_of(read_run(tmp_path / "run.mcap"))) == 0


async def test_an_episode_ends_by_itself_as_the_task_judges(client: URLabClient) -> None:
    def linger(view: TeleopView) -> TeleopCommand:
        command = towards(view) if view.episode else TeleopCommand(gripper=1.0)
        return TeleopCommand(gripper=1.0) if command.verdict else command

    hand = HandControl(client, speed=0.5)
    tally = await teleoperate(client, linger, hand=hand, task=Reach(), episodes=2, seconds=2.0)
    assert tally == TeleopTally(success=1, failure=1)


def test_keys_move_while_they_repeat() -> None:
    typed, now = [""], [0.0]
    operator = KeyboardOperator(lambda: typed.pop(0) if typed else "", clock=lambda: now[0])
    assert not operator(VIEW).moves
    typed.append("w\x1b[DF")
    assert operator(VIEW).linear == (1.0, 1.0, -0.2)
    now[0] = 0.1
    assert operator(VIEW).linear == (1.0, 1.0, -0.2)
    typed.append("s")
    now[0] = 0.15
    assert operator(VIEW).linear == (-1.0, 0.0, 0.0)
    now[0] = 1.0
    assert not operator(VIEW).moves
    typed += ["q ", " "]
    assert operator(VIEW) == TeleopCommand(angular=(0.0, 0.0, 1.0), gripper=-1.0)
    assert operator(VIEW).gripper == 1.0
    verdicts = {"\r": "success", "n": "failure", "\x7f": "discarded", "\x03": "quit"}
    for key, verdict in verdicts.items():
        typed.append(f"w{key}")
        assert operator(VIEW).verdict == verdict
        assert operator(VIEW) == TeleopCommand(gripper=0.0)
    typed.append("wd\rr")
    assert operator(VIEW).verdict == "success"
    assert operator(VIEW).linear == (0.0, 0.0, 1.0)  # of the next episode


@pytest.mark.parametrize(
    ("sequence", "linear"),
    [
        ("\x1b[A", (1.0, 0.0, 0.0)),
        ("\x1bOB", (-1.0, 0.0, 0.0)),  # as some terminals send it
        ("\x1b[1;2A", (0.2, 0.0, 0.0)),
        ("\x1b[1;2B", (-0.2, 0.0, 0.0)),
        ("\x1b[1;2C", (0.0, -0.2, 0.0)),
        ("\x1b[1;2D", (0.0, 0.2, 0.0)),
        ("\x1b[1;5D", (0.0, 1.0, 0.0)),
        ("\x1b[3~", (0.0, 0.0, 0.0)),
        ("\x1b[H", (0.0, 0.0, 0.0)),
        ("\x1b[F", (0.0, 0.0, 0.0)),
    ],
)
def test_arrows_move_like_their_letters_and_other_keys_do_nothing(
    sequence: str, linear: tuple[float, float, float]
) -> None:
    for cut in range(1, len(sequence) + 1):  # a terminal may deliver the parts of a sequence one after the other
        typed = [sequence[:cut], sequence[cut:]]
        operator = KeyboardOperator(lambda typed=typed: typed.pop(0), clock=lambda: 0.0)
        operator(VIEW)
        assert operator(VIEW) == TeleopCommand(linear=linear)


def test_arrows_are_read_on_windows_and_other_keys_without_a_character_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = [*"w", "\xe0", *"H", "\0", *"S", *"d"]
    console = SimpleNamespace(kbhit=lambda: bool(typed), getwch=lambda: typed.pop(0))
    monkeypatch.setattr(cli_teleop, "os", SimpleNamespace(name="nt"))
    monkeypatch.setitem(sys.modules, "msvcrt", console)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    with terminal_keys() as read:
        assert read() == "w\x1b[Ad"


@pytest.mark.skipif(os.name == "nt", reason="a pseudo-terminal of Unix")
def test_what_is_typed_is_read_without_waiting_and_the_terminal_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    import pty
    import termios

    keyboard, screen = pty.openpty()
    try:
        before = termios.tcgetattr(screen)
        with open(screen, closefd=False, encoding="utf-8") as stdin:
            monkeypatch.setattr("sys.stdin", stdin)
            with terminal_keys() as read:
                assert read() == ""
                os.write(keyboard, "wä".encode())
                assert eventually(read) == "wä"
                assert termios.tcgetattr(screen) != before, "keys come at once, not by lines"
        assert termios.tcgetattr(screen) == before
    finally:
        os.close(keyboard)
        os.close(screen)


@pytest.mark.parametrize("terminal", [True, False])
async def test_a_line_on_the_terminal_says_how_it_goes(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: terminal)
    monkeypatch.setattr("sys.stderr", screen)
    view: Any = SimpleNamespace(
        episode=2,
        time=1.25,
        position=np.array([0.1, -0.2, 0.3]),
        goal={"target": np.array([0.5])},
        success=True,
        blocked=True,
        tally=TeleopTally(success=1, failure=2, discarded=3),
    )
    unused, line = _StatusLine(), _StatusLine()
    unused.end()
    line.show(view)
    line.show(view)  # so soon that nobody could read both
    line.end()
    text = (
        "\repisode 2  1.2 s  hand +0.100 -0.200 +0.300  target +0.500  success  at the edge of reach  "
        "[1 success, 2 failure, 3 discarded]\x1b[K\n"
    )
    assert screen.getvalue() == (text if terminal else "")


@pytest.mark.long
def test_the_command_records_what_is_typed(tmp_path: Path, server: SimulatedServer) -> None:
    import pty

    options, file = server.client_options(), tmp_path / "typed.mcap"
    arguments = [f"tcp://{server.address.rpartition('/')[2]}:{options['step_port']}", "--record", str(file)]
    keyboard, screen = pty.openpty()
    with child("-m", "urlab_client", "teleop", *arguments, "--task", "urlab/Reach-v0", stdin=screen) as process:
        assert process.stdout is not None
        for _ in range(6):  # the keys and what they do: from here on it listens
            process.stdout.readline()
        os.write(keyboard, b"w\nr\x04")  # nothing moved yet when the first episode is judged
        out, error = process.communicate(timeout=DEADLINE_S)
    os.close(keyboard)
    os.close(screen)
    assert process.returncode == 0, error
    assert out == f"{file}  0 success, 0 failure, 0 discarded\n"
    assert read_run(file).summary().complete


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["sim://arm", "--record", "x.csv"], ".mcap"),
        (["sim://arm", "--camera", "arm/wrist"], "--camera and --overwrite require --record"),
        (["--task", "urlab/Reech-v0"], "'urlab/Reech-v0' is not a task. Did you mean 'urlab/Reach-v0'"),
        (["sim://arm"], "keys are read from a terminal"),
    ):
        assert main(["teleop", *arguments]) == 2
        assert said in capsys.readouterr().err
