"""The life of a `SimulatedServer`, what it starts with, and the life of its play sessions."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import pickle
import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from ports import free_ports
from waiting import eventually
from wire import Wire, pack, server_threads, write_level

from urlab_client import URLabClient
from urlab_client.enums import CameraMode, StepMode
from urlab_client.server import ControllerConfig, ModelError, PortInUse, SimulatedServer, bundled_models
from urlab_client.server import core as core_module
from urlab_client.server.compile.scene import compile_scene
from urlab_client.server.editor.levels import Levels
from urlab_client.server.limits import Limits

Connect = Callable[[SimulatedServer], Wire]
Serve = Callable[..., Wire]

PORTS = ("step", "state", "ctrl", "info", "camera")


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaves a thread of the server behind."""
    before = server_threads()
    yield
    left = server_threads() - before
    for thread in left:
        thread.join(60)
    assert not [thread for thread in left if thread.is_alive()]


def in_background(call: Callable[[], Any]) -> Future[Any]:
    """Run a call in a thread of its own."""
    pool = ThreadPoolExecutor(1)
    try:
        return pool.submit(call)
    finally:
        pool.shutdown(wait=False)


class Gate:
    """A function that says when it is entered, and waits until it may go on."""

    def __init__(self, then: Callable[..., Any]) -> None:
        self.entered = threading.Event()
        self.open = threading.Event()
        self._then = then

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.entered.set()
        assert self.open.wait(60)
        return self._then(*args, **kwargs)


@pytest.fixture
def slow_compile(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    """Have the compilation of scenes wait; it is let go at the end of the test."""
    gate = Gate(compile_scene)
    monkeypatch.setattr(core_module, "compile_scene", gate)
    yield gate
    gate.open.set()


# Life


def test_start_and_close_are_idempotent(models: Path, connect: Connect) -> None:
    server = SimulatedServer(models / "bot.xml")
    server.close()
    assert server.start() is server.start() is server
    port = server.step_port
    assert server.start().step_port == port
    assert connect(server).hello()["manager_present"] is False
    folder = server.saved_dir
    assert folder.is_dir()
    server.close()
    server.close()
    assert not folder.exists()
    with pytest.raises(RuntimeError, match="closed"):
        _ = server.step_port


def test_a_closed_server_starts_afresh(models: Path, connect: Connect) -> None:
    server = SimulatedServer(models / "bot.xml")
    for _ in range(2):
        with server:
            wire = connect(server)
            wire.hello()
            assert [row["actor_id"] for row in wire.ask("list_actors")["actors"]] == ["bot", ""]
            wire.ask("destroy_actor", target="bot")


def test_servers_side_by_side(models: Path, connect: Connect) -> None:
    with SimulatedServer(models / "bot.xml", play=True) as one, SimulatedServer(models / "bot.xml", play=True) as other:
        ports = [getattr(server, f"{name}_port") for server in (one, other) for name in PORTS]
        assert len(set(ports)) == len(ports)
        wires = [connect(one), connect(other)]
        for steps, wire in enumerate(wires, 1):
            wire.hello()
            wire.ask("set_mode", mode="direct")
            wire.ask("step", n_steps=steps)
        assert [wire.ask("forward")["step"] for wire in wires] == [1.0, 2.0]


def test_started_and_closed_from_several_threads(models: Path) -> None:
    server = SimulatedServer(models / "bot.xml")
    with ThreadPoolExecutor(4) as pool:
        assert len({started.step_port for started in pool.map(lambda _: server.start(), range(8))}) == 1
        list(pool.map(lambda _: server.close(), range(8)))
    with pytest.raises(RuntimeError):
        _ = server.address


def test_repr_says_where(models: Path) -> None:
    server = SimulatedServer(models / "bot.xml")
    assert "closed" in repr(server)
    with server:
        assert f"tcp://127.0.0.1:{server.step_port}" in repr(server)


def test_a_kept_folder_stays(models: Path, tmp_path: Path, connect: Connect) -> None:
    for number in range(2):
        with SimulatedServer(saved_dir=tmp_path / "saved", model_roots=[models]) as server:
            assert server.saved_dir == tmp_path / "saved"
            wire = connect(server)
            wire.hello()
            assert wire.ask("import_xml", path=str(models / "bot.xml"))["imported_now"] is (number == 0)


def test_collected_without_close(models: Path) -> None:
    before = server_threads()
    servers = [SimulatedServer(models / "bot.xml", play=True).start()]
    folder, line = servers[0].saved_dir, f"{__file__}:{test_collected_without_close.__code__.co_firstlineno + 2}"
    port = servers[0].step_port
    with pytest.warns(ResourceWarning, match="not closed") as caught:
        servers.clear()
    assert any(line in str(warning.message) for warning in caught)
    assert not folder.exists()
    eventually(lambda: server_threads() <= before)
    with socket.socket() as free:
        free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        free.bind(("127.0.0.1", port))


async def test_async_with_leaves_the_loop_free(models: Path, slow_compile: Gate) -> None:
    server = SimulatedServer(models / "bot.xml", play=True)

    async def let_go() -> None:
        await asyncio.to_thread(slow_compile.entered.wait, 60)
        slow_compile.open.set()

    async with asyncio.TaskGroup() as group:
        group.create_task(let_go())
        async with server as entered:
            assert entered is server
            assert server.step_port
    with pytest.raises(RuntimeError):
        _ = server.step_port


async def test_cancelled_while_it_starts(models: Path, slow_compile: Gate) -> None:
    server = SimulatedServer(models / "bot.xml", play=True)
    task = asyncio.create_task(server.__aenter__())
    await asyncio.to_thread(slow_compile.entered.wait, 60)
    task.cancel()
    slow_compile.open.set()
    with pytest.raises(asyncio.CancelledError):
        await task
    with pytest.raises(RuntimeError):
        _ = server.step_port


def test_our_client_finds_it(models: Path) -> None:
    with SimulatedServer(models / "bot.xml", play=True) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        assert list(client.articulations) == ["bot"]


def test_a_forked_child_leaves_the_server_alone(
    models: Path, connect: Connect, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = tmp_path / "registry"
    monkeypatch.setenv("URLAB_REGISTRY_DIR", str(registry))
    with SimulatedServer(models / "bot.xml", play=True, dialect="beta") as server:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads is what is tested
            child = os.fork()
        if child == 0:
            server.close()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        assert connect(server).hello()["manager_present"] is True
        assert server.saved_dir.is_dir()
        assert len([*registry.iterdir()]) == 1
    assert not [*registry.iterdir()]


# Closing while something is under way


def ask_later(wire: Wire, op: str, **fields: Any) -> Future[dict[str, Any]]:
    return in_background(lambda: wire.raw({"op": op, "session_id": wire.session_id, **fields}))


def test_close_during_a_long_step(models: Path, connect: Connect) -> None:
    with SimulatedServer(models / "bot.xml", play=True) as server:
        wire = connect(server)
        wire.hello()
        wire.ask("set_mode", mode="direct")
        engine = server._opened.core.play.running().engine
        engine.on_substep.append(lambda: eventually(lambda: engine._stopping))  # or it may have ended by then
        engine._step_timeout_s = 60.0
        reply = ask_later(wire, "step", n_steps=Limits().n_steps)
        eventually(lambda: engine.time > 0.0)
    assert reply.result(30)["code"] == "shutting_down"


def test_close_while_a_step_waits(models: Path, connect: Connect) -> None:
    with SimulatedServer(models / "bot.xml", play=True) as server:
        wire = connect(server)
        wire.hello()
        wire.ask("set_mode", mode="direct")
        wire.ask("set_paused", paused=True)
        engine = server._opened.core.play.running().engine
        engine._step_timeout_s = 60.0
        reply = ask_later(wire, "step")
        eventually(lambda: engine._queue)
    assert reply.result(30)["code"] == "shutting_down"


def test_close_during_compilation(models: Path, connect: Connect, slow_compile: Gate) -> None:
    with SimulatedServer(models / "bot.xml") as server:
        wire = connect(server)
        wire.hello()
        reply = ask_later(wire, "begin_pie")
        assert slow_compile.entered.wait(60)
    assert reply.result(30)["code"] == "shutting_down"


def test_close_during_what_cannot_be_broken_off(
    models: Path, connect: Connect, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    gate = Gate(lambda *_, **__: "/Game/Levels/x")
    monkeypatch.setattr(Levels, "create", gate)
    with caplog.at_level(logging.WARNING, "urlab_client.server"), SimulatedServer() as server:
        wire = connect(server)
        wire.hello()
        reply = ask_later(wire, "create_level", name="x")
        assert gate.entered.wait(60)
        server.close()
        assert not reply.done()
    assert "still running" in caplog.text
    gate.open.set()
    assert reply.result(30)["op"] == "create_level_ok"


# Ports


@pytest.mark.parametrize("name", PORTS)
def test_a_port_in_use(models: Path, name: str) -> None:
    before = set(threading.enumerate())
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(PortInUse) as caught:
            SimulatedServer(models / "bot.xml", **{f"{name}_port": port}).start()
    assert isinstance(caught.value, OSError)
    for part in (f"tcp://127.0.0.1:{port}", f"{name}_port", "in use"):
        assert part in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    eventually(lambda: set(threading.enumerate()) <= before)


@pytest.mark.parametrize("name", PORTS)
def test_two_servers_cannot_share_a_port(name: str) -> None:
    with SimulatedServer() as server, pytest.raises(PortInUse):
        SimulatedServer(**{f"{name}_port": getattr(server, f"{name}_port")}).start()


def test_a_released_port_can_be_taken_again(models: Path, connect: Connect) -> None:
    before = server_threads()
    ports = free_ports()
    with SimulatedServer(models / "bot.xml", **ports) as server:
        connect(server).hello()
    eventually(lambda: server_threads() <= before)  # on a busy machine closing does not wait for them all
    with SimulatedServer(models / "bot.xml", **ports) as server:
        assert {name: getattr(server, name) for name in ports} == ports
        connect(server).hello()


@pytest.mark.parametrize(
    ("host", "address"), [("localhost", "tcp://127.0.0.1"), ("0.0.0.0", "tcp://127.0.0.1"), ("*", "tcp://127.0.0.1")]
)
def test_hosts(host: str, address: str, connect: Connect) -> None:
    with SimulatedServer(host=host, insecure_no_auth=host != "localhost") as server:
        assert server.address == address
        connect(server).hello()


def test_a_host_of_ipv6() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError as error:
        pytest.skip(f"this machine has no IPv6: {error}")
    with SimulatedServer("ball", host="::1", play=True) as server, URLabClient(**server.client_options()) as client:
        assert server.address == "tcp://[::1]"
        client.discover()
        client.runtime.set_mode("live")
        client.runtime.set_paused(False)
        with client.state_stream("latest") as states:
            assert next(states).time >= 0.0


@pytest.mark.parametrize("host", ["no-such-host.invalid", "203.0.113.1"])
def test_a_host_of_another_machine(host: str) -> None:
    with pytest.raises(OSError, match=host):
        SimulatedServer(host=host, insecure_no_auth=True).start()


def test_a_client_that_goes_away_disturbs_nobody(connect: Connect) -> None:
    with SimulatedServer() as server:
        for _ in range(5):
            context = zmq.Context()
            rude = context.socket(zmq.REQ)
            rude.connect(f"{server.address}:{server.step_port}")
            rude.send(pack({"op": "meta"}))
            context.destroy(linger=0)
        connect(server).hello()


def test_a_dealer_gets_its_envelope_back() -> None:
    with SimulatedServer() as server, zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.connect(f"{server.address}:{server.step_port}")
        for number in range(3):
            dealer.send_multipart([bytes([number]), b"", pack({"op": "meta"})])
        replies = [dealer.recv_multipart() for _ in range(3)]
        assert [reply[:2] for reply in replies] == [[b"\0", b""], [b"\1", b""], [b"\2", b""]]
        assert msgspec.msgpack.decode(replies[0][2])["op"] == "meta_ok"


# What it starts with


def actor_rows(wire: Wire) -> dict[str, dict[str, Any]]:
    return {row["actor_id"]: row for row in wire.ask("list_actors")["actors"] if row["actor_id"]}


def test_every_bundled_robot_plays(connect: Connect) -> None:
    names = list(bundled_models())
    assert {"arm", "quadruped"} <= set(names)
    with SimulatedServer(*names, play=True) as server:
        wire = connect(server)
        assert [entry["actor_id"] for entry in wire.hello()["articulations"]] == names
        wire.ask("set_mode", mode="direct")
        assert wire.ask("step", n_steps=100)["step"] == 100.0


@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_ids_and_keys_of_equal_models(serve: Serve, dialect: str) -> None:
    wire = serve("bot", "bot", "prop", "bot", play=True, dialect=dialect)
    keys = {entry["actor_id"]: entry["prefix"] for entry in wire.hello()["articulations"]}
    assert keys == {"bot": "bot", "copy1_bot": "copy1_bot", "prop": "prop", "copy2_bot": "copy2_bot"}


def test_names_as_the_plugin_gives_them(serve: Serve) -> None:
    wire = serve("bot", "bot", play=True, actor_names="plugin")
    assert [entry["prefix"] for entry in wire.hello()["articulations"]] == ["bot_C_0", "bot_C_1"]


def test_models_stand_side_by_side(serve: Serve) -> None:
    wire = serve("bot", "prop", "bot", "bot", play=True)
    boxes = [wire.ask("get_actor_bounds", target=name, components_only=True) for name in actor_rows(wire)]
    assert actor_rows(wire)["bot"]["location"] == [0.0, 0.0, 0.0]
    for left, right in itertools.pairwise(boxes):
        assert right["min"][1] - left["max"][1] == pytest.approx(1.0)
    assert wire.ask("get_contacts")["contacts"] == []


def test_floors_stay_at_the_origin(connect: Connect) -> None:
    with SimulatedServer("arm", "floor", "quadruped") as server:
        wire = connect(server)
        wire.hello()
        assert actor_rows(wire)["floor"]["location"] == [0.0, 0.0, 0.0]
        assert actor_rows(wire)["quadruped"]["location"][1] > 0.5


def test_a_level_and_models_beside_it(models: Path, tmp_path: Path, connect: Connect) -> None:
    level = write_level(tmp_path / "room.json", size=3.0)
    with SimulatedServer(models / "bot.xml", level) as server:
        wire = connect(server)
        wire.hello()
        assert wire.ask("current_level")["level_path"] == "/Game/Levels/room"
        assert list(actor_rows(wire)) == ["crate", "bot"]
        assert actor_rows(wire)["bot"]["location"][1] > 3.5
        wire.ask("save_level")
    assert "bot" in level.read_text()
    with SimulatedServer(level, play=True) as server:
        assert [entry["actor_id"] for entry in connect(server).hello()["articulations"]] == ["bot"]


def test_edited_models_are_read_again(tmp_path: Path, connect: Connect) -> None:
    model = tmp_path / "one.xml"
    for name in ("before", "after"):
        model.write_text(f"<mujoco model='{name}'><worldbody><geom size='1'/></worldbody></mujoco>")
        with SimulatedServer(model, play=True, saved_dir=tmp_path / "saved") as server:
            assert [entry["prefix"] for entry in connect(server).hello()["articulations"]] == [name]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nothing.xml", "does not exist"),
        ("broken.xml", "MuJoCo rejects"),
        ("nothing.json", "nothing.json"),
        ("robot", "neither a file nor a bundled robot"),
    ],
)
def test_models_that_cannot_be_used(models: Path, name: str, text: str) -> None:
    with pytest.raises(ModelError, match=text) as caught:
        SimulatedServer(models / "bot.xml", models / name).start()
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, ValueError)


def test_different_models_of_one_name(models: Path, tmp_path: Path) -> None:
    (tmp_path / "bot.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ModelError, match="rename"):
        SimulatedServer(models / "bot.xml", tmp_path / "bot.xml").start()


def test_a_scene_that_does_not_compile(tmp_path: Path) -> None:
    level = write_level(tmp_path / "speck.json", size=1e-7, quick_convert=True)
    with pytest.raises(ModelError, match="mass"):
        SimulatedServer(level, play=True).start()
    with SimulatedServer(level) as server:
        assert server.step_port


def test_where_clients_may_import_from(
    models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, serve: Serve
) -> None:
    outside = tmp_path / "outside.xml"
    outside.write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    by_default = serve("bot", model_roots=None)
    assert by_default.ask("import_xml", path=str(models / "prop.xml"))["imported_now"] is True
    assert by_default.refused("import_xml", path=str(outside)) == "import_failed"
    monkeypatch.chdir(tmp_path)
    assert serve(model_roots=None).ask("import_xml", path="outside.xml")["imported_now"] is True
    assert serve("bot", model_roots=[tmp_path]).ask("import_xml", path=str(outside))["imported_now"] is True
    assert serve().ask("import_xml", path="arm")["blueprint_short_name"] == "arm"


@pytest.mark.parametrize(
    "options",
    [
        {"step_port": -1},
        {"camera_port": 65536},
        {"step_mode": "fast"},
        {"camera_modes": {"a/b": "infrared"}},
        {"camera_size": (0, 480)},
        {"actor_names": "short"},
    ],
)
def test_options_that_are_none(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r".+"):
        SimulatedServer(**options)


def test_a_name_without_a_file_lists_the_bundled_models() -> None:
    with pytest.raises(ModelError, match=r"robot is neither .* arm, .*quadruped"):
        SimulatedServer("robot").start()


def test_one_level_at_most() -> None:
    with pytest.raises(ValueError, match=r"a\.json, b\.json"):
        SimulatedServer("a.json", "b.json")


# Physics as configured


@pytest.mark.parametrize("mode", [StepMode.DIRECT, StepMode.LIVE, StepMode.PUPPET])
def test_a_pinned_mode(serve: Serve, mode: StepMode) -> None:
    wire = serve("bot", play=True, step_mode=mode, unpaused=True)
    for fields in ({"mode": "live"}, {"mode": "nonsense"}, {}):
        code, message = wire.refusal("set_mode", **fields)
        assert code == "mode_locked_by_server"
        assert str(mode) in message
    wire.ask("set_paused", paused=True)
    counted = wire.ask("step")["step"] if mode is not StepMode.DIRECT else wire.ask("forward")["step"]
    assert counted == (1.0 if mode is StepMode.PUPPET else 0.0)


def test_a_pinned_mode_does_not_unpause(serve: Serve) -> None:
    wire = serve("bot", play=True, step_mode="direct")
    assert wire.ask("set_paused", paused=False)["paused"] is False
    assert wire.ask("step", n_steps=2)["step"] == 2.0


def test_unpaused_from_the_start(serve: Serve) -> None:
    for reply in serve("bot", play=True, unpaused=True).until("forward"):
        if reply["time"] > 0.0:
            break


def test_controllers_by_id_key_and_star(serve: Serve) -> None:
    configs = {"bot": ControllerConfig(kp=1.0), "bot_C_1": ControllerConfig(kp=2.0), "*": ControllerConfig(kp=3.0)}
    wire = serve("bot", "bot", "limited", play=True, controllers=configs, actor_names="plugin")
    gains = {entry["actor_id"]: entry["controller"]["params"]["kp"]["m"] for entry in wire.hello()["articulations"]}
    assert gains == {"bot": 1.0, "copy1_bot": 2.0, "limited": 3.0}


def test_cameras_as_configured(serve: Serve) -> None:
    wire = serve(
        "bot", "bot", play=True, camera_modes={"bot/cam": CameraMode.DEPTH}, camera_size=(32, 16), camera_port=0
    )
    first, second = (entry["camera_topics"]["cam"] for entry in wire.hello()["articulations"])
    assert (first["mode"], second["mode"]) == ("depth", "real")
    assert first["resolution"] == [32.0, 16.0]
    assert first["zmq_endpoint"].startswith("tcp://127.0.0.1:")


def test_configured_names_that_fit_nothing(serve: Serve, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "urlab_client.server"):
        wire = serve("bot", controllers={"bto": ControllerConfig()}, camera_modes={"bot/eye": "depth"})
        assert wire.ask("begin_pie", timeout_s=60)["state"] == "ready"
    assert "'bto'" in caplog.text
    assert "'bot/eye'" in caplog.text


def test_options_of_the_model(serve: Serve) -> None:
    wire = serve("bot", play=True, mjcf_options=True)
    wire.ask("set_mode", mode="direct")
    assert wire.ask("step")["time"] == 0.005


# Play


def test_play_that_takes_too_long(serve: Serve, slow_compile: Gate) -> None:
    wire = serve("bot")
    for timeout in (0, -1, 0.001, float("nan")):
        assert wire.ask("begin_pie", timeout_s=timeout) == {
            "op": "begin_pie_ok",
            "state": "timeout",
            "compile_error": "",
        }
    assert wire.ask("pie_status") == {"op": "pie_status_ok", "state": "compiling", "compile_error": ""}
    assert wire.hello()["manager_present"] is True
    assert wire.refused("forward") == "not_ready"
    assert wire.ask("list_actors")["in_pie"] is True
    slow_compile.open.set()
    assert wire.ask("begin_pie", timeout_s=float("inf"))["state"] == "ready"
    assert wire.ask("pie_status")["sim_time"] == 0.0


def test_stopped_while_it_compiles(serve: Serve, slow_compile: Gate) -> None:
    wire = serve("bot")
    wire.ask("begin_pie", timeout_s=0)
    wire.ask("stop_pie")
    assert wire.ask("pie_status")["state"] == "off"
    slow_compile.open.set()
    assert wire.ask("begin_pie")["state"] == "ready"
    assert wire.refused("forward", session_id="") == "session_expired"
    assert wire.ask("forward")["time"] == 0.0


def test_a_failed_start_can_be_repeated(connect: Connect, tmp_path: Path) -> None:
    with SimulatedServer(write_level(tmp_path / "speck.json", size=1e-7, quick_convert=True)) as server:
        wire = connect(server)
        wire.hello()
        for _ in range(2):
            reply = wire.ask("begin_pie")
            assert reply["state"] == "compile_failed"
            assert "mass" in reply["compile_error"]
            assert "\n" not in reply["compile_error"]
            assert "handshake_payload" not in reply
        hello = wire.hello()
        assert (hello["manager_present"], hello["articulations"], hello["entities"]) == (True, [], {})
        assert wire.ask("pie_status")["state"] == "compile_failed"
        wire.ask("remove_quick_convert", target="crate")
        assert wire.ask("begin_pie")["state"] == "ready"


def test_play_in_another_level(serve: Serve, models: Path) -> None:
    wire = serve()
    for name, actors in (("one", ["a"]), ("two", ["b", "c"])):
        wire.ask("create_level", name=name)
        wire.ask("ensure_manager")
        wire.ask("import_xml", path=str(models / "bot.xml"))
        for k, actor in enumerate(actors):
            wire.ask("spawn_actor", blueprint="/Game/MuJoCoImports/bot", actor_id=actor, location=[k, 0, 0])
        wire.ask("save_level")

    def playing(reply: dict[str, Any]) -> list[str]:
        assert reply["state"] == "ready"
        return [entry["actor_id"] for entry in reply["handshake_payload"]["articulations"]]

    assert playing(wire.ask("begin_pie", level_path="/Game/Levels/one")) == ["a"]
    assert playing(wire.ask("begin_pie", level_path="two")) == ["b", "c"]
    # A level that is not there costs neither the level nor the play session at hand.
    wire.ask("set_mode", mode="direct")
    wire.ask("step", n_steps=3)
    assert wire.refused("begin_pie", level_path="three") == "load_level_failed"
    assert wire.ask("forward")["step"] == 3.0
    assert wire.ask("current_level")["level_path"] == "/Game/Levels/two"
    assert wire.refused("save_level") == "save_level_failed"


def test_the_session_survives_play(serve: Serve) -> None:
    wire = serve("bot")
    wire.hello(observations="minimal")
    for _ in range(2):
        wire.ask("begin_pie")
        assert "ctrl" not in wire.ask("forward")["per_articulation"]["bot"]
        wire.ask("set_mode", mode="direct")
        wire.ask("step")
        wire.ask("stop_pie")


def test_physics_errors_are_answers(serve: Serve, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    wire = serve("bot", play=True)
    wire.ask("set_mode", mode="puppet")
    reply = wire.ask("step", qpos=[float("nan")] * 8, qvel=[float("inf")] * 7)
    assert reply["step"] == 1.0
    wire.ask("set_mode", mode="direct")
    wire.ask("reset")
    assert wire.ask("step")["time"] == 0.002
    assert list(tmp_path.iterdir()) == []
