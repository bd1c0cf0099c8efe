"""`urlab console FILE`: a console without a simulation, which shows recordings."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import pytest
from waiting import until

import urlab_client
from urlab_client.aio import URLabClient
from urlab_client.console.replay import recorded_handshake
from urlab_client.console.session import ConsoleSession
from urlab_client.integrations.record import RecordingError, read_run, record, recorder
from urlab_client.server import ControllerConfig, SimulatedServer


def record_steps(file: Path, model: str, **server: Any) -> None:
    """Record half a second of a simulation."""
    with (
        SimulatedServer(model, play=True, **server) as running,
        urlab_client.URLabClient(**running.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, file):
            for _ in range(26):
                client.step(n_steps=10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of an arm and of a ball, each of half a second."""
    folder = tmp_path_factory.mktemp("recordings")
    for model in ("arm", "ball"):
        record_steps(folder / f"{model}.mcap", model)
    return folder


@contextlib.asynccontextmanager
async def console_of(file: Path) -> AsyncGenerator[ConsoleSession]:
    handshake = await asyncio.to_thread(lambda: recorded_handshake(read_run(file)))
    async with (
        SimulatedServer() as bare,
        URLabClient(**bare.client_options(), read_only=True, live_pictures=False) as client,
    ):
        console = ConsoleSession(client, recordings=file.parent, handshake=lambda: handshake, replayed=file)
        async with console.open():
            await until(lambda: console.replay.view is not None and not console.replay.view.playing)
            yield console


async def test_it_plays_from_the_start_once_somebody_watches(folder: Path) -> None:
    async with console_of(folder / "arm.mcap") as console:
        assert console.replay.at == 0.0
        with console.new_viewer():
            await until(lambda: console.replay.view is not None and console.replay.at == console.replay.view.seconds)


async def test_where_a_program_has_moved_it_to_it_stays(folder: Path) -> None:
    async with console_of(folder / "arm.mcap") as console:
        await console.replay.change(at=0.3)
        with console.new_viewer() as viewer:
            assert console.status(viewer).viewers == 1
            await until(lambda: len(console.view._watchers) == 0)  # nothing waits for viewers any more
        assert (console.replay.at, console.replay.rate) == (0.3, 0.0)


async def test_set_points_of_a_controller_mean_what_they_did(tmp_path: Path) -> None:
    file = tmp_path / "pd.mcap"
    record_steps(file, "quadruped", controllers={"quadruped": ControllerConfig(kp=40.0, kv=1.5)})
    async with console_of(file) as console:
        (robot,) = console.view.world.articulations
        assert {(one.takes, one.unit) for one in robot.actuators} == {("position", "rad")}
        assert robot.controller is not None
        assert robot.controller.params["kp"]["FL_thigh"] == 40.0


def test_damaged_controllers_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "_about", lambda client: {"controllers": "[1]"})
    record_steps(tmp_path / "run.mcap", "arm")
    with pytest.raises(RecordingError, match="the controllers in its metadata are damaged"):
        recorded_handshake(read_run(tmp_path / "run.mcap"))


async def test_it_opens_recordings_of_other_robots_too(folder: Path) -> None:
    async with console_of(folder / "arm.mcap") as console:
        await console.begin_replay(folder / "ball.mcap")
        assert [robot.key for robot in console.view.world.articulations] == ["ball"]
        await until(lambda: console.view.snapshot is not None and "ball" in console.view.snapshot.per_articulation)
        await console.begin_replay(folder / "arm.mcap")
        await until(lambda: console.view.snapshot is not None and "arm" in console.view.snapshot.per_articulation)
        assert [robot.key for robot in console.view.world.articulations] == ["arm"]
