"""What `urlab record` and `urlab view` do while simulation time passes: what interrupts them, and what does not."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from children import DEADLINE_S, in_background
from forked import COMMAND, program
from ports import free_port
from relay import Relay
from waiting import eventually, until

from urlab_client.aio import URLabClient
from urlab_client.aio.explain import watched
from urlab_client.cli import _watching, main
from urlab_client.cli._common import CommandError
from urlab_client.cli._watching import run_session
from urlab_client.integrations.record import read_run
from urlab_client.server import SimulatedServer

HEARTBEATS = 100
"""Bytes of more heartbeats than come while a step is on its way; the reply to one is larger."""


@pytest.fixture
async def server() -> AsyncIterator[SimulatedServer]:
    async with SimulatedServer("ball", play=True) as made:
        yield made


async def test_a_connection_that_breaks_between_step_and_reply_is_no_end(server: SimulatedServer) -> None:
    options = server.client_options()
    async with (
        Relay(options["step_port"]) as relay,
        URLabClient(**(options | {"step_port": relay.port}), step_mode="direct") as client,
    ):
        await client.discover()
        going = asyncio.create_task(run_session(client, 0.5, over=lambda: False))
        relay.hold_replies()
        await relay.until_held(HEARTBEATS)
        relay.cut()
        relay.thaw()
        await going
        assert client.transport_stats.connects == 2
        assert client.sim_time == pytest.approx(0.5)
        assert client.step_count == 250


async def test_another_client_that_takes_over_meanwhile_is_an_end(server: SimulatedServer) -> None:
    options = server.client_options()
    async with (
        Relay(options["step_port"]) as relay,
        URLabClient(**(options | {"step_port": relay.port}), step_mode="direct") as client,
        URLabClient(**options) as thief,
    ):
        await client.discover()
        going = asyncio.create_task(run_session(client, None, over=lambda: False))
        relay.hold_replies()
        await relay.until_held(HEARTBEATS)
        await thief.discover()
        relay.cut()
        relay.thaw()
        with pytest.raises(CommandError, match="another client took the session over"):
            await going


async def test_what_a_server_simulated_before_does_not_count(server: SimulatedServer) -> None:
    async with URLabClient(**server.client_options(), step_mode="direct") as before:
        await before.discover()
        await before.step(200)
    passed: list[float] = []
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        await run_session(client, 0.2, over=lambda: False, progress=passed.append)
        assert client.sim_time >= 0.4 + 0.2 - 1e-9
    assert passed[0] < 0.2 <= passed[-1] + 1e-9


@pytest.mark.parametrize("paused", [True, False])
async def test_physics_is_left_as_it_was(
    server: SimulatedServer, paused: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        await client.runtime.set_paused(paused)
        await run_session(client, 0.1, over=lambda: False)
        assert client.sim_time >= 0.1
        assert ("physics was paused: it runs until this command ends" in capsys.readouterr().err) == paused
        before = await client.sim.status()
        after = await watched(client.sim.status, before)
        assert (after.sim_time == before.sim_time) == paused


async def test_resets_do_not_prolong_it(server: SimulatedServer) -> None:
    async with URLabClient(**server.client_options(), step_mode="direct") as client:
        await client.discover()
        resets, passed = list[asyncio.Task[object]](), list[float]()

        def progress(done: float) -> None:
            passed.append(done)
            if client.sim_time > 0.2 and all(reset.done() for reset in resets):
                resets.append(asyncio.create_task(client.reset()))

        await run_session(client, 0.5, over=lambda: len(resets) > 10, progress=progress)
    assert len(resets) in (2, 3), "one after each 0.2 s"
    assert passed == sorted(passed)
    assert passed[-1] == pytest.approx(0.5)


async def test_live_mode_ends_when_play_does(server: SimulatedServer) -> None:
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        going = asyncio.create_task(run_session(client, None, over=lambda: False))
        await until(lambda: client.sim_time > 0)
        await client.sim.stop()
        with pytest.raises(CommandError, match="play has ended"):
            await going


async def test_live_mode_ends_when_the_server_stays_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_watching, "_AWAY_S", 0.2)
    server = SimulatedServer("ball", play=True)
    await asyncio.to_thread(server.start)
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        going = asyncio.create_task(run_session(client, None, over=lambda: False))
        await until(lambda: client.sim_time > 0)
        await asyncio.to_thread(server.close)
        with pytest.raises(CommandError, match=r"unreachable for 0\.2 s|play has ended"):
            await going


async def test_live_mode_ends_when_no_state_arrives(server: SimulatedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_watching, "_FIRST_STATE_S", 0.2)
    options = server.client_options() | {"state_port": free_port()}
    async with URLabClient(**options, step_mode="live") as client:
        await client.discover()
        with pytest.raises(CommandError, match=r"no state arrived within 0\.2 s; .* pass --state-port"):
            await run_session(client, 1.0, over=lambda: False)


def test_a_recording_without_states_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(_watching, "_FIRST_STATE_S", 0.2)
    with SimulatedServer("ball", play=True) as server:
        ports = ["--step-port", server.step_port, "--state-port", free_port()]
        assert main(["record", server.address, str(tmp_path / "run.mcap"), *map(str, ports)]) == 2
    assert "no state arrived" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("mode", ["direct", "live"])
def test_ctrl_c_ends_a_recording_early_and_whole(mode: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    command = ["record", "sim://ball", path, "--step-mode", mode, "--seconds", "1000"]
    with program(COMMAND, *command, cwd=tmp_path) as recording:
        eventually(lambda: path.exists() and path.stat().st_size > 2_000)
        recording.send_signal(signal.SIGINT)
        out, err = recording.communicate(timeout=DEADLINE_S)
    assert (recording.returncode, err) == (0, "")
    assert out.startswith(f"{path}  ")
    assert read_run(path).summary().complete


async def test_in_the_background_only_sigterm_ends_it() -> None:
    with in_background(), _watching.interruptible() as stop:
        signal.raise_signal(signal.SIGINT)
        await asyncio.sleep(0)
        assert not stop.is_set()
        signal.raise_signal(signal.SIGTERM)
        await asyncio.wait_for(stop.wait(), DEADLINE_S)


def test_record_says_that_it_waits_for_the_server(tmp_path: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    with program(COMMAND, "record", address, "run.mcap", cwd=tmp_path) as recording:
        assert recording.stderr is not None
        assert recording.stderr.readline() == f"waiting for the server at {address} …\n"
        recording.send_signal(signal.SIGTERM)
        recording.communicate(timeout=DEADLINE_S)
