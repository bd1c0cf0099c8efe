from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

import urlab_client
from urlab_client.server.assets.bundled_robots import bundled_models
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.compile.scene import CompiledScene, compile_scene
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.editor.world import EditorWorld

Place = tuple[str, tuple[float, float, float]]


@pytest.fixture
def scene_of(tmp_path: Path) -> Callable[..., CompiledScene]:
    """Compile bundled models placed at locations."""

    def build(*placed: Place) -> CompiledScene:
        world = EditorWorld(ContentRoot(tmp_path))
        for name, location in placed:
            world.spawn_actor(world.blueprints.import_xml(name)[0].class_path, location=location)
        return compile_scene(world.freeze())

    return build


def run(scene: CompiledScene, seconds: float, control: Callable[[], None] = lambda: None) -> None:
    steps = round(seconds / scene.model.opt.timestep)
    for _ in range(steps):
        control()
        mujoco.mj_step(scene.model, scene.data)
    assert not any(warning.number for warning in scene.data.warning), "the simulation became unstable"
    assert np.isfinite(scene.data.qpos).all()


def hold(scene: CompiledScene, index: ArticulationIndex) -> None:
    """Write what the server's PD controller would for set-points of zero, with its default gains."""
    position, velocity = scene.data.qpos[index.qpos_adr[7:]], scene.data.qvel[index.qvel_adr[6:]]
    scene.data.ctrl[index.ctrl_adr] = np.clip(-100.0 * position - 5.0 * velocity, -200.0, 200.0)


def tilt(scene: CompiledScene, body: int) -> float:
    """Angle between a body's z axis and the world's, degrees."""
    return float(np.degrees(np.arccos(np.clip(scene.data.xmat[body].reshape(3, 3)[2, 2], -1.0, 1.0))))


def test_the_models_are_found_by_name() -> None:
    models = bundled_models()

    assert sorted(models) == ["arm", "ball", "block", "floor", "pallet", "quadruped"]
    for name, path in models.items():
        assert mujoco.MjSpec.from_file(str(path)).modelname == name


def test_the_models_are_packaged() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())

    assert project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"] == ["src/urlab_client", "src/pytest_urlab"]
    assert all(path.is_relative_to(Path(urlab_client.__file__).parent) for path in bundled_models().values())


@pytest.mark.parametrize("name", sorted(bundled_models()))
def test_a_model_compiles_without_a_word_of_warning(scene_of: Callable[..., CompiledScene], name: str) -> None:
    scene = scene_of((name, (0.0, 0.0, 0.0)))

    assert scene.warnings == ()
    run(scene, 0.2)


def test_the_quadruped_has_what_a_robot_needs(scene_of: Callable[..., CompiledScene]) -> None:
    scene = scene_of(("quadruped", (0.0, 0.0, 0.0)))
    (index,) = scene.articulations

    assert index.key == "quadruped"
    assert len(index.actuator_names) == 12
    assert set(index.actuator_types.values()) == {"motor"}
    assert index.joint_names[0] == "root"
    assert set(index.joint_names[1:]) == set(index.actuator_names)
    assert scene.model.jnt_limited[index.joints[1:]].all()
    assert index.sensor_names == ("imu_accelerometer", "imu_gyro", "imu_orientation")
    assert "head" in [camera.name for camera in index.cameras]
    assert 8.0 < scene.model.body_mass.sum() < 20.0


@pytest.mark.parametrize("start", ["reset", "home"])
def test_the_quadruped_stands_for_five_seconds(scene_of: Callable[..., CompiledScene], start: str) -> None:
    scene = scene_of(("quadruped", (0.0, 0.0, 0.0)))
    (index,) = scene.articulations
    if start == "home":
        mujoco.mj_resetDataKeyframe(scene.model, scene.data, scene.model.key("quadruped_home").id)
    height = scene.data.qpos[2]

    run(scene, 5.0, lambda: hold(scene, index))

    assert scene.data.qpos[2] == pytest.approx(height, abs=0.02)
    assert np.linalg.norm(scene.data.qpos[:2]) < 0.05
    assert tilt(scene, index.root_body) < 3.0
    assert np.abs(scene.data.qvel).max() < 0.01
    accelerometer = scene.data.sensor("quadruped_imu_accelerometer").data
    np.testing.assert_allclose(accelerometer, [0, 0, 9.81], atol=0.5)


def test_without_torque_the_quadruped_lies_down_on_its_floor(scene_of: Callable[..., CompiledScene]) -> None:
    scene = scene_of(("quadruped", (0.0, 0.0, 0.0)))

    run(scene, 3.0)

    assert 0.03 < scene.data.qpos[2] < 0.25


def test_two_quadrupeds_and_a_ball_share_the_ground(scene_of: Callable[..., CompiledScene]) -> None:
    scene = scene_of(
        ("quadruped", (0.0, 0.0, 0.0)),
        ("quadruped", (0.3, 1.0, 0.0)),
        ("ball", (1.0, 0.0, 0.2)),
        ("pallet", (-2.0, 0.0, 0.05)),
    )
    first, second, ball, pallet = scene.articulations

    def control() -> None:
        hold(scene, first)
        hold(scene, second)

    run(scene, 2.0, control)

    heights = [float(scene.data.xpos[index.root_body][2]) for index in (first, second, ball, pallet)]
    assert heights[0] == pytest.approx(heights[1], abs=1e-3)
    assert heights[0] > 0.28
    assert heights[2] == pytest.approx(0.1, abs=2e-3)
    assert heights[3] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(
    "target",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.8, 0.4, -0.5, 0.6, -0.4, 1.0),
        (-1.5, -0.6, 0.7, -1.0, 0.7, -2.0),
    ],
)
def test_the_arm_reaches_its_targets(scene_of: Callable[..., CompiledScene], target: tuple[float, ...]) -> None:
    scene = scene_of(("arm", (0.0, 0.0, 0.0)))
    (index,) = scene.articulations
    assert index.actuator_names[-1] == "gripper"
    assert set(index.actuator_types.values()) == {"position"}

    scene.data.ctrl[index.ctrl_adr] = [*target, 0.03]
    run(scene, 2.5)

    np.testing.assert_allclose(scene.data.qpos[index.qpos_adr[:6]], target, atol=0.01)
    np.testing.assert_allclose(scene.data.qpos[index.qpos_adr[6:]], 0.03, atol=0.002)


def test_the_arm_points_its_gripper_and_camera_down_when_at_rest(scene_of: Callable[..., CompiledScene]) -> None:
    scene = scene_of(("arm", (0.0, 0.0, 0.0)))
    mujoco.mj_resetDataKeyframe(scene.model, scene.data, scene.model.key("arm_home").id)
    run(scene, 1.0)

    grip, hand = scene.data.site("arm_grip").xpos, scene.data.body("arm_hand").xpos
    camera = next(camera for camera in scene.articulations[0].cameras if camera.name == "wrist")
    look = -scene.data.cam_xmat[camera.id].reshape(3, 3)[:, 2]
    assert grip[2] < hand[2] - 0.05
    np.testing.assert_allclose(grip[:2], hand[:2], atol=1e-3)
    assert look[2] < -0.9
    assert scene.data.qpos[-1] == pytest.approx(0.04, abs=1e-3)


def test_the_gripper_holds_what_it_grips(tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_file(str(bundled_models()["arm"]))
    cube = spec.worldbody.add_body(name="cube", pos=[0.44, 0, 0.464])
    cube.add_freejoint()
    cube.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.015, 0.015, 0.015], mass=0.1)
    model = spec.compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(model)
    data.qpos[6:8] = 0.016

    mujoco.mj_step(model, data, 1000)

    assert np.linalg.norm(data.body("cube").xpos - data.site("grip").xpos) < 0.01
