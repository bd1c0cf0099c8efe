"""Threads of a server that die: noticed at once, told to clients and to whoever runs the server, and made good."""

from __future__ import annotations

import ctypes
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from waiting import DEADLINE_S, eventually
from wire import Wire

from urlab_client import ServerUnreachable, URLabClient, URLabPIEError
from urlab_client.enums import PIEState
from urlab_client.errors import InternalError
from urlab_client.keys import KeyPair
from urlab_client.protocol.messages.scene import CreateLevelOk
from urlab_client.server import CurveServer, Drop, Faults, SimulatedServer
from urlab_client.server.physics.play import Play
from urlab_client.server.rpc.dispatch import HANDLERS
from urlab_client.server.system.threads import Health
from urlab_client.server.transport.curve_authentication import CurveKeys


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


@pytest.mark.parametrize(
    "name", ["urlab-rpc", "urlab-physics", "urlab-streams", "urlab-cameras", "urlab-shm", "urlab-watchdog"]
)
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


def out_of_memory(*_: Any, **__: Any) -> Any:
    raise MemoryError("none left")


def quit_thread(*_: Any, **__: Any) -> Any:
    raise SystemExit("enough")


def is_told(server: SimulatedServer, client: URLabClient, name: str, told: list[str]) -> None:
    """Check that everybody hears of the death of a thread."""
    failure = eventually(lambda: server.failure)
    assert f"'{name}' died of " in failure
    assert eventually(lambda: told) == [failure]
    with pytest.raises(InternalError, match=f"'{name}' died of .*; start the server again"):
        client.runtime.forward()


def test_the_thread_of_the_registry(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("URLAB_REGISTRY_DIR", str(tmp_path))
    monkeypatch.setattr("urlab_client.protocol.instances.REWRITE_S", 0.01)
    told: list[str] = []
    with (
        SimulatedServer(models / "bot.xml", play=True, dialect="beta") as server,
        URLabClient(**server.client_options()) as client,
    ):
        client.discover()
        server.add_failure_callback(told.append)
        monkeypatch.setattr("urlab_client.protocol.instances.encode", out_of_memory)
        is_told(server, client, "urlab-registry", told)


def test_the_thread_that_knows_the_clients_keys(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    KeyPair.new().write(tmp_path, "server")
    curve = CurveServer(server_key=tmp_path / "server.key_secret", allow_any=True)
    told: list[str] = []
    with (
        SimulatedServer(models / "bot.xml", play=True, curve=curve) as server,
        URLabClient(**server.client_options()) as client,
        URLabClient(**server.client_options()) as late,
    ):
        client.discover()
        server.add_failure_callback(told.append)
        monkeypatch.setattr(CurveKeys, "welcomes", out_of_memory)
        with pytest.raises(ServerUnreachable):
            late.discover(timeout=0.05)
        is_told(server, client, "urlab-auth", told)


def test_the_thread_that_draws(server: SimulatedServer, models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert server.can_render is not None, "the other server has looked for OpenGL, and is not struck"
    monkeypatch.setattr("urlab_client.server.render.camera_renderer.search_backend", quit_thread)
    told: list[str] = []
    with (
        SimulatedServer(models / "bot.xml", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        server.add_failure_callback(told.append)
        assert not client.step(include_cameras=True).cameras
        is_told(server, client, "urlab-render", told)


def test_the_thread_that_starts_play(models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    with SimulatedServer(models / "bot.xml") as server, URLabClient(**server.client_options()) as client:
        client.discover()
        server.add_failure_callback(told.append)
        monkeypatch.setattr(Play, "_announce", quit_thread)
        with pytest.raises(URLabPIEError, match="'urlab-compile' died of SystemExit: enough"):
            client.sim.start()
        is_told(server, client, "urlab-compile", told)


@pytest.fixture
def jobs(models: Path) -> Iterator[tuple[SimulatedServer, Wire, Wire]]:
    """A server whose editor runs jobs, and two of its clients in one session."""
    with (
        SimulatedServer(dialect="beta", model_roots=[models]) as server,
        Wire(server) as wire,
        Wire(server) as other,
    ):
        wire.hello()
        other.session_id = wire.session_id
        yield server, wire, other


def test_a_reply_of_a_job_that_cannot_be_encoded_fails_the_job(
    jobs: tuple[SimulatedServer, Wire, Wire], monkeypatch: pytest.MonkeyPatch
) -> None:
    server, wire, _ = jobs
    monkeypatch.setitem(HANDLERS.handlers, "create_level", lambda *_: CreateLevelOk(level_path=object()))  # type: ignore[arg-type]
    job = wire.raw({"op": "create_level", "name": "fresh", "session_id": wire.session_id})["job_id"]
    done = next(status for status in wire.until("op_status", job_id=job) if status["state"] != "running")
    assert done["result"]["code"] == "internal_error"
    assert wire.ask("list_blueprints")["blueprints"] == []  # waits for earlier jobs
    assert server.failure is None


def test_the_thread_of_the_editors_jobs(
    jobs: tuple[SimulatedServer, Wire, Wire], monkeypatch: pytest.MonkeyPatch
) -> None:
    server, wire, other = jobs
    running, go_on = threading.Event(), threading.Event()
    told: list[str] = []
    server.add_failure_callback(told.append)

    def die(*_: Any) -> Any:
        running.set()
        assert go_on.wait(DEADLINE_S)
        raise SystemExit("enough")

    monkeypatch.setitem(HANDLERS.handlers, "create_level", die)
    job = wire.raw({"op": "create_level", "name": "fresh", "session_id": wire.session_id})["job_id"]
    assert running.wait(DEADLINE_S)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(other.raw, {"op": "list_blueprints", "session_id": wire.session_id})
        eventually(lambda: "wait_for" in stack_of("urlab-rpc"))
        go_on.set()
        replies = [waiting.result(DEADLINE_S), wire.raw({"op": "op_status", "job_id": job})]
    failure = eventually(lambda: server.failure)
    for reply in replies:
        assert reply["code"] == "internal_error"
        assert "'urlab-editor' died of SystemExit: enough" in reply["message"]
    assert eventually(lambda: told) == [failure]


def test_the_thread_that_waits_for_a_confined_compiler(
    serve: Callable[..., Wire], models: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wire = serve()
    with monkeypatch.context() as patch:
        patch.setattr("urlab_client._sandbox.process._SIZE", "many")
        assert wire.refused("import_xml", path=str(models / "bot.xml")) == "internal_error"
    assert "urlab-sandbox died of AttributeError" in caplog.text
    assert wire.ask("import_xml", path=str(models / "bot.xml"))["blueprint_short_name"] == "bot"


def stack_of(name: str) -> str:
    """Return the stack of a thread."""
    return "".join(traceback.format_stack(sys._current_frames()[the(name).ident or 0]))


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

    play, running = Play(Health()), Closing()
    play.listeners.append(fail)
    play.begin(lambda: running)  # type: ignore[arg-type, return-value]
    assert play.wait(30.0) is PIEState.COMPILE_FAILED
    assert "no descriptor is left" in play.compile_error
    assert running.closed
    assert seen == [running, None]
