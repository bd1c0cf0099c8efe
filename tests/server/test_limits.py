"""What a server refuses before it works on it: each limit, named in its error."""

from __future__ import annotations

import dataclasses
import itertools
import re
import socket as sockets
import struct
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from waiting import attempts, eventually
from wire import Wire, pack

from urlab_client.server import Limits, SimulatedServer
from urlab_client.server.dialects import ALPHA
from urlab_client.server.transport import endpoint

Serve = Callable[..., Wire]
SMALL = Limits(
    request_bytes=100_000, string_chars=100, n_steps=50, grid_cells=6, actors=12, markers=3, recording_file_bytes=200
)


@pytest.fixture
def small(serve: Serve) -> Wire:
    return serve("bot", limits=SMALL)


def test_the_docs_list_every_limit() -> None:
    page = (Path(__file__).parents[2] / "docs/security.md").read_text("utf-8")
    listed = dict(re.findall(r"^\| `(\w+)` \| ([\d ]+(?:MiB)?)", page, flags=re.MULTILINE))
    sizes = {
        name: int(text.replace(" ", "").removesuffix("MiB")) * (2**20 if "MiB" in text else 1)
        for name, text in listed.items()
    }
    assert sizes == dataclasses.asdict(Limits())


def test_a_limit_below_one_is_none() -> None:
    with pytest.raises(ValueError, match="n_steps"):
        Limits(n_steps=0)


def test_requests_name_the_limit_they_exceed(small: Wire) -> None:
    long = "x" * 101
    deep: object = 1
    for _ in range(80):
        deep = [deep]
    spawn = {"blueprint": "/Game/MuJoCoImports/bot"}
    for op, fields, code, name in (
        ("set_overlay_text", {"text": "x" * 100_001}, "bad_request", "request_bytes"),
        ("configure_controller", {"articulation": "bot", "params": {"a": deep}}, "bad_request", "request_depth"),
        ("spawn_actor", spawn | {"actor_id": long}, "bad_request", "string_chars"),
        ("import_xml", {"path": long}, "bad_request", "string_chars"),
        ("reset", {"per_articulation_qpos": {"bot": {long: 1.0}}}, "bad_request", "string_chars"),
        ("step", {"per_articulation": {long: {"ctrl": [0.0]}}}, "bad_request", "string_chars"),
        ("step", {"per_articulation": {"bot": {"xfrc_applied": {long: [0.0] * 6}}}}, "bad_request", "string_chars"),
        ("step", {"per_articulation": {"bot": {"control_mode": long}}}, "bad_request", "string_chars"),
        ("step", {"include_cameras": {"eye": long}}, "bad_request", "string_chars"),
        ("spawn_grid", spawn | {"base_actor_id": "g", "count_x": 7, "count_y": 1}, "too_many_cells", "grid_cells"),
    ):
        answer = small.refusal(op, **fields)
        assert answer[0] == code, (op, answer)
        assert name in answer[1], (op, answer)


def test_how_deep_a_request_may_nest_is_said_whatever_it_nests_in(small: Wire) -> None:
    for wrap in (lambda inner: [inner], lambda inner: {"a": inner}):
        deep: object = 1
        for _ in range(Limits().request_depth - 2):  # below the request itself, and `params`
            deep = wrap(deep)
        assert small.refused("configure_controller", articulation="bot", params={"a": deep}) == "no_active_manager"
        code, message = small.refusal("configure_controller", articulation="bot", params={"a": wrap(deep)})
        assert (code, f"deeper than {Limits().request_depth} levels" in message) == ("bad_request", True), message


def test_a_frame_that_is_far_too_long_costs_its_sender_the_connection(small: Wire) -> None:
    with small.connected(zmq.DEALER) as socket:
        with socket.get_monitor_socket(zmq.EVENT_DISCONNECTED) as monitor:
            socket.send_multipart([b"", bytes(2 * SMALL.request_bytes)])
            assert b"request_bytes" in socket.recv_multipart()[-1]
            socket.send_multipart([b"", bytes(2 * SMALL.request_bytes + 1)])
            assert monitor.poll(10_000), "the connection stays"
        socket.disable_monitor()
    assert small.ask("list_actors")["actors"], "others go on"


def test_a_level_takes_no_more_actors_than_the_limit(small: Wire) -> None:
    spawn = {"blueprint": "/Game/MuJoCoImports/bot", "spacing": [1, 1, 0], "origin": [5, 0, 0]}
    present = len(small.ask("list_actors")["actors"])
    small.ask("spawn_grid", **spawn, base_actor_id="a", count_x=3, count_y=2)
    room = SMALL.actors - present - 6
    small.ask("spawn_grid", **spawn, base_actor_id="b", count_x=room, count_y=1)
    small.ask("spawn_grid", **spawn, base_actor_id="b", count_x=room, count_y=1)  # they exist: none is added
    for op, fields in (
        ("spawn_actor", {"blueprint": spawn["blueprint"], "actor_id": "one"}),
        ("spawn_light", {"kind": "point"}),
        ("duplicate_actor", {"target": "a_0_0", "new_actor_id": "more"}),
    ):
        assert "limit actors" in small.refusal(op, **fields)[1]
    assert len(small.ask("list_actors")["actors"]) == SMALL.actors


def test_the_models_of_a_level_together(serve: Serve, models: Path) -> None:
    wire = serve(limits=Limits(scene_bytes=1))
    wire.ask("create_level", name="fresh")
    blueprint = wire.ask("import_xml", path=str(models / "bot.xml"))["blueprint_class_path"]
    assert "scene_bytes" in wire.refusal("spawn_actor", blueprint=blueprint, actor_id="x")[1]


@pytest.mark.mujoco("3.17")
def test_what_robots_of_a_kind_share_counts_once(serve: Serve, tmp_path: Path) -> None:
    (tmp_path / "plaid.xml").write_text(
        '<mujoco><asset><texture name="t" type="2d" builtin="checker" width="700" height="1000" rgb1="1 0 0"/>'
        '<material name="t" texture="t"/></asset><worldbody><body><freejoint/><geom size="0.1" material="t"/></body>'
        "</worldbody></mujoco>",
        encoding="utf-8",
    )
    wire = serve(limits=Limits(scene_bytes=24 * 2**20), model_roots=[tmp_path])
    wire.ask("create_level", name="fresh")
    blueprint = wire.ask("import_xml", path=str(tmp_path / "plaid.xml"))["blueprint_class_path"]
    for i in range(16):  # 2 MB each
        wire.ask("spawn_actor", blueprint=blueprint, actor_id=f"r{i}", location=[3.0 * i, 0.0, 0.0])
    wire.ask("ensure_manager")
    assert wire.ask("begin_pie")["compile_error"] == ""


def test_steps_beyond_the_limit_are_refused_and_the_rest_can_be_broken_off(serve: Serve) -> None:
    wire = serve("bot", play=True, unpaused=True, step_mode="direct", limits=SMALL)
    assert wire.refusal("step", n_steps=10**9) == (
        "bad_request",
        "step: 1000000000 steps are more than the limit n_steps, 50",
    )
    assert wire.ask("step", n_steps=50)["step"] == 50


def test_a_server_closes_in_the_middle_of_a_million_steps(models: Path, connect: Callable[..., Wire]) -> None:
    with SimulatedServer(models / "bot.xml", play=True, unpaused=True, step_mode="direct") as server:
        wire = connect(server)
        wire.hello()
        core = server._running.core
        assert core is not None
        engine = core.play.running().engine
        engine.on_substep.append(lambda: eventually(lambda: engine._stopping))  # or it may have ended by then
        engine._step_timeout_s = 60.0
        wire._socket.send(pack({"op": "step", "session_id": wire.session_id, "n_steps": 1_000_000}))
        eventually(lambda: engine.time > 0.0, "it was not under way")
        server.close()
        assert engine.time < 1_000_000 * 0.002
    assert b"shutting_down" in wire._socket.recv()


def test_a_recording_too_large_to_load(serve: Serve, tmp_path: Path) -> None:
    (tmp_path / "long.json").write_text('{"Frames": [' + "{}," * 100 + "{}]}")
    wire = serve("bot", play=True, model_roots=[tmp_path], limits=SMALL)
    code, message = wire.refusal("replay_load", path=str(tmp_path / "long.json"))
    assert (code, "recording_file_bytes" in message) == ("path_not_readable", True)


@pytest.mark.parametrize("restored", [False, True])
def test_drawings_give_way(restored: bool, models: Path) -> None:
    with SimulatedServer(models / "bot.xml", limits=SMALL) as server:
        if restored:
            server.restore()
        with Wire(server) as wire:
            wire.hello()
            for x in range(10):
                wire.ask("draw_marker", location=[x, 0, 0], color=[1, 0, 0], ttl=-1)
            kept = wire.core.drawings.take_frame(in_play=False)
    assert [stroke.at[0] for (stroke,) in kept] == [7, 8, 9], "the newest stay"


def test_a_frame_beyond_all_limits_costs_its_sender_the_connection(small: Wire) -> None:
    monitor = small._socket.get_monitor_socket(zmq.Event.DISCONNECTED)
    small._socket.send(b"x" * 300_000)
    assert monitor.poll(30_000)
    small._socket.disable_monitor()
    monitor.close(0)


# What goes wrong inside


def test_no_reply_tells_of_the_program(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    from urlab_client.server.rpc.dispatch import Dispatcher

    wire = serve("bot", play=True)

    def broken(*_: object) -> None:
        raise RuntimeError("secret /home/ada/token")

    monkeypatch.setattr(Dispatcher, "_serve", broken)
    for name in ALPHA.ops:
        reply = wire.raw({"op": name, "session_id": wire.session_id})
        assert reply == {
            "op": "error",
            "code": "internal_error",
            "message": f"{name}: the server failed with RuntimeError; its log has the details",
        }


# Slow, silent and many peers


def test_a_subscriber_that_never_reads_slows_nobody(connect: Callable[..., Wire], models: Path) -> None:
    with (
        SimulatedServer(models / "bot.xml", play=True, unpaused=True, step_mode="direct") as server,
        zmq.Context() as context,
        context.socket(zmq.SUB) as lazy,
        context.socket(zmq.SUB) as eager,
    ):
        for socket, limit in ((lazy, 1), (eager, 0)):
            socket.rcvhwm = limit
            socket.linger = 0
            socket.rcvtimeo = 30_000
            socket.subscribe(b"")
            socket.connect(f"{server.address}:{server.state_port}")
        wire = connect(server)
        wire.hello()
        eager.recv_multipart()
        for count in range(1, 2001):
            assert wire.ask("step", n_steps=1)["step"] == count
        newest = struct.pack(">d", 2000.0)  # which whoever reads gets
        eventually(lambda: newest in eager.recv_multipart()[1], look=0)


def test_connections_that_say_nothing_do_not_keep_others_out() -> None:
    with SimulatedServer() as server:
        silent = [sockets.create_connection(("127.0.0.1", server.step_port)) for _ in range(200)]
        try:
            with Wire(server) as wire:
                assert wire.hello()["session_id"]
        finally:
            for connection in silent:
                connection.close()


def test_connections_that_never_become_peers_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoint, "HANDSHAKE_MS", 100)
    with SimulatedServer() as server:
        for port in (server.step_port, server.state_port, server.ctrl_port, server.info_port):
            with sockets.create_connection(("127.0.0.1", port), timeout=30) as connection:
                eventually(lambda: not connection.recv(1024), "the connection was not closed", look=0)


GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)


def ready(kind: bytes) -> bytes:
    """Return the command with which a ZeroMQ peer of some socket type ends its handshake."""
    body = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    return b"\x04" + bytes([len(body)]) + body


def test_peers_that_answer_no_heartbeat_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endpoint, "HEARTBEAT_MS", 50)
    monkeypatch.setattr(endpoint, "SILENCE_MS", 200)
    with SimulatedServer() as server:
        ports = [(server.step_port, b"DEALER"), (server.state_port, b"SUB"), (server.ctrl_port, b"PUB")]
        for port, kind in [*ports, (server.info_port, b"SUB"), (server.camera_port, b"SUB")]:
            with sockets.create_connection(("127.0.0.1", port), timeout=30) as connection:
                connection.sendall(GREETING + ready(kind))
                received = (connection.recv(1024) for _ in attempts("the connection was not closed"))
                heard = b"".join(itertools.takewhile(bool, received))
            assert b"\x04PING" in heard, "it was a peer"


@contextmanager
def _watched(kind: int, address: str) -> Generator[tuple[zmq.Socket[bytes], zmq.Socket[bytes]]]:
    """Open a socket whose monitor tells of a connection that is closed."""
    with zmq.Context() as context, context.socket(kind) as socket:
        socket.linger = 0
        socket.rcvtimeo = 30_000
        monitor = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        monitor.linger = 0
        socket.connect(address)
        try:
            yield socket, monitor
        finally:
            socket.disable_monitor()
            monitor.close()


def test_a_subscription_that_is_too_long_costs_the_connection() -> None:
    with SimulatedServer() as server:
        for port in (server.state_port, server.info_port):
            with _watched(zmq.SUB, f"{server.address}:{port}") as (socket, monitor):
                socket.subscribe(b"x" * 4200)
                assert monitor.poll(30_000)


def test_a_control_message_that_is_too_long_costs_the_connection(models: Path) -> None:
    with (
        SimulatedServer(models / "bot.xml", play=True) as server,
        _watched(zmq.XPUB, f"{server.address}:{server.ctrl_port}") as (socket, monitor),
    ):
        topic = socket.recv()[1:]
        socket.send_multipart([topic, b"x" * (2**20 + 1)])
        assert monitor.poll(30_000)


def test_a_client_with_several_requests_waiting_gets_every_answer() -> None:
    with SimulatedServer() as server, zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger = 0
        socket.rcvtimeo = 30_000
        socket.connect(f"{server.address}:{server.step_port}")
        for number in range(300):
            socket.send_multipart([str(number).encode(), b"", pack({"op": "meta"})])
        assert [socket.recv_multipart()[0] for _ in range(300)] == [str(number).encode() for number in range(300)]
