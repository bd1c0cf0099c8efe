"""Reading requests: detection of the encoding, lenient coercion, and agreement of the two ways."""

from __future__ import annotations

import base64
import contextlib
import math
import struct
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_requests import every_kind, mangled, plain_request

from urlab_client.protocol.codec import MAX_REQUEST_BYTES, encode_request
from urlab_client.protocol.messages import runtime, scene
from urlab_client.protocol.messages.session import ArticulationCommand, Step
from urlab_client.server.dialects import ALPHA, BETA
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.requests import Incoming, RequestReader, need, usable

READER = RequestReader()
DEPTH = Limits().request_depth
pack = msgspec.msgpack.encode


def read(request: object) -> Incoming:
    return READER.read(request if isinstance(request, bytes) else pack(request))


def fields(request: object, *names: str) -> Any:
    """Return the named attributes of the request that these bytes or this map mean."""
    typed = read(request).request
    values = tuple(getattr(typed, name) for name in names)
    return values[0] if len(values) == 1 else values


def refused(frame: bytes) -> str:
    with pytest.raises(Refusal) as caught:
        READER.read(frame)
    assert caught.value.code == "bad_request"
    return caught.value.message


def as_plain(value: object) -> object:
    return msgspec.to_builtins(value, enc_hook=lambda array: array.tolist(), order="sorted")


def same(one: Incoming, other: Incoming) -> bool:
    """Compare through `repr`, which tells -0.0 from 0.0 and equates NaN with itself."""
    parts = [(i.name, i.op, i.session_id, i.missing, repr(as_plain(i.request))) for i in (one, other)]
    return parts[0] == parts[1]


# Detection of the encoding


@pytest.mark.parametrize("lead", [b"", b" ", b"\t", b"\r", b"\n", b" \r\n\t"])
def test_json_after_white_space(lead: bytes) -> None:
    assert read(lead + b'{"op":"meta"}').op is ALPHA.ops["meta"]


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"hello",
        b"[]",
        b" []",
        b"{",
        b'{"op":"meta"',
        b"\xef\xbb\xbf" + b'{"op":"meta"}',
        pack([1]),
        pack("meta"),
        pack(None),
        pack({"op": "meta"})[:-1],
        b"\xc1",
        b"\x81",
        b" " + pack({"op": "meta"}),
        b'{"op":"\xff"}',
        b"\x81\xa2op\xa1\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
    ],
)
def test_neither_map_nor_object(frame: bytes) -> None:
    assert refused(frame) == "the request is neither a msgpack map nor a JSON object"


@pytest.mark.parametrize("surplus", [b"\x00", b"\xc1", b"{", pack({"op": "hello"}), b"\x00" * 1000])
def test_bytes_after_a_msgpack_map_are_ignored(surplus: bytes) -> None:
    incoming = read(pack({"op": "set_paused", "session_id": "s", "paused": True}) + surplus)
    assert incoming.op is ALPHA.ops["set_paused"]
    assert incoming.session_id == "s"


@given(st.dictionaries(st.text(max_size=5), every_kind), st.binary(max_size=9))
def test_surplus_after_any_map(request: dict[str, Any], surplus: bytes) -> None:
    frame = pack({**request, "op": "meta", "session_id": "s"})
    assert same(read(frame + surplus), read(frame))


@given(st.binary(max_size=200))
def test_noise_is_answered(frame: bytes) -> None:
    with contextlib.suppress(Refusal):
        READER.read(frame)


def test_frame_limit() -> None:
    frame = pack({"op": "set_overlay_text", "text": "x" * MAX_REQUEST_BYTES})
    assert str(MAX_REQUEST_BYTES) in refused(frame)
    assert refused(b'{"op":"set_overlay_text","text":"' + b"x" * MAX_REQUEST_BYTES + b'"}')


def nested(depth: int) -> dict[str, Any]:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return {"op": "meta", "x": value}


def test_depth_limit() -> None:
    assert read(nested(DEPTH - 1)).op is ALPHA.ops["meta"]
    assert "deeper" in refused(pack(nested(DEPTH)))
    assert "deeper" in refused(msgspec.json.encode(nested(DEPTH)))


@pytest.mark.parametrize(
    "frame",
    [
        b"\x91" * 1_000_000,
        b"\x81\xa1a" * 1_000_000,
        b"\x82\xa1x" + b"\x91" * 1_000_000,
        b"\x82\xa2op\xa4step" + b"\xa4qpos" + b"\x91" * 1_000_000 + b"\x01",
        b'{"a":' * 1_000_000,
        b'{"op":"meta","x":' + b"[" * 500_000 + b"]" * 500_000 + b"}",
    ],
)
def test_hostile_depth_is_refused(frame: bytes) -> None:
    refused(frame)


# The envelope


def test_fields_of_the_envelope() -> None:
    incoming = read({"op": "current_level", "session_id": "abc"})
    assert (incoming.name, incoming.session_id, incoming.missing) == ("current_level", "abc", ())
    assert isinstance(incoming.request, scene.CurrentLevel)


@pytest.mark.parametrize("request_", [{}, {"op": None}, {"op": [1]}, {"op": {}}, {"op": b"meta"}])
def test_no_usable_op(request_: dict[str, Any]) -> None:
    assert read(request_).name is None


def test_op_of_another_type_is_read_as_text() -> None:
    assert read({"op": 5}).name == "5"
    assert read({"op": True}).name == "true"


def test_op_names_in_another_case() -> None:
    assert read({"op": "Set_Paused", "paused": True}).op is ALPHA.ops["set_paused"]
    assert read({"op": "HELLO"}).op is None
    assert read({"op": "Meta"}).op is None


def test_unknown_op_keeps_the_session_id() -> None:
    assert read({"op": "fly", "session_id": "abc"}) == Incoming("fly", session_id="abc")


@pytest.mark.parametrize(
    ("value", "read_as"), [(7, "7"), (7.5, "7.5"), (True, "true"), (None, ""), ([], ""), (b"s", "")]
)
def test_session_id_of_another_type(value: object, read_as: str) -> None:
    assert read({"op": "current_level", "session_id": value}).session_id == read_as


def test_missing_lists_declared_fields_in_order() -> None:
    assert read({"op": "spawn_grid"}).missing == ("blueprint", "base_actor_id", "count_x", "count_y")
    assert read({"op": "spawn_grid", "base_actor_id": None, "count_y": "x"}).missing == ("blueprint", "count_x")
    assert read({"op": "draw_line", "to": 1, "color": 1}).missing == ("from",)
    assert read({"op": "load_level", "name": "lab"}).missing == ("level_path",)


def test_a_byte_string_hides_its_field() -> None:
    assert read({"op": "set_paused", "paused": b"\x01"}).missing == ("paused",)
    assert read({"op": "set_qpos", "target": "a", "qpos": struct.pack("<d", 1.0)}).missing == ("qpos",)
    assert fields(
        {"op": "configure_controller", "articulation": "a", "params": {"kp": b"\x01", "x": [b"\x01"]}}, "params"
    ) == {
        "kp__b64__": base64.b64encode(b"\x01").decode(),
        "x": [base64.b64encode(b"\x01").decode()],
    }


def test_fields_that_only_the_handler_requires_are_not_missing() -> None:
    for op in ("set_mode", "set_control_source", "set_twist", "set_sim_options", "replay_load", "replay_set_active"):
        incoming = read({"op": op})
        assert incoming.missing == ()


def test_required_field_without_a_usable_value() -> None:
    request = read({"op": "set_paused", "paused": None}).request
    assert isinstance(request, runtime.SetPaused)
    assert usable(request.paused, otherwise=False) is False
    with pytest.raises(Refusal, match="paused") as caught:
        need(request, request.paused, "paused")
    assert caught.value.code == "missing_field"
    assert "set_paused" in caught.value.message


def test_required_text_must_not_be_empty() -> None:
    request = read({"op": "import_xml", "path": ""}).request
    assert isinstance(request, scene.ImportXml)
    with pytest.raises(Refusal, match="path"):
        need(request, request.path, "path")
    assert need(request, "x.xml", "path") == "x.xml"


# Coercion


def test_field_names_in_any_case() -> None:
    assert fields({"OP": "step", "Session_ID": "s", "N_Steps": 3}, "session_id", "n_steps") == ("s", 3)
    assert fields({"op": "get_contacts", "Filter": {"BODY1": "a"}}, "filter") == runtime.ContactFilter(body1="a")


def test_the_last_of_several_spellings_wins() -> None:
    assert fields({"op": "step", "n_steps": 2, "N_STEPS": 3}, "n_steps") == 3
    assert fields({"op": "step", "N_STEPS": 2, "n_steps": 3}, "n_steps") == 3
    twice = b"\x83\xa2op\xa4step\xa7n_steps\x02\xa7n_steps\x03"
    assert fields(twice, "n_steps") == 3
    assert fields(b'{"op":"step","n_steps":2,"n_steps":3}', "n_steps") == 3
    other_op = b"\x82\xa2op\xa4step\xa2op\xa4meta"
    assert read(other_op).op is ALPHA.ops["meta"]


def test_names_in_maps_that_differ_in_case_only_collapse() -> None:
    commands = fields({"op": "step", "per_articulation": {"A": {"ctrl": [1]}, "a": {"ctrl": [2]}}}, "per_articulation")
    assert commands == {"a": ArticulationCommand(ctrl=[2.0])}
    maps = fields({"op": "step", "per_articulation": {"a": {"ctrl_map": {"m": 1, "M": 2}}}}, "per_articulation")
    assert maps == {"a": ArticulationCommand(ctrl_map={"M": 2.0})}


def test_keys_that_are_no_text_are_dropped() -> None:
    assert fields({"op": "step", 1: 2, None: 3, b"n_steps": 7}, "n_steps") == 1
    assert fields({"op": "reset", "per_articulation_qpos": {"a": {1: 1.0, "j": 2.0}}}, "per_articulation_qpos") == {
        "a": {"j": 2.0}
    }


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (3, 3),
        (3.0, 3),
        (2.5, 3),
        (2.4, 2),
        (-2.5, -3),
        (True, 1),
        ("3", 3),
        ("+3.5", 4),
        (".5", 1),
        ("5.", 5),
        (2**31 - 1, 2**31 - 1),
        # what follows counts as absent, so the default holds
        (2**31, 1),
        (-(2**31) - 1, 1),
        (2**64 - 1, 1),
        (1e300, 1),
        (math.nan, 1),
        (math.inf, 1),
        ("3e0", 1),
        ("", 1),
        ("three", 1),
        (" 3", 1),
        ("٣", 1),
        (None, 1),
        ([3], 1),
        ({"a": 3}, 1),
        (msgspec.msgpack.Ext(1, b""), 1),
    ],
)
def test_whole_numbers(value: object, expected: int) -> None:
    assert fields({"op": "step", "n_steps": value}, "n_steps") == expected


def test_json_integer_beyond_any_float() -> None:
    assert fields(b'{"op":"step","n_steps":1' + b"0" * 400 + b"}", "n_steps") == 1
    assert fields(b'{"op":"begin_pie","timeout_s":1' + b"0" * 400 + b"}", "timeout_s") == math.inf


@pytest.mark.parametrize(
    ("value", "expected"),
    [(1, 1.0), (True, 1.0), ("-.25", -0.25), (0.1, 0.1), ("1e3", 30.0), (None, 30.0), ([], 30.0), ("inf", 30.0)],
)
def test_numbers(value: object, expected: float) -> None:
    assert fields({"op": "begin_pie", "timeout_s": value}, "timeout_s") == expected


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (True, True),
        (1, True),
        (-0.5, True),
        (0, False),
        ("true", True),
        ("YES", True),
        ("on", True),
        ("-10", True),
        ("000", False),
        ("0", False),
        ("1.0", False),
        ("no", False),
        ("", False),
        (None, False),
        ([], False),
    ],
)
def test_flags(value: object, expected: bool) -> None:
    assert fields({"op": "hello", "include_assets": value}, "include_assets") is expected


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("x", "x"),
        (3, "3"),
        (3.0, "3"),
        (0.5, "0.5"),
        (-1, "-1"),
        (True, "true"),
        (False, "false"),
        (None, ""),
        ({}, ""),
    ],
)
def test_text(value: object, expected: str) -> None:
    assert fields({"op": "spawn_light", "actor_id": value}, "actor_id") == expected


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ([1, 2, 3], (1.0, 2.0, 3.0)),
        ([1, "2", True], (1.0, 2.0, 1.0)),
        ([1, None, "x"], (1.0, 0.0, 0.0)),
        ([1, 2], (0.0, 0.0, 0.0)),
        ([1, 2, 3, 4], (0.0, 0.0, 0.0)),
        ("1 2 3", (0.0, 0.0, 0.0)),
        ({"x": 1}, (0.0, 0.0, 0.0)),
        (struct.pack("<3d", 1, 2, 3), (0.0, 0.0, 0.0)),
        (None, (0.0, 0.0, 0.0)),
    ],
)
def test_vectors_of_fixed_length(value: object, expected: tuple[float, ...]) -> None:
    assert fields({"op": "spawn_light", "location": value}, "location") == expected


def test_vectors_of_any_length() -> None:
    qpos = fields({"op": "step", "qpos": [1, "2.5", None, [], True]}, "qpos")
    assert isinstance(qpos, np.ndarray)
    assert qpos.dtype == np.float64
    assert qpos.tolist() == [1.0, 2.5, 0.0, 0.0, 1.0]
    assert fields({"op": "step", "qpos": []}, "qpos").shape == (0,)
    assert fields({"op": "step", "qpos": "1"}, "qpos") is None
    assert fields({"op": "step", "qpos": [[1.0]]}, "qpos").tolist() == [0.0]


def test_maps_of_numbers() -> None:
    commands = {"a": {"ctrl_map": {"m": "1", "n": None}, "ctrl": {"m": 1}, "control_mode": 3}, "b": 4, "c": None}
    assert fields({"op": "step", "per_articulation": commands}, "per_articulation") == {
        "a": ArticulationCommand(ctrl_map={"m": 1.0, "n": 0.0}, control_mode="3")
    }
    assert fields({"op": "step", "per_articulation": [1]}, "per_articulation") is None


def test_wrenches_that_are_no_arrays_are_left_out() -> None:
    commands = {"a": {"xfrc_applied": {"b": [1, 2, 3, 4, 5, 6], "c": None, "d": 1, "e": ["x"]}}}
    read_commands = fields({"op": "step", "per_articulation": commands}, "per_articulation")
    assert read_commands["a"].xfrc_applied == {"b": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "e": [0.0]}


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (True, True),
        (1, True),
        ("false", False),
        (None, False),
        ([], False),
        ({"a": "sync", "b": None, "c": 3, "d": []}, {"a": "sync", "b": None, "c": "3", "d": ""}),
    ],
)
def test_flag_or_map(value: object, expected: object) -> None:
    assert fields({"op": "step", "include_cameras": value}, "include_cameras") == expected


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("actor_name", "actor_name"),
        ("Actor_Name", "actor_name"),
        ("actor_id", "actor_id"),
        ("x", "actor_id"),
        (1, "actor_id"),
    ],
)
def test_choices(value: object, expected: str) -> None:
    assert fields({"op": "destroy_actor", "target": "a", "target_by": value}, "target_by") == expected


def test_unknown_fields_are_ignored() -> None:
    assert fields({"op": "set_paused", "paused": True, "later": {"a": [1]}}, "paused") is True


def test_any_values_lose_what_the_plugin_would_drop() -> None:
    params = {"kp": {"m": 1, "M": 2}, "ext": msgspec.msgpack.Ext(1, b""), "n": 1}
    assert fields({"op": "configure_controller", "articulation": "a", "params": params}, "params") == {
        "kp": {"M": 2},
        "ext": None,
        "n": 1,
    }


class LevelByName(scene.LoadLevel, tag="load_level", kw_only=True):
    """Reads a field that clients do not send."""

    name: str = ""


def test_a_wider_struct_reads_more() -> None:
    reader = RequestReader(structs={"load_level": LevelByName})
    for request in (
        {"op": "load_level", "level_path": "", "name": "lab"},
        {"Op": "load_level", "level_path": "", "NAME": "lab"},
    ):
        typed = reader.read(pack(request)).request
        assert isinstance(typed, LevelByName)
        assert (typed.name_or_path, typed.name) == ("", "lab")


def test_a_wider_struct_must_derive_from_the_declared_one() -> None:
    with pytest.raises(TypeError, match="LoadLevel"):
        RequestReader(structs={"load_level": scene.CreateLevel})


# What comes often is decoded directly, which shows in nothing but time


READER_OF_ALL = RequestReader(ops=BETA.ops)


def agree(request: dict[str, Any]) -> None:
    """Check that the direct way and the lenient one, which an unknown field calls for, read the same."""
    frames = pack(request), pack({**request, "later": None})
    assert same(*map(READER_OF_ALL.read, frames))


HOT = sorted(op.name for op in BETA.ops.values() if op.hot)
plain_hot_requests = st.sampled_from(HOT).flatmap(plain_request)


@given(plain_hot_requests)
def test_both_ways_agree_on_plausible_requests(request: dict[str, Any]) -> None:
    agree(request)


@given(mangled(plain_hot_requests))
def test_both_ways_agree_on_odd_requests(request: dict[str, Any]) -> None:
    agree(request)


def test_bytes_are_read_beside_an_unknown_field() -> None:
    agree({"op": "upload_model_chunk", "upload_id": "u", "kind": "xml", "data": b"\x00\xff"})


@pytest.mark.parametrize("op", [op for op in BETA.ops if op != "configure_controller"])
def test_what_our_client_sends_is_read_as_it_means_it(op: str) -> None:
    samples: dict[str, Any] = {
        "target": "a",
        "text": "t",
        "qpos": np.zeros(3),
        "count_x": 1,
        "count_y": 1,
        "percent": 5.0,
        "data": b"abc",
        "assets": [],
        "cameras": {},
        "pos": (1.0, 2.0, 3.0),
        "quat": (1.0, 0.0, 0.0, 0.0),
    }
    vectors = ("location", "color", "from_", "to", "center", "half_extents")
    required = [f.name for f in msgspec.structs.fields(BETA.ops[op].request) if f.required]
    values = {name: samples.get(name, (1.0, 2.0, 3.0) if name in vectors else "x") for name in required}
    if op == "set_paused":
        values["paused"] = True
    if op == "set_sim_options":
        values["options"] = runtime.SimOptions(timestep=0.001)
    request = BETA.ops[op].request(**values)
    for json in (False, True):
        incoming = READER_OF_ALL.read(encode_request(request, "s", json=json))
        request.session_id = "s"
        assert (incoming.op, as_plain(incoming.request)) == (BETA.ops[op], as_plain(request))


def test_every_field_of_a_step_is_read_as_our_client_means_it() -> None:
    request = Step(
        n_steps=4,
        observations="full",
        include_cameras={"cam": "sync", "other": None},
        per_articulation={"a": ArticulationCommand(ctrl=[1.0], ctrl_map={"m": 1.0}, xfrc_applied={"b": [0.0] * 6})},
        qpos=np.arange(3.0),
        time=1.0,
    )
    incoming = READER.read(encode_request(request, "s"))
    request.session_id = "s"
    assert as_plain(incoming.request) == as_plain(request)
    assert incoming.session_id == "s"
