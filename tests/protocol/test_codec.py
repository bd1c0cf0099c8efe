"""Requests and replies as bytes: golden frames, the plugin's number rules, JSON, and what is refused."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import filled
from vectors import load

from urlab_client.errors import (
    PathNotWritable,
    ProtocolError,
    SessionTakenOver,
    URLabError,
    WrongTransport,
)
from urlab_client.events import ClientEvent
from urlab_client.protocol import codec
from urlab_client.protocol.base import Op, Reply, Request
from urlab_client.protocol.codec import (
    check_finite,
    check_request,
    decode_reply,
    encode_message,
    encode_reply,
    encode_request,
)
from urlab_client.protocol.messages.jobs import OpStarted
from urlab_client.protocol.messages.recording import RecordingSaveOk
from urlab_client.protocol.messages.runtime import SetModeOk, SetPausedOk, SetSimSpeed
from urlab_client.protocol.messages.session import (
    ArticulationCommand,
    ArticulationState,
    BodyPose,
    Clock,
    EntityState,
    ErrorReply,
    HelloOk,
    InstanceInfo,
    ResetOk,
    Step,
    StepOk,
    TwistState,
)
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.registry import OPS
from urlab_client.protocol.sim_options import SimOptions
from urlab_client.server.dialects import ALPHA, BETA
from urlab_client.values.plain import plain as plain_data

OPS_BY_NAME = sorted(OPS)


def numbers_of(frame: bytes) -> list[object]:
    """All numbers in a msgpack frame, with the types they travel as."""

    def walk(value: object) -> list[object]:
        if isinstance(value, dict):
            return [n for item in value.values() for n in walk(item)]
        if isinstance(value, list):
            return [n for item in value for n in walk(item)]
        return [] if isinstance(value, bool) or not isinstance(value, (int, float)) else [value]

    return walk(msgspec.msgpack.decode(frame))


def plain(value: Any) -> Any:
    """Return a reply without structs, arrays and what stays encoded."""
    match value:
        case msgspec.Struct():
            return plain({name: getattr(value, name) for name in value.__struct_fields__})
        case dict():
            return {key: plain(item) for key, item in value.items()}
        case list() | tuple() | np.ndarray():
            return [plain(item) for item in value]
        case msgspec.Raw():
            return None
        case _:
            return value


@pytest.mark.parametrize("name", OPS_BY_NAME)
@pytest.mark.parametrize("json", [False, True])
def test_every_reply_survives_the_wire(name: str, json: bool) -> None:
    op = OPS[name]
    reply = filled(op.reply)
    before = plain(reply)
    decoded = decode_reply(op, op.reply, encode_reply(reply, json=json))
    assert type(decoded) is op.reply
    assert plain(decoded) == before


def content(value: Any) -> Any:
    """Return a copy of a value and of all that it holds, with the type of each part."""
    match value:
        case msgspec.Struct():
            inside: Any = {name: content(getattr(value, name)) for name in value.__struct_fields__}
        case dict():
            inside = {key: content(item) for key, item in value.items()}
        case list() | tuple():
            inside = [content(item) for item in value]
        case np.ndarray():
            inside = (value.dtype, value.tolist())
        case msgspec.Raw():
            inside = bytes(value)
        case _:
            inside = value
    return type(value), inside


ENCODERS: dict[str, Callable[[Any], object]] = {
    "alpha": lambda message: encode_reply(ALPHA.shaped(message)),
    "beta": lambda message: encode_reply(BETA.shaped(message)),
    "json": lambda message: encode_reply(message, json=True),
    "published": encode_message,
    "plain data": lambda message: plain_data(message, "list"),
}
REPLIES = [op.reply for op in OPS.values()]
PUBLISHED = [StateSnapshot, InstanceInfo, *ClientEvent.__subclasses__()]


@pytest.mark.parametrize("encoder", ENCODERS)
def test_encoding_leaves_what_it_encodes_as_it_was(encoder: str) -> None:
    messages = [filled(kind) for kind in (*REPLIES, *PUBLISHED, ErrorReply, OpStarted)]
    before = content(messages)
    for message in messages:
        ENCODERS[encoder](message)
    assert content(messages) == before


@pytest.mark.parametrize("json", [False, True])
def test_encoding_leaves_requests_as_they_were(json: bool) -> None:
    requests: list[Any] = [filled(op.request) for op in OPS.values()]
    before = content(requests)
    for request in requests:
        assert b"another session" in encode_request(request, "another session", json=json)
    assert content(requests) == before


@pytest.mark.parametrize("name", OPS_BY_NAME)
def test_every_number_of_every_reply_is_a_float64(name: str) -> None:
    numbers = numbers_of(encode_reply(filled(OPS[name].reply)))
    assert all(type(number) is float for number in numbers)


@pytest.mark.parametrize("name", OPS_BY_NAME)
def test_every_request_passes_its_own_check(name: str) -> None:
    request = filled(OPS[name].request)
    assert isinstance(request, Request)
    frame = encode_request(request, "sid")
    check_request(request, frame)
    plain = msgspec.msgpack.decode(frame)
    assert plain["op"] == name
    assert plain["session_id"] == "sid"


def test_defaults_do_not_travel() -> None:
    assert msgspec.msgpack.decode(encode_request(Step(), "sid")) == {"op": "step", "session_id": "sid"}


@pytest.mark.parametrize("vector", ["rpc_req_step_ints", "rpc_req_step_floats"])
def test_golden_step_requests_mean_what_we_send(vector: str) -> None:
    golden = msgspec.msgpack.decode(load(vector).data)
    ours = Step(n_steps=10, per_articulation={"g1": ArticulationCommand(ctrl=[0.5, -0.25])})
    sent = msgspec.msgpack.decode(encode_request(ours, golden["session_id"]))
    golden.pop("observations", None)
    assert sent == golden


def test_golden_float32_request() -> None:
    golden = msgspec.msgpack.decode(load("rpc_req_float32").data, type=SetSimSpeed)
    assert golden.percent == 25.0


def test_golden_replies() -> None:
    paused = load("rpc_rep_set_paused_ok").data
    assert decode_reply(OPS["set_paused"], SetPausedOk, paused).paused is True
    assert encode_reply(SetPausedOk(paused=True)) == paused
    mode = load("rpc_rep_set_mode_ok").data
    assert decode_reply(OPS["set_mode"], SetModeOk, mode).current_mode == "direct"
    assert encode_reply(SetModeOk(previous_mode="live", current_mode="direct")) == mode
    error = load("rpc_rep_wrong_transport")
    decoded = error.decoded
    assert encode_reply(ErrorReply(code=decoded["code"], message=decoded["message"])) == error.data


@pytest.mark.parametrize(
    ("vector", "error"), [("rpc_rep_wrong_transport", WrongTransport), ("rpc_rep_session_expired", SessionTakenOver)]
)
def test_golden_refusals_become_typed_errors(vector: str, error: type[URLabError]) -> None:
    with pytest.raises(error, match=re.escape(load(vector).decoded["message"])):
        decode_reply(OPS["step"], StepOk, load(vector).data)


def test_golden_camera_block() -> None:
    vector = load("rpc_rep_camera_block")
    reply = {"op": "step_ok", "time": 0.0, "step": 0.0, "per_articulation": {}}
    plain = msgspec.msgpack.decode(vector.data)
    reply["cameras"] = plain.get("cameras", plain)
    decoded = decode_reply(OPS["step"], StepOk, msgspec.msgpack.encode(reply))
    assert decoded.cameras is not None
    (frame,) = decoded.cameras.values()
    assert (frame.width, frame.height, frame.dtype) == (2, 2, "bgra8")
    assert frame.data.hex() == vector.decoded["head"]["data_hex"]


def test_a_failed_save_says_where_although_the_plugin_sends_no_message() -> None:
    frame = msgspec.msgpack.encode({"op": "error", "code": "path_not_writable", "absolute_path": "/p/r.json"})
    with pytest.raises(PathNotWritable, match=r"/p/r\.json"):
        decode_reply(OPS["recording_save"], RecordingSaveOk, frame)


def test_the_viewport_answers_under_the_name_of_another_op() -> None:
    op = OPS["set_viewport_mode"]
    frame = msgspec.msgpack.encode({"op": "set_mode_ok", "mode": "Lit"})
    assert decode_reply(op, op.reply, frame).mode == "Lit"  # type: ignore[attr-defined]


def test_what_is_not_finite_is_null_in_json() -> None:
    """The plugin's JSON would be invalid."""
    state = ArticulationState(qpos=np.array([math.nan, 1.5]), qvel=np.array([math.inf, -math.inf]))
    encoded = encode_reply(StepOk(time=math.nan, step=1, per_articulation={"arm": state}), json=True)
    found = json.loads(encoded, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert found["time"] is None
    assert found["per_articulation"]["arm"]["qpos"] == [None, 1.5]
    assert found["per_articulation"]["arm"]["qvel"] == [None, None]


finite = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.lists(finite, max_size=40)
points = st.tuples(finite, finite, finite)
quats = st.tuples(finite, finite, finite, finite)
states = st.builds(
    lambda qpos, qvel, ctrl, sensors, bodies, actions: ArticulationState(
        qpos=np.array(qpos),
        qvel=np.array(qvel),
        ctrl=None if ctrl is None else np.array(ctrl),
        sensors=sensors,
        bodies=bodies,
        twist=TwistState(linear=(0.5, 0, 0), angular=(0, 0, 1)),
        actions=actions,
    ),
    vectors,
    vectors,
    st.none() | vectors,
    st.none() | st.dictionaries(st.text(), vectors, max_size=4),
    st.none() | st.dictionaries(st.text(), st.builds(BodyPose, xpos=points, xquat=quats), max_size=3),
    st.integers(0, 1023),
)


@given(
    time=finite,
    step=st.integers(0, 2**53),
    per_articulation=st.dictionaries(st.text(max_size=8), states, max_size=3),
    entities=st.none() | st.dictionaries(st.text(), st.builds(EntityState, xpos=points, xquat=quats), max_size=2),
)
def test_state_survives_the_wire_bit_for_bit(
    time: float, step: int, per_articulation: dict[str, ArticulationState], entities: dict[str, EntityState] | None
) -> None:
    reply = StepOk(
        time=time, step=step, per_articulation=per_articulation, entities=entities, sim_time=Clock(sec=1, nsec=2)
    )
    expected = msgspec.to_builtins(reply, enc_hook=lambda a: a.tolist())
    decoded = decode_reply(OPS["step"], StepOk, encode_reply(reply))
    assert msgspec.to_builtins(decoded, enc_hook=lambda a: a.tolist()) == expected
    assert isinstance(decoded.step, int)
    assert all(state.qpos.dtype == np.float64 for state in decoded.per_articulation.values())


@given(st.binary(max_size=200))
def test_garbage_is_a_protocol_error_and_nothing_else(frame: bytes) -> None:
    with pytest.raises(ProtocolError) as info:
        decode_reply(OPS["step"], StepOk, frame)
    assert info.value.raw == frame


@given(st.integers(0, 600), st.integers(0, 255))
def test_a_flipped_byte_never_escapes_as_another_error(position: int, value: int) -> None:
    state = ArticulationState(qpos=np.arange(30.0), qvel=np.arange(29.0))
    frame = bytearray(encode_reply(StepOk(time=1, step=2, per_articulation={"robot": state})))
    frame[position % len(frame)] = value
    try:
        decoded: Reply = decode_reply(OPS["step"], StepOk, bytes(frame))
    except URLabError:
        return
    assert isinstance(decoded, StepOk)


def test_deeply_nested_garbage_is_a_protocol_error() -> None:
    with pytest.raises(ProtocolError):
        decode_reply(OPS["step"], StepOk, b"\x81\xa1x" * 100_000 + b"\xc0")


def test_unknown_fields_of_a_newer_server_are_ignored() -> None:
    frame = msgspec.msgpack.encode({"op": "set_paused_ok", "paused": False, "replay": {"current_frame": 3.0}})
    assert decode_reply(OPS["set_paused"], SetPausedOk, frame).paused is False


def test_json_requests_are_ascii() -> None:
    frame = encode_request(OPS["create_level"].request(name="Übung 😀"), "sid", json=True)  # type: ignore[call-arg]
    assert frame.isascii()
    assert msgspec.json.decode(frame)["name"] == "Übung 😀"


def test_json_spells_binary_as_base64() -> None:
    hello = HelloOk(
        session_id="s",
        urlab_version="urlab/0.1",
        mujoco_version_int=1,
        mujoco_version="1",
        manager_present=True,
        mjb=b"\x00\x01",
        vfs_assets={"a.stl": b"\x02"},
        articulations=[],
    )
    plain = msgspec.json.decode(encode_reply(hello, json=True))
    assert plain["mjb__b64__"] == "AAE="
    assert "mjb" not in plain
    assert plain["vfs_assets"] == {"a.stl__b64__": "Ag=="}


def test_an_oversize_request_is_refused() -> None:
    op: Op = OPS["set_overlay_text"]
    with pytest.raises(ValueError, match=r"set_overlay_text: a request of .* exceeds"):
        encode_request(op.request(text="x" * (65 * 1024 * 1024)), "sid")  # type: ignore[call-arg]


@given(number=st.floats())
def test_json_numbers_have_17_significant_digits(number: float) -> None:
    frame = encode_reply(OPS["set_sim_speed"].reply(percent=number), json=True)  # type: ignore[call-arg]
    spelled = b"%.17g" % number if math.isfinite(number) else b"null"
    assert frame == b'{"op":"set_sim_speed_ok","percent":%s}' % spelled


def test_json_numbers_that_are_whole_have_no_point() -> None:
    assert b'"percent":42}' in encode_reply(OPS["set_sim_speed"].reply(percent=42.0), json=True)  # type: ignore[call-arg]
    assert b"0.10000000000000001" in encode_reply(OPS["set_sim_speed"].reply(percent=0.1), json=True)  # type: ignore[call-arg]


def test_an_integer_beyond_any_float_is_a_protocol_error() -> None:
    state = b'{"qpos":[1%b],"qvel":[]}' % (b"0" * 400)
    frame = b'{"op":"step_ok","time":0,"step":1,"per_articulation":{"bot":%b}}' % state
    with pytest.raises(ProtocolError, match="step: the server's answer is not a valid step_ok"):
        decode_reply(OPS["step"], StepOk, frame)


def test_an_array_of_more_dimensions_says_so() -> None:
    frame = b'{"op":"step_ok","time":0,"step":1,"per_articulation":{"bot":{"qpos":[[1,2],[3,4]],"qvel":[]}}}'
    with pytest.raises(ProtocolError, match="expected a flat array of numbers, got 2 dimensions"):
        decode_reply(OPS["step"], StepOk, frame)


@pytest.mark.parametrize(
    ("op", "fields", "named"),
    [
        ("set_sim_speed", {"percent": math.inf}, "percent is inf"),
        ("set_sim_options", {"options": SimOptions(timestep=math.nan)}, "options.timestep is nan"),
        ("set_sim_options", {"options": SimOptions(gravity=(0.0, -math.inf, 1.0))}, r"options.gravity\[1\] is -inf"),
        ("configure_controller", {"articulation": "bot", "params": {"kp": {"elbow": math.inf}}}, None),
        ("recording_start", {"max_duration_s": math.inf}, None),
        ("reset", {"per_articulation_qpos": {"bot": {"elbow": math.nan}}}, "per_articulation_qpos.bot.elbow is nan"),
    ],
)
def test_only_gains_and_the_window_of_a_recording_may_be_infinite(op: str, fields: Any, named: str | None) -> None:
    request = OPS[op].request(**fields)
    if named is None:
        check_finite(request)
        return
    with pytest.raises(ValueError, match=rf"^{op}: {named}; it takes finite numbers\. Nothing was sent\.$"):
        check_finite(request)


def test_a_reply_is_refused_one_byte_beyond_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = encode_reply(SetPausedOk(paused=True))
    monkeypatch.setattr(codec, "MAX_REPLY_BYTES", len(frame))
    assert decode_reply(OPS["set_paused"], SetPausedOk, frame).paused
    monkeypatch.setattr(codec, "MAX_REPLY_BYTES", len(frame) - 1)
    limit = rf"set_paused: a reply of {len(frame)} bytes exceeds the limit {len(frame) - 1}"
    with pytest.raises(ProtocolError, match=limit) as refused:
        decode_reply(OPS["set_paused"], SetPausedOk, frame)
    assert refused.value.op == "set_paused"


def test_a_job_that_nobody_expects_is_named() -> None:
    op, started = OPS["create_level"], encode_reply(OpStarted(job_id="job_7"))
    with pytest.raises(ProtocolError, match="create_level: the server has started job_7 instead of answer") as refused:
        decode_reply(op, op.reply, started)
    assert refused.value.op == "create_level"


def test_a_reply_with_a_state_is_a_snapshot() -> None:
    bot = ArticulationState(qpos=np.array([0.5]), qvel=np.array([0.0]))
    crate = EntityState(xpos=(1.0, 2.0, 3.0), xquat=(1.0, 0.0, 0.0, 0.0))
    stepped = StepOk(time=3.25, step=13, per_articulation={"bot": bot}, entities={"crate": crate})
    snapshot = StateSnapshot.of(stepped)
    assert (snapshot.time, snapshot.step) == (3.25, 13)
    assert snapshot.sim_time == Clock(sec=3, nsec=250_000_000)  # servers without clocks tell only the time
    assert snapshot.wall_time == Clock(sec=0, nsec=0)
    assert snapshot.per_articulation == {"bot": bot}
    assert snapshot.entities == {"crate": crate}
    assert repr(snapshot) == "<StateSnapshot step 13 at 3.250 s: bot>"
    clocks = {"sim_time": Clock(sec=5, nsec=6), "wall_time": Clock(sec=7, nsec=8)}
    told = StateSnapshot.of(ResetOk(time=0.0, step=0, per_articulation={}, **clocks))
    assert (told.sim_time, told.wall_time) == (clocks["sim_time"], clocks["wall_time"])
    assert told.entities == {}
    assert repr(told) == "<StateSnapshot step 0 at 0.000 s: no robots>"


def test_what_has_no_form_as_plain_data_is_named() -> None:
    with pytest.raises(TypeError, match="object has no form in plain data"):
        plain_data({"a": [object()]}, "list")
