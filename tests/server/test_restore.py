"""`SimulatedServer.restore`: whatever a test did, the next one finds the server as it was."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from samples import filled
from wire import Wire, pack

from urlab_client.protocol.codec import encode_request
from urlab_client.server import ControllerConfig, Delay, Drop, Faults, SimulatedServer
from urlab_client.server.dialects import ALPHA

Act = Callable[[Wire], object]


def picture(server: SimulatedServer) -> dict[str, Any]:
    """What a client can see of a server, without the names of its ports."""
    with Wire(server) as wire:
        hello = wire.hello()
        del hello["session_id"]
        for articulation in hello["articulations"]:
            for camera in articulation["camera_topics"].values():
                del camera["zmq_endpoint"]
        seen: dict[str, Any] = {"hello": hello}
        for op in (
            "pie_status",
            "snapshot",
            "list_blueprints",
            "current_level",
            "actor_hierarchy",
            "get_camera",
            "replay_list_sessions",
            "list_keyframes",
        ):
            seen[op] = wire.raw({"op": op, "session_id": wire.session_id})
        if seen["pie_status"]["state"] == "ready":
            seen["options"] = wire.ask("set_sim_options", options={})
            seen["mode"] = wire.ask("set_mode", mode="direct")
            for name in ("step", "reset", "step"):
                reply = wire.ask(name, **({"n_steps": 5, "observations": "full"} if name == "step" else {}))
                del reply["wall_time"]
                seen.setdefault(name, []).append(reply)
    return seen


@pytest.fixture(scope="module", params=[True, False], ids=["play", "editor"])
def server(request: pytest.FixtureRequest, models: Path) -> Iterator[SimulatedServer]:
    with SimulatedServer(
        models / "bot.xml",
        models / "ball.xml",
        play=request.param,
        controllers={"bot": ControllerConfig()},
        model_roots=[models],
        faults=Faults(Delay("meta", seconds=0.0)),
    ) as server:
        yield server


@pytest.fixture(scope="module")
def original(server: SimulatedServer) -> dict[str, Any]:
    seen = picture(server)
    server.restore()
    return seen


def drive(wire: Wire) -> None:
    wire.raw({"op": "begin_pie", "session_id": wire.session_id})
    wire.ask("set_sim_options", options={"timestep": 0.01, "gravity": [0, 0, 5], "integrator": "euler"})
    wire.ask("configure_controller", articulation="bot", params={"kp": 3.0})
    wire.ask("set_control_source", source="ui")
    wire.ask("set_sim_speed", percent=50)
    wire.ask("set_twist", articulation="bot", linear=[1, 2, 3], angular=[0, 0, 1])
    wire.ask("set_mode", mode="direct")
    wire.ask("recording_start")
    push = {"ctrl": [0.5], "xfrc_applied": {"arm": [0, 0, 9, 0, 0, 0]}}
    wire.ask("step", n_steps=20, per_articulation={"bot": push}, observations="minimal")
    wire.ask("set_paused", paused=True)


def free_running(wire: Wire) -> None:
    wire.raw({"op": "begin_pie", "session_id": wire.session_id})
    wire.ask("set_paused", paused=False)


def play_and_author(wire: Wire) -> None:
    wire.ask("stop_pie")
    wire.ask("create_level", name="other")
    wire.ask("spawn_actor", blueprint="/Game/MuJoCoImports/bot", actor_id="x")
    wire.ask("ensure_manager")
    wire.ask("begin_pie")


def play_with_more(wire: Wire) -> None:
    wire.ask("stop_pie")
    wire.ask("spawn_actor", blueprint="/Game/MuJoCoImports/bot", actor_id="x")
    wire.ask("begin_pie")
    wire.ask("destroy_actor", target="x")


def record_a_file(wire: Wire) -> None:
    drive(wire)
    wire.ask("recording_save", path="ep.json")


def look_elsewhere(wire: Wire) -> None:
    wire.ask("set_camera", location=[1, 2, 3], rotation_euler=[0, 10, 20])
    wire.ask("set_viewport_mode", mode="Wireframe")
    wire.ask("select_actor", target="bot")
    wire.ask("draw_marker", location=[0, 0, 0], color=[1, 0, 0], ttl=-1)


def speak_json(wire: Wire) -> None:
    wire.exchange(pack({"op": "hello", "encoding": "json", "observations": "full"}))


def every_op(wire: Wire) -> None:
    for op in ALPHA.ops.values():
        wire.exchange(encode_request(filled(op.request), wire.session_id))
        if op.name == "hello":
            wire.hello()


@pytest.mark.parametrize(
    "act",
    [
        drive,
        free_running,
        lambda wire: wire.ask("stop_pie"),
        play_and_author,
        play_with_more,
        record_a_file,
        look_elsewhere,
        speak_json,
        every_op,
    ],
    ids=lambda act: act.__name__.strip("<>"),
)
def test_nothing_is_left(server: SimulatedServer, original: dict[str, Any], act: Act) -> None:
    with Wire(server) as wire:
        wire.hello()
        act(wire)
        session = wire.session_id
    server.restore()
    with Wire(server) as wire:
        expired = wire.raw({"op": "current_level", "session_id": session})
        assert expired["code"] == "session_expired"
    assert picture(server) == original
    server.restore()


def test_in_place_where_nothing_was_authored(server: SimulatedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("urlab_client.server.open_server.CLOSE_S", 60.0)  # a busy machine is not a server that hangs
    port, folder = server.step_port, server.saved_dir
    with Wire(server) as wire:
        wire.hello()
        drive(wire)
    server.restore()
    assert (server.step_port, server.saved_dir) == (port, folder)


def test_faults_are_those_of_the_start(server: SimulatedServer) -> None:
    assert server.faults is not None
    server.faults.clear()
    server.faults.add(Drop())
    server.restore()
    assert [active.fault for active in server.faults.active] == [Delay("meta", seconds=0.0)]


def test_a_server_that_hangs_is_started_again(models: Path) -> None:
    busy, enough = threading.Event(), threading.Event()

    def hang() -> None:
        busy.set()
        enough.wait(60)

    with SimulatedServer(models / "bot.xml", play=True) as server, zmq.Context() as context:
        before = picture(server)
        server.restore()
        with Wire(server) as wire, context.socket(zmq.REQ) as asking:
            wire.hello()
            wire.ask("set_mode", mode="direct")
            server._opened.core.play.running().engine.on_substep.append(hang)
            asking.linger = 0
            asking.connect(f"{server.address}:{server.step_port}")
            asking.send(pack({"op": "step", "session_id": wire.session_id}))
            assert busy.wait(30)
            server.restore()
        enough.set()
        assert picture(server) == before


def test_a_closed_server_stays_closed(models: Path) -> None:
    server = SimulatedServer(models / "bot.xml")
    server.restore()
    with pytest.raises(RuntimeError, match="closed"):
        _ = server.step_port
