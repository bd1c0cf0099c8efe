"""Scenes as the beta has them: options of all robots merged, and a document for each robot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from worlds import BALL_BODY, BOT, Workspace, mjcf, write_obj

from urlab_client.server.compile.scene import CompiledScene, compile_scene
from urlab_client.server.refusal import CompileFailed

CRAB = """
<mujoco model="crab"><asset><mesh name="claw" file="claw.obj"/></asset>
  <worldbody><body><joint name="hip"/><geom type="mesh" mesh="claw"/></body></worldbody>
  <actuator><motor joint="hip"/></actuator></mujoco>
"""


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path)


def merged(workspace: Workspace, *options: str) -> CompiledScene:
    for number, option in enumerate(options):
        path = workspace.blueprint(f"m{number}", mjcf(BALL_BODY, head=option))
        workspace.world.spawn_actor(path, location=(2.0 * number, 0.0, 0.0))
    return compile_scene(workspace.world.freeze(), options="merged")


def test_options_of_all_robots_are_merged(workspace: Workspace) -> None:
    scene = merged(
        workspace,
        '<option timestep="0.01" iterations="20" gravity="0 0 -1"><flag contact="disable"/></option>',
        "",
        '<option timestep="0.005" iterations="150" integrator="RK4"><flag energy="enable" gravity="disable"/></option>',
    )
    opt = scene.model.opt
    assert (opt.timestep, opt.iterations, opt.gravity[2]) == (0.005, 150, -1)
    assert opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    flags = mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_GRAVITY
    assert opt.disableflags == sum(map(int, flags))
    assert opt.enableflags == int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    (warning,) = scene.warnings
    assert "(m0: iterations 20, timestep 0.01)" in warning
    assert "smallest timestep" in warning


def test_robots_whose_options_conflict_do_not_compile(workspace: Workspace) -> None:
    with pytest.raises(CompileFailed, match=r"m0 has gravity \(0 0 -1\), m2 has gravity \(0 0 -3\).*--mjcf-options"):
        merged(workspace, '<option gravity="0 0 -1"/>', "", '<option gravity="0 0 -3"/>')


def prop(name: str, **settings: Any) -> dict[str, Any]:
    return {"name": name, "kind": "static_mesh", "mesh": {"shape": "box", "size": [0.1, 0.2, 0.3]}} | settings


def test_a_scene_attaches_a_document_for_each_robot(workspace: Workspace) -> None:
    level = workspace.saved / "Levels" / "props.json"
    write_obj(level.parent / "rock.obj", 1.0)
    rock = prop("rock", mesh={"shape": "file", "file": "rock.obj"}, location=[0, 9, 1], quick_convert={})
    crate = prop("crate", location=[0, 5, 1], quick_convert={})
    level.write_text(json.dumps({"format": "urlab-level", "version": 1, "blueprints": {}, "actors": [crate, rock]}))
    world = workspace.world
    world.levels.load("props")
    write_obj(workspace.models / "claw.obj", 0.1)
    crab, bot = workspace.blueprint("crab", CRAB), workspace.blueprint("bot", BOT)
    world.spawn_actor(crab, location=(1, 2, 3), rotation_quat=(0, 0, 0.6, 0.8))
    world.spawn_light("point", location=(1, 2, 3))
    world.spawn_actor(bot, location=(4, 0, 0))
    world.spawn_actor(crab, location=(7, 0, 0))
    scene = compile_scene(world.freeze(), options="merged")

    text, files = scene.export(attached=True)

    assert {"crab_model.xml", "bot_model.xml", "copy1_crab_model.xml"} <= files.keys()
    assert '<model name="copy1_crab_" file="copy1_crab_model.xml"' in text
    assert '<attach model="copy1_crab_" prefix="copy1_crab_"' in text
    assert len(files) == 5  # the claw is there once, and the rock
    assert all("/" not in name for name in files)
    built = mujoco.MjModel.from_xml_string(text, files)
    for kind in ("body", "jnt", "sensor", "key", "cam", "light"):
        count = getattr(scene.model, f"n{kind}")
        element = {"jnt": "joint", "cam": "camera"}.get(kind, kind)
        ours, theirs = ([getattr(model, element)(i).name for i in range(count)] for model in (built, scene.model))
        assert ours == theirs
    for name in ("body_pos", "body_quat", "body_mass", "qpos0", "key_qpos", "geom_pos"):
        np.testing.assert_allclose(getattr(built, name), getattr(scene.model, name), rtol=1e-4, atol=1e-6, err_msg=name)
    assert (built.nu, built.opt.timestep, built.opt.gravity[2]) == (scene.model.nu, 0.005, -1)


def test_a_scene_with_a_light_that_aims_at_the_world_is_one_document(workspace: Workspace) -> None:
    aims = mjcf(f'<light mode="targetbody" target="world" pos="1 1 3"/>{BALL_BODY}')
    workspace.world.spawn_actor(workspace.blueprint("lamp", aims), location=(1, 0, 0))
    text, files = compile_scene(workspace.world.freeze()).export(attached=True)
    assert "<attach" not in text
    assert mujoco.MjModel.from_xml_string(text, files).nlight == 1
