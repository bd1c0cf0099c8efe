"""Threads of a server that die: noticed at once, told to clients and to whoever runs the server, and made good."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import eventually
from wire import Wire

from urlab_client import InternalError, URLabClient
from urlab_client.protocol.enums import PIEState
from urlab_client.server import Drop, Faults, SimulatedServer
from urlab_client.server.physics.play import Play


def strike(thread: threading.Thread) -> None:
    """Raise SystemExit in a thread, as soon as it runs Python code."""
    assert thread.ident is not None
    struck = ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
    assert struck == 1


@pytest.fixture(scope="module")
def shared(models: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedServer]:
    with SimulatedServer(models / "bot.xml", play=True, shm_dir=tmp_path_factory.mktemp("shm")) as server:
        yield server


@pytest.fixture
def server(shared: SimulatedServer) -> Iterator[SimulatedServer]:
    yield shared
    shared.restore()


def the(name: str) -> threading.Thread:
    """Return the newest thread of that name."""
    return [thread for thread in threading.enumerate() if thread.name == name][-1]


@pytest.mark.parametrize("name", ["urlab-rpc", "urlab-physics", "urlab-streams", "urlab-cameras", "urlab-shm"])
def test_a_thread_that_dies_is_told_to_everybody(server: SimulatedServer, name: str) -> None:
    told: list[str] = []
    server.add_failure_callback(told.append)
    ports = server.step_port
    with URLabClient(**server.client_options()) as client:
        client.discover()  # in live mode: the streams have something to do
        assert server.failure is None
        strike(the(name))
        if name == "urlab-rpc":
            with pytest.raises(InternalError, match="'urlab-rpc' died of SystemExit"):
                client.runtime.forward()
        failure = eventually(lambda: server.failure)
        assert f"'{name}' died of SystemExit" in failure
        assert eventually(lambda: told) == [failure]
        with pytest.raises(InternalError, match=f"'{name}' died of SystemExit; start the server again"):
            client.step()
        assert name in repr(server)
        late: list[str] = []
        server.add_failure_callback(late.append)
        assert late == [failure]
    server.restore()
    assert server.failure is None
    assert server.step_port != ports
    with URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        assert client.step().step == 1


class Deadly(Drop):
    def concerns_request(self, op: str) -> bool:
        raise SystemExit(op)


def test_a_server_that_misbehaves_on_purpose_tells_as_well(models: Path) -> None:
    faults = Faults()
    with (
        SimulatedServer(models / "bot.xml", play=True, faults=faults) as server,
        URLabClient(**server.client_options(), rcv_timeout_ms=60_000) as client,
    ):
        client.discover()
        faults.add(Deadly())
        with pytest.raises(InternalError, match="'urlab-rpc' died of SystemExit: forward"):
            client.runtime.forward()
        faults.clear()
        with pytest.raises(InternalError, match="'urlab-rpc' died of SystemExit: forward; start the server again"):
            client.runtime.forward()


def test_a_step_that_waits_for_physics_is_answered_when_physics_dies(server: SimulatedServer) -> None:
    with URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        client.runtime.set_paused(True)  # the step is queued
        physics = the("urlab-physics")
        striking = threading.Timer(0.0, strike, (physics,))
        striking.start()
        with pytest.raises(InternalError, match="'urlab-physics' died of SystemExit"):
            client.step()
        striking.join()


def test_a_start_of_play_that_dies_is_a_failed_start(
    serve: Callable[..., Wire], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wire = serve("bot")

    def fail(*_: Any, **__: Any) -> None:
        raise SystemExit("enough")

    with monkeypatch.context() as patch:
        patch.setattr("urlab_client.server.core.compile_scene", fail)
        reply = wire.ask("begin_pie")
    assert reply["state"] == PIEState.COMPILE_FAILED
    assert "SystemExit: enough" in str(reply)
    assert wire.ask("begin_pie")["state"] == PIEState.READY


def test_a_listener_that_fails_fails_the_start_of_play(caplog: pytest.LogCaptureFixture) -> None:
    class Closing:
        closed = False

        def close(self, timeout: float = 1.0) -> bool:
            self.closed = True
            return True

    seen: list[Any] = []

    def fail(running: Any) -> None:
        seen.append(running)
        if running is not None:
            raise OSError("no descriptor is left")

    play, running = Play(), Closing()
    play.listeners.append(fail)
    play.begin(lambda: running)  # type: ignore[arg-type, return-value]
    assert play.wait(30.0) is PIEState.COMPILE_FAILED
    assert "no descriptor is left" in play.compile_error
    assert running.closed
    assert seen == [running, None]
