"""Session state, clocks, runtime ops and per-kind handles, in both flavours."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client.enums import ActuatorType, CameraMode
from urlab_client.errors import DimMismatch, NotMocapBody, UnknownArticulation, UnknownBody
from urlab_client.server import ControllerConfig

BOT = """
<mujoco model="bot"><compiler angle="radian"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1"/>
  <camera name="overview" pos="0 -3 2"/>
  <body name="base" pos="0 0 .1"><freejoint name="root"/><geom name="ball" size=".1" mass="1"/>
    <body name="arm" pos="0 0 .3"><joint name="swing" type="hinge" axis="0 1 0" range="-1 1" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 .2" size=".02" mass=".1"/>
      <body name="slider"><joint name="slide" type="slide"/><geom size=".02" mass=".05" pos=".1 0 .2"/></body>
    </body></body>
  <body name="target" mocap="true" pos="0 1 1"><geom size=".05" contype="0" conaffinity="0"/></body>
</worldbody><actuator>
  <motor name="swing" joint="swing" ctrlrange="-1 1" ctrllimited="true" forcerange="-2 2" forcelimited="true"/>
  <general name="slide" joint="slide" dyntype="filter" dynprm=".1"/>
</actuator><sensor><framequat name="attitude" objtype="body" objname="base"/></sensor>
<keyframe><key name="home" time="1.5" qpos="0 0 .1 1 0 0 0 .5 0"/></keyframe></mujoco>
"""


@pytest.fixture
def bot(models: Path) -> str:
    path = models / "bot.xml"
    path.write_text(BOT)
    return str(path)


async def test_who_answers(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        assert (client.urlab_version, client.mujoco_version, client.session_id) == ("", "", "")
        await client.discover()
        assert client.urlab_version.startswith("urlab/")
        assert client.mujoco_version == mujoco.mj_versionString()
        assert client.manager_present
        assert not client.model_is_approximate
        assert len(client.global_cameras) == 0
        assert client.transport_stats.received >= 3
        said = repr(getattr(client, "twin", client))
        assert said.endswith(f" connected, direct at 0.000 s: {next(iter(client.articulations))}>")
        sim = repr(getattr(client, "twin", client).sim)
        assert sim.startswith("<SimNamespace tcp://127.0.0.1:")
        assert ", start, " in sim
        assert repr(await client.explain()).startswith("<Diagnosis ")


async def test_clocks(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        before = time.time()
        reply = await client.step(700)
        after = time.time()
        assert client.sim_time == reply.time == client.data.time
        assert abs(client.sim_time_sec + 1e-9 * client.sim_time_nsec - client.sim_time) < 2e-9
        assert client.sim_time_sec == 1
        assert before <= client.wall_time_sec + 1e-9 * client.wall_time_nsec <= after
        assert before <= 1e-9 * client.recv_wall_time_ns <= after + 1
        assert client.step_count == 700
        received = client.recv_wall_time_ns
        await client.reset()
        assert client.recv_wall_time_ns > received


async def test_arrays_follow_the_model(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        art.set_ctrl({"slide": 0.5, "swing": 0.2})
        await client.step(50)
        assert np.array_equal(art.qpos_array, client.data.qpos)
        assert np.array_equal(art.qvel_array, client.data.qvel)
        assert art.dof_qpos.shape == art.dof_qvel.shape == (2,)
        assert np.array_equal(art.dof_qvel, art.qvel_array[6:])
        assert art.act_array[0] == 0.0
        assert art.act_array[1] == pytest.approx(client.data.act[0])
        assert 0 < art.act_array[1] < 0.5
        kept = art.qpos_array
        copy = kept.copy()
        await client.step(10)
        assert np.array_equal(kept, copy), "an array handed out is the user's to keep"
        assert not np.array_equal(art.qpos_array, copy)


async def test_what_a_user_writes_into_arrays_stays_with_the_user(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="full")
        (art,) = client.articulations.values()
        art.set_ctrl({"slide": 0.5, "swing": 0.2})
        reply = await client.step(50)
        names = ("qpos_array", "qvel_array", "dof_qpos", "dof_qvel", "act_array", "last_applied_ctrl")
        names += ("root_pos_w", "root_quat_w", "root_lin_vel_w", "root_ang_vel_b", "projected_gravity_b")
        before = {name: getattr(art, name).tolist() for name in names}
        force = art.actuators["swing"].force
        for name in names:
            getattr(art, name)[:] = 77.0
        (state,) = reply.per_articulation.values()
        for array in (state.qpos, state.qvel, state.ctrl, state.act, state.actuator_force):
            array[:] = 77.0
        assert {name: getattr(art, name).tolist() for name in names} == before
        assert art.actuators["swing"].force == force
        assert art.get_qpos()["slide"] == before["dof_qpos"][1]


async def test_forward_leaves_the_state_of_a_puppets_user_alone(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="puppet")
        await client.discover()
        client.data.qpos[2] = 5.0
        client.data.time = 3.0
        reply = await client.runtime.forward()
        assert reply.time == 0.0
        assert (client.data.qpos[2], client.data.time) == (5.0, 3.0)
        await client.step(0)
        assert (client.data.qpos[2], client.data.time) == (5.0, 3.0)
        assert (await client.runtime.forward()).time == 3.0


MIMO = """
<mujoco model="mimo"><worldbody>
  <body name="base" pos="0 0 1"><joint name="hip" type="hinge"/><geom size=".1" mass="1"/>
    <body name="arm"><joint name="elbow" type="hinge"/><geom size=".1" mass="1"/>
      <body name="hand"><joint name="wrist" type="ball"/><geom size=".1" mass="1" pos="0 0 .2"/></body></body></body>
</worldbody><actuator>
  <pid name="servo" joint="hip" kp="3" kv="1"/>
  <orientation name="wrist" joint="wrist" kp="2"/>
  <motor name="elbow" joint="elbow"/>
</actuator></mujoco>
"""


@pytest.mark.mujoco("3.12")
async def test_forces_of_actuators_with_several_inputs_and_outputs(connect: Any, serve: Any, tmp_path: Path) -> None:
    """Inputs, as in `ctrl`, and outputs, as in `actuator_force`, both in actuator order, are not as many."""
    (tmp_path / "mimo.xml").write_text(MIMO)
    with serve(tmp_path / "mimo.xml", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="full")
        (art,) = client.articulations.values()
        servo, wrist, elbow = art.actuators.values()
        assert [a.ctrl_local for a in (servo, wrist, elbow)] == [slice(0, 2), slice(2, 5), slice(5, 6)]
        servo.set_control([0.25, 0.0])
        servo.set_control(0.5)  # a number is the first input, the others stay
        assert art.ctrl_array[:2].tolist() == [0.5, 0.0]
        with pytest.raises(ValueError, match="takes 3 numbers"):
            wrist.set_control([0.5, 0.0])
        art.set_ctrl({"elbow": 0.25, "servo": 0.5})
        assert art.ctrl_array.tolist() == [0.5, 0.0, 0.0, 0.0, 0.0, 0.25]
        reply = await client.step()
        assert reply.per_articulation["mimo"].actuator_force.tolist() == [1.5, 0.0, 0.0, 0.0, 0.25]
        assert [a.force for a in (servo, wrist, elbow)] == [1.5, 0.0, 0.25]


@pytest.mark.mujoco("3.12")
async def test_forces_without_a_model_are_told_where_it_is_clear_whose_they_are(
    connect: Any, serve: Any, bot: str, tmp_path: Path
) -> None:
    (tmp_path / "mimo.xml").write_text(MIMO)
    with serve(bot, tmp_path / "mimo.xml", play=True) as server:
        client = connect(server, step_mode="direct", local_model=False)
        await client.discover(observations="full")
        simple, mimo = client.articulations["bot"], client.articulations["mimo"]
        simple.set_ctrl({"swing": 0.5})
        await client.step()
        assert simple.actuators["swing"].force == 0.5
        assert [actuator.force for actuator in mimo.actuators.values()] == [None] * 3


async def test_data_have_the_poses_of_the_present_state_when_they_are_read(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        for _ in range(3):
            await client.step(20)
            data = client.data
            expected = mujoco.MjData(client.model)
            expected.qpos, expected.qvel = data.qpos, data.qvel
            mujoco.mj_forward(client.model, expected)
            for name in ("xpos", "xquat", "geom_xpos", "site_xpos", "cam_xpos", "cvel", "subtree_com"):
                assert np.array_equal(getattr(data, name), getattr(expected, name)), name
            assert data.xpos[1:].any()


async def test_handles(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="full")
        (art,) = client.articulations.values()
        assert [joint.jnt_type for joint in art.joints.values()] == [0, 3, 2]
        assert [joint.qvel_local_offset for joint in art.joints.values()] == [0, 6, 7]
        assert [joint.qvel_offset for joint in art.joints.values()] == [0, 6, 7]
        assert art.joints["swing"].range == (-1.0, 1.0)
        swing, slide = art.actuators["swing"], art.actuators["slide"]
        assert (swing.ctrlrange, swing.forcerange) == ((-1.0, 1.0), (-2.0, 2.0))
        assert (slide.ctrlrange, slide.forcerange) == (None, None)
        assert (swing.type, swing.joint, swing.kp, swing.kv) == (ActuatorType.MOTOR, "swing", 1.0, 0.0)
        swing.set_control(5.0)
        await client.step()
        assert art.last_applied_ctrl[0] == 5.0, "the echo is unclamped"
        assert swing.force == 1.0
        assert swing.value == 5.0
        assert art.sensors["attitude"].dim == 4
        camera = art.cameras["overview"]
        assert (camera.mode, camera.resolution, camera.fovy) == (CameraMode.REAL, (640, 480), 45.0)
        assert (camera.dtype, camera.latest_frame, camera.sim_time) == (np.dtype(np.uint8), None, None)


async def test_set_qpos_is_mirrored(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        await client.runtime.set_qpos("bot", [0, 0, 2, 1, 0, 0, 0])
        assert art.root_pos_w[2] == client.data.qpos[2] == 2.0
        await client.runtime.set_qpos(art.prefix, np.array([0, 0, 3, 1, 0, 0, 0, 0.25, 0]), by_name=True)
        assert art.get_qpos()["swing"] == client.data.qpos[7] == 0.25
        reply = await client.runtime.forward()
        assert reply.per_articulation[art.prefix].qpos[2] == 3.0
        assert reply.time == 0.0
        assert np.allclose(art.bodies["base"].xpos, [0, 0, 3])
        with pytest.raises(DimMismatch):
            await client.runtime.set_qpos("bot", [1, 2, 3])
        with pytest.raises(UnknownArticulation):
            await client.runtime.set_qpos("ghost", [0] * 9)


async def test_contacts(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        await client.step(500)
        result = await client.runtime.get_contacts()
        assert result.n_contacts == len(result.contacts) >= 1
        assert not result.truncated
        contact = result.contacts[0]
        assert contact.body2.startswith(f"{art.prefix}_")
        assert np.allclose(contact.normal, [0, 0, 1], atol=1e-6)
        assert contact.force[0] > 0
        none = await client.runtime.get_contacts(body1=contact.body2, body2=contact.body1)
        assert none.n_contacts == 0, "filters are positional"
        one = await client.runtime.get_contacts(geom2=contact.geom2, max_contacts=1)
        assert one.contacts[0].geom2 == contact.geom2


async def test_mocap_keyframes_twist_and_speed(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        body = f"{art.prefix}_target"
        pose = await client.runtime.set_mocap_pose(body, pos=(0, 0, 4))
        assert pose.pos == (0.0, 0.0, 4.0)
        assert (await client.runtime.read_mocap_pose(body)).quat == (1.0, 0.0, 0.0, 0.0)
        with pytest.raises(NotMocapBody):
            await client.runtime.read_mocap_pose(f"{art.prefix}_base")
        with pytest.raises(UnknownBody):
            await client.runtime.read_mocap_pose("ghost")
        (key,) = await client.runtime.list_keyframes()
        assert (key.name, key.time, len(key.qpos)) == (f"{art.compiled_prefix}_home", 1.5, client.model.nq)
        await client.runtime.set_twist(art.prefix, linear=(0.5, 0.25, 9), angular=(9, 9, 1.5))
        await client.step()
        assert art.twist_linear.tolist() == [0.5, 0.25, 0.0]
        assert art.twist_angular.tolist() == [0.0, 0.0, 1.5]
        assert await client.runtime.set_sim_speed(1) == 5.0
        assert await client.runtime.set_sim_speed(250) == 100.0


async def test_looking_around(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, "ball", play=True) as server:
        client = connect(server)
        await client.discover()
        robots = await client.outliner.find_actors(class_filter="AMjArticulation")
        assert {row.actor_id for row in robots} == {"bot", "ball"}
        assert all(row.is_articulation for row in robots)
        assert [row.actor_id for row in await client.outliner.find_actors(name_prefix="ba")] == ["ball"]
        bounds = await client.outliner.get_actor_bounds("ball")
        assert np.allclose(bounds.extents, 0.1)
        assert {b.short_name for b in await client.outliner.list_blueprints()} == {"bot", "ball"}


async def test_the_controller_knows_its_articulation(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True, controllers={"bot": ControllerConfig(kp=7)}) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        assert art.controller.articulation_prefix == art.prefix
        assert art.controller.schema["kp"]["type"] == "per_joint"
        assert dict(art.controller.kp) == {"swing": 7.0, "slide": 7.0}
        assert set(art.controller.torque_limit.values()) == {200.0}
        assert set(art.controller.kv.values()) == {5.0}
        configured = await art.controller.configure(default_kp=9.0)
        assert configured["default_kp"] == 9.0


async def test_state_belongs_together_under_the_lock(connect: Any, serve: Any, bot: str) -> None:
    with serve(bot, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        torn: list[float] = []
        stop = threading.Event()
        twin = getattr(client, "twin", client)

        def watch() -> None:
            while not stop.is_set():
                with twin._data_lock, twin._data_lock:
                    if twin.data.time != twin.sim_time:
                        torn.append(twin.sim_time)

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            for _ in range(40):
                await client.step()
        finally:
            stop.set()
            watcher.join(60)
        assert torn == []


async def test_without_a_local_model_none_is_loaded(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct", local_model=False)
        await client.discover()
        assert (client.model, client.data) == (None, None)
        reply = await client.step()
        (ball,) = client.articulations.values()
        assert ball.qpos_array.tolist() == reply.per_articulation[ball.prefix].qpos.tolist()


async def test_a_step_is_one_request_and_its_state_is_one_instant(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (robot,) = client.articulations.values()
        sent, received = client.transport_stats.sent, client.transport_stats.received
        for _ in range(3):
            reply = await client.step()
            state = reply.per_articulation[robot.prefix]
            assert (client.sim_time, client.step_count, client.data.time) == (reply.time, reply.step, reply.time)
            assert (robot.qpos_array.tolist(), robot.qvel_array.tolist()) == (state.qpos.tolist(), state.qvel.tolist())
            assert client.data.qpos.tolist() == state.qpos.tolist()
            assert {name: list(reading) for name, reading in robot.get_sensors().items()} == state.sensors
        assert (client.transport_stats.sent, client.transport_stats.received) == (sent + 3, received + 3)


async def test_play_that_runs_is_left_alone_by_start(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        time = (await client.step(5)).time
        assert (await client.sim.start()).is_ready
        assert client.sim_time == time
        assert (await client.step()).time > time


@pytest.mark.mujoco("3.11")
async def test_an_actuator_behind_one_of_several_controls_has_its_own_range_and_place(
    connect: Any, serve: Any, tmp_path: Path
) -> None:
    path = tmp_path / "multi.xml"
    path.write_text("""
<mujoco model="multi"><worldbody>
  <body><joint name="turn" type="ball"/><geom size="0.1"/>
    <body pos="1 0 0"><joint name="h"/><geom size="0.1"/></body></body>
</worldbody><actuator>
  <orientation name="o" joint="turn" kp="3"/>
  <motor name="last" joint="h" ctrlrange="-2 3" ctrllimited="true"/>
</actuator></mujoco>""")
    with serve(path, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (robot,) = client.articulations.values()
        assert robot.actuators["last"].ctrlrange == (-2.0, 3.0)
        assert robot.actuators["o"].ctrlrange is None
        robot.set_ctrl({"last": 1.5})
        await client.step()
        assert robot.ctrl_array.tolist() == robot.last_applied_ctrl.tolist() == [0.0, 0.0, 0.0, 1.5]


def known(of: Any) -> list[Any]:
    """Return the state that a client shows: its own, and that of its data."""
    (art,) = of.articulations.values()
    local = [] if of.data is None else [of.data.time, of.data.qpos.tolist()]
    assert of.sim_time == pytest.approx(of.sim_time_sec + of.sim_time_nsec / 1e9)
    return [of.sim_time, art.qpos_array.tolist(), art.qvel_array.tolist(), *local]


async def test_after_each_handshake_the_state_is_the_servers(connect: Any, serve: Any, bot: str, dialect: str) -> None:
    """Also where play went on, or ran long before this client came: a handshake tells of the model alone."""
    with serve(bot, play=True) as server:
        client, late = connect(server, step_mode="direct"), connect(server, step_mode="direct", local_model=False)
        await client.discover()
        begun = known(client)
        await client.step(50)
        ran = known(client)
        await client.sim.start()
        assert (known(client), client.step_count) == (ran, 50), "play went on"
        await late.discover()
        if dialect == "beta":  # publishes in live mode alone: nothing tells before the first reply
            assert (known(late), late.step_count) == ([0.0, [], []], 0)
            await late.runtime.forward()
        assert (known(late), late.step_count) == (ran[:3], 0)
        await late.sim.stop()
        await late.sim.start()
        assert (known(late), late.step_count) == (begun[:3], 0)
        await late.step(50)
        await client.discover()
        assert (known(client), client.step_count) == (ran, 0)


async def test_a_client_that_comes_in_live_mode_sees_the_present_state_at_once(
    connect: Any, serve: Any, bot: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "urlab_client.aio.state.discovery._PERHAPS_S", 10.0
    )  # on a busy machine, a tick may take longer than 0.2 s
    with serve(bot, play=True) as server:
        first = connect(server, step_mode="direct")
        await first.discover()
        await first.step(50)
        ran = known(first)
        await first.runtime.set_paused(True)
        await first.runtime.set_mode("live")
        for options in ({}, {"step_mode": "direct"}, {"step_mode": "puppet"}):
            late = connect(server, live_pictures=False, **options)
            await late.discover()
            assert known(late) == ran
            await late.runtime.set_paused(True)
            await late.runtime.set_mode("live")


async def test_another_model_is_not_shown_in_the_state_of_the_one_before(
    connect: Any, serve: Any, models: Path
) -> None:
    with serve("ball", play=True) as server:
        client, other = connect(server, step_mode="direct"), connect(server, step_mode="direct")
        await client.discover()
        await client.step(50)
        await other.discover()
        await other.sim.stop()
        await other.scene.spawn_actor("/Game/MuJoCoImports/ball", "second", location=(3, 0, 5))
        await other.sim.start()
        await client.discover()
        assert client.sim_time == 0.0
        assert np.array_equal(client.data.qpos, client.model.qpos0)
