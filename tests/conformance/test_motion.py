"""Describing robots, letting time pass and moving joints: alike in every step mode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from waiting import DEADLINE_S

from urlab_client import URLabTimeoutError
from urlab_client.enums import ControllerKind
from urlab_client.errors import NotSettled
from urlab_client.server import ControllerConfig
from urlab_client.values.descriptions import SceneDescription

# One joint of each kind. The servo of the hinge has a gear, that of the slide a gain that differs from its bias.
MODEL = """
<mujoco model="kinds">
  <option timestep="0.002" gravity="0 0 0"/>
  <default><geom size="0.05" mass="0.2"/><joint damping="1"/></default>
  <worldbody>
    <body name="trunk"><freejoint name="root"/><geom size="0.1" mass="5"/>
      <site name="imu"/><camera name="eye" fovy="50"/>
      <body name="upper"><joint name="shoulder" type="ball"/><geom pos="0 0 0.2"/></body>
      <body name="lower"><joint name="knee" range="-60 60" armature="0.1"/><geom/></body>
      <body name="rail"><joint name="slider" type="slide" damping="20"/><geom mass="0.5"/></body>
    </body>
  </worldbody>
  <actuator>
    <position name="knee" joint="knee" kp="40" kv="4" gear="2" ctrlrange="-2 2"/>
    <general name="slider" joint="slider" biastype="affine" gainprm="100" biasprm="0 -200 -10"/>
    <motor name="push" joint="slider" ctrlrange="-1 1" forcerange="-3 3"/>
  </actuator>
  <sensor><jointpos name="knee_angle" joint="knee"/><jointvel name="slide_speed" joint="slider"/>
    <actuatorfrc name="knee_torque" actuator="knee"/><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def model(models: Path) -> Path:
    file = models / "kinds.xml"
    file.write_text(MODEL)
    return file


@pytest.fixture
def server(serve: Any, model: Path) -> Any:
    with serve(model, play=True) as server:
        yield server


@pytest.fixture(params=["direct", "puppet", "live"])
async def moving(request: pytest.FixtureRequest, connect: Any, server: Any) -> Any:
    """A client of each step mode whose simulation can go on."""
    client = connect(server, step_mode=request.param)
    await client.discover()
    if request.param == "live":
        await client.runtime.set_paused(False)
    return client


async def described(connect: Any, server: Any) -> Any:
    client = connect(server, step_mode="direct")
    await client.discover()
    await client.step(5)
    return client


async def test_a_description_becomes_json_and_back(connect: Any, server: Any) -> None:
    client = await described(connect, server)
    told = client.describe()
    assert msgspec.json.decode(msgspec.json.encode(told), type=SceneDescription) == told
    assert (told.playing, told.step_mode, told.sim_time, told.timestep) == (True, "direct", client.sim_time, 0.002)
    (art,) = client.articulations.values()
    assert told.articulations == [art.describe()]


async def test_joints_say_what_and_where_they_are(connect: Any, server: Any) -> None:
    client = await described(connect, server)
    (art,) = client.articulations.values()
    joints = art.joints
    kinds = {name: (joint.kind, joint.unit) for name, joint in joints.items()}
    assert kinds == {
        "root": ("free", ""),
        "shoulder": ("ball", ""),
        "knee": ("hinge", "rad"),
        "slider": ("slide", "m"),
    }
    assert joints["knee"].limits == pytest.approx((-np.pi / 3, np.pi / 3), rel=1e-5)  # six digits before MuJoCo 3.16
    assert joints["slider"].limits is None
    qpos, qvel = art.qpos_array, art.qvel_array
    told = {joint.name: joint for joint in art.describe().joints}
    for name, positions, velocities in (
        ("root", qpos[:7], qvel[:6]),
        ("shoulder", qpos[7:11], qvel[6:9]),
        ("knee", qpos[11], qvel[9]),
        ("slider", qpos[12], qvel[10]),
    ):
        assert np.array_equal(joints[name].position, positions)
        assert np.array_equal(joints[name].velocity, velocities)
        assert told[name].position == np.asarray(positions).tolist()
        assert told[name].velocity == np.asarray(velocities).tolist()


async def test_actuators_say_what_their_set_points_mean(connect: Any, server: Any) -> None:
    client = await described(connect, server)
    (art,) = client.articulations.values()
    art.set_ctrl({"push": 0.5})
    knee, slider, push = art.describe().actuators
    assert (knee.joint, knee.takes, knee.gear, knee.limits) == ("knee", "position", 2.0, (-2.0, 2.0))
    assert knee.unit == ""  # of the gear's far side
    assert (slider.takes, slider.limits) == ("position", None)
    assert (push.takes, push.unit, push.force_limits, push.set_point) == ("force", "N", (-3.0, 3.0), 0.5)


async def test_under_a_controller_set_points_are_positions(connect: Any, serve: Any, model: Path) -> None:
    with serve(model, play=True, controllers={"kinds": ControllerConfig(kind=ControllerKind.PD)}) as server:
        client = await described(connect, server)
        (art,) = client.articulations.values()
        assert art.describe().controller.in_force
        assert {one.name: (one.takes, one.unit) for one in art.describe().actuators} == {
            "knee": ("position", "rad"),
            "slider": ("position", "m"),
            "push": ("position", "m"),
        }
        art.control_mode = "raw"
        assert art.describe().actuators[2].takes == "force"


async def test_sensors_and_cameras_are_described(connect: Any, server: Any) -> None:
    client = await described(connect, server)
    (art,) = client.articulations.values()
    told = art.describe()
    assert {one.name: (one.kind, one.unit, one.dim) for one in told.sensors} == {
        "knee_angle": ("jointpos", "rad", 1),
        "slide_speed": ("jointvel", "m/s", 1),
        "knee_torque": ("actuatorfrc", "N m", 1),
        "gyro": ("gyro", "rad/s", 3),
    }
    assert told.sensors[0].reading == art.sensors["knee_angle"].latest.tolist()
    assert [(one.name, one.mode, one.fovy) for one in told.cameras] == [("eye", "real", 50.0)]


async def test_without_a_local_model_the_rest_is_described(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="direct", local_model=False)
    await client.discover()
    (told,) = client.describe().articulations
    assert (told.joints, told.sensors, told.pose) == ([], [], None)
    assert [(one.name, one.takes) for one in told.actuators] == [("knee", ""), ("slider", ""), ("push", "")]


async def test_time_passes(moving: Any) -> None:
    before = moving.sim_time
    passed = await moving.run_for(0.1)
    assert passed >= 0.1 - 1e-9
    if str(moving.step_mode) != "live":
        assert moving.sim_time - before == pytest.approx(0.1)


async def test_time_passes_without_a_local_model(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="direct", local_model=False)
    await client.discover()
    await client.run_for(0.1)
    assert client.sim_time == pytest.approx(0.1)


@pytest.mark.parametrize(("mode", "local_model"), [("direct", True), ("direct", False), ("live", True)])
async def test_time_that_passed_before_a_client_came_does_not_count(
    connect: Any, server: Any, mode: str, local_model: bool
) -> None:
    first = connect(server, step_mode="direct")
    await first.discover()
    (art,) = first.articulations.values()
    await art.move_to({"knee": 0.6})
    await first.run_for(1.0)
    await first.close()
    client = connect(server, step_mode=mode, local_model=local_model)
    await client.discover()
    if mode == "live":
        await client.runtime.set_paused(False)
    assert 0.2 - 1e-9 <= await client.run_for(0.2) < 1.0
    if local_model and mode == "direct":
        again = connect(server, step_mode="direct")
        await again.discover()
        assert await again.articulations["kinds"].move_to({"knee": 0.0}) > 0.0, "it was elsewhere"


async def test_a_client_that_comes_between_the_steps_of_another_knows_where_it_begins(
    connect: Any, server: Any
) -> None:
    first, late = connect(server, step_mode="direct"), connect(server, step_mode="direct")
    await first.discover()
    await first.articulations["kinds"].move_to({"knee": 0.6})
    await first.run_for(1.0)
    await late.discover()
    seen: list[float] = []
    knee = late.articulations["kinds"].joints["knee"]
    assert await late.wait_until(lambda: seen.append(knee.position) or True) == 0.0
    assert seen == [first.articulations["kinds"].joints["knee"].position]
    assert await late.run_for(0.2) == pytest.approx(0.2)


async def test_waiting_ends_when_it_is_so(moving: Any) -> None:
    (art,) = moving.articulations.values()
    art.set_ctrl({"push": 1.0})
    slider = art.joints["slider"]
    await moving.wait_until(lambda: slider.position > 0.001)
    assert slider.position > 0.001
    assert await moving.wait_until(lambda: True) == 0.0


async def test_waiting_in_vain_ends(moving: Any) -> None:
    before = moving.sim_time
    with pytest.raises(URLabTimeoutError, match=r"did not hold within 0\.05 s of simulation time"):
        await moving.wait_until(lambda: False, timeout=0.05)
    assert moving.sim_time - before >= 0.05 - 1e-9 or str(moving.step_mode) == "live"


async def test_joints_go_where_they_are_sent(moving: Any) -> None:
    (art,) = moving.articulations.values()
    await art.move_to({"knee": 0.6, "slider": -0.1}, tolerance=0.01)
    assert art.joints["knee"].position == pytest.approx(0.6, abs=0.011)
    assert art.joints["slider"].position == pytest.approx(-0.1, abs=0.011)


async def test_joints_that_do_not_arrive_are_named(connect: Any, server: Any) -> None:
    client = await described(connect, server)
    (art,) = client.articulations.values()
    with pytest.raises(NotSettled, match="Still moving: 'knee'"):
        await art.move_to({"knee": 0.05}, timeout=0.02)
    assert 0.1 < art.joints["knee"].velocity < 0.8
    with pytest.raises(NotSettled, match=r"'knee' is .* rad away") as caught:
        await art.move_to({"knee": 1.0}, timeout=0.02)
    assert caught.value.remaining == {"knee": pytest.approx(1.0 - art.joints["knee"].position)}
    assert "Still moving: 'knee'" in str(caught.value)


@pytest.mark.parametrize(
    ("targets", "error", "problem"),
    [
        ({"knee": 0.2, "slider": float("nan")}, ValueError, "'slider' of 'kinds' takes a finite number, got nan"),
        ({"knee": 0.2, "hip": 0.1}, KeyError, "hip"),
        ({"knee": 0.2, "push": 0.1}, KeyError, "'push' is an actuator, which moves the joint"),
        ({"slider": 0.1, "knee": 1.2}, ValueError, "'knee' of 'kinds' takes -1.0472 to 1.0472 rad, got 1.2"),
        ({"knee": 0.2, "shoulder": 0.1}, ValueError, "'shoulder' of 'kinds' is a ball joint"),
    ],
)
async def test_bad_targets_leave_all_set_points(
    connect: Any, server: Any, targets: dict[str, float], error: type[Exception], problem: str
) -> None:
    client = await described(connect, server)
    (art,) = client.articulations.values()
    with pytest.raises(error, match=problem):
        await art.move_to(targets)
    assert not art.ctrl_array.any()


async def test_a_joint_that_nothing_holds_is_refused(connect: Any, serve: Any, asset: Any) -> None:
    with serve(asset("ant.xml"), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        with pytest.raises(ValueError, match=r"'hip_4' of 'ant' has no position servo: '.*' takes force"):
            await art.move_to({"hip_4": 0.1})


async def test_time_that_stands_still_is_an_error_that_says_why(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="live", rcv_timeout_ms=500)
    await client.discover(timeout=DEADLINE_S)
    await client.runtime.set_paused(True, timeout=DEADLINE_S)
    with pytest.raises(URLabTimeoutError, match=r"stood still .* paused"):
        await client.run_for(1.0)


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
async def test_times_are_finite_and_not_negative(connect: Any, server: Any, seconds: float) -> None:
    client = await described(connect, server)
    before = client.sim_time
    with pytest.raises(ValueError, match="run_for takes"):
        await client.run_for(seconds)
    assert client.sim_time == before


async def test_predicates_answer_at_once(connect: Any, server: Any) -> None:
    async def later() -> bool:
        return True

    client = await described(connect, server)
    with pytest.raises(TypeError, match="not a coroutine function"):
        await client.wait_until(later)
