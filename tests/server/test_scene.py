from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from worlds import BALL_BODY, BOT, GYMNASIUM, Workspace, mjcf, write_obj, write_stl

from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.compile.scene import CompiledScene, compile_scene
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.editor.world import EditorWorld
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import CompileFailed

BALL = mjcf(BALL_BODY, model="ball")
FLOOR = '<geom name="floor" type="plane" size="5 5 0.1"/>'

SceneOf = Callable[..., CompiledScene]


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


@pytest.fixture
def scene_of(workspace: Workspace) -> SceneOf:
    """Compile actors given as name=MJCF in this order, 2 m apart along x; the name is the model's, too."""

    def build(*models: tuple[str, str], **options: Any) -> CompiledScene:
        for at, (name, text) in enumerate(models):
            path = workspace.blueprint(name, text)
            workspace.world.spawn_actor(path, f"id{at}", location=(2.0 * at, 0.0, 0.0))
        return compile_scene(workspace.world.freeze(), **options)

    return build


@pytest.fixture
def two_bots(scene_of: SceneOf) -> CompiledScene:
    return scene_of(("bot", BOT), ("bot", BOT))


def names(model: mujoco.MjModel, count: int, element: Callable[[int], Any]) -> list[str]:
    return [element(index).name for index in range(count)]


def short(index: ArticulationIndex, ids: np.ndarray, element: Callable[[int], Any]) -> tuple[str, ...]:
    return tuple(element(int(i)).name.removeprefix(index.prefix) for i in ids)


# What the conformance checklist states about scenes


def test_everything_an_articulation_owns_has_its_prefix(two_bots: CompiledScene) -> None:
    model = two_bots.model
    kinds = [
        (model.njnt, model.joint),
        (model.ngeom, model.geom),
        (model.nu, model.actuator),
        (model.nsensor, model.sensor),
        (model.nkey, model.key),
        (model.ncam, model.camera),
    ]
    for count, element in kinds:
        found = names(model, count, element)
        assert count
        assert all(name.startswith(("bot_", "copy1_bot_")) for name in found)
        assert len(set(found)) == count
    assert names(model, model.nbody, model.body) == ["world", "bot_base", "bot_arm", "copy1_bot_base", "copy1_bot_arm"]


def test_articulations_are_told_apart_by_key_and_id(two_bots: CompiledScene) -> None:
    assert [(index.key, index.prefix, index.actor_id) for index in two_bots.articulations] == [
        ("bot", "bot_", "id0"),
        ("copy1_bot", "copy1_bot_", "id1"),
    ]


def test_actors_stand_where_they_were_placed(two_bots: CompiledScene) -> None:
    model = two_bots.model

    np.testing.assert_allclose(model.body("copy1_bot_base").pos, [2, 0, 1])
    np.testing.assert_allclose(model.qpos0[two_bots.articulations[1].qpos_adr[:7]], [2, 0, 1, 1, 0, 0, 0])
    assert model.geom("copy1_bot_floor").bodyid[0] == 0
    np.testing.assert_allclose(model.geom("copy1_bot_floor").pos, [2, 0, 0])


def test_a_rotated_actor_is_compiled_rotated(workspace: Workspace) -> None:
    bot = workspace.blueprint("bot", BOT)
    workspace.world.spawn_actor(bot, location=(0, 0, 5), rotation_euler=(0, 0, 90))

    scene = compile_scene(workspace.world.freeze())

    np.testing.assert_allclose(scene.model.body("bot_base").pos, [0, 0, 6], atol=1e-12)
    np.testing.assert_allclose(scene.model.qpos0[3:7], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)


def test_an_empty_level_is_an_empty_model(workspace: Workspace) -> None:
    workspace.world.ensure_manager()

    scene = compile_scene(workspace.world.freeze())

    assert (scene.model.nbody, scene.model.ngeom, scene.model.nlight) == (1, 0, 0)
    assert scene.articulations == ()
    assert scene.entities == ()
    assert scene.warnings == ()


def test_the_plugins_options_apply_whatever_the_model_says(two_bots: CompiledScene) -> None:
    option = two_bots.model.opt

    assert option.timestep == 0.002
    np.testing.assert_array_equal(option.gravity, [0, 0, -9.81])
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.enableflags == 0
    assert option.disableflags == 0


def test_a_fresh_scene_is_at_its_reference_with_everything_computed(two_bots: CompiledScene) -> None:
    data = two_bots.data

    assert data.time == 0
    np.testing.assert_array_equal(data.qpos, two_bots.model.qpos0)
    np.testing.assert_allclose(data.xpos[two_bots.articulations[1].root_body], [2, 0, 1])


def test_the_binary_model_loads(two_bots: CompiledScene, tmp_path: Path) -> None:
    two_bots.model.opt.timestep = 0.004
    file = tmp_path / "scene.mjb"
    file.write_bytes(two_bots.mjb())

    model = mujoco.MjModel.from_binary_path(str(file))

    assert model.nq == two_bots.model.nq
    assert model.opt.timestep == 0.004


# Options


def test_ignored_options_are_named_in_one_warning(
    scene_of: SceneOf, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    ant = mjcf(BALL_BODY, head='<option timestep="0.01" cone="elliptic"><flag contact="disable"/></option>')
    scene = scene_of(("bot", BOT.replace(FLOOR, "")), ("ant", ant), ("plain", BALL))

    (warning,) = [record.getMessage() for record in caplog.records]

    assert scene.warnings == (warning,)
    for part in ("bot: gravity (0 0 -1), integrator RK4, timestep 0.005", "disabled contact", "cone ELLIPTIC"):
        assert part in warning
    assert "plain" not in warning
    assert "--mjcf-options" in warning
    assert capfd.readouterr() == ("", "")


@pytest.mark.mujoco("3.16")
def test_what_mujoco_warns_of_at_the_first_step_is_told(scene_of: SceneOf) -> None:
    wild = '<body name="b"><joint stiffness="1e15" springref="1e15"/><geom size="0.1"/></body>'
    (warning,) = scene_of(("bot", mjcf(wild))).warnings
    assert warning.startswith("Nan, Inf or huge value in QACC")


def test_the_first_models_options_can_be_honoured(scene_of: SceneOf) -> None:
    ant = mjcf(BALL_BODY, head='<option timestep="0.01" integrator="Euler"/>')

    scene = scene_of(("bot", BOT), ("ant", ant), options="first")

    assert scene.model.opt.timestep == 0.005
    assert scene.model.opt.gravity[2] == -1
    assert scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert len(scene.warnings) == 1
    assert "ant: timestep 0.01" in scene.warnings[0]
    assert "bot:" not in scene.warnings[0]


def test_attaching_is_quiet(
    scene_of: SceneOf, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    loud = mjcf(
        BALL_BODY,
        head='<option timestep="0.01" impratio="3" o_margin="1"/>'
        '<size nkey="4" nuser_geom="2" nuserdata="3" memory="1M"/>'
        '<visual><map znear="0.1" zfar="7"/><global realtime="2"/></visual><statistic extent="3"/>',
    )

    scene_of(("loud", loud), ("loud", loud))

    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_model_that_asks_for_memory_gets_it(scene_of: SceneOf) -> None:
    scene = scene_of(("big", mjcf(BALL_BODY, head='<size memory="40M"/>')), ("ball", BALL))

    assert scene.model.narena >= 40 * 2**20


def test_the_memory_that_mujoco_reserves_for_contacts_counts_against_the_limit(scene_of: SceneOf) -> None:
    with pytest.raises(CompileFailed, match=r"the scene takes \d{8} bytes, more than the limit scene_bytes, 8388608"):
        scene_of(("ball", BALL), limits=Limits(scene_bytes=8 * 2**20))


# Keyframes


def key(scene: CompiledScene, name: str) -> Any:
    return scene.model.key(name)


def test_keyframes_hold_their_owners_part_only(two_bots: CompiledScene) -> None:
    model = two_bots.model
    first, second = two_bots.articulations

    assert names(model, model.nkey, model.key) == ["bot_home", "copy1_bot_home"]
    home = key(two_bots, "copy1_bot_home")
    assert home.time[0] == 1.5
    # The free joint's part is as the MJCF has it, not moved by the actor's pose.
    np.testing.assert_array_equal(home.qpos[second.qpos_adr], [0, 0, 1, 1, 0, 0, 0, 0.5])
    np.testing.assert_array_equal(home.qpos[first.qpos_adr], model.qpos0[first.qpos_adr])
    np.testing.assert_array_equal(home.qvel, np.zeros(model.nv))
    assert home.ctrl[second.ctrl_adr[0]] == 0.3
    assert home.ctrl[first.ctrl_adr[0]] == 0


KEYED = mjcf(
    '<body name="stand"><joint name="h"/><geom size="0.1"/></body>'
    '<body name="base" pos="0 0 1"><freejoint/><geom size="0.1"/>'
    '<body name="arm"><joint name="b" type="ball"/><geom size="0.1"/></body></body>'
    '<body name="target" mocap="true" pos="1 1 1"/>',
    model="keyed",
    tail='<actuator><intvelocity name="iv" joint="h" kp="3" actrange="-1 1"/><motor name="m" joint="h"/></actuator>'
    "<keyframe>"
    '<key name="full" qpos="0.1 5 6 7 1 0 0 0 0 1 0 0" qvel="1 2 3 4 5 6 7 8 9 10"'
    ' act="0.7" ctrl="0.2 0.4" mpos="9 9 9"/>'
    '<key name="joints" qpos="0.1 0 1 0 0" qvel="1 8 9 10"/>'
    '<key name="nothing"/>'
    '<key name="begin" qpos="0.25"/>'
    "</keyframe>",
)


@pytest.mark.mujoco("3.16")
def test_keyframes_beside_free_objects(scene_of: SceneOf) -> None:
    scene = scene_of(("ball", BALL), ("keyed", KEYED), ("ball", BALL), ("keyed", KEYED))
    model = scene.model
    first_ball, first, _, second = scene.articulations

    full = key(scene, "copy1_keyed_full")
    np.testing.assert_array_equal(full.qpos[second.qpos_adr], [0.1, 5, 6, 7, 1, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(full.qvel[second.qvel_adr], np.arange(1.0, 11.0))
    np.testing.assert_array_equal(full.ctrl[second.ctrl_adr], [0.2, 0.4])
    np.testing.assert_array_equal(full.act, [0, 0.7])
    np.testing.assert_array_equal(full.mpos, [3, 1, 1, 7, 1, 1])
    for other in (first_ball, first):
        np.testing.assert_array_equal(full.qpos[other.qpos_adr], model.qpos0[other.qpos_adr])
        np.testing.assert_array_equal(full.qvel[other.qvel_adr], 0)

    # Exactly the coordinates that are not free: the free joint is at the origin, at rest.
    joints = key(scene, "keyed_joints")
    np.testing.assert_array_equal(joints.qpos[first.qpos_adr], [0.1, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(joints.qvel[first.qvel_adr], [1, 0, 0, 0, 0, 0, 0, 8, 9, 10])

    np.testing.assert_array_equal(key(scene, "copy1_keyed_nothing").qpos, model.qpos0)
    begin = key(scene, "copy1_keyed_begin").qpos[second.qpos_adr]
    np.testing.assert_array_equal(begin, [0.25, *model.qpos0[second.qpos_adr][1:]])


# Whose is what


ROBOTS = ["humanoid.xml", "ant.xml", "walker2d_v5.xml", "pusher_v5.xml"]


@pytest.mark.mujoco("3.16")
@pytest.mark.parametrize("file", ROBOTS)
def test_real_robots_twice(tmp_path: Path, file: str) -> None:
    world = EditorWorld(ContentRoot(tmp_path, model_roots=[GYMNASIUM]))
    blueprint, _ = world.blueprints.import_xml(file)
    for at in range(2):
        world.spawn_actor(blueprint.class_path, location=(0.0, 10.0 * at, 0.0))

    scene = compile_scene(world.freeze())

    model = scene.model
    alone = mujoco.MjModel.from_xml_path(str(GYMNASIUM / file))
    for index in scene.articulations:
        assert index.body_names == short(index, index.bodies, model.body)
        assert index.joint_names == short(index, index.joints, model.joint)
        assert index.actuator_names == short(index, index.actuators, model.actuator)
        assert index.joint_names == blueprint.joints
        assert len(index.bodies) == alone.nbody - 1
        assert len(index.qpos_adr) == alone.nq
        assert len(index.qvel_adr) == alone.nv
        assert len(index.ctrl_adr) == len(index.act_adr) == len(index.force_adr) == alone.nu
        np.testing.assert_allclose(model.body_mass[index.bodies], alone.body_mass[1:])
        np.testing.assert_allclose(model.jnt_range[index.joints], alone.jnt_range)
        assert index.root_body == index.bodies.min()
        assert set(index.actuator_types.values()) == {"motor"}
        assert (index.bodies.dtype, index.qpos_adr.dtype) == (np.int32, np.intp)
    for one, count in (("bodies", model.nbody - 1), ("joints", model.njnt), ("actuators", model.nactuator)):
        parts = np.concatenate([getattr(index, one) for index in scene.articulations])
        assert len(set(parts.tolist())) == len(parts) == count
    positions = np.concatenate([index.qpos_adr for index in scene.articulations])
    np.testing.assert_array_equal(np.sort(positions), np.arange(model.nq))


@pytest.mark.mujoco("3.16")
@pytest.mark.parametrize("file", ROBOTS)
def test_a_robot_in_a_scene_moves_as_it_does_alone(tmp_path: Path, file: str) -> None:
    world = EditorWorld(ContentRoot(tmp_path, model_roots=[GYMNASIUM]))
    world.spawn_actor(world.blueprints.import_xml(file)[0].class_path)
    scene = compile_scene(world.freeze())
    alone = mujoco.MjModel.from_xml_path(str(GYMNASIUM / file))
    for name in dir(alone.opt):
        if not name.startswith("_") and not callable(getattr(alone.opt, name)):
            setattr(alone.opt, name, getattr(scene.model.opt, name))
    data = mujoco.MjData(alone)
    controls = np.random.default_rng(7).uniform(-0.4, 0.4, (200, alone.nu))

    for control in controls:
        for model, state in ((scene.model, scene.data), (alone, data)):
            state.ctrl[:] = control
            mujoco.mj_step(model, state)

    assert not np.allclose(data.qpos, alone.qpos0)
    np.testing.assert_allclose(scene.data.qpos, data.qpos, atol=1e-6)


def test_one_prefix_may_begin_with_another(scene_of: SceneOf) -> None:
    robot = mjcf(
        '<body name="base"><joint name="1_j"/><geom size="0.1"/></body>',
        model="robot",
        tail='<actuator><motor name="1_m" joint="1_j"/></actuator><sensor><jointpos name="1_s" joint="1_j"/></sensor>',
    )
    other = mjcf(
        '<body name="base"><joint name="j"/><geom size="0.1"/></body>',
        model="robot_1_2",
        tail='<actuator><motor name="m" joint="j"/></actuator>',
    )

    scene = scene_of(("robot", robot), ("other", other), ("robot", robot))

    assert [index.key for index in scene.articulations] == ["robot", "robot_1_2", "copy1_robot"]
    for index in scene.articulations:
        assert index.body_names == ("base",)
        assert len(index.joints) == len(index.actuators) == 1
        assert scene.model.body(int(index.bodies[0])).name == f"{index.key}_base"
    assert [index.joint_names for index in scene.articulations] == [("1_j",), ("j",), ("1_j",)]
    assert [index.sensor_names for index in scene.articulations] == [("1_s",), (), ("1_s",)]


@pytest.mark.mujoco("3.16")
def test_actuators_with_several_inputs_and_outputs(scene_of: SceneOf) -> None:
    text = mjcf(
        '<body name="b"><joint name="turn" type="ball"/><geom size="0.1"/>'
        '<body pos="1 0 0"><joint name="h"/><geom size="0.1"/></body></body>',
        model="multi",
        tail='<actuator><motor name="m" joint="h"/><orientation name="o" joint="turn" kp="3"/>'
        '<pid name="p" joint="h" kp="1"/>'
        '<intvelocity name="iv" joint="h" kp="1" actrange="-1 1"/></actuator>',
    )

    scene = scene_of(("multi", text), ("multi", text))

    model = scene.model
    first, second = scene.articulations
    assert model.nu == 2 * (1 + 3 + 2 + 1)
    assert first.actuator_names == ("m", "o", "p", "iv")
    np.testing.assert_array_equal(first.ctrl_adr, np.arange(7))
    np.testing.assert_array_equal(second.ctrl_adr, np.arange(7, 14))
    np.testing.assert_array_equal(first.force_adr, np.arange(6))
    np.testing.assert_array_equal(second.force_adr, np.arange(6, 12))
    np.testing.assert_array_equal(first.act_adr, [-1] * 6 + [0])
    np.testing.assert_array_equal(second.act_adr, [-1] * 6 + [1])
    assert dict(first.actuator_types) == {"m": "motor", "o": "orientation", "p": "pid", "iv": "intvelocity"}


def test_a_model_of_world_geoms_only_belongs_to_the_world(scene_of: SceneOf) -> None:
    scene = scene_of(("ground", mjcf(FLOOR)), ("ball", BALL))

    ground, ball = scene.articulations

    assert ground.root_body == 0
    assert ground.bodies.size == ground.qpos_adr.size == ground.ctrl_adr.size == 0
    assert ball.root_body == 1


# Meshes


def meshy(workspace: Workspace, name: str, size: float) -> str:
    write_obj(workspace.models / name / "part.obj", size)
    write_stl(workspace.models / name / "shell.stl", size)
    workspace.write(
        f"{name}/{name}.xml",
        mjcf(
            '<body name="b"><freejoint/><geom type="mesh" mesh="part"/><geom type="mesh" mesh="shell"/></body>',
            model=name,
            head='<asset><mesh file="part.obj"/><mesh file="shell.stl"/></asset>',
        ),
    )
    return workspace.world.blueprints.import_xml(f"{name}/{name}.xml")[0].class_path


@pytest.mark.mujoco("3.17")
def test_instances_share_their_meshes(workspace: Workspace) -> None:
    path = meshy(workspace, "part", 0.3)
    workspace.world.spawn_grid(path, "g", 3, 2)

    model = compile_scene(workspace.world.freeze()).model

    assert model.nmesh == 2
    assert model.ngeom == 12
    assert len(set(model.geom_dataid.tolist())) == 2


def test_the_exported_scene_loads_with_its_assets(workspace: Workspace) -> None:
    for at, (name, size) in enumerate([("small", 0.1), ("large", 0.4)]):  # with files of the same names
        workspace.world.spawn_actor(meshy(workspace, name, size), location=(at, 0, 0))
    workspace.world.spawn_actor(workspace.blueprint("bot", BOT))
    scene = compile_scene(workspace.world.freeze())

    text, assets = scene.export()
    again = mujoco.MjModel.from_xml_string(text, assets=assets)

    assert len(assets) == 4
    assert all("/" not in name and "\\" not in name for name in assets)
    assert str(workspace.saved) not in text
    assert again.nq == scene.model.nq
    assert names(again, again.nkey, again.key) == ["bot_home"]
    np.testing.assert_allclose(again.body_mass, scene.model.body_mass, rtol=1e-4)
    assert again.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER  # the spec's options, not the live ones


# Cameras


def test_cameras_have_a_useful_size_and_a_vertical_view(scene_of: SceneOf) -> None:
    text = mjcf(
        '<camera name="plain"/><body name="b"><geom size="0.1"/><camera name="wide" resolution="1280 720" fovy="60"/>'
        '<camera name="lens" resolution="100 80" sensorsize="0.02 0.02" focal="0.01 0.01"/></body>',
        model="eyes",
    )

    scene = scene_of(("eyes", text), ("eyes", text))

    first, second = scene.articulations
    by_name = {camera.name: camera for camera in second.cameras}
    assert by_name.keys() == {"plain", "wide", "lens"}
    assert all(camera.mode == "real" for camera in first.cameras)
    assert (by_name["plain"].resolution, by_name["plain"].fovy) == ((640, 480), 45.0)
    assert (by_name["wide"].resolution, by_name["wide"].fovy) == ((1280, 720), 60.0)
    assert by_name["lens"].fovy == pytest.approx(90.0)
    assert scene.model.camera(by_name["lens"].id).name == "copy1_eyes_lens"
    assert scene.model.vis.global_.offwidth >= 1280
    assert scene.model.vis.global_.offheight >= 720


def test_the_default_camera_size_can_be_chosen(scene_of: SceneOf) -> None:
    text = mjcf('<camera name="plain"/><camera name="own" resolution="32 24"/><geom size="0.1"/>', model="eyes")

    scene = scene_of(("eyes", text), camera_size=(1920, 1080))

    assert {camera.name: camera.resolution for camera in scene.articulations[0].cameras} == {
        "plain": (1920, 1080),
        "own": (32, 24),
    }
    assert scene.model.vis.global_.offwidth >= 1920


# Lights, meshes of the level


def test_lights_shine_as_unreal_would_aim_them(workspace: Workspace) -> None:
    workspace.world.spawn_light("directional", rotation_euler=(0, -90, 0), intensity=2500.0, color=(1, 0.5, 0))
    workspace.world.spawn_light("point", location=(1, 2, 3), intensity=1e9)
    workspace.world.spawn_light("spot", rotation_euler=(0, 0, 90))

    model = compile_scene(workspace.world.freeze()).model

    sun, bulb, spot = (model.light(f"{kind}Light_0_Light") for kind in ("Directional", "Point", "Spot"))
    np.testing.assert_allclose(sun.dir, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(sun.diffuse, [0.5, 0.25, 0])
    np.testing.assert_allclose(bulb.pos, [1, 2, 3])
    np.testing.assert_allclose(bulb.diffuse, [2, 2, 2])
    np.testing.assert_allclose(spot.dir, [0, -1, 0], atol=1e-9)
    types = [
        mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mujoco.mjtLightType.mjLIGHT_POINT,
        mujoco.mjtLightType.mjLIGHT_SPOT,
    ]
    assert model.light_type.tolist() == [int(kind) for kind in types]


def level(workspace: Workspace, *actors: dict[str, Any]) -> CompiledScene:
    file = workspace.saved / "Levels" / "props.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"format": "urlab-level", "version": 1, "blueprints": {}, "actors": actors}))
    workspace.world.levels.load("props")
    workspace.world.spawn_actor(workspace.blueprint("ball", BALL), location=(5, 0, 0))
    return compile_scene(workspace.world.freeze())


def prop(name: str, **settings: Any) -> dict[str, Any]:
    return {"name": name, "kind": "static_mesh", "mesh": {"shape": "box", "size": [0.1, 0.2, 0.3]}} | settings


def test_converted_meshes_are_entities(workspace: Workspace) -> None:
    scene = level(
        workspace,
        prop("crate", location=[0, 0, 1], quick_convert={"friction": [0.5, 0.1, 0.2]}),
        prop("wall", quick_convert={"static": True}),
        prop("door", quick_convert={"driven_by_unreal": True}),
        prop("picture"),
    )
    model = scene.model

    crate, wall, door = scene.entities
    assert [entity.name for entity in scene.entities] == ["crate_MjBody", "wall_MjBody", "door_MjBody"]
    assert [model.body(entity.body).name for entity in scene.entities] == ["crate_MjBody", "wall_MjBody", "door_MjBody"]
    assert crate.free_joint == "crateFreeJoint"
    assert model.joint(crate.free_joint_id).name == "crateFreeJoint"
    np.testing.assert_array_equal(scene.data.qpos[crate.qpos_adr : crate.qpos_adr + 7], [0, 0, 1, 1, 0, 0, 0])
    assert crate.qvel_adr == model.joint("crateFreeJoint").dofadr[0]
    assert (wall.free_joint, wall.free_joint_id, wall.qpos_adr) == (None, -1, -1)
    assert (door.free_joint, model.body_mocapid[door.body]) == (None, 0)
    assert model.body_mocapid[wall.body] == -1

    geoms = names(model, model.ngeom, model.geom)
    assert {"Geom_0_0", "Geom_0_0_1", "Geom_0_0_2", "picture_Mesh"} <= set(geoms)
    np.testing.assert_allclose(model.geom("Geom_0_0").friction, [0.5, 0.1, 0.2])
    assert model.geom("picture_Mesh").contype[0] == model.geom("picture_Mesh").conaffinity[0] == 0
    assert [index.key for index in scene.articulations] == ["ball"]


def test_a_converted_mesh_file_is_scaled(workspace: Workspace) -> None:
    write_obj(workspace.saved / "Levels" / "rock.obj", 1.0)
    rock = {"shape": "file", "file": "rock.obj"}

    scene = level(
        workspace,
        prop("one", mesh=rock, quick_convert={}),
        prop("two", mesh=rock, scale=[2, 2, 2], quick_convert={}, location=[9, 0, 0]),
        prop("round", mesh={"shape": "sphere", "size": [0.5]}, scale=[2, 2, 2], quick_convert={}, location=[20, 0, 0]),
    )

    one, two, _ = (float(scene.model.body_mass[entity.body]) for entity in scene.entities)
    assert two == pytest.approx(8 * one)
    assert scene.model.geom("Geom_0_0_2").size[0] == 1.0


# Floors and suns


def test_floors_that_coincide_are_named_and_drawn_once(two_bots: CompiledScene) -> None:
    model = two_bots.model

    assert any("2 floors coincide (bot_floor, copy1_bot_floor)" in warning for warning in two_bots.warnings)
    drawn = model.geom_rgba[[model.geom("bot_floor").id, model.geom("copy1_bot_floor").id], 3]
    assert drawn.tolist() == [1, 0]
    np.testing.assert_allclose(model.geom("bot_floor").size[:2], [7, 5])  # reaches as far as both did
    assert model.geom("copy1_bot_floor").contype[0] == 1


def test_floors_apart_are_left_alone(scene_of: SceneOf) -> None:
    stair = mjcf(
        '<geom name="low" type="plane" size="1 1 1"/><geom name="high" type="plane" size="1 1 1" pos="0 0 1"/>'
    )

    scene = scene_of(("stair", stair))

    assert scene.warnings == ()
    assert scene.model.geom_rgba[:, 3].tolist() == [1, 1]


def test_a_sun_that_every_robot_brings_shines_once(scene_of: SceneOf) -> None:
    sunny = mjcf(BALL_BODY + '<light type="directional" dir="0 0 -1"/><light type="point"/>', model="sunny")

    model = scene_of(("sunny", sunny), ("sunny", sunny)).model

    assert model.light_active.tolist() == [True, True, False, True]


# What MuJoCo does not take


def test_a_light_may_aim_at_the_world(scene_of: SceneOf) -> None:
    aimed = mjcf(BALL_BODY + '<light mode="targetbody" target="world"/><camera mode="targetbody" target="world"/>')

    model = scene_of(("aimed", aimed), ("aimed", aimed)).model

    assert model.light_targetbodyid.tolist() == [0, 0]
    assert model.cam_targetbodyid.tolist() == [0, 0]


def test_mujocos_message_is_on_one_line(workspace: Workspace) -> None:
    path = workspace.blueprint("bot", BOT)
    workspace.world.spawn_actor(path)
    blueprint = workspace.content.blueprints["bot"]
    (blueprint.folder / "model.xml").write_text("<mujoco>\n<nonsense/></mujoco>")

    fresh = EditorWorld(ContentRoot(workspace.saved))
    fresh.spawn_actor(path)
    with pytest.raises(CompileFailed) as failed:
        compile_scene(fresh.freeze())

    assert "nonsense" in failed.value.message
    assert "\n" not in failed.value.message
    assert str(failed.value) == failed.value.message


def test_a_mesh_file_that_vanished_fails_the_compilation(workspace: Workspace) -> None:
    with pytest.raises(CompileFailed, match=r"gone\.obj"):
        level(workspace, prop("rock", mesh={"shape": "file", "file": "gone.obj"}, quick_convert={}))


@pytest.mark.mujoco("3.16")
def test_a_model_that_needs_its_own_integrator_says_how_to_get_it(scene_of: SceneOf, workspace: Workspace) -> None:
    cloth = mjcf(
        '<flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" mass="1" dim="2">'
        '<elasticity young="1e4" poisson="0.2" thickness="0.01" elastic2d="both"/>'
        '<contact selfcollide="none"/></flexcomp>',
        model="cloth",
        head='<option integrator="discrete"/>',
    )

    with pytest.raises(CompileFailed, match="--mjcf-options"):
        scene_of(("cloth", cloth))

    assert compile_scene(workspace.world.freeze(), options="first").model.nflex == 1


def test_what_a_scene_warns_of_is_logged(two_bots: CompiledScene, caplog: pytest.LogCaptureFixture) -> None:
    logged = [record for record in caplog.records if record.name == "urlab_client.server"]

    assert tuple(record.getMessage() for record in caplog.get_records("setup")) == two_bots.warnings
    assert all(record.levelno == logging.WARNING for record in logged)
