"""Mutated frames through the codecs and through a live server.

The short form runs in CI. The long form: `URLAB_FUZZ_FACTOR=100 pytest tests/server/test_fuzz.py --timeout 7200`.
"""

from __future__ import annotations

import contextlib
import copy
import random
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from mangling import FACTOR, golden_replies, golden_requests, mutated, strange
from samples import filled
from scenes import hasty
from waiting import attempts
from wire import Wire, pack, set_points

from urlab_client import URLabRPCError
from urlab_client.errors import RPC_ERRORS, ProtocolError
from urlab_client.protocol.base import DialectName, Needs
from urlab_client.protocol.codec import decode_reply
from urlab_client.protocol.messages.session import HelloOk, StepOk
from urlab_client.protocol.registry import OPS
from urlab_client.protocol.rows import decode_row
from urlab_client.protocol.topics import STATE_FULL, StreamTopic, TopicKind
from urlab_client.server import ControllerConfig, Limits, SimulatedServer
from urlab_client.server.dialects import ALPHA, DIALECTS
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.requests import Incoming, RequestReader
from urlab_client.server.streams.commands import StreamedSetPoints, decode_gains

FRAMES = 2_000 * FACTOR
"""For each direction of the codec."""

LIVE_FRAMES = 400 * FACTOR

# What a frame may do to a server is bounded, so that none takes seconds.
LIMITS = Limits(n_steps=50, actors=60, grid_cells=20)


def test_requests_are_read_or_refused() -> None:
    reader = RequestReader()
    read, refused = 0, Counter[str]()
    for frame in mutated(golden_requests(), 1, FRAMES):
        try:
            assert isinstance(reader.read(frame), Incoming)
            read += 1
        except Refusal as refusal:
            refused[refusal.code] += 1
    assert read
    assert [*refused] == ["bad_request"]


def test_replies_are_read_or_raise_what_callers_expect() -> None:
    ops = list(ALPHA.ops.values())
    read = raised = 0
    for number, frame in enumerate(mutated(golden_replies(), 2, FRAMES)):
        op = ops[number % len(ops)]
        # As often as not the kind that the frame was made from.
        for asked in (op, next((other for other in ops if other.reply_name.encode() in frame), op)):
            try:
                assert isinstance(decode_reply(asked, asked.reply, frame), asked.reply)
                read += 1
            except (ProtocolError, URLabRPCError):
                raised += 1
    assert read
    assert raised


def test_stream_payloads_are_read_or_raise_what_callers_expect() -> None:
    numbers = np.arange(12, dtype="<f4").tobytes()
    golden = [
        numbers, numbers[:16], numbers[:4], pack({"joint": {"kp": 1.0}}), b'{"joint":{"kp":1.0}}',
        set_points({1: 0.5, 2: 1.0}), b"bot actuator a:0:-1:1|b:1:0:2",
    ]  # fmt: skip
    kinds = [kind for kind in TopicKind if kind is not TopicKind.SET_GAINS]
    readers: list[Callable[[bytes], Any]] = [StreamedSetPoints.decode, decode_gains]

    def reader_of(kind: TopicKind) -> Callable[[bytes], Any]:
        return lambda payload: decode_row(StreamTopic(kind, "bot", "x"), payload)

    readers += [reader_of(kind) for kind in kinds]
    done = 0
    for frame in mutated(golden, 3, max(1, FRAMES // 8)):
        for read in readers:
            with contextlib.suppress(ProtocolError, ValueError):  # the latter for topics that have no rows
                read(frame)
            done += 1
    assert done >= FRAMES // 8


def _talk(session: str) -> list[dict[str, Any]]:
    """Requests that mean something to the server under test."""
    ask: list[tuple[str, dict[str, Any]]] = [
        ("step", {"n_steps": 2, "per_articulation": {"bot": {"ctrl": [0.1], "ctrl_map": {"m": 0.2}}}}),
        ("step", {"n_steps": 1, "per_articulation": {"bot": {"xfrc_applied": {"arm": [0.0] * 6}}}}),
        ("reset", {"keyframe_name": "home", "per_articulation_qpos": {"bot": {"j": 0.1}}}),
        ("forward", {}),
        ("meta", {}),
        ("set_mode", {"mode": "direct"}),
        ("set_paused", {"paused": False}),
        ("set_sim_speed", {"percent": 50.0}),
        ("set_sim_options", {"options": {"timestep": 0.002, "integrator": "rk4", "gravity": [0.0, 0.0, -9.81]}}),
        ("set_qpos", {"target": "bot", "qpos": [0.0] * 8}),
        ("set_twist", {"articulation": "bot", "linear": [1.0, 0.0, 0.0], "angular": [0.0, 0.0, 1.0]}),
        ("get_contacts", {"max_contacts": 5}),
        ("configure_controller", {"articulation": "bot", "params": {"kp": 5.0}}),
        ("spawn_actor", {"blueprint": "/Game/MuJoCoImports/bot", "actor_id": "two", "location": [1.0, 2.0, 3.0]}),
        (
            "spawn_grid",
            {"blueprint": "/Game/MuJoCoImports/bot", "base_actor_id": "g", "count_x": 2, "count_y": 2},
        ),
        ("spawn_light", {"kind": "point", "intensity": 100.0}),
        ("set_actor_transform", {"target": "bot", "location": [0.0, 0.0, 1.0]}),
        ("duplicate_actor", {"target": "bot", "new_actor_id": "twin"}),
        ("get_actor_bounds", {"target": "bot"}),
        ("list_actors", {}),
        ("find_actors", {"name_prefix": "b"}),
        ("draw_box", {"center": [0, 0, 0], "half_extents": [1, 1, 1], "color": [1, 0, 0], "ttl": 1.0}),
        ("set_viewport_camera", {"location": [1, 1, 1]}),
        ("recording_start", {"max_duration_s": 1.0}),
        ("recording_save", {"path": "take.json"}),
        ("recording_stop", {}),
        ("replay_load", {"path": "take.json"}),
        ("replay_start", {}),
        ("replay_stop", {}),
    ]
    return [{"op": name, "session_id": session, **fields} for name, fields in ask]


def _frames(session: str, seed: int, count: int) -> Iterator[bytes]:
    """Yield frames that are broken, and as many that are whole and mean nonsense."""
    plain = _talk(session)
    golden = [*map(pack, plain), *map(msgspec.json.encode, plain), *golden_requests(session)]
    for pair in zip(mutated(golden, seed, count // 2), strange(plain, seed, count // 2), strict=True):
        yield from pair


def test_a_live_server_answers_every_frame(
    models: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Some frames pause physics, and then each step waits for its whole time.
    monkeypatch.setattr("urlab_client.server.core.Engine", hasty(0.01))
    codes = {*RPC_ERRORS} - {"internal_error"}
    replies = {op.reply_name for op in ALPHA.ops.values()}
    refused = served = 0
    caplog.set_level("ERROR")
    with (
        SimulatedServer(models / "bot.xml", play=True, unpaused=True, step_mode="direct", limits=LIMITS) as server,
        Wire(server) as wire,
    ):
        for block in range(LIVE_FRAMES // 50):  # a mutated hello ends the session, so there is a new one every so often
            wire.hello(encoding="msgpack")
            for frame in _frames(wire.session_id, block, 50):
                answer = wire.exchange(frame)
                reply = msgspec.json.decode(answer) if answer[:1] == b"{" else msgspec.msgpack.decode(answer)
                if reply["op"] == "error":
                    assert reply["code"] in codes, (frame, reply)
                    refused += 1
                else:
                    assert reply["op"] in replies, (frame, reply)
                    served += 1
        wire.hello(encoding="msgpack")
        assert wire.ask("meta")["ops"]
    # Most mutations leave nothing to understand; some of what is left must reach the handlers.
    assert refused
    assert served > LIVE_FRAMES // 10


UNFIT: tuple[Any, ...] = (None, True, -1, float("nan"), "text", b"x", [], {}, [None], [{}], {"bot": None})
MISSING: Any = object()
# What succeeds in the scene of the next test where a sample value of each field does not.
SCENE: dict[str, dict[str, Any]] = {
    "claim_control": {"articulation": "bot", "ttl_s": 600.0},
    "step": {"include_cameras": False},
    "reset": {"keyframe_name": "bot_home"},
    "set_control_source": {"source": "zmq", "articulation": "bot"},
    "set_mocap_pose": {"body": "hand_hand", "pos": [0.0, 0.0, 1.0], "quat": [1.0, 0.0, 0.0, 0.0]},
    "read_mocap_pose": {"body": "hand_hand"},
    "set_camera_streaming": {"cameras": {"bot_cam": {"zmq": True, "shm": False}}},
    "set_camera_delay": {"cameras": {"bot_cam": {"delay_ms": 1.0}}},
    "replay_set_active": {"name": "take"},
    "import_xml": {"path": "prop.xml"},
    "load_level": {"level_path": "text"},
    "spawn_actor": {"scale": [1.0, 1.0, 1.0]},
    "spawn_grid": {"scale": [1.0, 1.0, 1.0]},
    "begin_pie": {"level_path": "", "timeout_s": 20.0},
    "set_viewport_mode": {"mode": "lit"},
    "upload_model_manifest": {
        "xml_sha256": "0" * 64,
        "assets": [{"name": "a.obj", "sha256": "1" * 64, "size": 8}],
        "step_mode": "direct",
    },
    "upload_model_chunk": {"kind": "asset", "name": "a.obj", "offset": 0, "total": 8, "data": b"a"},
}
BY_TARGET = "set_actor_transform", "actor_hierarchy", "get_actor_bounds", "frame_actor", "select_actor", "track_actor"


def _places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths to all that a request says, fields inside others, too."""
    inner = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, part in inner:
        if at or key not in ("op", "session_id"):
            yield (*at, key)
            yield from _places(part, (*at, key))


def _with(request: dict[str, Any], place: tuple[Any, ...], value: Any) -> bytes:
    changed = holder = copy.deepcopy(request)
    for key in place[:-1]:
        holder = holder[key]
    if value is MISSING:
        del holder[place[-1]]
    else:
        holder[place[-1]] = value
    return pack(changed)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_field_of_any_op_fails_the_server(
    dialect: DialectName, models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every field, and every one inside it, is missing, null, empty or of another type."""
    monkeypatch.setattr("urlab_client.server.core.Engine", hasty(0.01))
    monkeypatch.setattr("urlab_client.server.assets.uploads.MAX_OPEN", 10_000)
    talk = {request["op"]: request for request in _talk("")}
    known = {op: {**talk.get(op, {}), **SCENE.get(op, {})} for op in {*talk, *SCENE}}
    known |= {op: {**known.get(op, {}), "target": "two"} for op in BY_TARGET}
    # First what needs play, as it runs, and of that the claim that the beta asks for; last what opens another level.
    order = {"claim_control": -2, "begin_pie": 1, "stop_pie": 2}
    ops = DIALECTS[dialect].ops.values()
    ops = sorted(ops, key=lambda op: order.get(op.name, -1 if op.needs is Needs.MANAGER else 0))
    with (
        SimulatedServer(
            *(models / f"{name}.xml" for name in ("bot", "hand")),
            play=True,
            unpaused=True,
            dialect=dialect,
            limits=LIMITS,
            controllers={"*": ControllerConfig()},
            model_roots=[models],
            saved_dir=tmp_path,
        ) as server,
        Wire(server) as wire,
    ):

        def answered(frame: bytes) -> dict[str, Any]:
            reply = msgspec.msgpack.decode(wire.exchange(frame))
            for _ in attempts("the job did not end"):
                if "job_id" not in reply or reply.get("state", "running") != "running":
                    break
                reply = wire.raw({"op": "op_status", "session_id": wire.session_id, "job_id": reply["job_id"]})
            reply = reply.get("result", reply)
            assert reply.get("code") != "internal_error", (frame, reply)
            return reply

        served = set[str]()
        for op in ops:
            if op.name == "import_xml":
                wire.ask("stop_pie")
            wire.hello(encoding="msgpack")
            request = msgspec.to_builtins(filled(op.request), builtin_types=(bytes,), enc_hook=np.ndarray.tolist)
            request = msgspec.msgpack.decode(pack({**request, **known.get(op.name, {}), "session_id": wire.session_id}))
            if op.name == "upload_model_chunk":
                opened = wire.ask("upload_model_manifest", **SCENE["upload_model_manifest"])
                request["upload_id"] = opened["upload_id"]
            if answered(pack(request))["op"] != "error":
                served.add(op.name)
            for place in _places(request):
                for value in (MISSING, *UNFIT):
                    answered(_with(request, place, value))
            answered(pack(request))
    assert len(served) > 0.8 * len(ops), {op.name for op in ops} - served


def test_frames_on_the_other_sockets_leave_the_server_well(models: Path) -> None:
    chance = random.Random(5)
    golden = [b"bot/control", b"bot/set_gains", b"\x01", b"\x00state", b"", bytes(64), pack({"j": {"kp": 1.0}})]
    with (
        SimulatedServer(models / "bot.xml", play=True, unpaused=True) as server,
        zmq.Context() as context,
        context.socket(zmq.PUB) as commands,
        context.socket(zmq.XSUB) as state,
        Wire(server) as wire,
    ):
        for socket, port in ((commands, server.ctrl_port), (state, server.state_port)):
            socket.linger = 0
            socket.connect(f"{server.address}:{port}")
        wire.hello()
        for frame in mutated(golden, 6, 200 * FACTOR):
            commands.send_multipart([chance.choice(golden), frame][: chance.randrange(1, 3)])
            state.send(frame)
        before = wire.ask("step")["time"]
        assert any(reply["time"] > before for reply in wire.until("step"))


def test_binary_values_that_are_not_base64() -> None:
    frame = b'{"op":"hello_ok","session_id":"","urlab_version":"","mujoco_version":"","mjb__b64__":"x"}'
    with pytest.raises(ProtocolError, match="base64"):
        decode_reply(ALPHA.ops["hello"], HelloOk, frame)


def test_golden_frames_are_good() -> None:
    """Or the mutations would start from noise."""
    reader = RequestReader()
    assert {reader.read(frame).name for frame in golden_requests()} == {*OPS}
    assert STATE_FULL
    assert {HelloOk, StepOk} <= {op.reply for op in ALPHA.ops.values()}
