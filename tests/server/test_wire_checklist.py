"""Statements about the wire that any client can check, over a bare socket.

`test_editor_NN` follow the editor ops' list of checks, `test_sim_NN` the list of observable simulation behaviours.
Numbers that are missing belong to ops that this server does not offer yet.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from scenes import hasty as hasty_engine
from wire import Wire, float32, write_level

from urlab_client.protocol.base import Needs
from urlab_client.server import ControllerConfig, SimulatedServer
from urlab_client.server.dialects import ALPHA

Serve = Callable[..., Wire]

DT = 0.002
HUMANOID = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml"


@pytest.fixture(scope="module")
def shared(models: Path) -> Iterator[Wire]:
    """A server that the tests here leave as it is."""
    with SimulatedServer(models / "bot.xml") as server, Wire(server) as wire:
        wire.hello()
        yield wire


@pytest.fixture(scope="module")
def shared_play(models: Path) -> Iterator[Wire]:
    """A server in play, paused and live; the tests here change its speed at most."""
    with SimulatedServer(models / "bot.xml", play=True) as server, Wire(server) as wire:
        wire.hello()
        yield wire


# Editor ops


def spawn(wire: Wire, model: Path, actor_id: str, **fields: Any) -> dict[str, Any]:
    wire.ask("import_xml", path=str(model))
    return wire.ask("spawn_actor", blueprint=f"/Game/MuJoCoImports/{model.stem}", actor_id=actor_id, **fields)


def rows(wire: Wire, op: str = "list_actors", **fields: Any) -> dict[str, dict[str, Any]]:
    """Return the actors that have an id, by id."""
    return {row["actor_id"]: row for row in wire.ask(op, **fields)["actors"] if row["actor_id"]}


def same_rotation(one: list[float], other: list[float]) -> bool:
    return abs(float(np.dot(one, other))) == pytest.approx(1.0, abs=1e-6)


def play(wire: Wire) -> dict[str, Any]:
    wire.ask("ensure_manager")
    reply = wire.ask("begin_pie")
    assert reply["state"] == "ready", reply
    return reply


def test_editor_01_import_once(editor: Wire, models: Path) -> None:
    first = editor.ask("import_xml", path=str(models / "bot.xml"))
    second = editor.ask("import_xml", path=str(models / "bot.xml"))
    assert first == {
        "op": "import_xml_ok",
        "blueprint_class_path": "/Game/MuJoCoImports/bot.bot_C",
        "blueprint_short_name": "bot",
        "imported_now": True,
    }
    assert second == {**first, "imported_now": False}
    assert editor.ask("import_xml", path=str(models / "bot.xml"), force_reimport=True)["imported_now"] is True


def test_editor_02_import_needs_a_file(editor: Wire, models: Path) -> None:
    assert editor.refused("import_xml") == "missing_field"
    assert editor.refused("import_xml", path="") == "missing_field"
    assert editor.refused("import_xml", path=None) == "missing_field"
    assert editor.refused("import_xml", path=str(models / "nothing.xml")) == "import_failed"


def test_editor_03_broken_models_are_refused(editor: Wire, models: Path) -> None:
    code, message = editor.refusal("import_xml", path=str(models / "broken.xml"))
    assert code == "import_failed"
    assert "broken.xml" in message
    assert editor.ask("list_blueprints")["blueprints"] == []


def test_editor_04_levels_are_created_once(editor: Wire) -> None:
    assert editor.ask("create_level", name="lab")["level_path"] == "/Game/Levels/lab"
    assert editor.refused("create_level", name="lab") == "create_level_failed"
    assert editor.ask("create_level", name="lab", force_overwrite=True)["level_path"] == "/Game/Levels/lab"
    assert editor.refused("create_level", name="") == "missing_field"


def test_editor_05_levels_are_loaded_by_path(editor: Wire) -> None:
    editor.ask("create_level", name="lab")
    assert editor.refused("load_level", name="lab") == "missing_field"
    assert editor.refused("load_level", level_path="") == "missing_field"
    assert editor.ask("load_level", level_path="lab")["level_path"] == "/Game/Levels/lab"
    assert editor.ask("load_level", level_path="", name="lab")["level_path"] == "/Game/Levels/lab"
    assert editor.refused("load_level", level_path="nowhere") == "load_level_failed"


def test_levels_are_named_by_object_path_too(editor: Wire) -> None:
    assert editor.ask("create_level", name="/Game/Levels/G1.G1")["level_path"] == "/Game/Levels/G1"
    assert editor.refused("create_level", name="G1") == "create_level_failed"
    editor.ask("ensure_manager")
    editor.ask("save_level")
    editor.ask("create_level", name="G2.G2")
    assert editor.ask("load_level", level_path="/Game/Levels/G1.G1")["level_path"] == "/Game/Levels/G1.G1"
    assert editor.ask("current_level")["level_path"] == "/Game/Levels/G1"
    editor.ask("load_level", level_path="G2.g2")
    assert editor.ask("begin_pie", level_path="/Game/Levels/G1.G1")["state"] == "ready"
    editor.ask("stop_pie")
    assert editor.ask("current_level")["level_path"] == "/Game/Levels/G1"
    assert editor.ask("destroy_asset", asset_path="/Game/Levels/G1.G1")["was_found"] is True
    for wrong in ("/Game/Levels/G2.G1", "/Game/Levels/G2.", "/Game/Levels/.G2", "G2.G2.G2"):
        assert editor.refused("load_level", level_path=wrong) == "load_level_failed"


def test_editor_06_a_saved_level_comes_back(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a", location=[1, 2, 3], rotation_euler=[0, 0, 90])
    editor.ask("save_level")
    before = rows(editor)["a"]
    editor.ask("create_level", name="other")
    assert rows(editor) == {}
    editor.ask("load_level", level_path="fresh")
    assert rows(editor)["a"] == before
    assert before["location"] == [1.0, 2.0, 3.0]


def test_editor_07_one_manager(editor: Wire) -> None:
    first, second = editor.ask("ensure_manager"), editor.ask("ensure_manager")
    assert (first["was_existing"], second["was_existing"]) == (False, True)
    assert first["actor_name"] == second["actor_name"]
    assert [row["class"] for row in editor.ask("list_actors")["actors"]] == ["AMjManager"]


def test_editor_08_destroying_nothing(editor: Wire) -> None:
    reply = editor.ask("destroy_asset", asset_path="/Game/Levels/never.never")
    assert reply == {"op": "destroy_asset_ok", "asset_path": "/Game/Levels/never.never", "was_found": False}


def test_editor_09_an_id_is_moved_not_doubled(editor: Wire, models: Path) -> None:
    first = spawn(editor, models / "bot.xml", "a", location=[1, 0, 0])
    second = spawn(editor, models / "bot.xml", "a", location=[0, 4, 0])
    assert (first["was_existing"], second["was_existing"]) == (False, True)
    assert first["actor_name"] == second["actor_name"]
    assert [row["location"] for row in editor.ask("list_actors")["actors"]] == [[0.0, 4.0, 0.0]]


def test_editor_10_an_id_belongs_to_a_class(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a")
    editor.ask("import_xml", path=str(models / "prop.xml"))
    code, message = editor.refusal("spawn_actor", blueprint="/Game/MuJoCoImports/prop", actor_id="a")
    assert code == "spawn_failed"
    assert "'a'" in message


def test_editor_11_quaternion_and_euler(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "quat", rotation_quat=[0, 0, 0.70710678, 0.70710678])
    spawn(editor, models / "bot.xml", "euler", rotation_euler=[0, 0, 90])
    listed = rows(editor)
    assert same_rotation(listed["quat"]["rotation_quat"], listed["euler"]["rotation_quat"])


def test_editor_12_positive_roll_turns_back(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a", rotation_euler=[90, 0, 0])
    assert same_rotation(rows(editor)["a"]["rotation_quat"], [-0.70710678, 0, 0, 0.70710678])


def test_editor_13_transform_keeps_what_is_left_out(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a", location=[1, 1, 1], rotation_euler=[0, 0, 90])
    before = rows(editor)["a"]
    editor.ask("set_actor_transform", target="a")
    assert rows(editor)["a"] == before
    editor.ask("set_actor_transform", target="a", location=[0, 0, 5])
    assert rows(editor)["a"] == {**before, "location": [0.0, 0.0, 5.0]}
    editor.ask("set_actor_transform", target="a", location=[1, 2])  # malformed counts as left out
    assert rows(editor)["a"]["location"] == [0.0, 0.0, 5.0]


def test_editor_14_transform_finds_by_name_without_being_told(editor: Wire, models: Path) -> None:
    name = spawn(editor, models / "bot.xml", "a")["actor_name"]
    reply = editor.ask("set_actor_transform", target=name, location=[0, 0, 1])
    assert reply == {"op": "set_actor_transform_ok", "actor_name": name, "requires_pie_restart": False}
    assert editor.refused("set_actor_transform", target="nobody") == "set_actor_transform_failed"
    assert editor.refused("set_actor_transform", target="") == "missing_field"


def test_editor_14_framing_does_not(editor: Wire, models: Path) -> None:
    name = spawn(editor, models / "bot.xml", "a")["actor_name"]
    for key in (name, ""):
        assert editor.refused("frame_actor", target=key) == ("unknown_actor" if key else "missing_field")
    reply = editor.ask("frame_actor", target=name, target_by="ACTOR_NAME")
    assert reply == editor.ask("frame_actor", target="a")
    assert set(reply) == {"op", "location", "rotation_quat", "rotation_euler", "fov"}


def test_editor_15_grids(editor: Wire, models: Path) -> None:
    editor.ask("import_xml", path=str(models / "bot.xml"))
    grid = {"blueprint": "/Game/MuJoCoImports/bot", "base_actor_id": "g"}
    reply = editor.ask("spawn_grid", **grid, count_x=2, count_y=3, spacing=[2, 1, 7], origin=[1, 0, 1])
    assert reply["count"] == 6
    assert [cell["actor_id"] for cell in reply["actors"]] == ["g_0_0", "g_1_0", "g_0_1", "g_1_1", "g_0_2", "g_1_2"]
    assert reply["actors"][5]["location"] == [3.0, 2.0, 1.0]
    assert editor.ask("spawn_grid", **grid, count_x=32, count_y=32)["count"] == 1024
    for x, y, code in ((33, 32, "too_many_cells"), (65536, 65536, "too_many_cells"), (0, 1, "invalid_count")):
        assert editor.refused("spawn_grid", **grid, count_x=x, count_y=y) == code
    for unusable in ("many", None, [1], -1):
        assert editor.refused("spawn_grid", **grid, count_x=unusable, count_y=1) == "invalid_count"
        assert editor.refused("spawn_grid", **grid, count_x=1, count_y=unusable) == "invalid_count"
    assert editor.refused("spawn_grid", **grid, count_x=1) == "missing_field"


def test_editor_16_lights_add_up(editor: Wire) -> None:
    first = editor.ask("spawn_light", kind="SPOT", actor_id="lamp", color=[0.1, 0, 1])
    editor.ask("spawn_light", kind="point", actor_id="lamp")
    assert first["kind"] == "spot"
    assert first["color"] == [float32(0.1), 0.0, 1.0]
    lights = editor.ask("list_actors")["actors"]
    assert [row["actor_id"] for row in lights] == ["lamp", "lamp"]
    assert all(row["is_light"] for row in lights)
    assert editor.refused("spawn_light", kind="sun") == "spawn_failed"


def test_editor_17_finding_actors(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a")
    editor.ask("spawn_light", kind="point", actor_id="lamp")
    for name in ("AMjArticulation", "mjarticulation", "BOT_C", "pawn"):
        assert list(rows(editor, "find_actors", class_filter=name)) == ["a"]
    found = rows(editor, "find_actors", tag="urlab.actorid=lamp")
    assert list(found) == ["lamp"]
    assert found["lamp"]["tags"] == ["URLab.ActorId=lamp"]
    assert "is_light" not in found["lamp"]
    assert list(rows(editor, "find_actors", name_prefix="BO", tag=None)) == ["a"]


def test_editor_18_duplicates_land_beside(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a", location=[1, 2, 3])
    editor.ask("duplicate_actor", target="a", new_actor_id="b")
    assert rows(editor)["b"]["location"] == [2.0, 2.0, 3.0]
    assert editor.refused("duplicate_actor", target="nobody", new_actor_id="c") == "duplicate_failed"
    assert editor.refused("duplicate_actor", target="a", new_actor_id="") == "missing_field"


def test_editor_19_nothing_to_remove(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a")
    assert editor.refused("destroy_actor", target="nobody") == "destroy_failed"
    assert editor.refused("remove_quick_convert", target="a") == "remove_quick_convert_failed"
    assert editor.refused("remove_quick_convert", target="nobody") == "remove_quick_convert_failed"
    assert editor.ask("destroy_actor", target="a") == {"op": "destroy_actor_ok", "requires_pie_restart": False}
    assert editor.refused("destroy_actor", target="a") == "destroy_failed"


@pytest.fixture
def room(connect: Callable[[SimulatedServer], Wire], tmp_path: Path) -> Iterator[Wire]:
    """A client of a server whose level holds a manager and a static mesh `crate`, for which no op exists."""
    with SimulatedServer(write_level(tmp_path / "room.json", size=0.1)) as server:
        wire = connect(server)
        wire.hello()
        yield wire


def test_editor_20_quick_convert_starts_over(room: Wire) -> None:
    reply = room.ask("add_quick_convert", target="crate", friction=[0.5, 0.1, 0.1], coacd_threshold=0.1)
    assert reply["coacd_threshold"] == 0.1
    assert rows(room)["crate"]["quick_convert"]["friction"] == [0.5, 0.1, 0.1]
    assert rows(room)["crate"]["quick_convert"]["coacd_threshold"] == float32(0.1)
    room.ask("add_quick_convert", target="Crate_0")
    assert rows(room)["crate"]["quick_convert"]["friction"] == [1.0, 1.0, 1.0]
    room.ask("remove_quick_convert", target="crate")
    assert rows(room)["crate"]["has_quick_convert"] is False


def test_editor_21_location_is_the_one_asked_for(editor: Wire, models: Path) -> None:
    assert spawn(editor, models / "bot.xml", "a", location=[1, 2, 0.5])["location"] == [1.0, 2.0, 0.5]


def test_editor_22_play_needs_a_manager(editor: Wire) -> None:
    assert editor.ask("pie_status") == {"op": "pie_status_ok", "state": "off", "compile_error": ""}
    reply = editor.ask("begin_pie", timeout_s=3600)
    assert reply["state"] == "timeout"
    assert "ensure_manager" in reply["compile_error"]
    assert "handshake_payload" not in reply
    assert editor.ask("pie_status")["state"] == "off"


def test_editor_23_play_answers_with_a_handshake(editor: Wire, models: Path) -> None:
    name = spawn(editor, models / "bot.xml", "a")["actor_name"]
    payload = play(editor)["handshake_payload"]
    assert payload["op"] == "hello_ok"
    assert payload["session_id"] == editor.session_id
    assert [entry["prefix"] for entry in payload["articulations"]] == [name]
    assert payload["mjb_size"] == len(payload["mjb"])
    assert "vfs_assets" not in payload
    editor.ask("set_mode", mode="direct")
    editor.ask("step", n_steps=5)
    again = editor.ask("begin_pie", level_path="")
    assert again["state"] == "ready"
    assert again["handshake_payload"]["session_id"] == editor.session_id
    assert editor.ask("pie_status")["sim_time"] == pytest.approx(5 * DT)  # nothing restarted


def test_editor_24_edits_wait_for_the_next_play(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a")
    play(editor)
    assert spawn(editor, models / "bot.xml", "b")["requires_pie_restart"] is True
    assert list(rows(editor, "find_actors", in_pie=True)) == ["a"]
    assert list(rows(editor)) == ["a", "b"]
    assert editor.ask("set_actor_transform", target="a", location=[9, 0, 0])["requires_pie_restart"] is True
    assert rows(editor, "find_actors", in_pie=True)["a"]["location"] == [0.0, 0.0, 0.0]
    for op, fields in (("create_level", {"name": "x"}), ("load_level", {"level_path": "fresh"}), ("save_level", {})):
        assert editor.refused(op, **fields) == f"{op}_failed"


def test_editor_25_snapshot_shows_play(editor: Wire, models: Path) -> None:
    name = spawn(editor, models / "bot.xml", "a")["actor_name"]
    before = editor.ask("snapshot")
    assert (before["in_pie"], before["level_path"]) == (False, "/Game/Levels/fresh")
    assert before["actors"][0]["urlab"] == {
        "mj_class": "articulation",
        "joints": ["root", "j"],
        "actuators": ["m"],
        "sensors": ["s"],
        "cameras": ["cam"],
    }
    play(editor)
    during = editor.ask("snapshot")
    assert during["in_pie"] is editor.ask("list_actors")["in_pie"] is True
    assert during["level_path"] == "/Game/Levels/UEDPIE_0_fresh"
    assert rows(editor, "snapshot")["a"]["urlab"]["joints"] == [f"{name}_root", f"{name}_j"]
    assert "MjReplayManager" in [row["class"] for row in during["actors"]]
    assert editor.ask("actor_hierarchy", target="a")["root"] == {
        "name": name,
        "class": "bot_C",
        "location": [0.0, 0.0, 0.0],
        "children": [],
    }
    assert editor.ask("current_level")["level_path"] == "/Game/Levels/fresh"


def test_editor_26_stopping_twice(editor: Wire, models: Path) -> None:
    assert editor.ask("stop_pie") == {"op": "stop_pie_ok"}
    spawn(editor, models / "bot.xml", "a")
    play(editor)
    for _ in range(2):
        assert editor.ask("stop_pie") == {"op": "stop_pie_ok"}
        assert editor.ask("pie_status") == {"op": "pie_status_ok", "state": "off", "compile_error": ""}
    assert editor.ask("list_actors")["in_pie"] is False


def test_editor_27_markers(editor: Wire) -> None:
    assert editor.refused("draw_marker", location=[0, 0, 0]) == "missing_field"
    assert editor.ask("draw_marker", location=[0, 0, 0], color=[1]) == {"op": "draw_marker_ok"}
    assert editor.refused("draw_marker", location=[0, 0], color=[1, 0, 0]) == "missing_field"


def test_editor_28_overlay_text(editor: Wire) -> None:
    assert editor.refused("set_overlay_text") == "missing_field"
    assert editor.ask("set_overlay_text", text="") == {"op": "set_overlay_text_ok"}


def test_editor_29_view_modes(editor: Wire) -> None:
    assert editor.ask("set_viewport_mode", mode="WireFrame") == {"op": "set_mode_ok", "mode": "WireFrame"}
    assert editor.refused("set_viewport_mode", mode="x") == "invalid_mode"
    assert editor.refused("set_viewport_mode", mode="") == "missing_field"


def test_editor_30_euler_angles_of_the_camera(editor: Wire) -> None:
    editor.ask("set_camera", location=[1, 2, 3], rotation_euler=[0, -30, 45])
    view = editor.ask("get_camera")
    assert view["rotation_euler"] == pytest.approx([0, -30, 45])
    expected = np.array([0.0990, 0.2391, -0.3696, 0.8924])
    quat = np.array(view["rotation_quat"])
    assert min(np.abs(quat - expected).max(), np.abs(quat + expected).max()) < 1e-4


def test_editor_31_quaternions_of_the_camera(editor: Wire) -> None:
    quat = [0.5, 0.1, 0.7, 0.5]
    reply = editor.ask("set_camera", location=[0, 0, 0], rotation_quat=quat)
    assert same_rotation(reply["rotation_quat"], [-0.5, 0.1, -0.7, 0.5])


def test_editor_32_the_camera_needs_a_place(editor: Wire) -> None:
    assert editor.refused("set_camera", fov=50) == "missing_field"
    assert editor.ask("set_camera", location=[0, 0, 0], fov=50)["fov"] == 50.0
    assert editor.ask("set_camera", location=[0, 0, 0], fov=0)["fov"] == 50.0


def test_editor_33_untracking(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "a")
    editor.ask("track_actor", target="a")
    assert editor.ask("untrack") == {"op": "untrack_ok", "was_tracking": True}
    assert editor.ask("untrack") == {"op": "untrack_ok", "was_tracking": False}


@pytest.mark.parametrize("op", [op.name for op in ALPHA.ops.values() if op.needs is not Needs.NOTHING])
def test_editor_35_session_before_fields(shared: Wire, op: str) -> None:
    for session in ({}, {"session_id": ""}, {"session_id": "0"}, {"session_id": shared.session_id.upper()}):
        reply = shared.raw({"op": op, **session})
        assert (reply["op"], reply["code"]) == ("error", "session_expired")


# Simulation


def model_of(reply: dict[str, Any], folder: Path) -> mujoco.MjModel:
    path = folder / "scene.mjb"
    path.write_bytes(reply["mjb"])
    return mujoco.MjModel.from_binary_path(str(path))


@pytest.fixture
def pair(editor: Wire, models: Path) -> Wire:
    """Two robots `a0` and `a1`, keys `bot` and `copy1_bot`, in play."""
    spawn(editor, models / "bot.xml", "a0")
    spawn(editor, models / "bot.xml", "a1", location=[2, 0, 0])
    play(editor)
    return editor


@pytest.fixture
def direct(serve: Serve) -> Wire:
    """One robot, key `bot`, in direct mode."""
    wire = serve("bot", play=True)
    wire.ask("set_mode", mode="direct")
    return wire


@pytest.fixture
def puppet(serve: Serve) -> Wire:
    """One robot, key `bot`, in puppet mode."""
    wire = serve("bot", play=True)
    wire.ask("set_mode", mode="puppet")
    return wire


@pytest.fixture
def pd(serve: Serve) -> Wire:
    """One robot with a PD controller, in direct mode."""
    wire = serve("bot", play=True, controllers={"*": ControllerConfig()})
    wire.ask("set_mode", mode="direct")
    return wire


def command(ctrl: list[float], **more: Any) -> dict[str, Any]:
    return {"per_articulation": {"bot": {"ctrl": ctrl, **more}}}


def bot(reply: dict[str, Any]) -> dict[str, Any]:
    return reply["per_articulation"]["bot"]


def test_sim_01_to_07_names_and_placement(pair: Wire, tmp_path: Path) -> None:
    reply = pair.hello()
    model = model_of(reply, tmp_path)
    keys = {entry["actor_id"]: entry["prefix"] for entry in reply["articulations"]}
    assert keys == {"a0": "bot", "a1": "copy1_bot"}
    assert {row["actor_id"]: row["name"] for row in rows(pair).values()} == keys
    for key in keys.values():
        for kind, name in (("body", "base"), ("body", "arm"), ("joint", "root"), ("joint", "j"), ("geom", "floor")):
            assert getattr(model, kind)(f"{key}_{name}").id >= 0
        for kind, name in (("actuator", "m"), ("sensor", "s"), ("key", "home")):
            assert getattr(model, kind)(f"{key}_{name}").id >= 0
    assert model.body("copy1_bot_base").pos.tolist() == [2.0, 0.0, 1.0]
    start = model.jnt_qposadr[model.joint("copy1_bot_root").id]
    assert model.qpos0[start : start + 7].tolist() == [2.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert model.geom_bodyid[model.geom("copy1_bot_floor").id] == 0
    assert model.geom("copy1_bot_floor").pos.tolist() == [2.0, 0.0, -5.0]


def test_sim_04_actors_without_an_id(editor: Wire, models: Path) -> None:
    spawn(editor, models / "bot.xml", "")
    assert [entry["actor_id"] for entry in play(editor)["handshake_payload"]["articulations"]] == [""]


def test_sim_08_an_empty_level_is_a_model(editor: Wire, tmp_path: Path) -> None:
    payload = play(editor)["handshake_payload"]
    model = model_of(payload, tmp_path)
    assert (model.nbody, model.ngeom) == (1, 0)
    assert payload["articulations"] == []
    assert editor.ask("step")["per_articulation"] == {}


def test_sim_09_to_13_options_and_model(pair: Wire, tmp_path: Path) -> None:
    reply = pair.hello()
    model = model_of(reply, tmp_path)
    assert model.opt.timestep == DT
    assert model.opt.gravity.tolist() == [0.0, 0.0, -9.81]
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.enableflags == 0
    assert reply["mjb_size"] == len(reply["mjb"])


def test_sim_14_a_restart_takes_edits_over(pair: Wire, models: Path) -> None:
    assert spawn(pair, models / "bot.xml", "a2", location=[4, 0, 0])["requires_pie_restart"] is True
    assert len(pair.hello()["articulations"]) == 2
    pair.ask("stop_pie")
    play(pair)
    assert [entry["actor_id"] for entry in pair.hello()["articulations"]] == ["a0", "a1", "a2"]


def test_sim_15_to_17_keyframes(pair: Wire, tmp_path: Path) -> None:
    model = model_of(pair.hello(), tmp_path)
    keys = pair.ask("list_keyframes")["keyframes"]
    assert [key["name"] for key in keys] == ["bot_home", "copy1_bot_home"]
    for key in keys:
        assert key["time"] == 1.5
        assert (len(key["qpos"]), len(key["qvel"]), len(key["ctrl"])) == (model.nq, model.nv, model.nu)
        assert key["mocap_pos"] == key["mocap_quat"] == []
    second = keys[1]
    assert second["qpos"][:8] == model.qpos0[:8].tolist()
    assert second["ctrl"] == [0.0, 0.3]
    assert second["qpos"][8:] == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.5]


def test_sim_18_no_scene_cameras(pair: Wire) -> None:
    assert pair.hello()["global_cameras"] == {}


def test_sim_19_play_starts_paused(pair: Wire) -> None:
    assert [pair.ask("step")["time"] for _ in range(3)] == [0.0, 0.0, 0.0]


def test_sim_20_21_live_time_grows_at_most_in_real_time(pair: Wire) -> None:
    started = time.monotonic()
    assert pair.ask("set_paused", paused=False) == {"op": "set_paused_ok", "paused": False}
    for reply in pair.until("forward"):
        if reply["time"] > 0.1:
            break
    assert reply["time"] <= 1.05 * (time.monotonic() - started) + DT


def test_sim_22_half_speed(pair: Wire) -> None:
    assert pair.ask("set_sim_speed", percent=50)["percent"] == 50.0
    started = time.monotonic()
    pair.ask("set_paused", paused=False)
    for reply in pair.until("forward"):
        if reply["time"] > 0.1:
            break
    assert reply["time"] <= 0.55 * (time.monotonic() - started) + DT


@pytest.mark.parametrize(("asked", "given"), [(1, 5.0), (250, 100.0), (25, 25.0), ("33.3", float32(33.3))])
def test_sim_23_speed_is_clamped(shared_play: Wire, asked: object, given: float) -> None:
    assert shared_play.ask("set_sim_speed", percent=asked)["percent"] == given


@pytest.mark.parametrize(
    "fields", [{}, {"percent": None}, {"percent": "fast"}, {"percent": [1]}, {"percent": float("nan")}]
)
def test_sim_24_speed_is_required(shared_play: Wire, fields: dict[str, Any]) -> None:
    assert shared_play.refused("set_sim_speed", **fields) == "missing_field"


def test_sim_25_live_steps_do_not_count(serve: Serve) -> None:
    wire = serve("bot", play=True, unpaused=True)
    assert wire.ask("step", n_steps=100)["step"] == 0.0
    assert wire.ask("step")["step"] == 0.0


def test_sim_26_27_entering_direct(pair: Wire) -> None:
    assert pair.ask("set_mode", mode="direct") == {
        "op": "set_mode_ok",
        "previous_mode": "live",
        "current_mode": "direct",
    }
    assert pair.ask("step")["time"] == DT


def test_sim_28_time_stands_still_between_direct_steps(direct: Wire) -> None:
    direct.ask("step")
    assert {direct.ask("forward")["time"] for _ in range(10)} == {DT}


def test_sim_29_direct_steps_count(direct: Wire) -> None:
    reply = direct.ask("step", n_steps=10)
    assert reply["time"] == pytest.approx(10 * DT, abs=1e-9)
    assert reply["step"] == 10.0


def test_sim_30_at_least_one_step(direct: Wire) -> None:
    times = [
        direct.ask("step", **fields)["time"] for fields in ({"n_steps": 0}, {"n_steps": -3}, {}, {"n_steps": None})
    ]
    assert times == pytest.approx([DT, 2 * DT, 3 * DT, 4 * DT])


def test_sim_31_the_same_controls_give_the_same_motion(direct: Wire) -> None:
    runs = []
    for _ in range(2):
        direct.ask("reset")
        runs.append([bot(direct.ask("step", n_steps=3, **command([k / 7]))) for k in range(20)])
    assert runs[0] == runs[1]


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch, serve: Serve) -> Wire:
    """One robot in direct mode, with a server that gives up on a step soon."""
    monkeypatch.setattr("urlab_client.server.core.Engine", hasty_engine(0.05))
    wire = serve("bot", play=True)
    wire.ask("set_mode", mode="direct")
    return wire


def test_sim_32_33_a_step_while_paused_waits_for_its_turn(hasty: Wire) -> None:
    hasty.ask("set_paused", paused=True)
    assert hasty.refused("step", n_steps=7) == "step_timeout"
    assert hasty.ask("forward")["time"] == 0.0
    hasty.ask("set_paused", paused=False)
    for reply in hasty.until("forward"):
        if reply["time"] > 0.0:
            break
    assert reply["time"] == pytest.approx(7 * DT)
    assert reply["step"] == 7.0


QPOS = [0.1, 0.2, 0.9, 1.0, 0.0, 0.0, 0.0, 0.4]
QVEL = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]


def test_sim_34_to_36_puppet_state_comes_back(puppet: Wire) -> None:
    reply = puppet.ask("step", qpos=QPOS, qvel=QVEL, time=4.2, n_steps=10, observations="full")
    assert (reply["time"], reply["step"]) == (4.2, 1.0)
    assert (bot(reply)["qpos"], bot(reply)["qvel"]) == (QPOS, QVEL)
    assert bot(reply)["bodies"]["base"]["xpos"] == QPOS[:3]
    assert puppet.ask("step", n_steps=0)["step"] == 2.0


def test_sim_37_38_puppet_is_lenient(puppet: Wire) -> None:
    puppet.ask("step", qpos=QPOS, time=1)
    reply = puppet.ask("step", qpos=[1, 2, 3])
    assert bot(reply)["qpos"] == QPOS
    assert reply["time"] == 0.0


def test_sim_39_puppet_controls(puppet: Wire) -> None:
    assert bot(puppet.ask("step", ctrl=[0.25]))["ctrl"] == [0.25]
    assert bot(puppet.ask("step", **command([0.75])))["ctrl"] == [0.25]


def test_sim_40_41_names_of_modes(shared_play: Wire) -> None:
    assert shared_play.ask("set_mode", mode="Streaming")["current_mode"] == "live"
    assert shared_play.refused("set_mode", mode="foo") == "bad_mode"
    for fields in ({}, {"mode": None}, {"mode": ""}, {"mode": []}):
        assert shared_play.refused("set_mode", **fields) == "missing_field"
    reply = shared_play.ask("set_mode", mode="live")
    assert reply["previous_mode"] == reply["current_mode"] == "live"


def test_sim_42_43_a_new_session(direct: Wire) -> None:
    direct.ask("step", n_steps=3)
    old = direct.session_id
    direct.hello()
    assert direct.ask("forward")["step"] == 0.0
    assert direct.ask("set_mode", mode="direct")["previous_mode"] == "direct"
    assert direct.raw({"op": "forward", "session_id": old})["code"] == "session_expired"


def test_sim_44_back_to_live(direct: Wire) -> None:
    direct.ask("set_mode", mode="live")
    for reply in direct.until("forward"):
        if reply["time"] > 0.0:
            break


def test_sim_45_after_play(direct: Wire) -> None:
    direct.ask("step", n_steps=3)
    direct.ask("stop_pie")
    assert direct.refused("step") == "no_active_manager"
    play(direct)
    assert direct.ask("step")["step"] == 0.0
    assert direct.ask("set_mode", mode="live")["previous_mode"] == "live"


def test_sim_46_47_reset_and_its_reply(direct: Wire, tmp_path: Path) -> None:
    model = model_of(direct.hello(), tmp_path)
    stepped = direct.ask("step", n_steps=50, **command([0.5]))
    reset, forward = direct.ask("reset"), direct.ask("forward")
    assert (reset["time"], reset["step"]) == (0.0, 0.0)
    assert bot(reset)["qpos"] == model.qpos0.tolist()
    assert stepped["entities"] == {}
    for reply in (reset, forward):
        assert set(reply) == {"op", "time", "step", "sim_time", "wall_time", "per_articulation"}
    assert set(stepped) == {*reset, "entities"}


def test_sim_48_49_reset_to_a_keyframe(direct: Wire) -> None:
    reply = direct.ask("reset", keyframe_name="bot_home")
    assert reply["time"] == 1.5
    assert bot(reply)["qpos"] == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.5]
    assert bot(reply)["ctrl"] == pytest.approx([0.3])
    assert direct.refusal("reset", keyframe_name="home") == ("unknown_keyframe", "home")
    assert direct.ask("reset", keyframe_name="")["time"] == 0.0


def test_sim_50_reset_overrides_joints(direct: Wire, tmp_path: Path) -> None:
    model = model_of(direct.hello(), tmp_path)
    reply = direct.ask("reset", per_articulation_qpos={"bot": {"j": 0.25, "nope": 1}, "nobody": {"j": 1}})
    assert bot(reply)["qpos"] == [*model.qpos0[:-1].tolist(), 0.25]


def test_sim_51_reset_keeps_set_points(direct: Wire) -> None:
    direct.ask("step", **command([0.3]))
    assert bot(direct.ask("reset"))["ctrl"] == [0.0]
    assert bot(direct.ask("step"))["ctrl"] == [float32(0.3)]


def test_sim_52_53_clocks(direct: Wire) -> None:
    for _ in range(5):
        before = direct.ask("step", n_steps=7)
        asked = time.time()
        after = direct.ask("forward")
        answered = time.time()
        assert (after["time"], after["step"]) == (before["time"], before["step"])
        clock, wall = after["sim_time"], after["wall_time"]
        assert clock["sec"] + 1e-9 * clock["nsec"] == pytest.approx(after["time"], abs=2e-9)
        assert asked - 1e-6 < wall["sec"] + 1e-9 * wall["nsec"] < answered + 1e-6
        assert wall["nsec"] % 100 == 0.0


def test_sim_54_controls_are_single_precision(direct: Wire) -> None:
    assert bot(direct.ask("step", **command([0.7])))["ctrl"] == [0.699999988079071]


def test_sim_55_to_57_lenient_controls(direct: Wire) -> None:
    assert bot(direct.ask("step", **command([0.5, 9, 9])))["ctrl"] == [0.5]
    assert bot(direct.ask("step", per_articulation={"bot": {"ctrl_map": {"m": 0.25, "x": 1}}}))["ctrl"] == [0.25]
    assert bot(direct.ask("step", per_articulation={"bot": {"ctrl_map": {"bot_m": 0.75}}}))["ctrl"] == [0.75]
    assert bot(direct.ask("step", **command([0.1], ctrl_map={"m": 0.5})))["ctrl"] == [0.5]
    assert bot(direct.ask("step", per_articulation={"nobody": {"ctrl": [1]}, "BOT": {"ctrl": [1]}}))["ctrl"] == [1.0]


def test_sim_58_the_range_limits_the_force_not_the_echo(direct: Wire) -> None:
    reply = bot(direct.ask("step", observations="full", **command([5])))
    assert reply["ctrl"] == [5.0]
    assert reply["actuator_force"] == [1.0]


def test_sim_59_60_67_controllers_in_the_handshake(direct: Wire, pd: Wire) -> None:
    raw = direct.hello()["articulations"][0]
    assert raw["default_control_mode"] == "raw"
    assert "controller" not in raw
    entry = pd.hello()["articulations"][0]
    assert entry["default_control_mode"] == "ue_controller"
    assert entry["controller"]["kind"] == "pd"
    defaults = {"default_kp": 100.0, "default_kv": 5.0, "default_torque_limit": 200.0}
    assert (
        entry["controller"]["params"] == {"kp": {"m": 100.0}, "kv": {"m": 5.0}, "torque_limit": {"m": 200.0}} | defaults
    )
    per_joint, scalar = ({"type": kind, "dtype": "float32", "min": 0.0} for kind in ("per_joint", "scalar"))
    assert entry["controller"]["schema"] == {
        **dict.fromkeys(("kp", "kv", "torque_limit"), per_joint),
        **dict.fromkeys(defaults, scalar),
    }
    assert set(pd.ask("configure_controller", articulation="bot", params={})["params"]) == {
        "kp",
        "kv",
        "torque_limit",
        *defaults,
    }


def test_sim_61_62_pd_output(pd: Wire) -> None:
    assert bot(pd.ask("step", **command([0.1])))["ctrl"] == pytest.approx([10.0])
    pd.ask("reset")
    assert bot(pd.ask("step", **command([5])))["ctrl"] == [200.0]


def test_sim_63_pd_clamps_the_target_to_the_joint(serve: Serve) -> None:
    wire = serve("limited", play=True, controllers={"limited": ControllerConfig()})
    wire.ask("set_mode", mode="direct")
    assert bot(wire.ask("step", **command([5])))["ctrl"] == pytest.approx([20.0])


def test_sim_64_no_torque(pd: Wire) -> None:
    pd.ask("configure_controller", articulation="bot", params={"torque_limit": {"m": 0}})
    assert bot(pd.ask("step", **command([5])))["ctrl"] == [0.0]


def test_sim_65_66_configuring(pd: Wire) -> None:
    params = pd.ask("configure_controller", articulation="bot", params={"default_kp": 250})["params"]
    assert (params["default_kp"], params["kp"]) == (250.0, {"m": 100.0})
    params = pd.ask("configure_controller", articulation="BOT", params={"kp": {"m": 0.1, "x": 1}})["params"]
    assert params["kp"] == {"m": 0.10000000149011612}
    for ignored in (None, 3, [1]):
        assert pd.ask("configure_controller", articulation="bot", params=ignored)["params"] == params


def test_sim_68_configuring_what_is_not_there(direct: Wire) -> None:
    assert direct.refused("configure_controller", articulation="bot") == "missing_field"
    assert direct.refused("configure_controller", articulation=None, params={}) == "missing_field"
    assert direct.refusal("configure_controller", articulation="no", params={}) == ("unknown_articulation", "no")
    assert direct.refused("configure_controller", articulation="bot", params={}) == "no_controller"


def test_sim_69_raw_for_one_request(pd: Wire) -> None:
    pd.ask("step", **command([0.1]))
    assert bot(pd.ask("step", **command([0.1], control_mode="RAW")))["ctrl"] == [float32(0.1)]
    assert bot(pd.ask("step"))["ctrl"] != [float32(0.1)]


def test_sim_70_71_control_source(direct: Wire) -> None:
    direct.ask("step", **command([0.5]))
    assert direct.ask("set_control_source", source="UI") == {
        "op": "set_control_source_ok",
        "source": "ui",
        "scope": "global",
    }
    assert bot(direct.ask("step", **command([0.75])))["ctrl"] == [0.0]
    assert direct.ask("set_control_source", source="zmq", articulation="Bot") == {
        "op": "set_control_source_ok",
        "source": "zmq",
        "scope": "articulation",
        "articulation": "Bot",
    }
    assert bot(direct.ask("step"))["ctrl"] == [0.75]
    assert direct.refused("set_control_source", source="me") == "bad_value"
    assert direct.refused("set_control_source") == "missing_field"
    assert direct.refusal("set_control_source", source="ui", articulation="no") == ("unknown_articulation", "no")


@pytest.mark.parametrize(("sent", "paused"), [(True, True), (0, False), ("YES", True), ("no", False)])
def test_pausing_reads_loosely(direct: Wire, sent: object, paused: bool) -> None:
    assert direct.ask("set_paused", paused=sent) == {"op": "set_paused_ok", "paused": paused}


@pytest.mark.parametrize("sent", [None, [], {}])
def test_pausing_needs_a_flag(direct: Wire, sent: object) -> None:
    code, message = direct.refusal("set_paused", paused=sent)
    assert code == "missing_field"
    assert "set_paused" in message
    assert "'paused'" in message


@pytest.fixture
def ball(serve: Serve) -> Wire:
    """A free ball above a floor, key `ball`, in direct mode."""
    wire = serve("ball", play=True)
    wire.ask("set_mode", mode="direct")
    return wire


def height(reply: dict[str, Any]) -> float:
    return reply["per_articulation"]["ball"]["qpos"][2]


def test_sim_72_a_wrench_lasts_for_its_request(ball: Wire) -> None:
    lift = {"per_articulation": {"ball": {"xfrc_applied": {"ball": [0, 0, 9.81, 0, 0, 0]}}}}
    start = height(ball.ask("forward"))
    assert height(ball.ask("step", n_steps=50, **lift)) == pytest.approx(start, abs=1e-6)
    assert height(ball.ask("step", n_steps=50)) < start - 0.01


def test_sim_72_any_key_reaches_a_compiled_body_name(ball: Wire) -> None:
    lift = {"per_articulation": {"world": {"xfrc_applied": {"ball_ball": [0, 0, 9.81, 0, 0, 0]}}}}
    assert height(ball.ask("step", n_steps=50, **lift)) == pytest.approx(0.5, abs=1e-6)


def test_sim_73_wrenches_that_are_none(ball: Wire) -> None:
    wrenches = {"ball": [0, 0, 9.81], "nope": [0, 0, 9.81, 0, 0, 0]}
    assert height(ball.ask("step", n_steps=50, per_articulation={"ball": {"xfrc_applied": wrenches}})) < 0.5


def test_sim_74_live_takes_positions_only(pair: Wire) -> None:
    pair.ask("set_paused", paused=False)
    lift = {"ctrl_map": {"m": 1}, "xfrc_applied": {"base": [0, 0, 1e4, 0, 0, 0]}}
    for reply in pair.until("step", per_articulation={"bot": lift, "copy1_bot": {"ctrl": [0.5]}}):
        if reply["per_articulation"]["copy1_bot"]["ctrl"] == [0.5]:
            break
    assert bot(reply)["ctrl"] == [0.0]
    assert bot(reply)["qpos"][2] <= 1.0


@pytest.mark.parametrize("level", ["minimal", "standard", "full"])
def test_sim_75_79_80_levels(direct: Wire, level: str) -> None:
    keys = {"qpos", "qvel", "twist", "actions"}
    keys |= {"ctrl", "act", "sensors"} if level != "minimal" else set()
    keys |= {"bodies", "actuator_force"} if level == "full" else set()
    state = bot(direct.ask("step", observations=level.upper()))
    assert set(state) == keys
    assert state["twist"] == {"linear": [0.0, 0.0, 0.0], "angular": [0.0, 0.0, 0.0]}
    assert state["actions"] == 0.0
    if level == "full":
        assert set(state["bodies"]) == {"base", "arm"}
        assert len(state["bodies"]["arm"]["xquat"]) == 4


def test_sim_76_to_78_twist(direct: Wire) -> None:
    before = bot(direct.ask("forward"))["ctrl"]
    reply = direct.ask("set_twist", articulation="bot", linear=[0.5, 0.25, 9], angular=[9, 9, 1.5])
    assert reply == {
        "op": "set_twist_ok",
        "articulation": "bot",
        "linear": [0.5, 0.25, 0.0],
        "angular": [0.0, 0.0, 1.5],
    }
    state = bot(direct.ask("reset"))
    assert state["twist"] == {"linear": [0.5, 0.25, 0.0], "angular": [0.0, 0.0, 1.5]}
    assert state["ctrl"] == before
    assert direct.ask("set_twist", articulation="bot", linear=[5])["linear"] == [5.0, 0.0, 0.0]
    assert bot(direct.ask("forward"))["twist"] == {"linear": [5.0, 0.0, 0.0], "angular": [0.0, 0.0, 0.0]}
    assert direct.refused("set_twist") == "missing_field"
    assert direct.refusal("set_twist", articulation="no") == ("unknown_articulation", "no")


def test_sim_81_the_level_sticks(direct: Wire) -> None:
    direct.ask("step", observations="full")
    assert "bodies" in bot(direct.ask("step"))
    assert "bodies" in bot(direct.ask("step", observations="nonsense"))
    assert "bodies" in bot(direct.ask("reset"))
    direct.hello()
    assert "bodies" in bot(direct.ask("forward"))
    direct.hello(observations="nonsense")
    assert set(bot(direct.ask("forward"))) == {"qpos", "qvel", "ctrl", "act", "sensors", "twist", "actions"}
    direct.hello(observations="minimal")
    assert "ctrl" not in bot(direct.ask("forward"))


def test_sim_81_live_ignores_the_level(shared_play: Wire) -> None:
    assert "bodies" not in bot(shared_play.ask("step", observations="full"))


def test_sim_82_83_activations_and_sensors(direct: Wire) -> None:
    state = bot(direct.ask("step"))
    assert state["act"] == [0.0]
    assert state["sensors"] == {"s": [state["sensors"]["s"][0]]}


def test_sim_84_to_86_writing_positions(direct: Wire) -> None:
    direct.ask("step", n_steps=10)
    before = direct.ask("reset", per_articulation_qpos={"bot": {"j": 0.25}})
    base = [1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]
    reply = direct.ask("set_qpos", target="bot", qpos=base)
    assert reply == {
        "op": "set_qpos_ok",
        "target": "bot",
        "actor_name": "bot",
        "actor_id": "bot",
        "qpos": base,
        "free_base_shortcut": True,
    }
    after = direct.ask("forward")
    assert bot(after)["qpos"] == [*base, 0.25]
    assert (after["time"], bot(after)["qvel"]) == (before["time"], bot(before)["qvel"])
    full = direct.ask("set_qpos", target="BOT", target_by="Actor_Name", qpos=QPOS)
    assert (full["qpos"], full["free_base_shortcut"]) == (QPOS, False)
    code, message = direct.refusal("set_qpos", target="bot", qpos=[1, 2, 3])
    assert code == "dim_mismatch"
    assert "3" in message
    assert "8" in message
    assert direct.refusal("set_qpos", target="BOT", qpos=QPOS) == ("unknown_articulation", "BOT")
    assert direct.refused("set_qpos", qpos=QPOS) == "missing_field"
    assert direct.refused("set_qpos", target="", qpos=QPOS) == "missing_field"
    assert direct.refused("set_qpos", target="bot", qpos="1") == "missing_field"
    assert direct.refused("set_qpos", target="bot", qpos=[]) == "dim_mismatch"


def test_sim_84_a_single_free_joint_is_a_full_write(ball: Wire) -> None:
    reply = ball.ask("set_qpos", target="ball", qpos=[0, 0, 2, 1, 0, 0, 0])
    assert reply["free_base_shortcut"] is False


def test_sim_85_an_articulation_without_joints(serve: Serve) -> None:
    assert serve("hand", play=True).refused("set_qpos", target="hand", qpos=[1]) == "no_joints"


def test_sim_87_88_mocap(serve: Serve) -> None:
    wire = serve("bot", "hand", play=True)
    for op in ("set_mocap_pose", "read_mocap_pose"):
        assert wire.refusal(op, body="hand", pos=[0, 0, 0]) == ("unknown_body", "hand")
        assert wire.refused(op, body="bot_base", pos=[0, 0, 0]) == "not_mocap_body"
        assert wire.refused(op, body="") == "missing_field"
        assert wire.refused(op) == "missing_field"
    for nothing in ({}, {"pos": [1, 2]}, {"quat": [1, 2, 3]}, {"pos": None, "quat": None}):
        assert wire.refused("set_mocap_pose", body="hand_hand", **nothing) == "missing_field"
    reply = wire.ask("set_mocap_pose", body="hand_hand", pos=[1, 2, 3], quat=[0, 1, 0, 0])
    assert reply == {
        "op": "set_mocap_pose_ok",
        "body": "hand_hand",
        "pos": [1.0, 2.0, 3.0],
        "quat": [0.0, 1.0, 0.0, 0.0],
    }
    wire.ask("set_mocap_pose", body="hand_hand", pos=[4, 5, 6])
    assert wire.ask("read_mocap_pose", body="hand_hand") == {
        "op": "read_mocap_pose_ok",
        "body": "hand_hand",
        "pos": [4.0, 5.0, 6.0],
        "quat": [0.0, 1.0, 0.0, 0.0],
    }


def test_sim_88_bodies_follow_a_mocap_pose_at_forward(serve: Serve) -> None:
    wire = serve("hand", play=True)
    wire.ask("set_mode", mode="direct")
    wire.ask("step", observations="full")
    wire.ask("set_mocap_pose", body="hand_hand", pos=[1, 2, 3])
    assert wire.ask("forward")["per_articulation"]["hand"]["bodies"]["hand"]["xpos"] == [1.0, 2.0, 3.0]


def test_sim_89_90_contacts_of_a_resting_ball(serve: Serve) -> None:
    wire = serve("resting", play=True)
    wire.ask("set_mode", mode="direct")
    wire.ask("step", n_steps=500)
    reply = wire.ask("get_contacts")
    assert (reply["n_contacts"], reply["truncated"]) == (1.0, False)
    (contact,) = reply["contacts"]
    assert (contact["geom1"], contact["geom2"]) == ("ball_floor", "ball_ball")
    assert (contact["body1"], contact["body2"]) == ("world", "ball_ball")
    assert contact["normal"] == pytest.approx([0, 0, 1], abs=1e-6)
    assert contact["force"][0] == pytest.approx(9.81, abs=0.01)
    assert len(contact["force"]) == 6
    assert contact["dist"] <= 0
    assert wire.ask("get_contacts", filter={"body1": "ball_ball"})["contacts"] == []
    for names in ({"body2": "ball_ball"}, {"geom1": "ball_floor", "body2": ""}, {}, None):
        assert wire.ask("get_contacts", filter=names)["n_contacts"] == 1.0


def test_sim_91_a_cap_on_contacts(serve: Serve) -> None:
    wire = serve("resting", "resting", play=True)
    assert wire.ask("get_contacts", max_contacts=0)["n_contacts"] == 4.0  # each ball on each of the two floors
    reply = wire.ask("get_contacts", max_contacts=1)
    assert (reply["n_contacts"], reply["truncated"], len(reply["contacts"])) == (1.0, True, 1)
    assert wire.ask("get_contacts", max_contacts=4)["truncated"] is False


def test_sim_91_the_cap_is_64_unless_told(serve: Serve) -> None:
    wire = serve(*["resting"] * 9, play=True)
    reply = wire.ask("get_contacts")
    assert (reply["n_contacts"], reply["truncated"]) == (64.0, True)
    assert wire.ask("get_contacts", max_contacts=81)["n_contacts"] == 81.0, "each of nine balls on each of nine floors"


def test_sim_107_cameras(shared_play: Wire) -> None:
    (entry,) = shared_play.hello()["articulations"]
    camera = entry["camera_topics"]["cam"]
    assert (camera["mode"], camera["resolution"], camera["fovy"]) == ("real", [640.0, 480.0], 45.0)
    assert camera["zmq_topic"] == "bot/camera/cam"


def test_sim_109_unknown_cameras_are_left_out(direct: Wire) -> None:
    assert "cameras" not in direct.ask("step", include_cameras={"nope": "sync", "cam": None})


def test_entities_are_converted_meshes(room: Wire) -> None:
    """The documented meaning; the plugin never fills the block."""
    room.ask("add_quick_convert", target="crate")
    payload = play(room)["handshake_payload"]
    assert payload["entities"] == {
        "Crate_0_MjBody": {
            "id": 1.0,
            "has_free_base": True,
            "free_joint": "Crate_0FreeJoint",
            "free_joint_id": 0.0,
            "qpos_offset": 0.0,
            "qvel_offset": 0.0,
        }
    }
    state = room.ask("step")["entities"]["Crate_0_MjBody"]
    assert state["xpos"] == [0.0, 0.0, 2.0]
    assert state["qpos"] == [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]
    assert state["qvel"] == [0.0] * 6


def test_physics_is_bitwise_that_of_mujoco(serve: Serve, tmp_path: Path) -> None:
    wire = serve(play=False, model_roots=[HUMANOID.parent])
    wire.ask("import_xml", path=str(HUMANOID))
    key = wire.ask("spawn_actor", blueprint="/Game/MuJoCoImports/humanoid", actor_id="h")["actor_name"]
    model = model_of(play(wire)["handshake_payload"], tmp_path)
    data = mujoco.MjData(model)
    wire.ask("set_mode", mode="direct")
    assert bot_state(wire.ask("reset"), key) == (data.qpos.tolist(), data.qvel.tolist())
    mujoco.mj_forward(model, data)
    controls = np.random.default_rng(7).uniform(-0.4, 0.4, (300, model.nu))
    for k, ctrl in enumerate(controls):
        reply = wire.ask("step", per_articulation={key: {"ctrl": ctrl.tolist()}})
        data.ctrl[:] = ctrl.astype(np.float32)
        mujoco.mj_step(model, data)
        assert bot_state(reply, key) == (data.qpos.tolist(), data.qvel.tolist()), f"step {k}"
        assert reply["time"] == data.time


def bot_state(reply: dict[str, Any], key: str) -> tuple[list[float], list[float]]:
    state = reply["per_articulation"][key]
    return state["qpos"], state["qvel"]
