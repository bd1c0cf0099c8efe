"""Checks of the editor's ops, in a level of their own, which `Bench.author` opens."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from urlab_client.conformance.bench import ROBOT, Bench, to_the_end
from urlab_client.conformance.declarations import BETA, NEWER, Body, Group, NotTried, check, has, holds, same

author: Callable[..., Callable[[Body], Body]] = partial(check, group=Group.AUTHOR)

_ID: Final = "conformance"


async def _rows(bench: Bench) -> dict[str, dict[str, Any]]:
    actors = (await bench.ask("list_actors"))["actors"]
    return {row["actor_id"]: row for row in actors if row["actor_id"]}


async def _spawn(bench: Bench, **fields: Any) -> dict[str, Any]:
    """Spawn the robot until the check is over."""
    bench.later(_remove_op(bench), target=_ID)
    return await bench.ask("spawn_actor", blueprint=bench.blueprint, actor_id=_ID, **fields)


def _remove_op(bench: Bench) -> str:
    return "remove_actor" if "remove_actor" in bench.ops else "destroy_actor"


async def _is_at(bench: Bench, actor_id: str, *location: float) -> None:
    rows = await _rows(bench)
    holds(actor_id in rows, f"an actor {actor_id}", sorted(rows))
    found = np.array(rows[actor_id]["location"])[: len(location)]
    same(f"location of {actor_id}", np.array(location), found, 1e-4)


@author("Editor 3.1 create_level", "Editor 3.1 current_level")
async def own_level(bench: Bench) -> None:
    """The level that was created is the open one, and cannot be created again"""
    level = str((await bench.ask("current_level"))["level_path"])
    holds(level.startswith("/Game/Levels/urlab_conformance"), "the level that was created", level)
    await bench.refused("create_level_failed", "create_level", name=level)
    await bench.refused("missing_field", "create_level", name="")


@author("Beta 2", "Generation 2 15", dialects=NEWER)
async def handshake_without_play(bench: Bench) -> None:
    """Without play the handshake in a level has no instance, no robots and no shared memory for requests"""
    await bench.greet()
    same("fields of play", set(), {"instance", "entities", "shm_rpc"} & bench.plain_hello.keys())
    has(bench.plain_hello, articulations=[])


@author("Editor 3.1 ensure_manager")
async def one_manager(bench: Bench) -> None:
    """A manager is there once"""
    has(await bench.ask("ensure_manager"), was_existing=True)


@author("Editor 3.1 import_xml", "Beta 57")
async def missing_files(bench: Bench) -> None:
    """Importing a missing file fails"""
    await bench.refused("import_failed", "import_xml", path="/no/such/folder/no_such_file.xml")
    await bench.refused("missing_field", "import_xml")
    await bench.refused("missing_field", "import_xml", path="")


async def _job(bench: Bench, op: str, **fields: Any) -> str:
    """Start a job; return its id."""
    started = await bench.wire.raw(op, **fields)
    has(started, op="op_started")
    holds(str(started["job_id"]).startswith("job_"), "job_N", started["job_id"])
    return str(started["job_id"])


async def _failed(bench: Bench, job_id: str, code: str) -> None:
    """Poll a job that fails with a code; it has no result before, and gives it once."""
    status = await bench.ask("op_status", job_id=job_id)
    while status["state"] == "running":
        has(status, result=None)
        status = await bench.ask("op_status", job_id=job_id)
    has(status, state="failed")
    has(status["result"], op="error", code=code)
    await bench.refused("unknown_job", "op_status", job_id=job_id)


@author("Generation 2 1", "Generation 2 2", "Generation 2 3", "Generation 2 4", "Beta 57", dialects=NEWER)
async def jobs(bench: Bench) -> None:
    """An editor op starts a job with a growing number, whose result comes once"""
    numbers: list[int] = []
    for _ in range(2):
        job_id = await _job(bench, "create_level", name="")
        numbers.append(int(job_id.removeprefix("job_")))
        await _failed(bench, job_id, "missing_field")
    holds(numbers[1] > numbers[0], "a larger number", numbers)


@author("Generation 2 5", "Generation 2 6", dialects=NEWER)
async def failed_imports(bench: Bench) -> None:
    """An import of a missing file fails as a job, one without a path at once"""
    missing = "/no/such/folder/no_such_file.xml"
    for path, code in ((missing, "import_failed"), ("", "missing_field")):
        await _failed(bench, await _job(bench, "import_xml", path=path), code)
    has(await bench.wire.raw("import_xml"), op="error", code="missing_field")


@author("Generation 2 8", dialects=NEWER)
async def jobs_outlive_sessions(bench: Bench) -> None:
    """A job of an earlier session is polled with the new one"""
    job_id = await _job(bench, "create_level", name="")
    await bench.greet()
    await _failed(bench, job_id, "missing_field")


@author("Generation 2 9", dialects=NEWER)
async def without_jobs(bench: Bench) -> None:
    """Quick editor ops answer directly"""
    await _spawn(bench)
    for op in ("ensure_manager", "current_level", "snapshot", "list_actors"):
        has(await bench.wire.raw(op), op=f"{op}_ok")
    moved = await bench.wire.raw("set_actor_transform", target=_ID, location=[0.0, 0.0, 1.0])
    has(moved, op="set_actor_transform_ok")
    asset = await bench.wire.raw("destroy_asset", asset_path="/Game/Levels/no_such.no_such")
    has(asset, op="destroy_asset_ok")


@author("Editor 3.1 spawn_actor", "Editor 3.3 list_actors")
async def spawning(bench: Bench) -> None:
    """An actor is spawned once per id where it was asked for; an unknown blueprint is refused"""
    first = await _spawn(bench, location=[1.0, 2.0, 3.0], rotation_euler=[0.0, 0.0, 90.0])
    again = await _spawn(bench, location=[4.0, 5.0, 6.0], rotation_euler=[0.0, 0.0, 90.0])
    has(first, was_existing=False)
    has(again, was_existing=True, actor_name=first["actor_name"])
    await _is_at(bench, _ID, 4.0, 5.0, 6.0)
    half = np.sqrt(0.5)
    turned = np.array((await _rows(bench))[_ID]["rotation_quat"])
    same("rotation_quat, z and w", half, abs(float(turned @ [0, 0, half, half])) * half, 1e-3)
    await bench.refused("spawn_failed", "spawn_actor", blueprint="/Game/Nothing/nothing", actor_id="nothing")


@author("Editor 3.1 set_actor_transform")
async def moving(bench: Bench) -> None:
    """An actor is moved, and keeps what is left out"""
    await _spawn(bench, rotation_euler=[0.0, 0.0, 90.0])
    before = (await _rows(bench))[_ID]
    await bench.ask("set_actor_transform", target=_ID, location=[0.0, 0.0, 5.0])
    await _is_at(bench, _ID, 0.0, 0.0, 5.0)
    after = (await _rows(bench))[_ID]
    same("rotation_quat", np.array(before["rotation_quat"]), np.array(after["rotation_quat"]), 1e-4)
    await bench.refused("set_actor_transform_failed", "set_actor_transform", target="nobody", location=[0, 0, 0])


@author("Editor 3.1 duplicate_actor", "Generation 2 12")
async def duplicating(bench: Bench) -> None:
    """A copy has its own id and place"""
    first = await _spawn(bench)
    bench.later(_remove_op(bench), target="copy")
    copy = await bench.ask("duplicate_actor", target=_ID, new_actor_id="copy", location=[3.0, 0.0, 0.0])
    holds(copy["actor_name"] != first["actor_name"], "another actor", copy["actor_name"])
    await _is_at(bench, "copy", 3.0, 0.0, 0.0)


@author("Editor 3.1 spawn_grid", "Generation 2 12")
async def grids(bench: Bench) -> None:
    """A grid has an actor in each cell"""
    names = {f"cell_{i}_{j}" for i in range(2) for j in range(2)}
    for name in names:
        bench.later(_remove_op(bench), target=name)
    grid = {"blueprint": bench.blueprint, "base_actor_id": "cell", "count_x": 2, "count_y": 2}
    has(await bench.ask("spawn_grid", **grid, spacing=[2.0, 3.0, 0.0]), count=4)
    same("ids", names, set(await _rows(bench)))
    await _is_at(bench, "cell_1_1", 2.0, 3.0)


@author("Editor 3.1 destroy_actor", "Generation 2 14")
async def removing(bench: Bench) -> None:
    """A removed actor is gone, and an unknown one is refused"""
    await bench.ask("spawn_actor", blueprint=bench.blueprint, actor_id=_ID)
    await bench.ask(_remove_op(bench), target=_ID)
    holds(_ID not in await _rows(bench), f"no actor {_ID}", "it is there")
    await bench.refused("destroy_failed", _remove_op(bench), target=_ID)


@author("Editor 3.3 get_actor_bounds")
async def bounds(bench: Bench) -> None:
    """The bounds of an actor are where it is"""
    await _spawn(bench, location=[10.0, 0.0, 0.0])
    reply = await bench.ask("get_actor_bounds", target=_ID)
    low, high = np.array(reply["min"]), np.array(reply["max"])
    same("center", (low + high) / 2, np.array(reply["center"]), 1e-3)
    holds(low[0] < high[0] and abs(reply["center"][0] - 10.0) < 5.0, "bounds around x = 10", reply["center"])


@author("Editor 3.1 save_level", "Editor 3.1 load_level")
async def saving(bench: Bench) -> None:
    """A saved level comes back as it was; an unknown one is refused"""
    await _spawn(bench, location=[1.0, 0.0, 0.0])
    await bench.ask("save_level")
    await bench.ask("set_actor_transform", target=_ID, location=[9.0, 0.0, 0.0])
    level = (await bench.ask("current_level"))["level_path"]
    await bench.ask("load_level", level_path=level)
    await _is_at(bench, _ID, 1.0, 0.0, 0.0)
    await bench.refused("load_level_failed", "load_level", level_path="/Game/Levels/no_such_level_at_all")


@author("Editor 3.1 destroy_asset")
async def assets(bench: Bench) -> None:
    """Removing an asset that is not there succeeds, and says so"""
    has(await bench.ask("destroy_asset", asset_path="/Game/Levels/no_such.no_such"), was_found=False)


async def _begin(bench: Bench) -> dict[str, Any]:
    """Begin play; return its handshake."""
    reply = await bench.ask("begin_pie", timeout_s=60)
    has(reply, state="ready")
    return reply["handshake_payload"]


@author("Editor 3.2 begin_pie", "Beta 4", "Beta 23")
async def beginning(bench: Bench) -> None:
    """Play begins with a handshake of the level's robots, whose claims are new, and starts paused in live mode"""
    await _spawn(bench)
    bench.later("stop_pie")
    payload = await _begin(bench)
    same("actor ids", [_ID], [robot["actor_id"] for robot in payload["articulations"]])
    times = [float((await bench.ask("step"))["time"]) for _ in range(2)]
    same("time at the start, paused", times[0], times[1])
    if bench.features.claims:
        key = payload["articulations"][0]["prefix"]
        await bench.refused("not_control_owner", "step", per_articulation={key: {"ctrl": []}})
        await bench.ask("claim_control", articulation=key)
        await bench.ask("stop_pie")
        await _begin(bench)
        await bench.refused("not_control_owner", "step", per_articulation={key: {"ctrl": []}})


@author("Generation 2 22", dialects=NEWER)
async def beginning_again(bench: Bench) -> None:
    """With play, frame ids begin anew"""
    await _spawn(bench)
    bench.later("stop_pie")
    numbers: list[float] = []
    for steps in (20, 1):
        await _begin(bench)
        await bench.ask("set_mode", mode="direct")
        replies = [await bench.ask("step") for _ in range(steps)]
        numbers.append(replies[-1]["frame_id"])
        await bench.ask("stop_pie")
    holds(numbers[1] < numbers[0], "a smaller frame id", numbers)


# Uploads


async def _manifest(bench: Bench, xml: str, **fields: Any) -> dict[str, Any]:
    digest = hashlib.sha256(xml.encode()).hexdigest()
    return await bench.ask("upload_model_manifest", xml_sha256=digest, total_bytes=len(xml), **fields)


def _chunk(upload: dict[str, Any], xml: str) -> dict[str, Any]:
    return {"upload_id": upload["upload_id"], "kind": "xml", "total": len(xml), "data": xml.encode()}


@author("Beta 58", "Beta 61", dialects=BETA)
async def refused_uploads(bench: Bench) -> None:
    """A file's name with a slash, an unknown upload and an unfinished one are refused"""
    file = {"name": "a/b.stl", "sha256": "0" * 64, "size": 1}
    await bench.refused("bad_request", "upload_model_manifest", xml_sha256="0" * 64, total_bytes=1, assets=[file])
    await bench.refused("unknown_upload", "upload_model_commit", upload_id="nothing")
    upload = await _manifest(bench, f"<!-- {bench.wire.session_id} -->")
    await bench.refused("bad_request", "upload_model_commit", upload_id=upload["upload_id"])


@author("Beta 59", "Beta 60", "Beta 62", dialects=BETA)
async def uploads(bench: Bench) -> None:
    """A model is uploaded, after wrong bytes too, spawned, and not asked for a second time"""
    known = (await bench.ask("list_blueprints"))["blueprints"]
    if any(row["blueprint_short_name"] == "model" for row in known):
        raise NotTried("needs a server without an uploaded model, which this one would replace")
    xml = f"<!-- {bench.wire.session_id} -->{ROBOT}"
    upload = await _manifest(bench, xml)
    has(upload, need_xml=True, need_assets=[])
    await bench.refused("hash_mismatch", "upload_model_chunk", **_chunk(upload, xml.upper()))
    has(await bench.ask("upload_model_chunk", **_chunk(upload, xml)), complete=True)
    has(await _manifest(bench, xml), need_xml=False, need_assets=[])
    made: dict[str, Any] = {}

    async def commit() -> None:
        made.update(await bench.ask("upload_model_commit", upload_id=upload["upload_id"]))
        bench.later("destroy_asset", asset_path=str(made["blueprint_class_path"]).removesuffix("_C"))

    await to_the_end(commit())
    has(made, imported=True, nq=None)
    bench.later(_remove_op(bench), target="uploaded")
    await bench.ask("spawn_actor", blueprint=made["blueprint_class_path"], actor_id="uploaded")
    await bench.refused("unknown_upload", "upload_model_commit", upload_id=upload["upload_id"])


@author("Editor 3.3 add_quick_convert")
async def quick_convert(bench: Bench) -> None:
    """A static mesh becomes a body, and stops being one"""
    actors = (await bench.ask("list_actors"))["actors"]
    mesh = next((row for row in actors if row.get("is_static_mesh_actor")), None)
    if mesh is None:
        raise NotTried("needs a static mesh in the level, which no op makes")
    name = {"target": mesh["name"], "target_by": "actor_name"}
    await bench.ask("add_quick_convert", **name, static=True)
    await bench.ask("remove_quick_convert", **name)
    await bench.refused("remove_quick_convert_failed", "remove_quick_convert", **name)
