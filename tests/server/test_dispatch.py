"""The envelope: order of checks, encodings, error replies, one request at a time."""

from __future__ import annotations

import base64
import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from odd_requests import mangled, plain_request
from wire import Wire, check_numbers, pack, write_level

from urlab_client.enums import PIEState, Transport
from urlab_client.protocol.base import Needs
from urlab_client.protocol.codec import MAX_REQUEST_BYTES
from urlab_client.protocol.messages.runtime import SetPaused, SetPausedOk
from urlab_client.protocol.messages.scene import CurrentLevel, CurrentLevelOk
from urlab_client.protocol.messages.session import Meta, MetaOk
from urlab_client.server import SimulatedServer
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.core import ServerConfig, ServerCore
from urlab_client.server.dialects import ALPHA, BETA
from urlab_client.server.editor.world import EditorWorld
from urlab_client.server.handlers import HANDLERS
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import Dispatcher, HandlerTable

Serve = Callable[..., Wire]


any_request = st.sampled_from(sorted(BETA.ops)).flatmap(plain_request)


@pytest.fixture(scope="module")
def idle(models: Path) -> Iterator[Wire]:
    """A server without a play session, which the tests here leave as it is."""
    with SimulatedServer(models / "bot.xml") as server, Wire(server) as wire:
        wire.hello()
        yield wire


@pytest.fixture(scope="module")
def playing(models: Path) -> Iterator[Wire]:
    """A server in play, which the tests here leave as it is."""
    with SimulatedServer(models / "bot.xml", play=True) as server, Wire(server) as wire:
        wire.hello()
        yield wire


# The order of checks


def code(reply: dict[str, Any]) -> str:
    assert reply["op"] == "error"
    return reply["code"]


@pytest.mark.parametrize("frame", [b"", b"\x00", b"{", b"[]", pack([]), pack("hello"), b"\xff" * 100])
def test_bad_request(idle: Wire, frame: bytes) -> None:
    assert code(idle.raw(frame)) == "bad_request"


def test_requests_of_several_frames_are_none(idle: Wire) -> None:
    one = pack({"op": "create_level", "session_id": idle.session_id, "name": "half"})
    assert code(msgspec.msgpack.decode(idle.exchange(one, one))) == "bad_request"
    assert idle.refused("load_level", level_path="half") == "load_level_failed"  # neither was executed


@pytest.mark.parametrize("request_", [{}, {"op": None}, {"op": []}, {"op": b"hello"}])
def test_missing_op_before_the_session(idle: Wire, request_: dict[str, Any]) -> None:
    assert code(idle.raw({"session_id": "nonsense", **request_})) == "missing_op"


def test_bootstrap_ops_need_no_session(idle: Wire) -> None:
    assert idle.raw({"op": "meta", "session_id": "nonsense"})["op"] == "meta_ok"
    assert idle.raw({"op": "meta"})["op"] == "meta_ok"


@pytest.mark.parametrize("name", ["HELLO", "Meta", "fly", "", "5"])
def test_session_before_the_name_of_the_op(idle: Wire, name: str) -> None:
    assert code(idle.raw({"op": name})) == "session_expired"
    assert idle.refused(name) == "unknown_op"


def test_no_session_before_the_first_hello(models: Path, connect: Callable[[SimulatedServer], Wire]) -> None:
    with SimulatedServer() as server:
        wire = connect(server)
        for session in ({}, {"session_id": ""}, {"session_id": None}):
            assert code(wire.raw({"op": "current_level", **session})) == "session_expired"


@pytest.mark.parametrize("op", [op for op in ALPHA.ops.values() if op.declared_required])
def test_declared_fields_before_the_manager(idle: Wire, op: Any) -> None:
    for absent in op.declared_required:
        fields = dict.fromkeys(op.declared_required)
        del fields[absent]
        got, message = idle.refusal(op.name, **fields)
        assert got == "missing_field"
        assert op.name in message
        assert absent in message


def test_the_first_missing_field_is_named(idle: Wire) -> None:
    assert "'blueprint'" in idle.refusal("spawn_grid", count_x=1)[1]


@pytest.mark.parametrize("op", [op for op in ALPHA.ops.values() if op.needs is Needs.MANAGER])
def test_the_manager_before_the_handler(idle: Wire, op: Any) -> None:
    # Null satisfies the presence check, and fields that only the handler knows are not looked at yet.
    got, message = idle.refusal(op.name, **dict.fromkeys(op.declared_required))
    assert got == "no_active_manager"
    assert op.name in message


def test_not_ready_without_a_model(connect: Callable[[SimulatedServer], Wire], tmp_path: Path) -> None:
    with SimulatedServer(write_level(tmp_path / "speck.json", size=1e-7, quick_convert=True)) as server:
        wire = connect(server)
        wire.hello()
        assert wire.ask("begin_pie")["state"] == "compile_failed"
        error = wire.ask("pie_status")["compile_error"]
        for op in ALPHA.ops.values():
            if op.needs is Needs.MANAGER and op.name in HANDLERS.handlers:
                got, message = wire.refusal(op.name, **dict.fromkeys(op.declared_required))
                assert got == "not_ready"
                assert error in message


# Names in another case


def test_ops_in_another_case(playing: Wire) -> None:
    assert playing.raw({"op": "Set_Paused", "session_id": playing.session_id, "paused": True})["paused"] is True
    assert playing.refusal("Recording_Start") == ("unknown_op", "Recording_Start")
    assert playing.refusal("REPLAY_STOP") == ("unknown_op", "REPLAY_STOP")


def test_ops_in_another_case_need_a_manager_first(idle: Wire) -> None:
    assert idle.refused("Recording_Start") == "no_active_manager"


def test_every_op_is_served() -> None:
    assert set(HANDLERS.handlers) >= set(ALPHA.ops)


# Sessions and encodings


def test_hello_without_play(idle: Wire) -> None:
    reply = idle.hello()
    assert set(reply) == {
        "op",
        "session_id",
        "urlab_version",
        "mujoco_version_int",
        "mujoco_version",
        "manager_present",
        "articulations",
    }
    assert (reply["urlab_version"], reply["manager_present"], reply["articulations"]) == ("urlab/0.1", False, [])


def test_hello_ships_the_model_twice(playing: Wire) -> None:
    reply = playing.hello()
    assert isinstance(reply["mjb"], bytes)
    assert base64.b64decode(reply["mjb_base64"]) == reply["mjb"]
    assert "mjcf_compiled" not in reply
    assert "vfs_assets" not in reply


def test_hello_ships_assets_on_request(playing: Wire) -> None:
    reply = playing.hello(include_assets=True)
    assert "<mujoco" in reply["mjcf_compiled"]
    assert reply["vfs_assets"] == {}


def test_a_new_session_ends_the_old_one(idle: Wire) -> None:
    first = idle.hello()["session_id"]
    second = idle.hello()["session_id"]
    assert first != second
    assert first == first.lower()
    assert [len(part) for part in first.split("-")] == [8, 4, 4, 4, 12]
    assert code(idle.raw({"op": "current_level", "session_id": first})) == "session_expired"


JSON_HELLO = b'{"op":"hello","encoding":"JSON"}'


def test_json_replies_begin_with_hello(serve: Serve, models: Path) -> None:
    wire = serve("bot", play=True)
    reply = wire.exchange(JSON_HELLO)
    assert reply.startswith(b"{")
    decoded = msgspec.json.decode(reply)
    assert base64.b64decode(decoded["mjb__b64__"]) == base64.b64decode(decoded["mjb_base64"])
    assert "mjb" not in decoded
    # Everything is JSON now, errors and answers to msgpack included.
    assert wire.exchange(b"").startswith(b"{")
    assert wire.exchange(pack({"op": "current_level", "session_id": decoded["session_id"]})).startswith(b"{")


@pytest.mark.parametrize("encoding", [None, "msgpack", "xml", 1])
def test_hello_resets_the_encoding(serve: Serve, encoding: object) -> None:
    wire = serve()
    wire.exchange(JSON_HELLO)
    fields = {} if encoding is None else {"encoding": encoding}
    wire.hello(**fields)
    assert wire.raw(b"{")["code"] == "bad_request"


def test_json_requests_get_msgpack_before_any_json_hello(serve: Serve) -> None:
    wire = serve()
    assert wire.raw(b' {"op":"meta"}')["op"] == "meta_ok"
    assert wire.raw(b'{"op":"hello"}')["op"] == "hello_ok"


def test_json_requests_in_every_form(serve: Serve, models: Path) -> None:
    wire = serve()
    request = {"op": "import_xml", "session_id": wire.session_id, "path": str(models / "bot.xml")}
    escaped = msgspec.json.encode(request).replace(b"/", b"\\u002f")
    assert wire.raw(b"\r\n" + escaped)["imported_now"] is True


def test_the_encoding_survives_play(serve: Serve) -> None:
    wire = serve("bot")
    session = msgspec.json.decode(wire.exchange(JSON_HELLO))["session_id"]
    for op in ("begin_pie", "stop_pie", "pie_status"):
        reply = msgspec.json.decode(wire.exchange(pack({"op": op, "session_id": session})))
        assert reply["op"] == f"{op}_ok"


def test_a_frame_beyond_the_limit_is_answered(idle: Wire) -> None:
    reply = idle.raw({"op": "set_overlay_text", "session_id": idle.session_id, "text": "x" * MAX_REQUEST_BYTES})
    assert code(reply) == "bad_request"
    assert str(MAX_REQUEST_BYTES) in reply["message"]


# Without a socket


@pytest.fixture
def core(tmp_path: Path) -> ServerCore:
    world = EditorWorld(ContentRoot(tmp_path))
    return ServerCore(world=world, config=ServerConfig(), camera_endpoint=lambda *_: "tcp://127.0.0.1:5558")


def ask(dispatcher: Dispatcher, transport: Transport = Transport.ZMQ, **request: Any) -> dict[str, Any]:
    frame = dispatcher.answer(pack(request), transport)
    check_numbers(frame)
    return msgspec.msgpack.decode(frame)


@pytest.mark.parametrize("op", [op.name for op in ALPHA.ops.values() if op.needs is Needs.EDITOR])
def test_shared_memory_takes_no_editor_ops(core: ServerCore, op: str) -> None:
    dispatcher = Dispatcher(core, HANDLERS)
    assert code(ask(dispatcher, Transport.SHM, op=op)) == "wrong_transport"


def test_shared_memory_takes_the_others(core: ServerCore) -> None:
    dispatcher = Dispatcher(core, HANDLERS)
    assert code(ask(dispatcher, Transport.SHM)) == "missing_op"
    assert code(ask(dispatcher, Transport.SHM, op="fly")) == "session_expired"
    session = ask(dispatcher, Transport.SHM, op="hello")["session_id"]
    assert code(ask(dispatcher, Transport.SHM, op="fly", session_id=session)) == "unknown_op"
    assert code(ask(dispatcher, Transport.SHM, op="step", session_id=session)) == "no_active_manager"


def test_a_failing_handler_is_an_answer(core: ServerCore, caplog: pytest.LogCaptureFixture) -> None:
    table = HandlerTable()

    @table.handles(Meta)
    def meta(server: ServerCore, request: Meta) -> MetaOk:
        raise ZeroDivisionError("secret detail")

    dispatcher = Dispatcher(core, table)
    with caplog.at_level(logging.ERROR, "urlab_client.server"):
        reply = ask(dispatcher, op="meta")
    assert code(reply) == "internal_error"
    assert "meta" in reply["message"]
    assert "secret" not in reply["message"]
    assert "secret detail" in caplog.text
    assert "Traceback" in caplog.text


def test_a_reply_that_cannot_travel_is_an_answer(core: ServerCore) -> None:
    table = HandlerTable()

    @table.handles(Meta)
    def meta(server: ServerCore, request: Meta) -> MetaOk:
        return MetaOk(ops=[object()])  # type: ignore[list-item]

    assert code(ask(Dispatcher(core, table), op="meta")) == "internal_error"


def test_refusals_become_errors(core: ServerCore) -> None:
    table = HandlerTable()

    @table.handles(Meta)
    def meta(server: ServerCore, request: Meta) -> MetaOk:
        raise Refusal("timeout", "the game thread sleeps")

    assert ask(Dispatcher(core, table), op="meta") == {
        "op": "error",
        "code": "timeout",
        "message": "the game thread sleeps",
    }


def test_handlers_run_one_at_a_time_whatever_the_transport(core: ServerCore) -> None:
    table = HandlerTable()
    entered, leave = threading.Event(), threading.Event()
    inside: list[int] = []

    @table.handles(Meta)
    def meta(server: ServerCore, request: Meta) -> MetaOk:
        inside.append(1)
        assert len(inside) == 1
        entered.set()
        assert leave.wait(60)
        inside.pop()
        return MetaOk(ops=[])

    dispatcher = Dispatcher(core, table)
    replies: list[dict[str, Any]] = []
    threads = [
        threading.Thread(target=lambda transport=transport: replies.append(ask(dispatcher, transport, op="meta")))
        for transport in Transport
    ]
    for thread in threads:
        thread.start()
    assert entered.wait(60)
    leave.set()
    for thread in threads:
        thread.join(60)
    assert replies == [{"op": "meta_ok", "ops": []}] * len(threads)


@pytest.fixture(scope="module")
def fuzzed(models: Path) -> Iterator[tuple[Dispatcher, ServerCore]]:
    with SimulatedServer(models / "bot.xml", models / "hand.xml", play=True) as server:
        opened = server._opened
        assert opened is not None
        yield Dispatcher(opened.core, HANDLERS), opened.core


@given(request_=any_request | mangled(any_request))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)
def test_no_request_makes_the_server_fail(fuzzed: tuple[Dispatcher, ServerCore], request_: dict[str, Any]) -> None:
    dispatcher, core = fuzzed
    core.session.json = False
    core.session.id = "s"
    if core.play.state is not PIEState.READY:
        core.begin_play()
        core.play.wait(60.0)
    frame = dispatcher.answer(pack({**request_, "session_id": "s"}))
    if core.session.json:
        reply = msgspec.json.decode(frame)
    else:
        check_numbers(frame)
        reply = msgspec.msgpack.decode(frame)
    assert reply["op"] == "error" or reply["op"].endswith("_ok")
    assert reply.get("code") != "internal_error"


def test_registration_mistakes() -> None:
    table = HandlerTable()
    with pytest.raises(TypeError, match="CurrentLevelOk"):

        @table.handles(SetPaused)
        def wrong_reply(server: ServerCore, request: SetPaused) -> CurrentLevelOk:
            return CurrentLevelOk(level_path="")

    @table.handles(CurrentLevel)
    def once(server: ServerCore, request: CurrentLevel) -> CurrentLevelOk:
        return CurrentLevelOk(level_path="")

    with pytest.raises(TypeError, match="two handlers"):
        table.handles(CurrentLevel)(once)

    class Impostor(CurrentLevel, tag="set_paused", kw_only=True):
        """Carries the tag of another op."""

    with pytest.raises(TypeError, match="Impostor"):
        table.handles(Impostor)

    @table.handles(SetPaused)
    def paused(server: ServerCore, request: SetPaused) -> SetPausedOk:
        return SetPausedOk(paused=True)

    assert set(table.handlers) == {"current_level", "set_paused"}
