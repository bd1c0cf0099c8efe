"""Threads and tasks of integrations that fail: whatever waits for them fails with the cause, and the log names them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from waiting import DEADLINE_S, eventually, until

from urlab_client.aio import URLabClient
from urlab_client.aio.background import background_thread
from urlab_client.errors import ConnectionLost, URLabError
from urlab_client.integrations._feed.follower import Follower
from urlab_client.integrations.gym import vector
from urlab_client.integrations.record import RecordingError, read_run, record
from urlab_client.integrations.record import writer as writing
from urlab_client.integrations.view.view import AsyncView, WindowBackend
from urlab_client.server import SimulatedServer
from urlab_client.simulation.opengl import RenderingUnavailable
from urlab_client.simulation.painting import Painter, Visible


def die(*_: Any, **__: Any) -> Any:
    raise SystemExit("enough")


async def fail(*_: Any, **__: Any) -> None:
    raise MemoryError("none left")


async def lose(*_: Any, **__: Any) -> None:
    raise ConnectionLost("gone")


@pytest.fixture
async def client() -> AsyncIterator[URLabClient]:
    async with (
        SimulatedServer("arm", play=True, unpaused=True) as server,
        URLabClient(**server.client_options()) as made,
    ):
        await made.discover()
        yield made


def logged(caplog: pytest.LogCaptureFixture, name: str) -> bool:
    return any(f"{name} ended unexpectedly" in record.getMessage() and record.exc_info for record in caplog.records)


async def test_the_thread_that_writes(
    client: URLabClient, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = record(client, tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match=r"broke off: SystemExit\('enough'\)") as caught:  # noqa: PT012
        async with recorder:
            monkeypatch.setattr(writing._Sink, "write", die)
            await until(lambda: recorder.failed)
    assert isinstance(caught.value.__cause__, RecordingError)
    assert isinstance(caught.value.__cause__.__cause__, SystemExit)
    assert logged(caplog, "urlab-record")


async def test_the_tasks_that_feed_a_recording(
    client: URLabClient, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Follower, "_follow_states", fail)
    recorder = record(client, tmp_path / "run.mcap")
    with pytest.raises(RecordingError, match=r"broke off: MemoryError\('none left'\)"):
        async with recorder:
            await until(lambda: recorder.failed)
    assert logged(caplog, "urlab-feed")
    assert read_run(tmp_path / "run.mcap").damage == "", "what it holds is whole"


OPTIONS: dict[str, Any] = {"cameras": (), "camera_hz": 10.0, "max_hz": 100.0, "contacts": False}


class Display:
    """A display that fails with its first state."""

    address = ""

    def __init__(self) -> None:
        self.closed = False

    def open(self) -> None: ...
    def idle(self) -> bool:
        return True

    def close(self) -> None:
        self.closed = True

    use = show = show_picture = die


async def test_the_thread_that_shows(client: URLabClient, caplog: pytest.LogCaptureFixture) -> None:
    display = Display()
    async with AsyncView(client, display, "view", **OPTIONS) as view:
        await until(lambda: view.closed)
        assert isinstance(view.error, URLabError)
        assert isinstance(view.error.__cause__, SystemExit)
    assert display.closed
    assert logged(caplog, "urlab-view")


async def test_the_tasks_that_feed_a_view(client: URLabClient, monkeypatch: pytest.MonkeyPatch) -> None:
    class Fine(Display):
        def use(self, *_: Any) -> None: ...

        show = show_picture = use

    monkeypatch.setattr(Follower, "_follow_states", fail)
    display = Fine()
    async with AsyncView(client, display, "view", **OPTIONS) as view:
        await until(lambda: view.closed)
        assert isinstance(view.error, URLabError)
        assert isinstance(view.error.__cause__, MemoryError)
        await until(lambda: display.closed)  # although the block goes on


def test_the_thread_that_draws_for_a_batch(caplog: pytest.LogCaptureFixture) -> None:
    begun: Future[None] = Future()

    def find_backend() -> None:
        begun.result(DEADLINE_S)
        raise SystemExit("enough")

    model, stage = mujoco.MjModel.from_xml_string("<mujoco/>"), cast("Any", None)
    painter = Painter(model, find_backend, stage, lambda run: background_thread("urlab-pictures", run))
    visible = Visible(np.empty(0), {})
    waiting = painter.submit(lambda *_: None, visible)
    begun.set_result(None)
    for drawn in (lambda: waiting, lambda: painter.submit(lambda *_: None, visible)):
        with pytest.raises(RenderingUnavailable, match=r"nothing more is drawn: SystemExit\('enough'\)") as caught:
            drawn().result(DEADLINE_S)
        assert isinstance(caught.value.__cause__, SystemExit)
    eventually(lambda: logged(caplog, "urlab-pictures"))
    assert painter.close()


def test_the_restart_of_an_environment(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    with SimulatedServer("arm", play=True) as server:
        envs = vector.URLabVectorEnv([f"{server.address}:{server.step_port}"])
        try:
            envs.reset(seed=1)
            session = envs._sessions[0]
            with monkeypatch.context() as patch:
                patch.setattr(session, "open", fail)
                patch.setattr(session.episode, "step", lose)
                infos = envs.step(envs.action_space.sample())[4]
                assert "gone" in str(infos["error"][0])
                eventually(lambda: logged(caplog, "urlab-environment"))
            envs.reset(seed=1)
        finally:
            envs.close()


async def test_a_recording_whose_beginning_is_cancelled_ends(
    client: URLabClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opening, go_on, made = threading.Event(), threading.Event(), list[writing.WriterThread]()

    class SlowToOpen(writing.WriterThread):
        def __init__(self, *arguments: Any) -> None:
            opening.set()
            go_on.wait(DEADLINE_S)
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr("urlab_client.integrations.record.recorder.WriterThread", SlowToOpen)
    path = tmp_path / "run.mcap"
    beginning = asyncio.create_task(record(client, path).__aenter__())
    await until(opening.is_set)
    beginning.cancel()
    with pytest.raises(asyncio.CancelledError):
        await beginning
    go_on.set()
    await until(lambda: made and not made[0]._thread.is_alive())
    assert read_run(path).summary().complete


async def test_a_view_whose_beginning_is_cancelled_is_closed(client: URLabClient) -> None:
    opening, go_on = threading.Event(), threading.Event()

    class SlowToOpen(WindowBackend):
        closed = False

        def open(self) -> None:
            opening.set()
            go_on.wait(DEADLINE_S)

        def close(self) -> None:
            self.closed = True

    backend = SlowToOpen()
    view = AsyncView(client, backend, "view", cameras=(), camera_hz=10.0, max_hz=30.0, contacts=False)
    beginning = asyncio.create_task(view.__aenter__())
    await until(opening.is_set)
    beginning.cancel()
    with pytest.raises(asyncio.CancelledError):
        await beginning
    go_on.set()
    await until(lambda: backend.closed)
