"""NaN, infinities, None and values out of range: refused before anything is sent, by name, in both flavours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from urlab_client.aio.client_types import Verdict
from urlab_client.enums import ControlMode, OutOfRange
from urlab_client.server import ControllerConfig, SimulatedServer

BOT = """
<mujoco model="bot"><compiler angle="radian"/><worldbody>
  <body name="base" pos="0 0 1"><freejoint name="root"/><geom size=".1" mass="1"/>
    <body name="arm" pos="0 0 .3"><joint name="hinge" type="hinge" range="-1.5 1.5" limited="true"/>
      <geom size=".05" mass=".1" pos="0 0 .2"/>
      <body name="hand"><joint name="slide" type="slide"/><geom size=".02" mass=".05" pos=".1 0 .2"/></body>
    </body></body>
  <body name="target" mocap="true" pos="0 1 1"><geom size=".05" contype="0" conaffinity="0"/></body>
</worldbody><actuator>
  <motor name="swing" joint="hinge" ctrlrange="-2 2" ctrllimited="true"/>
  <motor name="free" joint="slide"/>
  <position name="servo" joint="slide" kp="3" kv="1"/>
</actuator></mujoco>
"""
NAN, INF = math.nan, math.inf


@pytest.fixture
def server(serve: Any, models: Path) -> Any:
    path = models / "bot.xml"
    path.write_text(BOT)
    with serve(path, play=True, controllers={"bot": ControllerConfig()}) as running:
        yield running


@pytest.fixture
async def client(connect: Any, server: SimulatedServer) -> Any:
    made = connect(server, step_mode="direct")
    await made.discover(observations="full")
    await made.reset()
    made.articulations["bot"].control_mode = "raw"
    return made


@pytest.mark.parametrize(
    ("value", "error", "problem"),
    [
        (NAN, ValueError, "actuator 'swing' of 'bot' takes a finite number, got nan"),
        (-INF, ValueError, "takes a finite number, got -inf"),
        (np.float32("nan"), ValueError, "takes a finite number, got nan"),
        ([NAN], ValueError, "takes finite numbers, got nan at index 0"),
        (None, TypeError, "actuator 'swing' of 'bot' takes a number, got None"),
        ("fast", TypeError, "takes numbers, got"),
        ([None], TypeError, r"takes numbers, got \[None\]"),
    ],
)
async def test_set_points_are_numbers(client: Any, value: Any, error: type[Exception], problem: str) -> None:
    bot = client.articulations["bot"]
    bot.set_ctrl({"swing": 0.5, "free": 0.25})
    with pytest.raises(error, match=problem):
        bot.actuators["swing"].set_control(value)
    with pytest.raises(error, match=problem):
        bot.set_ctrl({"free": 7.0, "swing": value})
    assert bot.get_ctrl() == {"swing": 0.5, "free": 0.25, "servo": 0.0}, "all or none"


async def test_assigned_arrays_are_numbers(client: Any) -> None:
    bot = client.articulations["bot"]
    bot.ctrl_array = [1, 2, 3]
    for values, error in (([0, NAN, 0], ValueError), ([0, None, 0], TypeError), ([0, 0], ValueError)):
        with pytest.raises(error):
            bot.ctrl_array = values
    assert bot.ctrl_array.tolist() == [1, 2, 3]


@pytest.mark.parametrize("mode", ["direct", "live", "puppet"])
async def test_what_was_written_in_place_is_looked_at_before_it_is_sent(client: Any, mode: str) -> None:
    await client.runtime.set_mode(mode)
    bot = client.articulations["bot"]
    before = await client.step()
    bot.ctrl_array[:] = [NAN, 0, INF]
    with pytest.raises(ValueError, match=r"are not finite: 'swing' nan, 'servo' inf\. Nothing was"):
        await client.step()
    bot.ctrl_array[:] = 0
    found = await client.resync()
    assert (found.steps_sent, found.session_renewed) == (0, False)
    assert found.step == before.step
    await client.step()


@pytest.mark.mujoco("3.12")
async def test_one_of_several_inputs_is_named_by_its_number(connect: Any, serve: Any, models: Path) -> None:
    path = models / "pid.xml"
    path.write_text(BOT.replace("<position", "<pid"))
    with serve(path, play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        (bot,) = client.articulations.values()
        bot.actuators["servo"].set_control([1.0, 2.0], out_of_range="error")
        assert bot.ctrl_array.tolist() == [0, 0, 1, 2]
        bot.ctrl_array[:] = [NAN, 0, 0, INF]
        with pytest.raises(ValueError, match=r"are not finite: 'swing' nan, 'servo' input 1 inf\. Nothing was"):
            await client.step()


async def test_huge_set_points_are_numbers(client: Any) -> None:
    bot = client.articulations["bot"]
    bot.ctrl_array[:] = 1e308
    steps = client.step_count
    await client.step()
    assert client.step_count == steps + 1
    assert np.abs(bot.last_applied_ctrl).min() > 1e30, "they were applied"
    bot.ctrl_array[:] = 0


async def test_a_push_is_of_numbers(client: Any) -> None:
    await client.runtime.set_mode("puppet")
    bot = client.articulations["bot"]
    at = bot.joints["hinge"].qpos_offset
    client.data.qpos[at] = NAN
    hinge = f"{bot.compiled_prefix}_hinge"
    for n_steps in (0, 1):
        with pytest.raises(ValueError, match=rf"step: data.qpos\[{at}\] of joint '{hinge}' is nan. Nothing was sent"):
            await client.step(n_steps)
    assert math.isnan(client.data.qpos[at]), "MuJoCo would have reset it all"
    client.data.qpos[at] = 0.5
    client.data.qvel[0] = INF
    with pytest.raises(ValueError, match=rf"data.qvel\[0\] of joint '{bot.compiled_prefix}_root' is inf"):
        await client.step(0)
    client.data.qvel[0] = 0
    client.data.time = NAN
    with pytest.raises(ValueError, match=r"data.time is nan"):
        await client.step(0)
    client.data.time = 0.0
    await client.step(0)


async def test_wrenches_are_numbers(client: Any) -> None:
    bot = client.articulations["bot"]
    with pytest.raises(ValueError, match=r"apply_xfrc: force\[1\] takes a finite number, got nan"):
        bot.apply_xfrc("arm", force=(0, NAN, 0))
    with pytest.raises(TypeError, match=r"apply_xfrc: torque\[2\] takes a number, got None"):
        bot.apply_xfrc("arm", torque=(0, 0, None))


async def test_positions_are_numbers(client: Any) -> None:
    before = (await client.runtime.forward()).per_articulation["bot"].qpos
    for value, error in ((NAN, ValueError), (INF, ValueError), (None, TypeError)):
        qpos = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, value, 0.0]
        with pytest.raises(error, match=r"set_qpos: qpos\[7\], joint 'hinge' takes a .*number"):
            await client.runtime.set_qpos("bot", qpos, by_name=True)
        with pytest.raises(error, match=r"reset: joint 'hinge' of 'bot' takes a .*number"):
            await client.reset(per_articulation_qpos={"bot": {"slide": 0.1, "hinge": value}})
    with pytest.raises(ValueError, match=r"set_qpos: qpos\[2\], joint 'root' takes"):
        await client.runtime.set_qpos("bot", [0, 0, NAN, 1, 0, 0, 0], by_name=True)
    assert ((await client.runtime.forward()).per_articulation["bot"].qpos == before).all()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"timestep": 0.0}, "timestep must be a positive number, not 0.0"),
        ({"timestep": -1}, "timestep must be a positive number, not -1"),
        ({"timestep": 1e-60}, "timestep must be a positive number, not 0.0"),
        ({"timestep": NAN}, "timestep must be a positive number, not nan"),
        ({"timestep": INF}, "timestep must be a positive number, not inf"),
        ({"density": 1e300}, "density must not be negative, and be finite: inf is not possible"),
        ({"gravity": (0, 0, NAN)}, "gravity must be three finite numbers, not 0.0, 0.0, nan"),
        ({"impratio": 0}, "impratio must be a positive number"),
        ({"iterations": -1}, "iterations must not be negative: -1 is not possible"),
        ({"iterations": 2**40}, "iterations must be an integer of 32 bits"),
    ],
)
async def test_options_are_values_that_a_simulation_can_have(
    client: Any, options: dict[str, Any], problem: str
) -> None:
    before = client.model.opt.timestep
    with pytest.raises(ValueError, match=f"set_sim_options: {problem}.*Nothing was sent"):
        await client.runtime.set_sim_options(**options)
    assert (await client.runtime.set_sim_options()).timestep == before
    assert math.isfinite((await client.step()).time)


async def test_options_may_be_of_numpy_and_are_of_their_type(client: Any) -> None:
    echo = await client.runtime.set_sim_options(timestep=np.float32(0.001), gravity=np.array([0, 0, -1.0]))
    assert echo.gravity == client.model.opt.gravity.tolist() or echo.gravity == tuple(client.model.opt.gravity)
    with pytest.raises(TypeError, match=r"set_sim_options: Expected `float \| null`, got `str` - at `\$.timestep`"):
        await client.runtime.set_sim_options(timestep="short")
    await client.runtime.set_sim_options(timestep=0.002, gravity=(0, 0, -9.81))


@pytest.mark.parametrize("encoding", ["msgpack", "json"])
async def test_every_other_number_is_finite(connect: Any, server: SimulatedServer, encoding: str) -> None:
    client = connect(server, step_mode="direct", encoding=encoding)
    await client.discover()
    for call in (
        lambda bad: client.runtime.set_twist("bot", linear=(0, bad, 0)),
        lambda bad: client.runtime.set_mocap_pose("bot_target", pos=(0, 0, bad)),
        client.runtime.set_sim_speed,
        lambda bad: client.debug.draw_marker((0, 0, 0), (1, 0, 0), ttl=bad),
        lambda bad: client.viewport.set_camera((bad, 0, 0)),
    ):
        for bad in (NAN, INF):
            with pytest.raises(ValueError, match=rf"\w+: \S+ is {bad}; it takes finite numbers. Nothing was sent"):
                await call(bad)


async def test_infinities_that_mean_no_limit_are_sent(client: Any) -> None:
    controller = client.articulations["bot"].controller
    await controller.set_gains(torque_limit={"swing": INF})
    assert controller.torque_limit["swing"] == INF
    await controller.set_gains(torque_limit={"swing": 200.0})
    await client.recording.start(max_duration_s=INF)
    await client.recording.stop()


async def test_values_out_of_range_are_allowed_unless_told_otherwise(client: Any) -> None:
    bot = client.articulations["bot"]
    swing, free = bot.actuators["swing"], bot.actuators["free"]
    swing.set_control(5.0)
    assert swing.value == 5.0
    with pytest.raises(ValueError, match="actuator 'swing' of 'bot' takes -2 to 2, got -3"):
        swing.set_control(-3, out_of_range="error")
    with pytest.raises(ValueError, match="takes -2 to 2, got 9"):
        bot.set_ctrl({"free": 1.0, "swing": 9}, out_of_range=OutOfRange.ERROR)
    assert bot.get_ctrl() == {"swing": 5.0, "free": 0.0, "servo": 0.0}
    bot.set_ctrl({"swing": -9, "free": 100.0}, out_of_range="clamp")
    assert bot.get_ctrl() == {"swing": -2.0, "free": 100.0, "servo": 0.0}
    free.set_control(1e6, out_of_range="error")
    bot.actuators["servo"].set_control([1.0], out_of_range="error")
    assert bot.ctrl_array.tolist() == [-2.0, 1e6, 1.0]
    with pytest.raises(ValueError, match="'wrap' is not a valid OutOfRange"):
        swing.set_control(0, out_of_range="wrap")


async def test_the_range_of_a_controllers_target_is_that_of_the_joint(client: Any) -> None:
    bot = client.articulations["bot"]
    bot.control_mode = ControlMode.UE_CONTROLLER
    bot.set_ctrl({"swing": 9.0}, out_of_range="clamp")
    assert bot.get_ctrl()["swing"] == 1.5


async def test_without_a_model_no_range_is_known(connect: Any, server: SimulatedServer) -> None:
    client = connect(server, step_mode="direct", local_model=False)
    await client.discover()
    bot = client.articulations["bot"]
    bot.set_ctrl({"swing": 9.0}, out_of_range="error")
    bot.ctrl_array[1] = NAN
    with pytest.raises(ValueError, match="set-points of articulation 'bot' are not finite: 'free' nan"):
        await client.step()


async def test_explain_names_set_points_that_cannot_be_right(client: Any) -> None:
    bot = client.articulations["bot"]
    bot.ctrl_array[:] = [NAN, 0, 0]
    finding = next(f for f in (await client.explain()).findings if f.subject == "bot")
    assert finding.verdict is Verdict.PROBLEM
    assert "not finite, so step() refuses them: 'swing' nan" in finding.text
    bot.ctrl_array[:] = [5, 0, 0]
    await client.step()
    finding = next(f for f in (await client.explain()).findings if f.subject == "bot")
    assert finding.verdict is Verdict.NOTE
    assert "Set-points out of range: 'swing' 5 (-2 to 2); MuJoCo clamps them." in finding.text
    bot.control_mode = "ue_controller"
    finding = next(f for f in (await client.explain()).findings if f.subject == "bot")
    assert "'swing' 5 (-1.5 to 1.5); targets beyond the limits of their joints" in finding.text
