"""Checks that only read: frames, refusals, the handshake and its model, the editor's lists, shared memory."""

from __future__ import annotations

import asyncio
import base64
import re
from pathlib import Path
from typing import Any, Final, cast

import msgspec

from urlab_client.aio.model.compilation import compile_confined
from urlab_client.conformance.bench import Bench
from urlab_client.conformance.declarations import (
    ALPHA,
    BETA,
    NEWER,
    Differs,
    NotTried,
    check,
    expecting,
    has,
    holds,
    same,
)
from urlab_client.conformance.wire import plain
from urlab_client.protocol import shm
from urlab_client.protocol.registry import OPS, dialect_ops
from urlab_client.values.names import cleaned_name

_GUID: Final = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}|[0-9a-f]{32}")


async def _answer(bench: Bench, frame: bytes) -> dict[str, Any]:
    with expecting("a message"):
        return plain(await bench.wire.frame(frame))


@check("Session 2.1", "Transports 2.1")
async def json_requests(bench: Bench) -> None:
    """A request in JSON is answered like one in msgpack"""
    reply = await _answer(bench, b'{"op":"meta"}')
    same("op", "meta_ok", reply.get("op"))
    same("ops", sorted(bench.ops), sorted(row["name"] for row in reply["ops"]))


@check("Session 2.2")
async def json_replies(bench: Bench) -> None:
    """A session that asks for JSON is answered in JSON"""
    frame = await bench.wire.frame(b'{"op":"hello","encoding":"json"}', OPS["hello"])
    try:
        holds(frame[:1] == b"{", "a reply in JSON", frame[:8])
        reply = plain(frame)
        same("op", "hello_ok", reply.get("op"))
        if "mjb_size" in reply:
            holds("mjb__b64__" in reply, "the model as mjb__b64__", sorted(reply))
    finally:
        await bench.greet()


@check("Session 5.1", "Session 5.2")
async def order_of_checks(bench: Bench) -> None:
    """Refusals come in the stated order, each with code and message"""
    encode = msgspec.msgpack.encode
    frames = {
        b"\xc1garbage": "bad_request",
        encode({"x": 1}): "missing_op",
        encode({"op": "step", "session_id": "nobody"}): "session_expired",
        encode({"op": "step"}): "session_expired",
        encode({"op": "no_such_op", "session_id": "nobody"}): "session_expired",
        encode({"op": "no_such_op", "session_id": bench.wire.session_id}): "unknown_op",
    }
    for frame, code in frames.items():
        reply = await _answer(bench, frame)
        has(reply, op="error", code=code)
        holds(isinstance(reply.get("message"), str), "a message", reply.get("message"))
    await bench.refused("missing_field", "set_paused")


@check("Session 5.2", needs=("no_play",))
async def no_play(bench: Bench) -> None:
    """An op that needs play is refused without"""
    await bench.refused("no_active_manager", "forward")


@check("Session 6", "Beta 7")
async def second_hello(bench: Bench) -> None:
    """A second hello ends the first session"""
    first = bench.wire.session_id
    holds(_GUID.fullmatch(first), "a lower-case GUID as session id", first)
    await bench.greet()
    holds(bench.wire.session_id != first, "another session id", first)
    op = "pie_status" if "pie_status" in bench.ops else "forward"
    await bench.refused("session_expired", op, session_id=first)
    holds((await bench.wire.raw(op)).get("code") != "session_expired", "the second session to work", "session_expired")


@check("Beta 8")
async def unknown_fields(bench: Bench) -> None:
    """Unknown fields of a request do no harm"""
    await bench.greet(no_such_field={"a": [1, 2, None]}, another=True)
    await bench.ask("meta", no_such_field=1)


@check("Session 9.2")
async def catalogue(bench: Bench) -> None:
    """The list of ops is the one that is declared"""
    name = "alpha" if bench.dialect == "alpha" else "beta"
    declared = dict(dialect_ops(name))
    if "current_level" not in bench.ops:  # a packaged build
        declared = {key: op for key, op in declared.items() if op.needs != "editor_only"}
    declared = {key: op for key, op in declared.items() if key not in {"hello", "meta"}}
    if bench.dialect != "june":
        same("ops", sorted(declared), sorted(bench.ops))
    for key in declared.keys() & bench.ops.keys():
        row, op = bench.ops[key], declared[key]
        same(f"category of {key}", str(op.needs), row.get("category"))
        same(f"required_fields of {key}", list(op.declared_required), row.get("required_fields") or [])


@check("Beta 1", "Generation 2 13", dialects=NEWER)
async def newer_ops(bench: Bench) -> None:
    """The list has the ops of jobs and cameras, and those of claims in the beta"""
    wanted = {"op_status", "remove_actor", "set_camera_streaming"}
    if bench.dialect == "beta":
        wanted |= {"claim_control", "release_control", "set_control_source", "set_camera_delay"}
    if "current_level" not in bench.ops:
        wanted -= {"op_status", "remove_actor"}
    same("missing ops", [], sorted(wanted - bench.ops.keys()))
    same("ops that are gone", [], sorted({"destroy_actor", "hello", "meta"} & bench.ops.keys()))


@check("Session 9.1")
async def handshake(bench: Bench) -> None:
    """The handshake has versions and play state"""
    hello = bench.plain_hello
    for name, kind in (("urlab_version", str), ("mujoco_version", str), ("manager_present", bool)):
        holds(isinstance(hello.get(name), kind), f"{name} as {kind.__name__}", hello.get(name))
    major, rest = divmod(int(hello["mujoco_version_int"]), 1_000_000)
    same("mujoco_version_int", str(hello["mujoco_version"]), f"{major}.{rest // 1000}.{rest % 1000}")


@check("Beta 2", dialects=BETA, needs=("no_play",))
async def handshake_without_play(bench: Bench) -> None:
    """Without play the handshake has the scalar fields and no robots"""
    wanted = {"op", "session_id", "urlab_version", "mujoco_version_int", "mujoco_version", "manager_present"}
    same("fields", sorted({*wanted, "articulations"}), sorted(bench.plain_hello))
    same("articulations", [], bench.plain_hello["articulations"])


@check("Generation 2 15", dialects=NEWER, needs=("no_play",))
async def no_regions_without_play(bench: Bench) -> None:
    """Without play the handshake names no shared memory for requests"""
    holds("shm_rpc" not in bench.plain_hello, "no shm_rpc", bench.plain_hello.get("shm_rpc"))


@check("Beta 3", "Beta 4", dialects=BETA, needs=("play",))
async def instance(bench: Bench) -> None:
    """In play the handshake describes the instance in eleven fields"""
    told = bench.plain_hello.get("instance")
    wanted = ("instance_id", "index", "pid", "host", "step_port", "state_port", "cam_base_port")
    wanted = {*wanted, "manager_present", "busy", "urlab_version", "capabilities"}
    same("fields of instance", sorted(wanted), sorted(told or {}))
    has(told or {}, manager_present=True)
    has(bench.plain_hello, urlab_version="urlab/0.2")


@check("Session 3.2", "Session 9.1", needs=("play",))
async def model_twice(bench: Bench) -> None:
    """The model comes twice, as bytes and as text of the same content and stated size"""
    hello = bench.plain_hello
    if "mjb" not in hello:
        raise NotTried("needs a model that the editor could compile")
    same("mjb_size", len(hello["mjb"]), int(hello["mjb_size"]))
    same("mjb_base64", True, base64.b64decode(hello["mjb_base64"]) == hello["mjb"])


@check("Session 7", "Session 9.1.1", needs=("robots", "model"))
async def names(bench: Bench) -> None:
    """Robots have different prefixes, which begin the names of their elements in the model"""
    keys = [robot.key for robot in bench.robots]
    same("number of different prefixes", len(keys), len(set(keys)))
    for robot in bench.robots:
        holds(robot.layout.bodies, f"bodies that begin with {robot.info.compiled_prefix}_", "none in the model")
        known = set(robot.layout.actuators) | {cleaned_name(name) for name in robot.layout.actuators}
        renamed = set(robot.info.original_names.actuators)
        stray = sorted(set(robot.info.actuator_types) - known - renamed)
        same(f"actuators of {robot.key} that the model lacks", [], stray)
        mode = robot.info.default_control_mode
        holds(mode in {"raw", "ue_controller"}, "default_control_mode raw or ue_controller", mode)


@check("Beta 5", "Beta 6", dialects=BETA, needs=("robots",))
async def public_names(bench: Bench) -> None:
    """A robot is called by its cleaned actor id, and nothing was renamed"""
    for robot in bench.robots:
        info = robot.info
        same("prefix", cleaned_name(info.actor_id) if info.actor_id else info.actor_name, info.prefix)
        renamed = [*info.original_names.actuators, *info.original_names.joints, *info.original_names.bodies]
        same("original_names", [], [*renamed, *info.original_names.sensors])


@check("Beta 87", dialects=BETA, needs=("play",))
async def global_cameras(bench: Bench) -> None:
    """The handshake announces no camera of the scene"""
    same("global_cameras", {}, bench.plain_hello.get("global_cameras"))


@check("Beta 47", dialects=BETA, needs=("camera",))
async def camera_names(bench: Bench) -> None:
    """A camera is called by its robot and its own name, and so is its topic"""
    for robot in bench.robots:
        for name, info in robot.info.camera_topics.items():
            same(f"slashes in {name}", 1, name.count("/"))
            same("first half", robot.key, name.partition("/")[0])
            same("zmq_topic", name, info.zmq_topic)


@check("Session 9.1.1", dialects=ALPHA, needs=("camera",))
async def camera_topics(bench: Bench) -> None:
    """A camera's topic is its robot, `camera` and its name"""
    for robot in bench.robots:
        for name, info in robot.info.camera_topics.items():
            same("zmq_topic", f"{robot.key}/camera/{name}", info.zmq_topic)
            holds(0 < info.fovy < 180, "fovy in degrees", info.fovy)


@check("Beta 86", "Session 9.1", needs=("model",))
async def assets(bench: Bench) -> None:
    """The model compiled from the handshake's XML and files is as large as the binary one"""
    import mujoco

    await bench.greet(include_assets=True)
    xml, files = bench.plain_hello.get("mjcf_compiled"), bench.plain_hello.get("vfs_assets")
    holds(xml is not None and isinstance(files, dict), "mjcf_compiled and vfs_assets", sorted(bench.plain_hello))
    with expecting("XML that MuJoCo compiles"):
        # Confined, because it comes from the server.
        mjb = await asyncio.to_thread(compile_confined, str(xml), cast("dict[str, bytes]", files))
        built = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": mjb})
    for size in ("nq", "nv", "nu", "nbody"):
        same(size, int(getattr(bench.compiled, size)), int(getattr(built, size)))


@check("Session 9.15", "Simulation 1.6", needs=("model",))
async def keyframes(bench: Bench) -> None:
    """The keyframes are those of the model"""
    listed = (await bench.ask("list_keyframes"))["keyframes"]
    known = [str(bench.compiled.key(i).name) for i in range(bench.compiled.nkey)]
    same("keyframes", sorted(name for name in known if name), sorted(str(row["name"]) for row in listed if row["name"]))


@check("Session 9.14", "Simulation 7.3", needs=("model",))
async def contacts(bench: Bench) -> None:
    """Contacts name bodies of the model"""
    known = {"", *(bench.compiled.body(i).name for i in range(bench.compiled.nbody))}
    told = {row[side] for row in (await bench.ask("get_contacts"))["contacts"] for side in ("body1", "body2")}
    same("bodies that the model lacks", set(), told - known)


@check("Editor 3.1 current_level", "Editor 3.2 pie_status", needs=("editor",))
async def level_and_play(bench: Bench) -> None:
    """The open level and the state of play are told"""
    holds("level_path" in await bench.ask("current_level"), "a level_path", "none")
    status = await bench.ask("pie_status")
    holds(status["state"] in {"off", "compiling", "ready", "compile_failed"}, "a state of play", status["state"])
    same("ready", bench.hello.manager_present, status["state"] == "ready")


@check("Editor 3.3 list_actors", "Editor 3.3 find_actors", "Editor 2.2", needs=("editor",))
async def actors(bench: Bench) -> None:
    """The actors of the level are listed with unit quaternions, and found by name"""
    rows = (await bench.ask("list_actors"))["actors"]
    for row in rows:
        length = sum(float(value) ** 2 for value in row["rotation_quat"])
        holds(abs(length - 1) < 1e-3, f"a unit quaternion of {row['name']}", length)
    for row in rows[:1]:
        found = (await bench.ask("find_actors", name_prefix=row["name"]))["actors"]
        holds(any(one["name"] == row["name"] for one in found), row["name"], found)


@check("Editor 3.1 snapshot", "Editor 3.1 actor_hierarchy", "Editor 3.3 list_blueprints", "Editor 3.5 get_camera",
       needs=("editor",))  # fmt: skip
async def lists(bench: Bench) -> None:
    """The level's description, its tree, the blueprints and the viewport's camera are told"""
    await bench.ask("snapshot")
    for row in (await bench.ask("list_actors"))["actors"][:1]:
        await bench.ask("actor_hierarchy", target=row["name"], target_by="actor_name")
    await bench.ask("list_blueprints")
    reply = await bench.wire.raw("get_camera")
    holds(reply.get("op") == "get_camera_ok" or reply.get("code") in {"no_viewport", "unsupported"}, "a pose", reply)


@check("Generation 2 7", dialects=NEWER, needs=("editor",))
async def unknown_job(bench: Bench) -> None:
    """`op_status` refuses no job, an empty one and an unknown one"""
    await bench.refused("missing_field", "op_status")
    await bench.refused("bad_request", "op_status", job_id="")
    await bench.refused("unknown_job", "op_status", job_id="job_999999")
    await bench.refused("session_expired", "op_status", job_id="job_1", session_id="nobody")


@check("Generation 2 15", "Generation 2 16", "Transports 6.2", dialects=NEWER, needs=("play", "shm"))
async def request_regions(bench: Bench) -> None:
    """The regions of requests and replies exist with the stated header"""
    told = bench.plain_hello.get("shm_rpc")
    if told is None:
        raise NotTried("needs a server that offers shared memory for requests")
    same("fields of shm_rpc", 9, len(told))
    for path, stride in ((told["req_path"], told["req_stride"]), (told["rep_path"], told["rep_stride"])):
        header = _header(Path(path))
        same("stride", int(stride), header.stride)
        same("slots", 2, header.n_buffers)


@check("Transports 6.2", dialects=ALPHA, needs=("play", "shm"))
async def regions(bench: Bench) -> None:
    """The regions of requests and replies exist, with two slots each"""
    for file in (shm.REQUEST_FILE, shm.REPLY_FILE):
        paths = [Path(found) / file for found in shm.region_directories(bench.plain_hello["shm_session_dir"], file)]
        path = next((path for path in paths if path.exists()), None)
        if path is None:
            raise Differs(f"{file} in one of {len(paths)} folders", "no such file")
        same("slots", 2, _header(path).n_buffers)


def _header(path: Path) -> shm.Header:
    with expecting("a region with its header"):
        data = path.read_bytes()
        header = shm.parse_header(data)
    same("size", shm.region_size(header.stride, header.n_buffers), len(data))
    return header
