"""Golden frames of the generations after the alpha: read into our structs, and written again byte for byte."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
import vectors

from urlab_client._platform.processors import no_fence
from urlab_client.aio.features import Features
from urlab_client.enums import CameraMode
from urlab_client.errors import (
    ControlClaimed,
    HashMismatch,
    LeaseBusy,
    NotControlOwner,
    PayloadTooLarge,
    ProtocolError,
    UnknownJob,
    UnknownOp,
    UnknownUpload,
    URLabRPCError,
    rpc_error,
)
from urlab_client.protocol import shm, topics
from urlab_client.protocol.base import Op, Reply
from urlab_client.protocol.codec import (
    check_request,
    decode_answer,
    decode_job,
    decode_reply,
    encode_reply,
    encode_request,
    from_wire_array,
)
from urlab_client.protocol.messages.jobs import OpStarted, OpStatusOk
from urlab_client.protocol.messages.session import HelloOk, ResetOk, StepOk
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.registry import OPS
from urlab_client.server.dialects import ALPHA, BETA
from urlab_client.values import pictures

REPLIES = {op.reply_name: op for op in OPS.values()} | {"set_mode_ok": OPS["set_mode"]}


def of(prefix: str) -> list[tuple[str, str]]:
    """Generation and name of the vectors after the alpha that begin so."""
    return [(g, v.name) for g in ("june", "beta") for v in vectors.all(g) if v.name.startswith(prefix)]


def op_of_reply(frame: bytes) -> str:
    return str((msgspec.json if frame[:1] == b"{" else msgspec.msgpack).decode(frame)["op"])


def ordered(frame: bytes) -> object:
    """What a frame holds, with the order of its keys and the types of its numbers; how lengths are spelt is open."""

    def pairs(value: object) -> object:
        if isinstance(value, dict):
            return [(key, pairs(item)) for key, item in value.items()]
        if isinstance(value, list):
            return [pairs(item) for item in value]
        return type(value), value

    return pairs(msgspec.msgpack.decode(frame))


ANSWERS = [case for case in of("rpc_rep_") if op_of_reply(vectors.load(case[1], case[0]).data) in REPLIES]
ERRORS = [case for case in of("rpc_rep_") if op_of_reply(vectors.load(case[1], case[0]).data) == "error"]
DIALECTS = {"june": ALPHA, "beta": BETA}


@pytest.mark.parametrize(("generation", "name"), ANSWERS)
def test_a_reply_survives(generation: str, name: str) -> None:
    frame = vectors.load(name, generation).data
    op: Op = REPLIES[op_of_reply(frame)]
    reply: Reply = decode_reply(op, op.reply, frame)
    if generation == "june":
        # The alpha's shape, with fields that the alpha does not send.
        assert msgspec.msgpack.decode(encode_reply(reply)) == msgspec.msgpack.decode(frame)
        return
    if name == "rpc_rep_hello_ok_generation3":
        assert [robot.prefix for robot in decode_reply(op, HelloOk, frame).articulations] == ["arm_a"]
        return
    assert ordered(encode_reply(BETA.shaped(reply))) == ordered(frame)


# A number by itself means what nobody would expect, so clients send none: see the server's tests.
REQUESTS = [case for case in of("rpc_req_") if case[1] != "rpc_req_step_camera_by_number"]


@pytest.mark.parametrize(("generation", "name"), REQUESTS)
def test_a_request_survives(generation: str, name: str) -> None:
    plain = msgspec.msgpack.decode(vectors.load(name, generation).data)
    op = OPS[plain["op"]]
    request = msgspec.convert(plain, op.request, strict=False, dec_hook=from_wire_array)
    frame = encode_request(request, plain.get("session_id", ""))
    check_request(request, frame)
    ours = msgspec.msgpack.decode(frame)
    defaults = {f.encode_name: f.default for f in msgspec.structs.fields(op.request)}
    unsent = {key: value for key, value in plain.items() if key not in ours}
    assert {key: value for key, value in plain.items() if key in ours} == {
        key: value for key, value in ours.items() if key in plain
    }
    assert all(defaults[key] == value for key, value in unsent.items() if key in defaults)
    assert unsent.keys() <= defaults.keys() | {"step_mode"}


@pytest.mark.parametrize(("generation", "name"), ERRORS)
def test_an_error_becomes_its_exception_with_all_it_says(generation: str, name: str) -> None:
    """Beta statement 79."""
    frame = vectors.load(name, generation).data
    plain = (msgspec.json if frame[:1] == b"{" else msgspec.msgpack).decode(frame)
    with pytest.raises(URLabRPCError) as caught:
        decode_reply(OPS["step"], StepOk, frame)
    assert type(caught.value) is type(rpc_error(plain["code"], ""))
    assert caught.value.details == {key: plain[key] for key in plain.keys() - {"op", "code", "message"}}


@pytest.mark.parametrize(
    ("name", "kind", "says"),
    [
        ("rpc_rep_not_control_owner", NotControlOwner, {"owner": "dashboard"}),
        ("rpc_rep_step_not_owner", NotControlOwner, {"owner": "(unclaimed)"}),
        ("rpc_rep_control_claimed", ControlClaimed, {"owner": "dashboard"}),
        ("rpc_rep_lease_busy", LeaseBusy, {"lease_id": "0B1C2D3E-4F50-6172-8394-A5B6C7D8E9F0"}),
        ("rpc_rep_unknown_job", UnknownJob, {}),
        ("rpc_rep_upload_hash_mismatch", HashMismatch, {}),
        ("rpc_rep_upload_unknown", UnknownUpload, {}),
        ("rpc_rep_upload_too_large", PayloadTooLarge, {}),
    ],
)
def test_errors_of_the_beta(name: str, kind: type[URLabRPCError], says: dict[str, str]) -> None:
    with pytest.raises(kind) as caught:
        decode_reply(OPS["step"], StepOk, vectors.load(name, "beta").data)
    assert type(caught.value) is kind
    assert {key: getattr(caught.value, key) for key in says} == says


def test_the_op_that_was_renamed_is_unknown() -> None:
    op = OPS["destroy_actor"]
    with pytest.raises(UnknownOp):
        decode_reply(op, op.reply, vectors.load("rpc_rep_unknown_op_destroy_actor", "june").data)


@pytest.mark.parametrize("name", ["rpc_rep_op_started", "rpc_rep_op_started_json"])
def test_only_an_editor_op_may_begin_a_job(name: str) -> None:
    """Generation 2 statement 51."""
    frame = vectors.load(name, "june").data
    op = OPS["import_xml"]
    started = decode_answer(op, op.reply, frame)
    assert isinstance(started, OpStarted)
    assert started.job_id == "job_1"
    for refused in ("step", "op_status", "meta", "upload_model_commit"):
        with pytest.raises(ProtocolError, match=refused):
            decode_answer(OPS[refused], OPS[refused].reply, frame)


@pytest.mark.parametrize(
    ("op", "name"),
    [
        ("import_xml", "rpc_rep_op_status_done_import"),
        ("spawn_actor", "rpc_rep_op_status_done_spawn"),
        ("remove_actor", "rpc_rep_op_status_done_remove"),
    ],
)
def test_the_result_of_a_job_is_read_as_a_reply(op: str, name: str) -> None:
    """Generation 2 statement 45."""
    status = decode_reply(OPS["op_status"], OpStatusOk, vectors.load(name, "june").data)
    assert status.result is not None
    assert isinstance(decode_job(OPS[op], OPS[op].reply, status.result), OPS[op].reply)
    with pytest.raises(ProtocolError, match="current_level"):
        decode_job(OPS["current_level"], OPS["current_level"].reply, status.result)


def test_a_failed_job_raises_what_the_op_would() -> None:
    """Generation 2 statement 46."""
    op = OPS["remove_actor"]
    status = decode_reply(OPS["op_status"], OpStatusOk, vectors.load("rpc_rep_op_status_failed", "beta").data)
    assert status.result is not None
    with pytest.raises(type(rpc_error("destroy_failed", ""))) as caught:
        decode_job(op, op.reply, status.result)
    assert caught.value.op == "remove_actor"


def test_a_job_whose_result_is_a_job() -> None:
    op = OPS["import_xml"]
    with pytest.raises(ProtocolError, match="another job"):
        decode_job(op, op.reply, {"op": "op_started", "job_id": "job_2", "state": "running"})


def test_both_names_of_the_state_end_in_one_place() -> None:
    """Beta statement 73."""
    op = OPS["step"]
    new = decode_reply(op, StepOk, vectors.load("rpc_rep_step_ok_direct", "beta").data)
    assert new.per_articulation.keys() == {"arm_a"}
    assert new.entities is not None
    assert new.entities.keys() == {"crate", "table"}
    assert (new.frame_id, new.per_articulation["arm_a"].user) == (4242, {"grip_force": 2.5, "mode": "idle"})
    old = decode_reply(op, StepOk, vectors.load("rpc_rep_step_ok_no_frame_id", "june").data)
    assert (old.frame_id, old.arts) == (None, None)
    assert old.per_articulation.keys() == {"arm0"}
    neither = msgspec.msgpack.encode({"op": "reset_ok", "time": 0.0, "step": 0.0})
    assert decode_reply(OPS["reset"], ResetOk, neither).per_articulation == {}


@pytest.mark.parametrize("name", ["msgpack_state_full", "msgpack_state_full_user"])
def test_snapshots(name: str) -> None:
    """Beta statement 73."""
    frame = vectors.load(name, "beta").data
    snapshot = StateSnapshot.decode(frame)
    assert snapshot.per_articulation.keys() == {"arm_a"}
    assert snapshot.entities.keys() == {"crate", "table"}
    assert ordered(encode_reply(BETA.shaped(snapshot))) == ordered(frame)


def test_a_published_snapshot_and_its_region() -> None:
    topic, payload = vectors.load("msg_state_full", "beta").frames
    assert topic == topics.STATE_FULL
    assert StateSnapshot.decode(payload).per_articulation.keys() == {"arm_a"}
    region = vectors.load("shm_region_state_full", "beta")
    found = shm.Region(bytearray(region.data), fence=no_fence).read_latest()
    assert found is not None
    assert found.sequence == region.decoded["header"]["sequence"]
    assert StateSnapshot.decode(found.payload).per_articulation.keys() == {"arm_a"}


@pytest.mark.parametrize("name", [v.name for v in vectors.all("june") if v.name.startswith("ucm1_")])
def test_picture_headers(name: str) -> None:
    """Generation 2 statement 53."""
    vector = vectors.load(name, "june")
    said = vector.decoded
    if vector.expect == "reject":
        with pytest.raises(ProtocolError):
            pictures.decode_camera(vector.data, CameraMode(said["mode"]), said["width"], said["height"])
        return
    frame = pictures.decode_camera(vector.data, CameraMode(said["mode"]), said["width"], said["height"])
    bare = bytes.fromhex(said["pixels_hex"])
    assert np.array_equal(
        frame.pixels, pictures.decode_camera(bare, CameraMode(said["mode"]), said["width"], said["height"]).pixels
    )
    assert (frame.frame_id, frame.sim_time, frame.capture_time) == (
        said["frame_id"],
        said["sim_time"],
        said["capture_unix_time"],
    )


@pytest.mark.parametrize(("generation", "name"), [("june", "msg_camera_v2_2x2"), ("beta", "msg_camera")])
def test_a_published_picture(generation: str, name: str) -> None:
    vector = vectors.load(name, generation)
    topic, payload = vector.frames
    assert topic.decode() == vector.decoded["topic"]
    assert pictures.decode_camera(payload, CameraMode.REAL, 2, 2).frame_id == 4242


# What the answers say about the server.


def features(*ops: str) -> Features:
    return Features().with_ops(ops)


@pytest.mark.parametrize(
    ("ops", "generation"),
    [
        (("destroy_actor",), "alpha"),
        ((), "alpha"),
        (("set_camera_streaming", "op_status", "remove_actor"), "june"),
        (("claim_control", "set_control_source", "configure_controller"), "beta"),
        (("claim_control", "set_camera_streaming"), "3"),
    ],
)
def test_generations(ops: tuple[str, ...], generation: str) -> None:
    assert features(*ops).generation == generation


def test_each_feature_follows_from_its_own_evidence() -> None:
    """Beta statement 77."""
    op = OPS["hello"]
    odd = features("claim_control", "destroy_actor")
    assert (odd.claims, odd.jobs, odd.remove_op, odd.camera_switch) == (True, False, "destroy_actor", False)
    with_instance = odd.with_hello(decode_reply(op, HelloOk, vectors.load("rpc_rep_hello_ok", "beta").data))
    assert with_instance.renders_sync
    before_play = with_instance.with_hello(
        decode_reply(op, HelloOk, vectors.load("rpc_rep_hello_ok_no_manager", "beta").data)
    )
    assert before_play.renders_sync
    bare = msgspec.msgpack.encode(
        {
            **msgspec.msgpack.decode(vectors.load("rpc_rep_hello_ok_no_manager", "beta").data),
            "instance": {"instance_id": "x", "capabilities": ["fly"], "favourite": {"colour": 1}},
        }
    )
    assert odd.with_hello(decode_reply(op, HelloOk, bare)).capabilities == {"fly"}


def test_the_shape_of_a_reply_outweighs_the_list_of_ops() -> None:
    step = OPS["step"]
    new = decode_reply(step, StepOk, vectors.load("rpc_rep_step_ok_direct", "beta").data)
    old = decode_reply(step, StepOk, vectors.load("rpc_rep_step_ok_no_frame_id", "june").data)
    said = features("claim_control")
    assert (said.publishes_steps, said.with_reply(old).publishes_steps) == (False, True)
    assert (features().publishes_steps, features().with_reply(new).publishes_steps) == (True, False)
    assert said.with_reply(new).with_reply(new) == said.with_reply(new)


def test_a_server_without_a_list_is_taken_for_the_oldest() -> None:
    unlisted = Features().with_ops(None)
    assert unlisted.offers("anything")
    assert not any((unlisted.claims, unlisted.jobs, unlisted.camera_switch, unlisted.uploads, unlisted.leases))
