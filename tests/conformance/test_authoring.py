"""Authoring a level and playing it, in both flavours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from urlab_client import NoActiveManager, PIEState, URLabAsset, URLabPIEError
from urlab_client.enums import StepMode
from urlab_client.errors import CreateLevelFailed, ImportFailed, LoadLevelFailed, SpawnFailed, TooManyCells, Unsupported

BOX = """
<mujoco model="box"><worldbody><body name="box" pos="0 0 1"><freejoint name="root"/>
<geom name="g" type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
<keyframe><key name="home" qpos="0 0 2 1 0 0 0"/></keyframe></mujoco>
"""


@pytest.fixture
def box(tmp_path: Path) -> str:
    path = tmp_path / "box.xml"
    path.write_text(BOX)
    return str(path)


@pytest.fixture
def empty(serve: Any, tmp_path: Path) -> Any:
    with serve(model_roots=[tmp_path]) as server:
        yield server


async def test_author_play_drive(connect: Any, empty: Any, box: str) -> None:
    client = connect(empty, step_mode="direct")
    await client.discover()
    assert not client.manager_present
    with pytest.raises(NoActiveManager, match=r"sim\.start"):
        await client.step()
    await client.scene.create_level("lab")
    blueprint = await client.scene.import_xml(box)
    assert blueprint.imported_now
    assert not (await client.scene.import_xml(box)).imported_now
    handle = await client.scene.spawn_actor(blueprint, "crate", location=(1, 2, 0.5))
    assert handle.location == (1.0, 2.0, 0.5)
    assert handle.runtime(_twin(client)) is None
    assert await client.scene.ensure_manager() is False
    assert await client.scene.ensure_manager() is True
    await client.scene.save_level()
    assert await client.scene.current_level() == "/Game/Levels/lab"

    assert (await client.sim.status()).state is PIEState.OFF
    result = await client.sim.start()
    assert result.is_ready
    assert result.handshake_payload["articulations"][0]["actor_id"] == "crate"
    assert client.manager_present
    assert client.step_mode is StepMode.DIRECT
    crate = client.articulations_by_id["crate"]
    assert handle.runtime(_twin(client)) is not None
    assert np.allclose(crate.root_pos_w, [1, 2, 1.5])
    await client.step(10)
    assert crate.root_pos_w[2] < 1.5
    assert (await client.sim.status()).sim_time == pytest.approx(0.02)

    moved = await client.scene.spawn_actor(blueprint, "crate", location=(0, 0, 3))
    assert moved.was_existing
    assert moved.requires_pie_restart
    await client.sim.stop()
    assert not client.manager_present
    assert (await client.sim.status()).state is PIEState.OFF
    await client.sim.start()
    assert np.allclose(client.articulations_by_id["crate"].root_pos_w, [0, 0, 4])


def _twin(client: Any) -> Any:
    return getattr(client, "twin", client)


async def test_apply_scene_is_idempotent(connect: Any, empty: Any, box: str) -> None:
    client = connect(empty)
    await client.discover()
    assets = [URLabAsset("a", box), URLabAsset("b", box, location=(1, 0, 0), rotation_euler=(0, 0, 90))]
    first = await client.scene.apply_scene("lab", assets)
    assert [handle.was_existing for handle in first.values()] == [False, False]
    assert np.allclose(first["b"].rotation_quat, [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    again = await client.scene.apply_scene("lab", [URLabAsset("b", box, location=(5, 0, 0))])
    assert again["b"].was_existing
    rows = {row.actor_id: row for row in await client.outliner.list_actors() if row.actor_id}
    assert rows["b"].location == (5.0, 0.0, 0.0)
    assert rows["a"].is_articulation
    with pytest.raises(ValueError, match="used twice: a"):
        await client.scene.apply_scene("lab", [URLabAsset("a", box), URLabAsset("a", box)])


async def test_a_grid(connect: Any, empty: Any, box: str) -> None:
    client = connect(empty, step_mode="direct")
    await client.discover()
    await client.scene.create_level("grid")
    await client.scene.ensure_manager()
    blueprint = await client.scene.import_xml(box)
    handles = await client.scene.spawn_grid(blueprint, "g", 3, 2, spacing=(2, 3, 0), origin=(0, 0, 1))
    assert list(handles) == ["g_0_0", "g_1_0", "g_2_0", "g_0_1", "g_1_1", "g_2_1"]
    assert handles["g_2_1"].location == (4.0, 3.0, 1.0)
    with pytest.raises(TooManyCells):
        await client.scene.spawn_grid(blueprint, "h", 33, 32)
    half = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # a quarter turn to the left
    turned = await client.scene.spawn_grid(blueprint, "t", 1, 1, origin=(0, 9, 0), rotation_quat=half)
    assert turned["t_0_0"].rotation_quat == pytest.approx(half, abs=1e-6)
    await client.scene.destroy_actor("t_0_0")
    await client.sim.start()
    assert len(client.articulations) == 6


async def test_snapshot_and_edits(connect: Any, empty: Any, box: str) -> None:
    client = connect(empty)
    await client.discover()
    await client.scene.create_level("lab")
    blueprint = await client.scene.import_xml(box)
    await client.scene.spawn_actor(blueprint, "crate")
    copy = await client.scene.duplicate_actor("crate", "copy")
    assert (copy.actor_id, copy.location, copy.was_existing) == ("copy", (1.0, 0.0, 0.0), False)
    light = await client.scene.spawn_light("SPOT", "lamp", location=(0, 0, 3), color=(1, 0.5, 0.25))
    assert (light.kind, light.color) == ("spot", (1.0, 0.5, 0.25))
    snapshot = await client.scene.snapshot()
    assert not snapshot.in_pie
    crate = next(actor for actor in snapshot.actors if actor.actor_id == "crate")
    assert crate.is_articulation
    assert "root" in crate.joints
    await client.scene.set_actor_transform("crate", location=(0, 0, 9))
    node = await client.scene.actor_hierarchy("crate")
    assert (node.location, node.children) == ((0.0, 0.0, 9.0), [])
    await client.scene.destroy_actor(copy.actor_name, by_name=True)
    assert {row.actor_id for row in await client.outliner.list_actors()} >= {"crate", "lamp"}
    assert "copy" not in {row.actor_id for row in await client.outliner.list_actors()}


async def test_levels_come_back(connect: Any, empty: Any, box: str) -> None:
    client = connect(empty)
    await client.discover()
    await client.scene.create_level("one")
    await client.scene.spawn_actor(await client.scene.import_xml(box), "crate", location=(1, 1, 1))
    await client.scene.save_level()
    await client.scene.create_level("two")
    assert not any(row.actor_id == "crate" for row in await client.outliner.list_actors())
    await client.scene.load_level("one")
    (crate,) = (row for row in await client.outliner.list_actors() if row.actor_id == "crate")
    assert crate.location == (1.0, 1.0, 1.0)
    with pytest.raises(CreateLevelFailed):
        await client.scene.create_level("one")
    await client.scene.create_level("one", force_overwrite=True)
    assert await client.scene.destroy_asset("/Game/Levels/two.two") is True
    assert await client.scene.destroy_asset("/Game/Levels/two.two") is False


async def test_broken_and_missing_models_say_why(connect: Any, empty: Any, tmp_path: Path) -> None:
    client = connect(empty)
    await client.discover()
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(ImportFailed, match="mass and inertia"):
        await client.scene.import_xml(str(broken))
    with pytest.raises(ImportFailed, match=r"nowhere\.xml"):
        await client.scene.import_xml(str(tmp_path / "nowhere.xml"))
    with pytest.raises(SpawnFailed):
        await client.scene.spawn_actor("/Game/MuJoCoImports/ghost", "g")


async def test_play_without_a_manager_explains_itself(connect: Any, empty: Any) -> None:
    client = connect(empty)
    await client.discover()
    await client.scene.create_level("bare")
    with pytest.raises(URLabPIEError, match="ensure_manager") as info:
        await client.sim.start()
    assert info.value.state is PIEState.TIMEOUT
    result = await client.sim.start(raise_on_failure=False)
    assert not result.is_ready


async def test_a_healthy_session_goes_on(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.step(10)
        result = await client.sim.start()
        assert result.is_ready
        await client.step()
        assert client.sim_time == pytest.approx(0.022), "play was not restarted"


async def test_what_this_server_cannot_do_yet_says_so(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server)
        await client.discover()
        with pytest.raises(Unsupported, match="reflections"):
            await client.viewport.set_mode("reflections")


async def test_meta_lists_the_ops(connect: Any, empty: Any, dialect: str) -> None:
    client = connect(empty)
    names = {op.name for op in await client.meta()}
    assert len(names) == {"alpha": 62, "beta": 73}[dialect]
    assert {"step", "spawn_actor", "draw_axes"} <= names


async def test_a_start_that_is_refused_leaves_play_as_it_was(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        with pytest.raises(LoadLevelFailed, match="/Game/Levels/nowhere"):
            await client.sim.start("/Game/Levels/nowhere")
        assert (await client.step(2)).step == 2
