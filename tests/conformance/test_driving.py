"""Driving robots in direct mode: what a script does, over the wire, in both flavours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client import SessionTakenOver, UnknownName, URLabError
from urlab_client.enums import ControlMode, StepMode
from urlab_client.errors import ModeLocked, NoSession, UnknownKeyframe
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.server import ControllerConfig

MODELS = ["humanoid.xml", "ant.xml", "walker2d_v5.xml", "pusher_v5.xml"]


@pytest.mark.parametrize("model", MODELS)
async def test_physics_is_bitwise_what_mj_step_gives(connect: Any, serve: Any, asset: Any, model: str) -> None:
    substeps = 3 if model == "humanoid.xml" else 1  # until it has fallen
    with serve(asset(model), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        local = mujoco.MjData(client.model)
        mujoco.mj_forward(client.model, local)
        rng = np.random.default_rng(7)
        for _ in range(100):
            # Set-points travel as float32, as in the plugin.
            art.ctrl_array[:] = rng.uniform(-0.4, 0.4, len(art.ctrl_array)).astype(np.float32)
            local.ctrl[:] = art.ctrl_array
            mujoco.mj_step(client.model, local, substeps)
            await client.step(substeps)
        assert np.array_equal(client.data.qpos, local.qpos)
        assert np.array_equal(client.data.qvel, local.qvel)
        assert np.array_equal(client.data.ctrl, local.ctrl)
        assert client.sim_time == local.time
        assert client.step_count == 100 * substeps


async def test_several_substeps_equal_single_ones(connect: Any, serve: Any, asset: Any) -> None:
    with serve(asset("ant.xml"), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (art,) = client.articulations.values()
        art.ctrl_array[:] = 0.25
        await client.step(50)
        together = art.qpos_array
        await client.reset()
        for _ in range(50):
            await client.step()
        assert np.array_equal(art.qpos_array, together)


async def test_two_of_the_same_robot_are_two_robots(connect: Any, serve: Any, asset: Any) -> None:
    with serve(asset("ant.xml"), asset("ant.xml"), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert len(client.articulations) == 2
        first, second = client.articulations.values()
        assert set(first.joints) == set(second.joints)
        assert not {j.id for j in first.joints.values()} & {j.id for j in second.joints.values()}
        first.set_ctrl(dict.fromkeys(first.actuators, 0.5))
        await client.step(20)
        assert np.allclose(first.last_applied_ctrl, 0.5)
        assert np.allclose(second.last_applied_ctrl, 0.0)
        assert not np.array_equal(first.dof_qpos, second.dof_qpos)


async def test_a_robot_beside_free_objects(connect: Any, serve: Any) -> None:
    with serve("arm", "ball", "pallet", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert {art.actor_id for art in client.articulations.values()} == {"arm", "ball", "pallet"}
        assert set(client.entities) == set(client.articulations), "each robot once, not its bodies as well"
        ball = client.articulations_by_id["ball"]
        assert ball.has_free_base
        assert not client.articulations_by_id["arm"].has_free_base
        height = ball.root_pos_w[2]
        await client.step(20)
        assert ball.root_pos_w[2] < height
        assert ball.root_lin_vel_w[2] < 0
        assert np.allclose(ball.projected_gravity_b, [0, 0, -1])
        free = slice(ball.qpos_offset, ball.qpos_offset + 7)
        assert np.array_equal(client.data.qpos[free], ball.qpos_array)


async def test_a_wrench_acts_for_one_step_only(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (ball,) = client.articulations.values()
        weight = float(client.model.body_mass[ball.body_id]) * 9.81
        ball.apply_xfrc(force=(0, 0, weight))
        height = ball.root_pos_w[2]
        await client.step(50)
        assert ball.root_pos_w[2] == pytest.approx(height, abs=1e-6)
        await client.step(50)
        assert ball.root_pos_w[2] < height - 1e-3


async def test_a_wrench_survives_a_failed_step(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (ball,) = client.articulations.values()
        ball.apply_xfrc(force=(0, 0, 2 * 9.81))
        usurper = connect(server)
        await usurper.discover()
        with pytest.raises(SessionTakenOver):
            await client.step()
        await client.discover()
        await client.step(50)
        assert ball.root_lin_vel_w[2] > 0


async def test_state_of_a_root_that_is_not_free(connect: Any, serve: Any, asset: Any) -> None:
    with serve(asset("walker2d_v5.xml"), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (walker,) = client.articulations.values()
        walker.ctrl_array[:] = 0.3
        await client.step(40)
        local = mujoco.MjData(client.model)
        local.qpos[:], local.qvel[:] = client.data.qpos, client.data.qvel
        mujoco.mj_forward(client.model, local)
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(client.model, local, mujoco.mjtObj.mjOBJ_XBODY, walker.body_id, velocity, 0)
        assert np.allclose(walker.root_pos_w, local.xpos[walker.body_id])
        assert np.allclose(walker.root_quat_w, local.xquat[walker.body_id])
        assert np.allclose(walker.root_lin_vel_w, velocity[3:])
        assert np.allclose(walker.root_ang_vel_w, velocity[:3])


async def test_root_frames_of_a_free_base_agree_with_mujoco(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="full")
        (robot,) = client.articulations.values()
        robot.apply_xfrc(force=(40, 25, 10), torque=(3, -4, 5))
        await client.step(30)
        local = mujoco.MjData(client.model)
        local.qpos[:], local.qvel[:] = client.data.qpos, client.data.qvel
        mujoco.mj_forward(client.model, local)
        world, body = np.zeros(6), np.zeros(6)
        mujoco.mj_objectVelocity(client.model, local, mujoco.mjtObj.mjOBJ_XBODY, robot.body_id, world, 0)
        mujoco.mj_objectVelocity(client.model, local, mujoco.mjtObj.mjOBJ_XBODY, robot.body_id, body, 1)
        assert np.allclose(robot.root_lin_vel_w, world[3:])
        assert np.allclose(robot.root_ang_vel_w, world[:3])
        assert np.allclose(robot.root_lin_vel_b, body[3:])
        assert np.allclose(robot.root_ang_vel_b, body[:3])
        rotation = local.xmat[robot.body_id].reshape(3, 3)
        assert np.allclose(robot.projected_gravity_b, rotation.T @ [0, 0, -1])
        assert np.allclose(np.roll(robot.root_quat_xyzw, 1), robot.root_quat_w)


async def test_handles_describe_the_compiled_model(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (arm,) = client.articulations.values()
        model = client.model
        for name, joint in arm.joints.items():
            assert model.joint(joint.id).name == f"{arm.compiled_prefix}_{name}"
            assert joint.qpos_offset == model.jnt_qposadr[joint.id]
            assert arm.qpos_array[joint.qpos_local_offset] == client.data.qpos[joint.qpos_offset]
            assert (joint.range is not None) == bool(model.jnt_limited[joint.id])
        for name, actuator in arm.actuators.items():
            assert model.actuator(actuator.id).name == f"{arm.compiled_prefix}_{name}"
            assert actuator.joint is None or actuator.joint in arm.joints
            assert actuator.type is not None
        await client.step()
        for name, sensor in arm.sensors.items():
            assert sensor.latest.shape == (sensor.dim,), name
        assert set(arm.get_sensors()) == set(arm.sensors)
        for body in arm.bodies.values():
            assert np.allclose(np.linalg.norm(body.xquat), 1)


async def test_set_points_are_partial_and_misspelled_names_are_told(connect: Any, serve: Any, applied: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (arm,) = client.articulations.values()
        one, two, *_ = arm.actuators
        arm.set_ctrl({one: 0.1})
        arm.set_ctrl({f"{arm.prefix}_{two}": 0.2})
        assert (arm.get_ctrl()[one], arm.get_ctrl()[two]) == (0.1, 0.2)
        with pytest.raises(UnknownName, match="has no actuator"):
            arm.set_ctrl({one: 0.3, "elbw": 1.0})
        assert arm.get_ctrl()[one] == 0.1
        assert arm.resolve_actuator("nonsense") is None
        assert arm.resolve_joint(f"{arm.prefix}_{next(iter(arm.joints))}") == next(iter(arm.joints))
        await client.step()
        assert arm.last_applied_ctrl[0] == applied(0.1)
        assert type(arm.ctrl_array + 1) is np.ndarray
        assert isinstance(arm.ctrl_array.sum(), float)


async def test_reset_finds_a_keyframe_by_its_short_name(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (robot,) = client.articulations.values()
        await client.step(100)
        reply = await client.reset(keyframe_name="home", seed=7)
        assert (reply.step, client.step_count, client.reset_seed) == (0, 0, 7)
        key = client.model.key(f"{robot.compiled_prefix}_home")
        assert np.array_equal(client.data.qpos, key.qpos)
        with pytest.raises(UnknownKeyframe, match="Did you mean 'home'\\? Known: 'home'"):
            await client.reset(keyframe_name="homme")


async def test_reset_sets_the_local_data_also_where_replies_do_not_show_it(
    connect: Any, serve: Any, tmp_path: Path
) -> None:
    model = tmp_path / "muscle.xml"
    model.write_text("""<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body></worldbody>
    <actuator><general name="slow" joint="hinge" dyntype="integrator" biastype="affine"/></actuator>
    <keyframe><key name="tense" act=".5"/></keyframe></mujoco>""")
    with serve(str(model), play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        for keyframe, activation in (("tense", 0.5), (None, 0.0)):
            client.data.qfrc_applied[:] = client.data.xfrc_applied[:] = 1.0
            await client.reset(keyframe)
            assert client.data.act.tolist() == [activation]
            assert not client.data.qfrc_applied.any()
            assert not client.data.xfrc_applied.any()
        (robot,) = client.articulations.values()
        robot.ctrl_array[:] = 1.0
        await client.step(10)
        assert client.data.act.tolist() == pytest.approx([10 * client.model.opt.timestep])
        assert client.reset_seed is None


async def test_an_ambiguous_keyframe_is_refused(connect: Any, serve: Any) -> None:
    with serve("quadruped", "quadruped", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        with pytest.raises(UnknownKeyframe, match="could mean"):
            await client.reset(keyframe_name="home")
        one, _ = client.articulations.values()
        await client.reset(keyframe_name=f"{one.prefix}_home")


async def test_reset_overrides_single_joints(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (arm,) = client.articulations.values()
        name = next(iter(arm.joints))
        await client.reset(per_articulation_qpos={arm.prefix: {name: 0.25}}, seed=3)
        assert arm.get_qpos()[name] == 0.25
        with pytest.raises(KeyError, match="has no joint"):
            await client.reset(per_articulation_qpos={arm.prefix: {"nonsense": 0.25}})


async def test_observation_levels(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="minimal")
        (robot,) = client.articulations.values()
        reply = await client.step()
        state = reply.per_articulation[robot.prefix]
        assert (state.ctrl, state.sensors, state.bodies) == (None, None, None)
        reply = await client.step(observations="full")
        state = reply.per_articulation[robot.prefix]
        assert state.bodies is not None
        assert all(actuator.force is not None for actuator in robot.actuators.values())
        reply = await client.step()
        assert reply.per_articulation[robot.prefix].sensors is None, "one step's level must not outlive it"
        reply = await client.step(observations="standard")
        assert reply.per_articulation[robot.prefix].sensors is not None, "a level that is named is not the default"
        with pytest.raises(ValueError, match="everything"):
            await client.step(observations="everything")


async def test_discover_again_keeps_what_the_user_holds(connect: Any, serve: Any, applied: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (arm,) = client.articulations.values()
        actuator = next(iter(arm.actuators.values()))
        actuator.set_control(0.2)
        old_session = client.session_id
        assert (await client.step(3)).step == client.step_count == 3
        await client.discover()
        assert client.session_id != old_session
        assert client.articulations[arm.prefix] == arm
        assert client.step_count == 0, "steps are counted from the handshake on"
        assert (await client.step()).step == client.step_count == 1
        assert arm.last_applied_ctrl[0] == applied(0.2)
        assert actuator.value == 0.2


@pytest.mark.parametrize("on", [True, False])
async def test_options_are_those_of_the_server_in_the_local_model(connect: Any, serve: Any, on: bool) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        opt = client.model.opt
        for switch in (not on, on):
            options = await client.runtime.set_sim_options(
                enable_multiccd=switch, enable_sleep=switch, gravity=(0, 0, -1.5), integrator="rk4"
            )
        assert (opt.disableflags, opt.enableflags) == (options.disableflags, options.enableflags)
        assert bool(opt.disableflags & mujoco.mjtDisableBit.mjDSBL_MULTICCD) is not on
        assert bool(opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP) is on
        assert (opt.gravity.tolist(), opt.integrator) == ([0.0, 0.0, -1.5], mujoco.mjtIntegrator.mjINT_RK4)


async def test_closing_takes_back_the_mode_that_discover_promoted_and_no_other(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:

        async def mode_after(client: Any) -> str:
            await client.close()
            other = connect(server)
            await other.discover()
            return (await other.call(SetMode(mode="live"))).previous_mode

        promoting = connect(server, step_mode="direct")
        await promoting.discover()
        assert await mode_after(promoting) == "live"

        finding = connect(server, step_mode="direct")
        await finding.discover()
        await finding.sim.stop()
        other = connect(server)
        await other.discover()
        await other.sim.start()
        await other.runtime.set_mode("direct")
        await finding.discover()
        assert await mode_after(finding) == "direct", "somebody else's choice"


async def test_a_second_client_takes_over_and_the_first_is_told(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        first, second = connect(server, step_mode="direct"), connect(server, step_mode="direct")
        await first.discover()
        await second.discover()
        with pytest.raises(SessionTakenOver):
            await first.step()
        await second.step()


async def test_without_a_local_model_the_arrays_still_come(connect: Any, serve: Any, applied: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct", local_model=False)
        await client.discover()
        assert client.model is None
        (arm,) = client.articulations.values()
        arm.set_ctrl({next(iter(arm.actuators)): 0.3})
        await client.step(5)
        assert len(arm.qpos_array) == 8
        assert arm.last_applied_ctrl[0] == applied(0.3)
        with pytest.raises(URLabError, match="local_model=True"):
            _ = arm.root_pos_w


async def test_modes_are_promoted_and_taken_back(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        assert client.step_mode is StepMode.DIRECT
        await client.close()
        other = connect(server)
        await other.discover()
        assert await other.runtime.set_mode("puppet") is StepMode.PUPPET
        reply = await other.call(_set_mode("live"))
        assert reply.previous_mode == "puppet"


async def test_closing_reverts_only_its_own_promotion(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.close()
        other = connect(server)
        await other.discover()
        reply = await other.call(_set_mode("live"))
        assert reply.previous_mode == "live"


def _set_mode(mode: str) -> Any:
    from urlab_client.protocol.messages.runtime import SetMode

    return SetMode(mode=mode)


@pytest.mark.parametrize("pinned", [True, False])
@pytest.mark.parametrize("step_mode", ["auto", "direct"])
async def test_the_mode_that_the_server_is_in_already(connect: Any, serve: Any, pinned: bool, step_mode: str) -> None:
    """session-ops.md, sections 6 and 9.6: no op tells the mode, a pinned server refuses to change it, and play starts
    paused."""
    with serve("ball", play=True, step_mode="direct" if pinned else "auto") as server:
        if not pinned:
            before = connect(server, step_mode="direct", auto_promote_step_mode=False)
            await before.discover()
            await before.runtime.set_mode("direct")
        client = connect(server, step_mode=step_mode)
        await client.discover()
        if pinned and step_mode == "auto":
            await client.runtime.set_paused(False)
        reply = await client.step(5)
        assert (reply.step, client.step_count, client.step_mode) == (5, 5, StepMode.DIRECT)
        assert reply.time == pytest.approx(5 * client.model.opt.timestep)
        assert "direct, as " in str(await client.explain())
        assert (await client.step(2)).step == 7
        assert await client.runtime.set_mode("direct") is StepMode.DIRECT


async def test_a_server_that_is_pinned_to_another_mode(connect: Any, serve: Any) -> None:
    with serve("ball", play=True, step_mode="puppet") as server:
        client = connect(server, step_mode="direct")
        with pytest.raises(ModeLocked, match="puppet"):
            await client.discover()
        assert client.step_mode is StepMode.PUPPET
        with pytest.raises(ModeLocked, match="puppet"):
            await client.runtime.set_mode("live")
        assert (await client.step(5)).time == client.data.time == pytest.approx(5 * client.model.opt.timestep)


async def test_auto_follows_a_server_in_puppet_mode(connect: Any, serve: Any) -> None:
    with serve("ball", play=True, step_mode="puppet") as server:
        client = connect(server)
        await client.discover()
        reply = await client.step(5)
        assert client.step_mode is StepMode.PUPPET
        assert reply.time == client.data.time == pytest.approx(5 * client.model.opt.timestep)


async def test_auto_stays_live_where_the_server_is(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server)
        await client.discover()
        for n_steps in (1, 5):
            assert (await client.step(n_steps)).step == client.step_count == 0
            assert client.step_mode is StepMode.LIVE


@pytest.mark.parametrize(("actual", "expected"), [("live", "direct"), ("direct", "live"), ("live", "puppet")])
async def test_a_mode_that_was_not_to_be_changed_is_told_apart(
    connect: Any, serve: Any, actual: str, expected: str
) -> None:
    with serve("ball", play=True, step_mode=actual, unpaused=True) as server:
        client = connect(server, step_mode=expected, auto_promote_step_mode=False)
        await client.discover()
        with pytest.raises(URLabError, match=rf"step mode {actual}, .*not in {expected}.*set_mode\('{expected}'\)"):
            await client.step(5)
        assert client.step_mode == actual
        assert (await client.step(5)).step == (10 if actual == "direct" else 0)


async def test_live_is_asked_for_where_somebody_left_another_mode(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        left = connect(server)
        await left.discover()
        await left.runtime.set_mode("direct")
        client = connect(server, step_mode="live")
        await client.discover()
        assert (await client.step(5)).step == 0


@pytest.mark.parametrize(("mode", "n_steps"), [("direct", 0), ("direct", -1), ("live", 0), ("puppet", -1)])
async def test_fewer_steps_than_there_can_be_are_refused(connect: Any, serve: Any, mode: str, n_steps: int) -> None:
    """simulation.md, section 2.4: the server takes one step where none was asked for."""
    with serve("ball", play=True) as server:
        client = connect(server, step_mode=mode)
        await client.discover()
        with pytest.raises(ValueError, match=rf"^step: n_steps must be at least .* got {n_steps}"):
            await client.step(n_steps)
        assert (await client.runtime.forward()).step == 0


async def test_calls_before_the_handshake_say_so(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server)
        for call in (client.scene.current_level, client.step, client.reset, client.runtime.forward):
            with pytest.raises(NoSession, match=r"^\w+: no session is open\. Call discover\(\) first\.$"):
                await call()
        await client.discover()
        assert (await client.step()).step == 0


async def test_live_mode_hands_over_set_points(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        (arm,) = client.articulations.values()
        arm.set_ctrl({next(iter(arm.actuators)): 0.3})
        reply = await client.step(100)
        assert (reply.time, reply.step) == (0.0, 0), "live physics starts paused and counts nothing"
        assert await client.runtime.set_paused(False) is False


async def test_puppet_mode_pushes_the_local_state(connect: Any, serve: Any, asset: Any) -> None:
    with serve(asset("humanoid.xml"), play=True) as server:
        client = connect(server, step_mode="puppet")
        await client.discover(observations="full")
        (robot,) = client.articulations.values()
        client.data.qpos[2] = 2.5
        reply = await client.step(0)
        assert (reply.time, reply.step) == (0.0, 1)
        assert robot.qpos_array[2] == 2.5
        assert robot.bodies["torso"].xpos[2] == 2.5
        client.data.ctrl[:] = 0.1
        local = mujoco.MjData(client.model)
        local.qpos[:], local.ctrl[:] = client.data.qpos, client.data.ctrl
        mujoco.mj_forward(client.model, local)
        mujoco.mj_step(client.model, local, 25)
        reply = await client.step(25)
        assert reply.time == local.time
        assert np.array_equal(robot.qpos_array, local.qpos)


@pytest.mark.parametrize("mode", ["raw", "ue_controller"])
async def test_control_mode(connect: Any, serve: Any, mode: str) -> None:
    with serve("quadruped", play=True, controllers={"*": ControllerConfig()}) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (robot,) = client.articulations.values()
        assert robot.control_mode is ControlMode.UE_CONTROLLER
        assert robot.controller.kind == "pd"
        robot.control_mode = mode
        robot.ctrl_array[:] = 0.05
        await client.step()
        bypassed = np.allclose(robot.last_applied_ctrl, np.float32(0.05))
        assert bypassed == (mode == "raw")
        with pytest.raises(ValueError, match="autopilot"):
            robot.control_mode = "autopilot"


async def test_gains(connect: Any, serve: Any) -> None:
    from urlab_client.errors import ControllerSchemaViolation

    with serve("quadruped", play=True, controllers={"*": ControllerConfig()}) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (robot,) = client.articulations.values()
        controller = robot.controller
        kp, joint = controller.kp, next(iter(robot.actuators))
        await controller.set_gains(kp={joint: 40.0})
        assert kp[joint] == 40.0
        await controller.set_defaults(kp=60, kv=2, torque_limit=30)
        assert set(kp.values()) == {60.0}
        assert controller.params["default_kp"] == 60.0
        with pytest.raises(ControllerSchemaViolation, match="no actuator 'tail'"):
            await controller.set_gains(kp={"tail": 1.0})
        with pytest.raises(ControllerSchemaViolation, match="at least 0"):
            await controller.set_defaults(kp=-1)
        assert (await controller.refresh())["kp"][joint] == 60.0


@pytest.mark.parametrize(("asked", "told"), [(9999, True), (0, True), (33.3, False), (50, False)])
async def test_a_speed_that_the_engine_clamps_is_told(
    connect: Any, serve: Any, asset: Any, caplog: pytest.LogCaptureFixture, asked: float, told: bool
) -> None:
    with serve(asset("ant.xml"), play=True) as server:
        client = connect(server)
        await client.discover()
        in_force = await client.runtime.set_sim_speed(asked)
    assert in_force == pytest.approx(min(max(asked, 5), 100))
    assert ("set_sim_speed" in caplog.text) == told
