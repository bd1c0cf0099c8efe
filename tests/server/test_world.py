from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from worlds import BALL_BODY, BOT, Workspace, mjcf, write_obj

from urlab_client.server.assets.actors import ConversionSettings
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.compile.scene import compile_scene
from urlab_client.server.editor.world import Actor, ActorKind, ActorNames, EditorWorld
from urlab_client.server.handlers.scene import _row as snapshot_row
from urlab_client.server.refusal import Refusal

BALL = mjcf(BALL_BODY, model="ball")
HALF = math.sqrt(0.5)


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


@pytest.fixture
def world(workspace: Workspace) -> EditorWorld:
    workspace.world.levels.create("lab")
    return workspace.world


@pytest.fixture
def bot(workspace: Workspace, world: EditorWorld) -> str:
    """Class path of the bot."""
    return workspace.blueprint("bot", BOT)


@pytest.fixture
def ball(workspace: Workspace, world: EditorWorld) -> str:
    """Class path of the ball."""
    return workspace.blueprint("ball", BALL)


def refusal(call: Callable[..., object], *args: Any, **kwargs: Any) -> Refusal:
    with pytest.raises(Refusal) as refused:
        call(*args, **kwargs)
    assert "\n" not in refused.value.message
    return refused.value


def names(rows: list[Actor]) -> list[str]:
    return [row.name for row in rows]


def row(world: EditorWorld, key: str) -> Actor:
    return next(row for row in list(world.actors) if key in (row.name, row.actor_id))


def same_rotation(a: Any, b: Any) -> bool:
    return abs(abs(sum(p * q for p, q in zip(a, b, strict=True))) - 1.0) < 1e-9


# Blueprints


def test_blueprints_are_listed_by_name(bot: str, ball: str, world: EditorWorld) -> None:
    rows = world.blueprints.list_blueprints()

    assert [item.short_name for item in rows] == ["ball", "bot"]
    assert [item.class_path for item in rows] == [ball, bot]
    assert rows[0].package_path == "/Game/MuJoCoImports/ball"
    assert rows[0].parent_class == "MjArticulation"


@pytest.mark.parametrize(
    "path", ["/Game/MuJoCoImports/bot", "/Game/MuJoCoImports/bot.bot_C", "/game/mujocoimports/BOT.bot_c"]
)
def test_a_blueprint_is_named_by_package_or_class_path(bot: str, world: EditorWorld, path: str) -> None:
    assert world.spawn_actor(path, "a").actor.class_path == bot


@pytest.mark.parametrize("path", ["bot", "/Game/MuJoCoImports/bot.bot", "/Game/MuJoCoImports/robot", "/Script/Pawn_C"])
def test_other_paths_name_no_blueprint(bot: str, world: EditorWorld, path: str) -> None:
    refused = refusal(world.spawn_actor, path, "a")

    assert refused.code == "spawn_failed"
    assert "/Game/MuJoCoImports/bot" in refused.message


def test_actors_take_the_new_model_of_a_reimport_at_the_next_play(
    workspace: Workspace, bot: str, world: EditorWorld
) -> None:
    world.spawn_actor(bot, "a")
    before = world.freeze()
    workspace.write("bot.xml", BOT.replace('mass="1"', 'mass="3"'))

    world.blueprints.import_xml("bot.xml", force_reimport=True)

    def mass(actors: tuple[Any, ...]) -> float:
        return float(compile_scene(actors).model.body_mass.sum())

    assert mass(world.freeze()) == pytest.approx(3.5)
    assert mass(before) == pytest.approx(1.5)


def test_a_blueprint_in_use_is_not_destroyed(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")

    refused = refusal(world.blueprints.destroy_asset, "/Game/MuJoCoImports/bot.bot")

    assert refused.code == "destroy_asset_failed"
    assert "bot" in refused.message
    world.destroy_actor("a")
    assert world.blueprints.destroy_asset("/Game/MuJoCoImports/bot.bot")
    assert not world.blueprints.destroy_asset("/Game/MuJoCoImports/bot.bot")
    assert world.blueprints.list_blueprints() == []


@pytest.mark.parametrize(
    "path",
    ["/Game/MuJoCoImports/bot.bot_C", "/Game/MuJoCoImports/bot.ball", "/Game/Levels/none.none", "/Game/../x.x", "bot"],
)
def test_what_is_no_asset_is_not_found(bot: str, world: EditorWorld, path: str) -> None:
    assert world.blueprints.destroy_asset(path) is False


# Levels


def test_a_level_without_a_name_cannot_be_saved(workspace: Workspace) -> None:
    assert workspace.world.levels.package == "/Temp/Untitled_1"

    refused = refusal(workspace.world.levels.save)

    assert refused.code == "save_level_failed"
    assert "create_level" in refused.message


def test_a_level_is_created_once_unless_forced(workspace: Workspace, bot: str) -> None:
    world = workspace.world
    world.spawn_actor(bot, "a")

    assert refusal(world.levels.create, "lab").code == "create_level_failed"
    assert len(list(world.actors)) == 1
    assert world.levels.create("lab", force_overwrite=True) == "/Game/Levels/lab"
    assert list(world.actors) == []
    assert refusal(world.levels.create, "").code == "missing_field"
    assert refusal(world.levels.create, "../lab").code == "create_level_failed"


def test_levels_keep_what_was_saved(workspace: Workspace, bot: str, ball: str, world: EditorWorld) -> None:
    world.ensure_manager()
    world.spawn_actor(bot, "a", location=(1, 2, 3), rotation_euler=(0, 0, 90))
    world.spawn_actor(ball)
    world.spawn_light("spot", "lamp", location=(0, 0, 4), rotation_euler=(0, -90, 0), intensity=123.456)
    before = list(world.actors)
    world.levels.save()
    world.spawn_actor(ball, "unsaved")
    world.levels.create("other")
    assert list(world.actors) == []

    assert world.levels.load("lab") == world.levels.package == "/Game/Levels/lab"

    assert list(world.actors) == before
    assert EditorWorld(ContentRoot(workspace.saved)).levels.load("/Game/Levels/lab")


@pytest.mark.parametrize("name", ["nowhere", "/Engine/lab", "../lab"])
def test_a_level_that_is_not_there_is_not_loaded(bot: str, world: EditorWorld, name: str) -> None:
    world.spawn_actor(bot, "a")

    assert refusal(world.levels.load, name).code == "load_level_failed"
    assert names(list(world.actors)) == ["bot"]


def test_destroying_the_open_level_opens_an_untitled_one(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")
    world.levels.save()

    assert world.blueprints.destroy_asset("/Game/Levels/lab.lab")

    assert world.levels.package == "/Temp/Untitled_1"
    assert list(world.actors) == []
    assert refusal(world.levels.load, "lab").code == "load_level_failed"


@pytest.mark.parametrize(
    ("op", "code"),
    [
        (lambda world: world.levels.create("new"), "create_level_failed"),
        (lambda world: world.levels.load("lab"), "load_level_failed"),
        (lambda world: world.levels.save(), "save_level_failed"),
    ],
)
def test_levels_are_not_touched_during_play(world: EditorWorld, op: Callable[[EditorWorld], str], code: str) -> None:
    world.pie_running = True

    assert refusal(op, world).code == code


def test_a_save_that_fails_leaves_the_level_as_it_was(
    workspace: Workspace, bot: str, world: EditorWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.levels.save()
    world.spawn_actor(bot, "a")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        refused = refusal(world.levels.save)

    assert refused.code == "save_level_failed"
    assert "No space" in refused.message
    world.levels.load("lab")
    assert list(world.actors) == []


def test_a_content_root_can_be_moved(workspace: Workspace, bot: str, world: EditorWorld, tmp_path: Path) -> None:
    world.spawn_actor(bot, "a")
    world.levels.save()
    shutil.rmtree(workspace.models)
    moved = workspace.saved.rename(tmp_path / "elsewhere")

    fresh = EditorWorld(ContentRoot(moved))
    fresh.levels.load("lab")

    assert compile_scene(fresh.freeze()).model.nu == 1


def test_a_level_file_with_its_models_can_be_moved(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "here")
    bot = workspace.blueprint("bot", BOT)
    workspace.world.levels.create("lab")
    workspace.world.spawn_actor(bot, "a")
    workspace.world.levels.save()
    shutil.rmtree(workspace.saved / "MuJoCoImports")
    (tmp_path / "here").rename(tmp_path / "there")

    fresh = EditorWorld(ContentRoot(tmp_path / "fresh"))
    fresh.levels.load_file(tmp_path / "there" / "saved" / "Levels" / "lab.json")

    assert names(list(fresh.actors)) == ["bot"]
    assert compile_scene(fresh.freeze()).model.nu == 1


def test_a_level_file_brings_its_snapshot_along(
    workspace: Workspace, bot: str, world: EditorWorld, tmp_path: Path
) -> None:
    world.spawn_actor(bot, "a")
    world.levels.save()
    shutil.rmtree(workspace.models)

    fresh = EditorWorld(ContentRoot(tmp_path / "fresh"))
    fresh.levels.load_file(workspace.saved / "Levels" / "lab.json")
    shutil.rmtree(workspace.saved)

    assert compile_scene(fresh.freeze()).model.nu == 1
    assert [item.short_name for item in fresh.blueprints.list_blueprints()] == ["bot"]


def test_a_level_file_is_saved_where_it_was_opened(
    workspace: Workspace, bot: str, world: EditorWorld, tmp_path: Path
) -> None:
    world.spawn_actor(bot, "a")
    world.levels.save()
    file = tmp_path / "elsewhere" / "my level.json"
    file.parent.mkdir()
    text = (
        (workspace.saved / "Levels" / "lab.json").read_text().replace("../", "../saved/").replace("../saved/../", "../")
    )
    file.write_text(text.replace("../models", "../models").replace("../saved/models", "../models"))
    fresh = EditorWorld(ContentRoot(tmp_path / "fresh"))

    assert fresh.levels.load_file(file) == "/Game/Levels/my_level"
    fresh.set_actor_transform("a", location=(7, 0, 0))
    fresh.levels.save()
    fresh.set_actor_transform("a", location=(8, 0, 0))
    fresh.levels.load("my_level")

    assert row(fresh, "a").location == (7, 0, 0)
    assert json.loads(file.read_text())["actors"][0]["location"] == [7.0, 0.0, 0.0]
    assert not (tmp_path / "fresh" / "Levels").exists()
    assert refusal(fresh.levels.create, "my_level", force_overwrite=True).code == "create_level_failed"
    assert refusal(fresh.blueprints.destroy_asset, "/Game/Levels/my_level.my_level").code == "destroy_asset_failed"
    assert file.exists()


def test_the_levels_own_model_wins_when_the_level_was_named_by_the_user(
    bot: str, world: EditorWorld, workspace: Workspace, tmp_path: Path
) -> None:
    world.spawn_actor(bot, "a")
    world.levels.save()
    other = Workspace(tmp_path / "other")
    other.blueprint("bot", BALL.replace('model="ball"', 'model="impostor"'))

    other.world.levels.load_file(workspace.saved / "Levels" / "lab.json")

    assert compile_scene(other.world.freeze()).model.nu == 1


def test_bundled_models_in_a_level_are_found_on_any_machine(
    workspace: Workspace, world: EditorWorld, tmp_path: Path
) -> None:
    world.blueprints.import_xml("ball")
    world.spawn_actor("/Game/MuJoCoImports/ball", "b")
    world.levels.save()
    level = tmp_path / "level.json"
    text = (workspace.saved / "Levels" / "lab.json").read_text()
    level.write_text(text)
    shutil.rmtree(workspace.saved)

    fresh = EditorWorld(ContentRoot(tmp_path / "fresh"))
    fresh.levels.load_file(level)

    assert '"bundled:ball"' in text
    assert names(list(fresh.actors)) == ["ball"]


HEAD = {"format": "urlab-level", "version": 1, "blueprints": {}}
BOX = {"name": "crate", "kind": "static_mesh", "mesh": {"shape": "box", "size": [0.1, 0.1, 0.1]}}


def load(workspace: Workspace, level: object) -> EditorWorld:
    file = workspace.saved / "Levels" / "hand.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(level if isinstance(level, str) else json.dumps(level))
    workspace.world.levels.load("hand")
    return workspace.world


@pytest.mark.parametrize(
    ("level", "text"),
    [
        ("{", "is not a level"),
        ("[]", "is not a level"),
        ('{"x": ' + "[" * 100_000, "is not a level"),
        ('{"format": "other"}', 'it lacks "format": "urlab-level"'),
        (HEAD | {"version": 2, "actors": []}, "version 2"),
        (HEAD, "actors"),
        (HEAD | {"actors": [BOX | {"colour": "red"}]}, "colour"),
        (HEAD | {"actors": [BOX | {"location": [0, 0]}]}, "$.actors[0].location"),
        (HEAD | {"actors": [BOX, BOX]}, "two actors are called 'crate'"),
        (HEAD | {"actors": [BOX | {"name": "a crate"}]}, "letters, digits and underscores"),
        (HEAD | {"actors": [BOX | {"rotation_quat": [0, 0, 0, 0]}]}, "not a rotation"),
        (HEAD | {"actors": [BOX | {"scale": [1, 0, 1]}]}, "scale"),
        (HEAD | {"actors": [BOX | {"parent": "nobody"}]}, "attached to 'nobody'"),
        (HEAD | {"actors": [BOX | {"parent": "crate"}]}, "attached to itself"),
        (HEAD | {"actors": [{"name": "r", "kind": "articulation", "blueprint": "robot"}]}, "'robot' is not imported"),
        (HEAD | {"actors": [{"name": "r", "kind": "articulation"}]}, "needs a 'blueprint'"),
        (HEAD | {"actors": [BOX | {"kind": "light"}]}, "needs a 'light'"),
        (HEAD | {"actors": [BOX | {"mesh": {"shape": "box", "size": [1]}}]}, "3 positive numbers"),
        (HEAD | {"actors": [BOX | {"mesh": {"shape": "sphere", "size": [-1]}}]}, "positive"),
        (HEAD | {"actors": [BOX | {"mesh": {"shape": "file"}}]}, "'file'"),
        (HEAD | {"actors": [BOX | {"mesh": {"shape": "plane", "size": [1, 1]}, "quick_convert": {}}]}, "static"),
        (HEAD | {"actors": [{"name": "m", "kind": "manager", "quick_convert": {}}]}, "only a static mesh"),
        (HEAD | {"actors": [{"name": "m", "kind": "manager", "controller": "pd"}]}, "only an articulation can have a"),
        (
            HEAD | {"actors": [BOX | {"mesh": {"shape": "file", "file": "/etc/hostname"}}]},
            "mesh /etc/hostname lies outside the folders that clients may read",
        ),
        (
            HEAD
            | {
                "blueprints": {"robot": {"source": "robot.xml", "record": "/etc/hostname"}},
                "actors": [{"name": "r", "kind": "articulation", "blueprint": "robot"}],
            },
            "blueprint 'robot': /etc/hostname lies outside the folders that clients may read",
        ),
    ],
)
def test_a_level_that_makes_no_sense_is_refused_with_the_place(workspace: Workspace, level: object, text: str) -> None:
    workspace.world.levels.create("lab")

    refused = refusal(load, workspace, level)

    assert refused.code == "load_level_failed"
    assert text in refused.message
    assert workspace.world.levels.package == "/Game/Levels/lab"


def stands(blueprint: str, source: str, **more: Any) -> dict[str, Any]:
    """A level with one robot, and where it comes from."""
    robot = {"name": "r", "kind": "articulation", "blueprint": blueprint}
    return HEAD | {"blueprints": {blueprint: {"source": source, **more}}, "actors": [robot]}


def test_the_model_of_a_level_must_be_the_one_it_names(
    workspace: Workspace, world: EditorWorld, caplog: pytest.LogCaptureFixture
) -> None:
    file = workspace.saved / "Levels" / "hand.json"
    (file.parent / "bot.xml").write_text(BOT)
    for level, said in (
        (stands("robot", "bot.xml"), "blueprint 'robot' comes from bot.xml, which makes one called 'bot'"),
        (stands("robot", "missing.xml"), "missing.xml"),
    ):
        file.write_text(json.dumps(level))
        assert said in refusal(world.levels.load_file, file).message
        assert "lies outside the folders" in refusal(world.levels.load, "hand").message  # which a client names
    file.write_text(json.dumps(stands("bot", "bot.xml", digest="of another day")))
    world.levels.load_file(file)
    assert "bot.xml has changed since the level was saved; the new model is used" in caplog.text


def test_a_model_that_is_imported_stands_in_for_one_that_is_gone(
    workspace: Workspace, bot: str, caplog: pytest.LogCaptureFixture
) -> None:
    file = workspace.saved / "Levels" / "hand.json"
    file.write_text(json.dumps(stands("bot", "missing.xml", digest="of another day", record="gone.json")))
    workspace.world.levels.load_file(file)
    assert names(list(workspace.world.actors)) == ["r"]
    assert "the imported 'bot' differs from the level's, which cannot be read" in caplog.text


def test_a_level_brings_meshes_which_no_op_can(workspace: Workspace) -> None:
    write_obj(workspace.saved / "Levels" / "meshes" / "rock.obj", 0.5)
    rock = {
        "name": "rock",
        "kind": "static_mesh",
        "actor_id": "rock-1",
        "mesh": {"shape": "file", "file": "meshes/rock.obj"},
        "parent": "crate",
    }
    world = load(workspace, HEAD | {"actors": [BOX | {"location": [1, 2, 3], "scale": [1, 2, 3]}, rock]})

    rows = list(world.actors)
    assert [item.class_name for item in rows] == ["StaticMeshActor", "StaticMeshActor"]
    assert {item.kind for item in rows} == {ActorKind.STATIC_MESH}
    assert rows[1].tags == ("URLab.ActorId=rock-1",)
    box = world.get_actor_bounds("crate", components_only=True)
    assert box.center == pytest.approx((1, 2, 3))
    assert box.extents == pytest.approx((0.1, 0.2, 0.3))
    rock_box = world.get_actor_bounds("rock-1")  # along the mesh's principal axes, so somewhat large
    assert all(
        -0.5 < low <= 0.001 and 0.499 <= high < 1.0 for low, high in zip(rock_box.min, rock_box.max, strict=True)
    )
    tree = world.actor_hierarchy("crate")
    assert [child.name for child in tree.children] == ["rock"]

    world.levels.save()
    saved = json.loads((workspace.saved / "Levels" / "hand.json").read_text())
    assert saved["actors"][1]["mesh"]["file"] == "meshes/rock.obj"


identifiers = st.text("abcXYZ_09ü", min_size=1, max_size=8)
numbers = st.floats(-1e6, 1e6)
positions = st.tuples(numbers, numbers, numbers)


@given(
    st.lists(st.tuples(identifiers, positions, st.tuples(*[st.floats(-360, 360)] * 3)), max_size=5),
    st.lists(st.tuples(st.sampled_from(["directional", "POINT", "Spot"]), st.text(max_size=8), positions), max_size=3),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_any_level_comes_back_as_it_was(
    workspace: Workspace, robots: list[tuple[str, Any, Any]], lights: list[tuple[str, str, Any]]
) -> None:
    world = workspace.world
    world.levels.create("any", force_overwrite=True)
    bot = workspace.blueprint("bot", BOT)
    for actor_id, location, euler in robots:
        world.spawn_actor(bot, f"bot_{actor_id}", location=location, rotation_euler=euler)
    for kind, actor_id, location in lights:
        world.spawn_light(kind, actor_id, location=location)
    before = [snapshot_row(actor, compiled=False) for actor in world.snapshot()]
    world.levels.save()

    fresh = EditorWorld(ContentRoot(workspace.saved))
    fresh.levels.load("any")

    assert [snapshot_row(actor, compiled=False) for actor in fresh.snapshot()] == before


# Spawning


def test_the_model_name_names_actors(workspace: Workspace, bot: str, world: EditorWorld) -> None:
    nameless = workspace.blueprint("my-file", mjcf(BALL_BODY))
    spaced = workspace.blueprint("spaced", mjcf(BALL_BODY, model="my robot!"))

    placed = [world.spawn_actor(path).actor.name for path in (bot, bot, nameless, spaced, bot)]

    assert placed == ["bot", "copy1_bot", "my_file", "my_robot_", "copy2_bot"]
    world.destroy_actor("copy1_bot")
    assert world.spawn_actor(bot).actor.name == "copy1_bot"


def test_actors_can_be_named_as_the_plugin_does(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path, actor_names="plugin")
    bot = workspace.blueprint("robot", BOT)

    assert [workspace.world.spawn_actor(bot).actor.name for _ in range(3)] == ["robot_C_0", "robot_C_1", "robot_C_2"]
    assert workspace.world.duplicate_actor("robot_C_0", "d").actor.name == "robot_C_3"


def test_names_whose_compiled_names_would_repeat_are_passed_over(workspace: Workspace, world: EditorWorld) -> None:
    tricky = workspace.blueprint(
        "tricky", mjcf('<body name="base"><geom size="0.1"/><body name="1_base"><geom size="0.1"/></body></body>')
    )

    alike = workspace.blueprint("alike", mjcf(BALL_BODY.replace("ball", "base"), model="tricky_1"))

    placed = [world.spawn_actor(blueprint).actor.name for blueprint in (tricky, alike)]

    assert placed == ["tricky", "copy1_tricky_1"]  # tricky_1 + base would be tricky + 1_base
    assert compile_scene(world.freeze()).model.nbody == 4


@pytest.mark.parametrize("naming", ["model", "plugin"])
def test_no_copy_has_a_name_that_begins_with_that_of_another_robot(tmp_path: Path, naming: ActorNames) -> None:
    workspace = Workspace(tmp_path, actor_names=naming)
    world = workspace.world
    robot, copy = (workspace.blueprint(name, mjcf(BALL_BODY, model=name)) for name in ("robot", "copy2"))
    world.spawn_actor(robot, "copy1_rob")
    world.spawn_actor(copy, world.actors.unused_id("robot"))
    for blueprint in (robot, copy, robot, copy):
        world.spawn_actor(blueprint, world.actors.unused_id("robot"))

    names = [actor.name for actor in list(world.actors)]
    ids = [actor.actor_id for actor in list(world.actors)]
    for known in (names, ids):
        assert len(set(known)) == 6
        assert [(a, b) for a in known for b in known if a != b and a.startswith(b)] == []


def test_an_id_is_placed_once_and_moved_from_then_on(bot: str, world: EditorWorld) -> None:
    first = world.spawn_actor(bot, "a", location=(1, 2, 3), rotation_euler=(0, 0, 90))
    second = world.spawn_actor(bot, "a", location=(4, 5, 6))

    assert (first.was_existing, second.was_existing) == (False, True)
    assert second.actor.name == first.actor.name
    assert second.actor.location == (4, 5, 6)
    assert [(item.actor_id, item.location) for item in list(world.actors)] == [("a", (4, 5, 6))]
    assert row(world, "a").rotation == (0, 0, 0, 1)
    assert world.actor_path(first.actor) == "/Game/Levels/lab.lab:PersistentLevel.bot"


def test_an_id_of_another_class_is_refused(bot: str, ball: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")
    world.spawn_light("point", "lamp")

    assert refusal(world.spawn_actor, ball, "a").code == "spawn_failed"
    assert refusal(world.spawn_actor, bot, "LAMP").code == "spawn_failed"  # tags know no letter case
    assert not world.spawn_actor(bot, "A").was_existing  # ids of articulations do
    assert not world.spawn_actor(ball, "bot").was_existing  # an object name is not an id


def test_rotations_are_understood_in_mujocos_frame(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "quat", rotation_quat=(0, 0, 2, 2))
    world.spawn_actor(bot, "euler", rotation_euler=(0, 0, 90))
    rolled = world.spawn_actor(bot, "rolled", rotation_euler=(90, 0, 0))
    both = world.spawn_actor(bot, "both", rotation_quat=(0, 0, 0, 1), rotation_euler=(90, 0, 0))

    assert same_rotation(row(world, "quat").rotation, row(world, "euler").rotation)
    assert same_rotation(row(world, "rolled").rotation, (-HALF, 0, 0, HALF))
    assert same_rotation(rolled.rotation_quat, (-HALF, 0, 0, HALF))
    assert both.rotation_quat == row(world, "both").rotation == (0, 0, 0, 1)


@pytest.mark.parametrize(
    ("pose", "text"),
    [
        ({"scale": (2.0, 2.0, 2.0)}, "scale"),
        ({"rotation_quat": (0.0, 0.0, 0.0, 0.0)}, "rotation"),
        ({"rotation_quat": (math.nan, 0.0, 0.0, 1.0)}, "rotation"),
        ({"rotation_euler": (math.inf, 0.0, 0.0)}, "rotation_euler"),
        ({"location": (math.nan, 0.0, 0.0)}, "location"),
    ],
)
def test_a_pose_that_is_none_is_refused(bot: str, world: EditorWorld, pose: dict[str, Any], text: str) -> None:
    refused = refusal(world.spawn_actor, bot, "a", **pose)

    assert refused.code == "spawn_failed"
    assert text in refused.message
    assert list(world.actors) == []


def test_what_is_missing_is_named(bot: str, world: EditorWorld) -> None:
    assert refusal(world.spawn_actor, "").code == "missing_field"
    assert refusal(world.spawn_grid, bot, "", 1, 1).code == "missing_field"
    for op in (world.destroy_actor, world.set_actor_transform, world.get_actor_bounds, world.select_actor):
        assert refusal(op, "").code == "missing_field"
    assert refusal(world.duplicate_actor, "", "b").code == "missing_field"
    assert refusal(world.actor_hierarchy, "").code == "missing_field"
    assert refusal(world.blueprints.destroy_asset, "").code == "missing_field"
    assert refusal(world.levels.load, "").code == "missing_field"


def test_a_grid_is_placed_x_first(ball: str, world: EditorWorld) -> None:
    placed = world.spawn_grid(ball, "g", 2, 3, spacing=(1, 2, 9), origin=(10, 20, 30))

    assert [cell.actor.actor_id for cell in placed] == ["g_0_0", "g_1_0", "g_0_1", "g_1_1", "g_0_2", "g_1_2"]
    assert placed[3].actor.location == (11, 22, 30)
    assert names(list(world.actors)) == ["ball", "copy1_ball", "copy2_ball", "copy3_ball", "copy4_ball", "copy5_ball"]
    again = world.spawn_grid(ball, "g", 3, 1)
    assert [cell.was_existing for cell in again] == [True, True, False]
    assert len(list(world.actors)) == 7


def test_a_grid_that_cannot_be_placed_whole_is_not_placed(bot: str, ball: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "g_1_1")

    assert refusal(world.spawn_grid, ball, "g", 2, 2).code == "spawn_failed"
    assert refusal(world.spawn_grid, ball, "g", 2, 2, spacing=(math.inf, 1, 0)).code == "spawn_failed"
    assert names(list(world.actors)) == ["bot"]


@pytest.mark.parametrize(
    ("counts", "code"),
    [
        ((0, 1), "invalid_count"),
        ((1, -1), "invalid_count"),
        ((33, 32), "too_many_cells"),
        ((2**40, 2**40), "too_many_cells"),
    ],
)
def test_a_grid_has_limits(ball: str, world: EditorWorld, counts: tuple[int, int], code: str) -> None:
    assert refusal(world.spawn_grid, ball, "g", *counts).code == code


def test_lights_are_added_each_time(world: EditorWorld) -> None:
    first = world.spawn_light("SPOT", "lamp", location=(1, 2, 3), rotation_euler=(1, -30, 45), color=(0.1, 0.2, 0.3))
    second = world.spawn_light("spot", "lamp")

    assert (first.name, second.name) == ("SpotLight_0", "SpotLight_1")
    assert first.light is not None
    assert first.light.kind == "spot"
    assert first.light.color == pytest.approx((0.1, 0.2, 0.3))
    assert first.light.color[0] == 0.10000000149011612  # single precision, as the plugin echoes it
    listed = list(world.actors)
    assert [item.label for item in listed] == ["SpotLight", "SpotLight2"]
    assert all(item.kind is ActorKind.LIGHT and item.tags == ("URLab.ActorId=lamp",) for item in listed)
    assert refusal(world.spawn_light, "sun").code == "spawn_failed"
    assert refusal(world.spawn_light, "point", intensity=math.nan).code == "spawn_failed"


def test_there_is_one_manager(world: EditorWorld) -> None:
    assert not world.has_manager
    first, existed = world.ensure_manager()
    second, existed_again = world.ensure_manager()

    assert (existed, existed_again) == (False, True)
    assert first.name == second.name
    assert row(world, first.name).class_name == "AMjManager"
    assert world.has_manager


# Editing


def test_a_transform_changes_the_parts_it_names(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a", location=(1, 2, 3), rotation_quat=(0, 0, HALF, HALF))

    world.set_actor_transform("a", location=(4, 5, 6))
    assert row(world, "a").location == (4, 5, 6)
    assert same_rotation(row(world, "a").rotation, (0, 0, HALF, HALF))
    world.set_actor_transform("bot", rotation_quat=(0, 3, 0, 0))
    assert row(world, "a").location == (4, 5, 6)
    assert row(world, "a").rotation == (0, 1, 0, 0)
    assert world.set_actor_transform("a").name == "bot"

    code = "set_actor_transform_failed"
    assert refusal(world.set_actor_transform, "nobody").code == code
    assert refusal(world.set_actor_transform, "a", rotation_quat=(0, 0, 0, 0)).code == code
    assert refusal(world.set_actor_transform, "a", location=(0, math.nan, 0)).code == code


def test_the_first_actor_with_the_id_or_name_is_meant(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "gone")
    world.spawn_actor(bot, "bot")  # its object name is copy1_bot
    world.destroy_actor("gone")
    world.spawn_actor(bot, "other")  # its object name is bot

    assert world.set_actor_transform("bot").name == "copy1_bot"
    assert world.set_actor_transform("other").name == "bot"
    assert world.actors.get("bot").name == "copy1_bot"  # type: ignore[union-attr]  # by id
    assert world.actors.get("bot", by_name=True).actor_id == "other"  # type: ignore[union-attr]
    assert world.actors.get("copy1_bot") is None


def test_a_copy_has_the_rotation_of_its_source_and_stands_beside_it(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a", location=(1, 2, 3), rotation_quat=(0, 0, HALF, HALF))

    copy = world.duplicate_actor("a", "b")

    assert copy.actor.location == (2, 2, 3)
    assert same_rotation(row(world, "b").rotation, (0, 0, HALF, HALF))
    assert copy.actor.class_path == bot
    assert world.duplicate_actor("a", "b", location=(9, 9, 9)).was_existing
    assert row(world, "b").location == (9, 9, 9)
    assert len(list(world.actors)) == 2


def test_lights_can_be_copied_and_managers_cannot(bot: str, world: EditorWorld) -> None:
    world.spawn_light("point", "lamp", color=(1, 0, 0))
    world.spawn_actor(bot, "a")
    manager, _ = world.ensure_manager()

    copy = world.duplicate_actor("lamp", "lamp2")

    assert row(world, "lamp2").kind is ActorKind.LIGHT
    assert copy.actor.name == "PointLight_1"
    assert refusal(world.duplicate_actor, "lamp", "a").code == "duplicate_failed"
    assert refusal(world.duplicate_actor, manager.name, "m").code == "duplicate_failed"
    assert refusal(world.duplicate_actor, "nobody", "n").code == "duplicate_failed"


def test_a_destroyed_actor_is_gone(workspace: Workspace, bot: str) -> None:
    world = load(workspace, HEAD | {"actors": [BOX, BOX | {"name": "lid", "parent": "crate"}]})
    world.select_actor("crate")

    world.destroy_actor("crate")

    assert names(list(world.actors)) == ["lid"]
    assert world.actors.get("lid", by_name=True).parent == ""  # type: ignore[union-attr]
    assert world.actors.selected == ""
    assert refusal(world.destroy_actor, "crate").code == "destroy_failed"


def test_one_actor_is_selected(bot: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")
    world.spawn_actor(bot, "b")

    world.select_actor("a")
    assert world.select_actor("b").name == world.actors.selected == "copy1_bot"
    assert refusal(world.select_actor, "c").code == "select_failed"


# Looking


def test_filters_narrow_down_together_and_know_no_letter_case(bot: str, ball: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")
    world.spawn_actor(ball, "b")
    world.spawn_light("point", "lamp")
    world.ensure_manager()

    def found(**filters: str) -> list[str]:
        return names(world.find_actors(**filters)[0])

    assert found() == ["bot", "ball", "PointLight_0", "AMjManager_0"]
    for robots in ("AMjArticulation", "mjarticulation", "Pawn", "apawn"):
        assert found(class_filter=robots) == ["bot", "ball"]
    assert found(class_filter="BOT_c") == ["bot"]
    assert found(class_filter="Light") == ["PointLight_0"]
    assert found(class_filter="Actor", name_prefix="B") == ["bot", "ball"]
    assert found(tag="urlab.actorid=LAMP") == ["PointLight_0"]
    assert found(tag="urlab.actorid=a") == []
    assert found(class_filter="Pawn", tag="urlab.actorid=lamp") == []
    assert found(class_filter="MjManager") == []
    assert found(class_filter="AMjManager") == ["AMjManager_0"]


def test_play_shows_the_level_as_it_was_at_its_start(bot: str, ball: str, world: EditorWorld) -> None:
    world.spawn_actor(bot, "a")
    editor = world.snapshot()
    described = snapshot_row(editor[0], compiled=False).urlab
    assert described is not None
    assert described.joints == ["root", "j"]
    world.freeze()
    world.pie_running = True
    world.spawn_actor(ball, "b")
    world.set_actor_transform("a", location=(9, 0, 0))

    play = world.snapshot()

    assert [item.class_name for item in play] == ["bot_C", "MjReplayManager"]
    assert play[0].location == (0, 0, 0)
    described = snapshot_row(play[0], compiled=True).urlab
    assert described is not None
    assert described.joints == ["bot_root", "bot_j"]
    assert described.actuators == ["bot_m"]
    assert described.sensors == ["bot_s"]
    assert described.cameras == ["cam"]
    assert names(list(world.actors)) == ["bot", "ball"]
    rows, in_play = world.find_actors(class_filter="Pawn", in_pie=True)
    assert (names(rows), in_play) == (["bot"], True)
    assert (names(world.find_actors()[0]), world.find_actors()[1]) == (["bot", "ball"], False)
    assert world.actor_hierarchy("bot").location == (0, 0, 0)
    assert refusal(world.actor_hierarchy, "ball").code == "actor_hierarchy_failed"
    assert world.levels.shown() == "/Game/Levels/UEDPIE_0_lab"
    assert world.levels.package == "/Game/Levels/lab"

    world.pie_running = False
    assert names(world.snapshot()) == ["bot", "ball"]
    assert world.find_actors(in_pie=True)[1] is False
    assert world.levels.shown() == "/Game/Levels/lab"


def test_bounds_hold_the_geoms_at_the_authored_pose(workspace: Workspace, world: EditorWorld) -> None:
    text = mjcf(
        '<geom name="floor" type="plane" size="1 1 1"/>'
        '<body name="b" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.2 0.3"/>'
        '<geom type="sphere" size="0.1" pos="1 0 0" contype="0" conaffinity="0"/></body>'
    )
    world.spawn_actor(workspace.blueprint("boxed", text), "a", location=(10, 0, 0), rotation_euler=(0, 0, 90))

    solid = world.get_actor_bounds("a")
    every = world.get_actor_bounds("a", components_only=True)

    assert solid.min == pytest.approx((9.8, -0.1, 0.7))
    assert solid.max == pytest.approx((10.2, 0.1, 1.3))
    assert solid.center == pytest.approx((10, 0, 1))
    assert solid.extents == pytest.approx((0.2, 0.1, 0.3))
    assert every.max == pytest.approx((10.2, 1.1, 1.3))
    assert refusal(world.get_actor_bounds, "b").code == "get_actor_bounds_failed"


def test_bounds_of_meshes_follow_the_mesh(workspace: Workspace, world: EditorWorld) -> None:
    write_obj(workspace.models / "part.obj", 0.4)
    text = mjcf('<body name="b"><geom type="mesh" mesh="part"/></body>', head='<asset><mesh file="part.obj"/></asset>')
    world.spawn_actor(workspace.blueprint("meshy", text), "a", location=(0, 0, 2))

    bounds = world.get_actor_bounds("a")

    # MuJoCo's box is aligned with the mesh's principal axes, so it is somewhat larger than the tetrahedron.
    assert all(low <= 0.001 for low in bounds.min[:2])
    assert all(high >= 0.399 for high in bounds.max[:2])
    assert bounds.max[2] < 2.7


def test_lights_managers_and_bare_models_have_no_bounds(workspace: Workspace, world: EditorWorld) -> None:
    world.spawn_light(actor_id="lamp")
    manager, _ = world.ensure_manager()
    world.spawn_actor(workspace.blueprint("floor", mjcf('<geom type="plane" size="1 1 1"/>')), "floor")

    for key in ("lamp", manager.name, "floor"):
        assert world.get_actor_bounds(key).extents == (0, 0, 0)


# Quick Convert


def test_a_mesh_is_converted_with_the_settings_of_the_last_call(workspace: Workspace) -> None:
    world = load(workspace, HEAD | {"actors": [BOX]})

    world.quick_convert.add("crate", ConversionSettings(static=True, coacd_threshold=0.1, friction=(0.5, 0.1, 0.1)))
    settings_ = row(world, "crate").quick_convert
    assert settings_ is not None
    assert (settings_.static, settings_.friction) == (True, (0.5, 0.1, 0.1))
    assert settings_.coacd_threshold == 0.10000000149011612
    world.quick_convert.add("crate", ConversionSettings())
    again = row(world, "crate").quick_convert
    assert again is not None
    assert (again.static, again.friction) == (False, (1, 1, 1))
    world.quick_convert.remove("crate")
    assert row(world, "crate").quick_convert is None
    assert refusal(world.quick_convert.remove, "crate").code == "remove_quick_convert_failed"


def test_only_meshes_are_converted(workspace: Workspace, bot: str) -> None:
    plane = BOX | {"name": "ground", "mesh": {"shape": "plane", "size": [1, 1]}}
    world = load(workspace, HEAD | {"actors": [BOX, plane]})
    world.spawn_actor(bot, "a")
    code = "add_quick_convert_failed"

    assert refusal(world.quick_convert.add, "a", ConversionSettings()).code == code
    assert refusal(world.quick_convert.add, "nobody", ConversionSettings()).code == code
    assert refusal(world.quick_convert.add, "crate", ConversionSettings(friction=(math.nan, 0, 0))).code == code
    assert refusal(world.quick_convert.add, "ground", ConversionSettings()).code == code
    assert world.quick_convert.add("ground", ConversionSettings(static=True)).quick_convert is not None


def test_play_gets_the_actors_in_spawn_order(bot: str, ball: str, world: EditorWorld) -> None:
    for path in (ball, bot, ball):
        world.spawn_actor(path)

    frozen = world.freeze()

    assert [actor.kind for actor in frozen] == [ActorKind.ARTICULATION] * 3 + [ActorKind.REPLAY_MANAGER]
    model = compile_scene(frozen).model
    assert [model.body(index).name for index in range(1, model.nbody)] == [
        "ball_ball",
        "bot_base",
        "bot_arm",
        "copy1_ball_ball",
    ]
    assert model.nq == 7 + 8 + 7
    assert mujoco.mj_version() > 0
