"""Tasks and threads of a client that fail: an event and the log name them, and what waits for them hears why."""

from __future__ import annotations

import asyncio
import logging
import traceback
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from bare_loop import run_bare
from ports import free_port
from waiting import DEADLINE_S
from waiting import until as wait_until

from urlab_client.aio import Stream, URLabClient
from urlab_client.aio import launch as launching
from urlab_client.aio.session.control import Control
from urlab_client.aio.state import connection_monitor
from urlab_client.aio.state.connection_monitor import ConnectionMonitor, SessionKeeper
from urlab_client.aio.streams.camera_switch import CameraSwitch
from urlab_client.aio.streams.live_state import LiveState
from urlab_client.aio.transport import waiting as transport_waiting
from urlab_client.aio.transport.shm_regions import ServerRegions
from urlab_client.errors import ServerRestarted, ServerUnreachable, URLabError
from urlab_client.events import ClientEvent, ServerReconnected, TaskFailed
from urlab_client.server import SimulatedServer


async def fail(*_: Any, **__: Any) -> None:
    raise MemoryError("none left")


def die(*_: Any, **__: Any) -> Any:
    raise MemoryError("none left")


@pytest.fixture
async def server() -> AsyncIterator[SimulatedServer]:
    async with SimulatedServer("arm", play=True) as made:
        yield made


async def until(events: Stream[ClientEvent], kind: type[ClientEvent]) -> ClientEvent:
    async with asyncio.timeout(DEADLINE_S):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError(kind)


async def is_told(events: Stream[ClientEvent], caplog: pytest.LogCaptureFixture, name: str) -> None:
    event = await until(events, TaskFailed)
    assert isinstance(event, TaskFailed)
    assert (event.task, event.error) == (name, "MemoryError: none left")
    (record,) = [one for one in caplog.records if one.name == "urlab_client.background" and name in one.getMessage()]
    assert record.exc_info is not None
    assert isinstance(record.exc_info[1], MemoryError)


async def test_the_keeper_of_the_session(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_monitor, "_PROBE_INTERVAL_S", 0.01)
    ports = {f"{name}_port": free_port() for name in ("step", "state", "ctrl", "info", "camera")}
    async with SimulatedServer("arm", play=True, **ports) as first:
        client = URLabClient(**first.client_options(), step_mode="direct", keep_session=True)
        events = client.events()
        with monkeypatch.context() as patch:
            patch.setattr(SessionKeeper, "_probe", fail)
            await client.discover()
            await is_told(events, caplog, "urlab-keeper")
        assert (await client.step()).step == 1
    await wait_until(lambda: client._transport.refused)  # type: ignore[union-attr]
    async with SimulatedServer("arm", play=True, **ports), client:
        assert await until(events, ServerReconnected)
        with pytest.raises(ServerRestarted) as caught:
            await client.step()
        assert "urlab-keeper ended unexpectedly: MemoryError: none left" in str(caught.value.__cause__)
        await client.discover()
        assert client._session.unkept is None
        assert client._keeper._task is not None
        assert not client._keeper._task.done()


async def test_the_watch_on_the_connection(
    server: SimulatedServer, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ConnectionMonitor, "_find_out", fail)
    async with URLabClient(**server.client_options(), step_mode="direct") as client:
        await client.discover()
        async with client.events() as events:
            client._monitor._investigate()
            await is_told(events, caplog, "urlab-watch")
            assert (await client.step()).step == 1


async def test_the_renewal_of_claims(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Control, "_renew_one", fail)
    async with (
        SimulatedServer("arm", play=True, dialect="beta") as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        await client.discover()
        async with client.events() as events:
            await client.articulations["arm"].claim(ttl=0.01)
            await is_told(events, caplog, "urlab-claims")
            assert (await client.step()).step == 1


async def test_the_switching_of_cameras(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    async with (
        SimulatedServer("arm", play=True, dialect="beta") as server,
        URLabClient(**server.client_options(), live_pictures=False) as client,
    ):
        await client.discover()
        view, switch = client.articulations["arm"].cameras["wrist"], client._publishers.camera_switch
        assert switch is not None
        async with client.events() as events:
            with monkeypatch.context() as patch:
                patch.setattr(CameraSwitch, "_send", fail)
                async with view.frames():
                    await is_told(events, caplog, "urlab-cameras")
                    with pytest.raises(URLabError, match="urlab-cameras ended unexpectedly: MemoryError") as caught:
                        await switch.settled()
                    assert isinstance(caught.value.__cause__, MemoryError)
                    length = len(traceback.extract_tb(caught.value.__traceback__))
                    with pytest.raises(URLabError) as again:
                        await switch.settled()
                    assert len(traceback.extract_tb(again.value.__traceback__)) == length, "it grows"
            async with view.frames():
                await switch.settled()
                assert switch.is_on(view.info)


async def test_the_thread_that_logs_what_a_started_server_prints(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def close_and_die(pipe: IO[bytes], *_: Any) -> None:
        pipe.close()
        die()

    monkeypatch.setattr(launching, "_log_lines", close_and_die)
    client = URLabClient("sim://arm", step_mode="direct")
    async with client.events() as events:
        await client.discover()
        assert (await client.step()).step == 1
        await is_told(events, caplog, "urlab-server")
    await client.close()


async def test_the_thread_that_reads_from_a_started_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launching, "_CHUNK_BYTES", "many")
    async with URLabClient("sim://arm") as client:
        with pytest.raises(URLabError, match="urlab-server ended unexpectedly: TypeError") as caught:
            await client.discover()
        assert isinstance(caught.value.__cause__, TypeError)


def look_or_die(monkeypatch: pytest.MonkeyPatch, lives: Iterator[bool]) -> list[bool]:
    """Let the watching thread die after as many looks as are given; return where the next thread notes its looks."""
    monkeypatch.setattr(transport_waiting, "_AGAIN_S", 0.01)
    look, again = transport_waiting._Watcher._look, list[bool]()

    def look_or_die(self: Any) -> bool:
        alive = next(lives, None)
        if alive is None:
            again.append(True)
        return die() if alive is False else look(self)

    monkeypatch.setattr(transport_waiting._Watcher, "_look", look_or_die)
    return again


async def test_the_thread_that_watches_shared_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServerRegions, "connect_doorbell", lambda _: None)
    async with (
        SimulatedServer("arm", play=True, shm_dir=tmp_path) as server,
        URLabClient(**server.client_options(), transport="shm", step_mode="direct") as client,
    ):
        await client.discover()
        async with client.events() as events:
            again, step = look_or_die(monkeypatch, iter([False])), 0
            async with asyncio.timeout(DEADLINE_S):
                while not events.stats.received:  # a step that is answered at once needs no thread
                    step += 200
                    assert (await client.step(200)).step == step
            await is_told(events, caplog, "urlab-waiter")
            async with asyncio.timeout(DEADLINE_S):
                while not again:
                    step += 200
                    assert (await client.step(200)).step == step


def test_the_thread_that_watches_sockets(
    scripted: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        client = URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False)
        async with client, client.events() as events:
            again = look_or_die(monkeypatch, iter([True, True, False]))
            for _ in range(3):
                assert await client.meta()
            await is_told(events, caplog, "urlab-waiter")
            await wait_until(lambda: again)
            assert await client.meta()

    run_bare(main())


async def test_an_error_in_one_receiver_costs_the_others_nothing(
    server: SimulatedServer, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        monkeypatch.setattr(LiveState, "_apply", die)

        def told() -> list[logging.LogRecord]:
            return [one for one in caplog.records if "could not be handled" in one.getMessage()]

        async with client.state_stream("all") as states, asyncio.timeout(DEADLINE_S):
            while len(told()) < 2:  # of states that come together, only the newest is applied
                await states.receive(timeout=DEADLINE_S)
    record, second, *_ = told()
    assert ["(1 so far)" in record.getMessage(), "(2 so far)" in second.getMessage()] == [True, True]
    assert record.exc_info is not None
    assert isinstance(record.exc_info[1], MemoryError)


async def test_a_failing_listener_hides_no_lost_connection(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with SimulatedServer("arm", play=True) as server:
        client = URLabClient(**server.client_options(), rcv_timeout_ms=60_000)
        await client.discover()
        monkeypatch.setattr(ConnectionMonitor, "on_connection", die)
        client._transport.on_event = die
    async with client:
        with pytest.raises(ServerUnreachable):
            await client.meta(timeout=0.05)
    assert "could not be handled" in caplog.text
