"""A console whose loops fail goes on, and says so in the log and to its viewers; the program around it is unharmed."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import math
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import pytest
from ports import free_ports
from starlette.applications import Starlette
from starlette.routing import Mount
from waiting import DEADLINE_S, until

from urlab_client.aio import URLabClient, background
from urlab_client.console.controls import Controls
from urlab_client.console.hand_driving import HandDriving
from urlab_client.console.lease import Viewer
from urlab_client.console.messages import Hand
from urlab_client.console.pictures import Feed
from urlab_client.console.replay import Replay
from urlab_client.console.session import ConsoleSession
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import StepMode
from urlab_client.errors import ServerUnreachable, SessionTakenOver
from urlab_client.integrations.record import record
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Reset, ResetOk
from urlab_client.protocol.messages.sim import BeginPie, StopPie
from urlab_client.server import ControllerConfig, SimulatedServer
from urlab_client.web import app

ME = Viewer("key", "me")
LOOPS = [
    (ConsoleSession, "_follow_events"),
    (ConsoleSession, "_keep"),
    (ConsoleSession, "_receive"),
    (ConsoleSession, "_pulse"),
    (Controls, "send_set_points"),
    (Controls, "keep_stepping"),
    (HandDriving, "keep_driving"),
    (Replay, "keep_playing"),
]


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "_PAUSE_S", 0.01)


def once(monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
    """Let the first call of a coroutine function fail."""
    method, calls = getattr(owner, name), iter([True])

    @functools.wraps(method)
    async def failing(*arguments: Any) -> Any:
        if next(calls, False):
            raise MemoryError("none left")
        return await method(*arguments)

    monkeypatch.setattr(owner, name, failing)


@contextlib.asynccontextmanager
async def mounted(folder: Path, mode: str = "direct") -> AsyncGenerator[tuple[URLabClient, ConsoleSession]]:
    """Run a program that mounts a console."""
    with SimulatedServer("arm", play=True) as server:
        async with connected(server, folder, mode) as (client, console):
            yield client, console


@contextlib.asynccontextmanager
async def connected(
    server: SimulatedServer, folder: Path, mode: str
) -> AsyncGenerator[tuple[URLabClient, ConsoleSession]]:
    """Run a program that mounts a console of a server."""
    async with URLabClient(**server.client_options(), step_mode=mode) as client:
        site = app(client, recordings=folder)

        @contextlib.asynccontextmanager
        async def lifespan(_: Starlette) -> AsyncGenerator[None]:
            async with site.router.lifespan_context(site):
                yield

        program = Starlette(routes=[Mount("/console", site)], lifespan=lifespan)
        async with program.router.lifespan_context(program):
            console: ConsoleSession = site.state.console
            await until(lambda: any(entry.what == "session_opened" for entry in console.view.entries))
            yield client, console


def errors(console: ConsoleSession) -> dict[str, str]:
    """Return what viewers read about the console's own errors."""
    return {entry.what: entry.text for entry in console.view.entries if (entry.kind, entry.who) == ("error", "console")}


def logged(caplog: pytest.LogCaptureFixture, name: str) -> bool:
    return any(f"{name} ended unexpectedly" in record.getMessage() and record.exc_info for record in caplog.records)


def test_an_error_names_its_op_once(caplog: pytest.LogCaptureFixture) -> None:
    view = SharedView(URLabClient("tcp://127.0.0.1"))
    view.note("error", "console", "step", "step: no reply from tcp://127.0.0.1:5559.")
    view.note("error", "console", "connect", "hello: connection refused.")
    assert [record.getMessage() for record in caplog.records] == [
        "step: no reply from tcp://127.0.0.1:5559.",
        "connect: hello: connection refused.",
    ]


async def test_a_loss_counts_from_its_first_moment_whatever_is_learnt_of_it(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (_, console):
        await until(lambda: console.link.state == "connected")
        connected = console.link.since
        found: list[float] = []
        for state, reason in (("silent", ""), ("lost", "no reply"), ("lost", "refused"), ("connected", "")):
            console._set_link(state, reason)
            found.append(console.link.since)
        assert connected < found[0] == found[1] == found[2] < found[3]


async def test_a_number_that_the_program_wrote_stops_the_steps_and_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with mounted(tmp_path) as (client, console):
        arm = client.articulations["arm"]
        await console.controls.run(ME, running=True)
        await until(lambda: client.step_count > 0)
        arm.ctrl_array[0] = math.nan
        await until(lambda: not console.controls.running)
        assert "not finite" in errors(console)["step"]
        assert "not finite" in caplog.text
        arm.ctrl_array[0] = 0.0
        stopped = client.step_count
        await console.controls.run(ME, running=True)
        await until(lambda: client.step_count > stopped)


async def test_a_viewer_who_has_lost_the_controls_moves_no_hand(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (client, console):
        await until(lambda: console.view.snapshot is not None)
        console.hands.command(ME, Hand("arm", linear=(0.0, 0.0, -1.0), gripper=1.0))
        console.lease.release(ME)
        console.lease.use(Viewer("other", "Ann"))
        before = client.articulations["arm"].ctrl_array.copy()
        await until(lambda: any((entry.kind, entry.what) == ("error", "hand") for entry in console.view.entries))
        assert "Ann has the controls" in console.view.entries[-1].text
        assert (client.articulations["arm"].ctrl_array == before).all()


async def test_a_number_that_the_program_wrote_is_not_sent_in_live_mode(tmp_path: Path) -> None:
    async with mounted(tmp_path, "live") as (client, console):
        arm = client.articulations["arm"]
        arm.ctrl_array[:] = math.nan
        name, *others = arm.actuators
        console.controls.set_points(ME, {"arm": {name: 0.1}})
        await until(lambda: "set-points" in errors(console))
        assert "finite" in errors(console)["set-points"]
        arm.set_ctrl(dict.fromkeys(others, 0.0))
        console.controls.set_points(ME, {"arm": {name: 0.2}})
        await until(lambda: console.view.snapshot is not None and 0.2 in arm_set_points(console))


async def test_set_points_of_a_play_session_do_not_drive_the_next(tmp_path: Path) -> None:
    async with mounted(tmp_path, "live") as (client, console):
        await until(lambda: console.view.snapshot is not None)
        first, second, *_ = client.articulations["arm"].actuators
        console.controls.set_points(ME, {"arm": {first: 0.4}})
        await until(lambda: 0.4 in shown_targets(console))
        await console.controls.do(ME, StopPie())
        await until(lambda: any(entry.what == "play_ended" for entry in console.view.entries))
        await console.controls.do(ME, BeginPie())
        console.controls.set_points(ME, {"arm": {second: 0.2}})
        await until(lambda: 0.2 in arm_set_points(console))
        assert 0.4 not in arm_set_points(console)


async def test_a_new_play_session_while_the_console_steps_is_no_failure(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (client, console):
        await console.controls.run(ME, running=True)
        await until(lambda: client.step_count > 0)
        await console.controls.do(ME, StopPie())
        await console.controls.do(ME, BeginPie())
        assert not console.controls.running
        assert [entry.text for entry in console.view.entries if entry.kind == "error"] == []


async def test_after_a_replay_that_moved_the_simulation_the_console_steps_as_before(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (client, console):
        async with record(client, tmp_path / "run.mcap"):
            for _ in range(3):
                await client.step()
        for stop in (False, True):
            await console.controls.run(ME, running=True)
            await console.begin_replay(tmp_path / "run.mcap")
            assert console.controls.running, "behind the replay the simulation goes on"
            await console.begin_replay(tmp_path / "run.mcap", placing=True)
            assert (client.step_mode, console.controls.running) == ("puppet", False)
            with pytest.raises(ValueError, match="no physics runs"):
                await console.controls.run(ME, running=True)
            if stop:
                await console.controls.run(ME, running=False)
            await console.end_replay()
            assert (client.step_mode, console.controls.running) == ("direct", not stop)
        await console.controls.run(ME, running=True)
        with pytest.raises(FileNotFoundError):
            await console.begin_replay(tmp_path / "none.mcap", placing=True)
        assert console.controls.running


@pytest.mark.parametrize("mode", ["live", "direct"])
async def test_a_reset_begins_without_earlier_set_points(mode: str, tmp_path: Path) -> None:
    async with mounted(tmp_path, mode) as (client, console):
        await until(lambda: console.view.snapshot is not None)
        arm = client.articulations["arm"]
        first = next(iter(arm.actuators))
        for keyframe in (None, "home"):
            console.controls.set_points(ME, {"arm": {first: 0.4}})
            assert arm.ctrl_array[0] == 0.4
            reply = await console.controls.do(ME, Reset(keyframe_name=keyframe))
            assert isinstance(reply, ResetOk)
            applied = reply.per_articulation["arm"].ctrl
            assert applied is not None
            assert keyframe or not applied.any()
            assert arm.ctrl_array.tolist() == applied.tolist()
            if mode == "live":
                await until(lambda: 0.4 not in arm_set_points(console))
        arm.set_ctrl({first: 0.3})  # by the program around it, which goes on
        await console.controls.do(ME, Reset())
        assert arm.ctrl_array[0] == 0.3


async def test_set_points_of_an_earlier_client_are_shown_kept_and_ended_by_a_reset(tmp_path: Path) -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        async with URLabClient(**server.client_options(), step_mode="live") as earlier:
            await earlier.discover()
            first, second, *_ = earlier.articulations["arm"].actuators
            earlier.articulations["arm"].set_ctrl({first: 0.4})
            await earlier.step()
        async with connected(server, tmp_path, "live") as (client, console):
            await until(lambda: shown_targets(console)[:1] == [0.4])
            console.controls.set_points(ME, {"arm": {second: 0.1}})
            assert client.articulations["arm"].ctrl_array[:2].tolist() == pytest.approx([0.4, 0.1])
        async with connected(server, tmp_path, "live") as (_, console):
            await until(lambda: 0.4 in shown_targets(console))
            await console.controls.do(ME, Reset())
            await until(lambda: not any(arm_set_points(console)))


async def test_a_moved_joint_leaves_the_set_points_of_a_controller_as_they_are(tmp_path: Path) -> None:
    """Weight holds the joints away from their set-points: what is measured must not become what is commanded."""
    pd = {"quadruped": ControllerConfig(kp=40.0, kv=1.5)}
    with SimulatedServer("quadruped", play=True, controllers=pd) as server:
        async with URLabClient(**server.client_options(), step_mode="direct") as client:
            await client.discover()
            robot = client.articulations["quadruped"]
            robot.set_ctrl({"FL_thigh": 0.3})
            await client.step(2000)
            wanted = robot.ctrl_array.tolist()
            assert max(abs(robot.dof_qpos - wanted)) > 0.05
        async with connected(server, tmp_path, "direct") as (client, console):
            await until(lambda: shown_targets(console, "quadruped") != [])
            assert shown_targets(console, "quadruped") == pytest.approx(wanted, abs=0.002)
            console.controls.set_points(ME, {"quadruped": {"FL_hip": 0.1}})
            robot = client.articulations["quadruped"]
            assert robot.ctrl_array.tolist() == pytest.approx([0.1, *wanted[1:]], abs=0.002)


@pytest.mark.parametrize("mode", ["live", "direct"])
async def test_after_a_reset_a_controller_keeps_the_pose_of_the_start(mode: str, tmp_path: Path) -> None:
    pd = {"quadruped": ControllerConfig(kp=40.0, kv=1.5)}
    with SimulatedServer("quadruped", play=True, unpaused=True, controllers=pd) as server:
        async with connected(server, tmp_path, mode) as (client, console):
            await until(lambda: shown_targets(console, "quadruped") != [])
            console.controls.set_points(ME, {"quadruped": {"FL_thigh": 0.5}})
            if mode == "direct":
                await console.controls.step(ME, 100)
            robot = client.articulations["quadruped"]
            thigh = robot.joints["FL_thigh"]
            await until(lambda: float(thigh.position) > 0.2)
            reply = await console.controls.do(ME, Reset())
            assert isinstance(reply, ResetOk)
            start = float(reply.per_articulation["quadruped"].qpos[thigh.qpos_local_offset])
            assert robot.actuators["FL_thigh"].value == pytest.approx(start, abs=0.002)
            console.controls.set_points(ME, {"quadruped": {"FL_thigh": 0.5}})
            if mode == "direct":
                await console.controls.step(ME, 100)
            await until(lambda: float(thigh.position) > 0.2)
        async with connected(server, tmp_path, "live") as (client, console):  # a console that was started anew
            await until(lambda: (shown_targets(console, "quadruped")[1:2] or [0.0])[0] > 0.4)
            await console.controls.do(ME, Reset())
            assert client.articulations["quadruped"].actuators["FL_thigh"].value == pytest.approx(start, abs=0.002)


@pytest.mark.parametrize("held", [True, False], ids=["held", "driven"])
async def test_set_points_are_not_sent_to_a_server_that_was_started_again(held: bool, tmp_path: Path) -> None:
    """Its controller takes the torques that held a pose, or a viewer's, for angles."""
    ports = free_ports()
    pd = {"quadruped": ControllerConfig(kp=40.0, kv=1.5)}
    with SimulatedServer("quadruped", play=True, **ports) as server:
        async with connected(server, tmp_path, "direct") as (client, console):
            await until(lambda: console.view.snapshot is not None)
            if held:
                await console.controls.hold(ME, "quadruped", True)
            else:
                console.controls.set_points(ME, {"quadruped": {"FL_thigh": 8.0}})
            await console.controls.step(ME, 100)
            robot, session = client.articulations["quadruped"], client.session_id
            assert abs(robot.ctrl_array).max() > 5.0
            server.close()
            with SimulatedServer("quadruped", play=True, controllers=pd, **ports):
                await until(lambda: client.session_id != session and console.link.state == "connected")
                await until(lambda: abs(robot.ctrl_array).max() < 3.0)
                await until(lambda: console.view.snapshot is not None and console.view.snapshot.time < 0.1)
                await console.controls.step(ME, 1)
                assert list(console.controls.holding) == []
                assert robot.ctrl_array.tolist() == pytest.approx(robot.dof_qpos.tolist(), abs=0.05)


async def test_a_robot_that_was_held_is_held_again_in_a_session_that_is_taken_back(tmp_path: Path) -> None:
    with SimulatedServer("quadruped", play=True) as server:
        async with connected(server, tmp_path, "direct") as (client, console):
            await until(lambda: console.view.snapshot is not None)
            await console.controls.hold(ME, "quadruped", True)
            await console.controls.step(ME, 100)
            async with URLabClient(**server.client_options(), step_mode="direct") as other:
                await other.discover()
                other.articulations["quadruped"].set_ctrl({"FL_thigh": 8.0, "RR_calf": 3.0})
                await other.step(5)
                with contextlib.suppress(SessionTakenOver):
                    await client.runtime.forward()
                await until(lambda: console.link.state == "taken_over")
                assert console.status(ME).holding == [], "in the steps of the other program nothing holds it"
            console.reconnect()
            await until(lambda: console.link.state == "connected")
            assert console.status(ME).holding == ["quadruped"]
            await console.controls.step(ME, 2000)
            assert console.status(ME).holding == ["quadruped"]
            assert client.articulations["quadruped"].root_pos_w[2] > 0.28


async def test_the_torques_of_a_hold_end_with_it(tmp_path: Path) -> None:
    with SimulatedServer("quadruped", play=True) as server:
        async with connected(server, tmp_path, "direct") as (client, console):
            await until(lambda: console.view.snapshot is not None)
            robot = client.articulations["quadruped"]
            await console.controls.hold(ME, "quadruped", True)
            await console.controls.step(ME, 100)
            robot.set_ctrl({"FL_thigh": 1.0})  # by the program around it
            await console.controls.step(ME, 1)
            assert {name: one.value for name, one in robot.actuators.items() if one.value} == {"FL_thigh": 1.0}


async def test_posing_takes_time_so_that_it_can_be_recorded(tmp_path: Path) -> None:
    async with mounted(tmp_path, "puppet") as (client, console):
        joint = next(name for name, one in client.articulations["arm"].joints.items() if one.kind == "hinge")
        before = client.sim_time
        for value in (0.1, 0.2):
            await console.posing.place(ME, {"arm": {joint: value}})
            assert client.sim_time > before
            assert client.sim_time - before < 1.0
            before = client.sim_time


async def test_a_stop_ends_a_large_number_of_steps(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (client, console):
        many = asyncio.ensure_future(console.controls.step(ME, 1_000_000))
        await until(lambda: client.step_count > 0)
        await console.controls.run(ME, running=False)
        done = await many
        assert 0 < done.step == client.step_count < 1_000_000


async def test_the_log_says_once_who_sets_which_set_points(tmp_path: Path) -> None:
    async with mounted(tmp_path) as (client, console):
        first, second, *_ = client.articulations["arm"].actuators
        for value in (0.1, 0.2, 0.3):
            console.controls.set_points(ME, {"arm": {first: value}})
        console.controls.set_points(ME, {"arm": {second: 0.1}})
        said = [(entry.who, entry.text) for entry in console.view.entries if entry.what == "set-points"]
        assert said == [("me", f'{{"arm":["{name}"]}}') for name in (first, second)]


def shown_targets(console: ConsoleSession, robot: str = "arm") -> list[float]:
    found = json.loads(console.view.state_json or "{}").get("articulations", {}).get(robot, {}).get("targets")
    return found or []


def arm_set_points(console: ConsoleSession) -> list[float]:
    assert console.view.snapshot is not None
    ctrl = console.view.snapshot.per_articulation["arm"].ctrl
    return [] if ctrl is None else [round(value, 6) for value in ctrl.tolist()]


async def test_each_loop_goes_on_after_a_failure(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for owner, name in LOOPS:
        once(monkeypatch, owner, name)
    async with mounted(tmp_path) as (client, console):
        for _, name in LOOPS:
            what = name.lstrip("_")
            assert "MemoryError: none left" in errors(console)[what]
            assert logged(caplog, f"urlab-web-{what}")
        await until(lambda: console.view.state_json is not None)
        await console.controls.run(ME, running=True)
        await until(lambda: client.step_count > 0)


async def test_a_mode_that_changes_meanwhile_makes_no_step_of_set_points(tmp_path: Path) -> None:
    async with mounted(tmp_path, "live") as (client, console):
        actuator = next(iter(client.articulations["arm"].actuators))
        session = client._session
        async with session.turn(SetMode) as turn:
            console.controls.set_points(ME, {"arm": {actuator: 0.1}})
            await until(lambda: session.state_lock._waiting or session.request_lock._waiting)
            await client._state.mode.ask(turn, StepMode.DIRECT)
        assert (await client.step()).step == 1
        assert errors(console) == {}


@pytest.mark.opengl
async def test_pictures_go_on_after_a_failure(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    once(monkeypatch, Feed, "_run")
    async with mounted(tmp_path, "live") as (_, console):
        feed = console.cameras.feed("arm/wrist")
        assert feed is not None
        async with feed.watch(), asyncio.timeout(DEADLINE_S):
            assert (await feed.after(0)).jpeg
        assert "MemoryError: none left" in errors(console)["camera arm/wrist"]
        assert logged(caplog, "urlab-web-camera")


async def test_a_server_that_stays_away_is_told_once_for_each_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons = iter(["within 4997 ms: refused", "within 5000 ms: refused", "within 5000 ms: no such host"])
    tried = asyncio.Event()

    async def refused(_: ConsoleSession) -> None:
        reason = next(reasons, None)
        if reason is None:
            tried.set()
            await asyncio.Event().wait()
        raise ServerUnreachable(f"no connection {reason}.")

    monkeypatch.setattr(ConsoleSession, "_discover", refused)
    monkeypatch.setattr("urlab_client.console.session._RETRY_S", 0.0)
    async with URLabClient(address="tcp://127.0.0.1:1") as client:
        console = ConsoleSession(client, recordings=tmp_path)
        async with console.open(), asyncio.timeout(DEADLINE_S):
            await tried.wait()
            told = [entry.text for entry in console.view.entries if entry.what == "connect"]
    assert told == ["no connection within 4997 ms: refused.", "no connection within 5000 ms: no such host."]
