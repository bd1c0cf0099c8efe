"""Checks of the editor's ops, in a level of their own."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from urlab_client.conformance.bench import Bench, holds, same
from urlab_client.conformance.declarations import NEWER, Differs, Group, NotTried, check

AUTHOR: Final = Group.AUTHOR
_ID: Final = "conformance"
_blueprint: Final[dict[Bench, str]] = {}


async def prepare(bench: Bench) -> None:
    """Open a level of this run's own, with the blueprint of a robot."""
    _blueprint[bench] = await bench.author()


async def _rows(bench: Bench) -> dict[str, dict[str, Any]]:
    actors = (await bench.wire.ask("list_actors"))["actors"]
    return {row["actor_id"]: row for row in actors if row["actor_id"]}


async def _spawn(bench: Bench, actor_id: str = _ID, **fields: Any) -> dict[str, Any]:
    return await bench.edit("spawn_actor", blueprint=_blueprint[bench], actor_id=actor_id, **fields)


def _remove_op(bench: Bench) -> str:
    return "remove_actor" if "remove_actor" in bench.ops else "destroy_actor"


async def _clear(bench: Bench) -> None:
    for actor_id in await _rows(bench):
        await bench.job(_remove_op(bench), target=actor_id)


@check("Editor 3.1 create_level", "Editor 3.1 current_level", group=AUTHOR)
async def own_level(bench: Bench) -> None:
    """The level that was created is the open one, and cannot be created again"""
    level = (await bench.wire.ask("current_level"))["level_path"]
    holds(str(level).startswith("/Game/Levels/urlab_conformance"), "the level that was created", level)
    await bench.refuse("create_level_failed", "create_level", name=str(level))
    await bench.refuse("missing_field", "create_level", name="")


@check("Editor 3.1 ensure_manager", group=AUTHOR)
async def one_manager(bench: Bench) -> None:
    """A manager is there once"""
    same("was_existing", True, (await bench.edit("ensure_manager"))["was_existing"])


@check("Editor 3.1 import_xml", "Beta 57", group=AUTHOR)
async def missing_files(bench: Bench) -> None:
    """Importing a missing file fails"""
    await bench.refuse("import_failed", "import_xml", path="/no/such/folder/no_such_file.xml")
    await bench.wire.refused("missing_field", "import_xml")
    await bench.refuse("missing_field", "import_xml", path="")


@check("Generation 2 1", "Generation 2 2", "Generation 2 3", "Generation 2 4", "Beta 57",
       group=AUTHOR, dialects=NEWER)  # fmt: skip
async def jobs(bench: Bench) -> None:
    """An editor op starts a job with a growing number, whose result comes once"""
    numbers: list[int] = []
    for _ in range(2):
        started = await bench.wire.raw("create_level", name="")
        same("op", "op_started", started.get("op"))
        holds(str(started["job_id"]).startswith("job_"), "job_N", started["job_id"])
        numbers.append(int(str(started["job_id"]).removeprefix("job_")))
        status = await bench.wire.ask("op_status", job_id=started["job_id"])
        while status["state"] == "running":
            same("result of a running job", None, status.get("result"))
            status = await bench.wire.ask("op_status", job_id=started["job_id"])
        same("state", "failed", status["state"])
        same("result", ("error", "missing_field"), (status["result"]["op"], status["result"]["code"]))
    holds(numbers[1] > numbers[0], "a larger number", numbers)


@check("Editor 3.1 spawn_actor", "Editor 3.3 list_actors", group=AUTHOR)
async def spawning(bench: Bench) -> None:
    """An actor is spawned once per id where it was asked for; an unknown blueprint is refused"""
    first = await _spawn(bench, location=[1.0, 2.0, 3.0], rotation_euler=[0.0, 0.0, 90.0])
    again = await _spawn(bench, location=[4.0, 5.0, 6.0], rotation_euler=[0.0, 0.0, 90.0])
    same("was_existing", (False, True), (first["was_existing"], again["was_existing"]))
    same("actor_name", first["actor_name"], again["actor_name"])
    row = (await _rows(bench)).get(_ID)
    if row is None:
        raise Differs(f"an actor {_ID}", sorted(await _rows(bench)))
    same("location", np.array([4.0, 5.0, 6.0]), np.array(row["location"]), 1e-4)
    half = np.sqrt(0.5)
    turned = np.array(row["rotation_quat"])
    same("rotation_quat, z and w", half, abs(float(turned @ [0, 0, half, half])) * half, 1e-3)
    await bench.refuse("spawn_failed", "spawn_actor", blueprint="/Game/Nothing/nothing", actor_id="nothing")
    await _clear(bench)


@check("Editor 3.1 set_actor_transform", group=AUTHOR)
async def moving(bench: Bench) -> None:
    """An actor is moved, and keeps what is left out"""
    await _spawn(bench, rotation_euler=[0.0, 0.0, 90.0])
    before = (await _rows(bench))[_ID]
    await bench.edit("set_actor_transform", target=_ID, location=[0.0, 0.0, 5.0])
    after = (await _rows(bench))[_ID]
    same("location", np.array([0.0, 0.0, 5.0]), np.array(after["location"]), 1e-4)
    same("rotation_quat", np.array(before["rotation_quat"]), np.array(after["rotation_quat"]), 1e-4)
    await bench.refuse("set_actor_transform_failed", "set_actor_transform", target="nobody", location=[0, 0, 0])
    await _clear(bench)


@check("Editor 3.1 duplicate_actor", "Generation 2 12", group=AUTHOR)
async def duplicating(bench: Bench) -> None:
    """A copy has its own id and place"""
    first = await _spawn(bench)
    copy = await bench.edit("duplicate_actor", target=_ID, new_actor_id="copy", location=[3.0, 0.0, 0.0])
    holds(copy["actor_name"] != first["actor_name"], "another actor", copy["actor_name"])
    same("location", np.array([3.0, 0.0, 0.0]), np.array((await _rows(bench))["copy"]["location"]), 1e-4)
    await _clear(bench)


@check("Editor 3.1 spawn_grid", "Generation 2 12", group=AUTHOR)
async def grids(bench: Bench) -> None:
    """A grid has an actor in each cell"""
    grid = {"blueprint": _blueprint[bench], "base_actor_id": "cell", "count_x": 2, "count_y": 2}
    reply = await bench.edit("spawn_grid", **grid, spacing=[2.0, 3.0, 0.0])
    same("count", 4, int(reply["count"]))
    rows = await _rows(bench)
    same("ids", {f"cell_{i}_{j}" for i in range(2) for j in range(2)}, set(rows))
    same("location", np.array([2.0, 3.0]), np.array(rows["cell_1_1"]["location"])[:2], 1e-4)
    await _clear(bench)


@check("Editor 3.1 destroy_actor", "Generation 2 14", group=AUTHOR)
async def removing(bench: Bench) -> None:
    """A removed actor is gone, and an unknown one is refused"""
    await _spawn(bench)
    await bench.edit(_remove_op(bench), target=_ID)
    same("actors", [], [name for name in await _rows(bench) if name == _ID])
    await bench.refuse("destroy_failed", _remove_op(bench), target=_ID)


@check("Editor 3.3 get_actor_bounds", group=AUTHOR)
async def bounds(bench: Bench) -> None:
    """The bounds of an actor are where it is"""
    await _spawn(bench, location=[10.0, 0.0, 0.0])
    reply = await bench.wire.ask("get_actor_bounds", target=_ID)
    low, high = np.array(reply["min"]), np.array(reply["max"])
    same("center", (low + high) / 2, np.array(reply["center"]), 1e-3)
    holds(low[0] < high[0] and abs(reply["center"][0] - 10.0) < 5.0, "bounds around x = 10", reply["center"])
    await _clear(bench)


@check("Editor 3.1 save_level", "Editor 3.1 load_level", group=AUTHOR)
async def saving(bench: Bench) -> None:
    """A saved level comes back as it was; an unknown one is refused"""
    await _spawn(bench, location=[1.0, 0.0, 0.0])
    before = (await _rows(bench))[_ID]
    await bench.edit("save_level")
    await bench.edit("set_actor_transform", target=_ID, location=[9.0, 0.0, 0.0])
    level = (await bench.wire.ask("current_level"))["level_path"]
    await bench.edit("load_level", level_path=level)
    after = (await _rows(bench)).get(_ID, {})
    same("location", before["location"], after.get("location"))
    await bench.refuse("load_level_failed", "load_level", level_path="/Game/Levels/no_such_level_at_all")
    await _clear(bench)


@check("Editor 3.1 destroy_asset", group=AUTHOR)
async def assets(bench: Bench) -> None:
    """Removing an asset that is not there succeeds, and says so"""
    reply = await bench.edit("destroy_asset", asset_path="/Game/Levels/no_such.no_such")
    same("was_found", False, reply["was_found"])


@check("Editor 3.2 begin_pie", "Beta 4", "Beta 23", group=AUTHOR)
async def beginning(bench: Bench) -> None:
    """Play begins with a handshake of the level's robots, whose claims are new, and starts paused in live mode"""
    await _spawn(bench)
    bench.later("stop_pie")
    reply = await bench.wire.ask("begin_pie", timeout_s=60)
    same("state", "ready", reply["state"])
    payload = reply["handshake_payload"]
    same("robots", 1, len(payload["articulations"]))
    same("actor_id", _ID, payload["articulations"][0]["actor_id"])
    times = [float((await bench.wire.ask("step"))["time"]) for _ in range(2)]
    same("time at the start, paused", times[0], times[1])
    if bench.features.claims:
        key = payload["articulations"][0]["prefix"]
        await bench.wire.refused("not_control_owner", "step", per_articulation={key: {"ctrl": []}})
        await bench.wire.ask("claim_control", articulation=key)
        await bench.wire.ask("stop_pie")
        await bench.wire.ask("begin_pie", timeout_s=60)
        await bench.wire.refused("not_control_owner", "step", per_articulation={key: {"ctrl": []}})
    await bench.wire.ask("stop_pie")
    await _clear(bench)


@check("Editor 3.3 add_quick_convert", group=AUTHOR)
async def quick_convert(bench: Bench) -> None:
    """A static mesh becomes a body, and stops being one"""
    actors = (await bench.wire.ask("list_actors"))["actors"]
    mesh = next((row for row in actors if row.get("is_static_mesh_actor")), None)
    if mesh is None:
        raise NotTried("needs a static mesh in the level, which no op makes")
    name = {"target": mesh["name"], "target_by": "actor_name"}
    await bench.edit("add_quick_convert", **name, static=True)
    await bench.edit("remove_quick_convert", **name)
    await bench.refuse("remove_quick_convert_failed", "remove_quick_convert", **name)
