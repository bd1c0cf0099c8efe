"""The API reference's own snippets, in both flavours, against the simulated server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import urlab_client
from urlab_client.enums import CameraTiming, ControlMode, StepMode
from urlab_client.server import ControllerConfig

ROBOT = """
<mujoco model="robot"><compiler angle="radian"/><worldbody>
  <body name="torso" pos="0 0 1"><joint name="waist" axis="0 0 1"/><geom size=".1" mass="1"/>
    <camera name="head" pos="0 0 .3" resolution="32 24"/>
    <body name="upper_arm" pos=".2 0 0"><joint name="shoulder" axis="0 1 0" range="-2 2" limited="true"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="5"/></body>
  </body></worldbody>
  <actuator><motor name="waist" joint="waist"/><motor name="shoulder" joint="shoulder"/></actuator>
  <keyframe><key name="home" qpos="0.1 0.2"/></keyframe>
</mujoco>
"""
PALLET = """
<mujoco model="pallet"><worldbody><body name="pallet" pos="2 0 .1"><freejoint name="pallet_free"/>
<geom type="box" size=".4 .3 .05" mass="5"/></body></worldbody></mujoco>
"""


@pytest.fixture
def scene(serve: Any, models: Path) -> Any:
    (models / "robot.xml").write_text(ROBOT)
    (models / "pallet.xml").write_text(PALLET)
    with serve(
        models / "robot.xml", models / "pallet.xml", play=True, controllers={"robot": ControllerConfig()}
    ) as server:
        yield server


async def test_connection(connect: Any, scene: Any) -> None:
    client = connect(scene, step_mode=StepMode.DIRECT, transport="zmq")
    await client.discover(observations="standard")
    await client.close()
    await client.close()


def test_context_manager(scene: Any) -> None:
    with urlab_client.URLabClient(**scene.client_options(), step_mode="direct") as client:
        client.discover()
        assert client.articulations["robot"].prefix == "robot"


async def test_step_and_reset(connect: Any, scene: Any) -> None:
    client = connect(scene, step_mode="direct")
    await client.discover()
    art = client.articulations["robot"]
    reply = await client.step(n_steps=1, include_cameras=False, observations="standard")
    assert reply.step == 1
    await client.reset()
    await client.reset(keyframe_name="home")
    assert art.get_qpos() == {"waist": 0.1, "shoulder": 0.2}
    await client.reset(seed=42)
    await client.reset(per_articulation_qpos={"robot": {"shoulder": 0.3}})
    assert client.data.qpos[art.joints["shoulder"].qpos_offset] == 0.3


async def test_entities(connect: Any, scene: Any) -> None:
    client = connect(scene, step_mode="direct")
    await client.discover()
    pallet = client.entities["pallet"]
    assert pallet.root_pos_w.shape == (3,)
    assert pallet.root_quat_w.shape == (4,)
    assert pallet.has_free_base is True
    assert pallet.free_joint.endswith("pallet_free")
    qpos = np.asarray(client.data.qpos[pallet.qpos_offset : pallet.qpos_offset + 7])
    assert np.array_equal(qpos[:3], pallet.root_pos_w)
    pallet.apply_xfrc(force=(0, 0, 100))
    await client.step(5)
    assert pallet.root_lin_vel_w[2] > 0


async def test_controllers(connect: Any, scene: Any) -> None:
    client = connect(scene, step_mode="direct")
    await client.discover()
    art = client.articulations["robot"]
    await art.controller.set_gains(
        kp={"waist": 300.0, "shoulder": 280.0},
        kv={"waist": 20.0, "shoulder": 18.0},
        torque_limit={"waist": 35.0, "shoulder": 45.0},
    )
    assert dict(art.controller.torque_limit) == {"waist": 35.0, "shoulder": 45.0}
    art.set_ctrl({"shoulder": 0.5})
    await client.step(500)
    assert art.get_qpos()["shoulder"] == pytest.approx(0.5, abs=0.05)
    await art.controller.set_defaults(kp=100, kv=5, torque_limit=200)
    assert set(art.controller.kp.values()) == {100.0}
    art.control_mode = "raw"
    assert art.control_mode is ControlMode.RAW
    assert art.resolve_joint("shoulder") == "shoulder"
    assert art.resolve_actuator("nonsense") is None


@pytest.mark.opengl
async def test_cameras(connect: Any, scene: Any) -> None:
    client = connect(scene, step_mode="direct")
    await client.discover()
    camera = client.articulations["robot"].cameras["head"]
    await client.step(include_cameras={"head": "sync"})
    assert camera.latest_frame.shape == (24, 32, 4)
    assert camera.sim_time == client.sim_time
    await client.step(include_cameras={"robot/head": CameraTiming.LATEST})
    await client.step(include_cameras=True)
    assert camera.delivered


def test_imports_of_the_reference() -> None:
    for name in [
        "URLabAsset",
        "URLabBlueprint",
        "URLabSpawnHandle",
        "URLabLightHandle",
        "PIEStartResult",
        "PIEStatus",
        "PIEState",
        "SimOptions",
        "ActorInfo",
        "BlueprintInfo",
        "RecordingHandle",
        "RecordingSummary",
        "ReplaySession",
        "ReplayStatus",
        "URLabRPCError",
        "URLabVersionMismatch",
        "URLabPIEError",
        "URLabClient",
    ]:
        assert name in urlab_client.__all__
        assert hasattr(urlab_client, name)
