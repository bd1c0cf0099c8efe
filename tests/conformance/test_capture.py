"""Pictures without a step: in every mode, of the moment of the call, and nothing else moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from urlab_client import NoActiveManager
from urlab_client.errors import ModeLocked

MODEL = """
<mujoco model="gate">
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <light pos="0 -1 2" dir="0 0.4 -1"/>
    <camera name="near" pos="0 -1.5 0" xyaxes="1 0 0 0 0 1"/>
    <camera name="far" pos="0 -4 0" xyaxes="1 0 0 0 0 1"/>
    <body name="bar"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.1" fromto="0 0 0 0.5 0 0" rgba="1 0.2 0.1 1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="turn" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture
def server(serve: Any, models: Path) -> Any:
    file = models / "gate.xml"
    file.write_text(MODEL)
    with serve(file, play=True, camera_size=(32, 24), camera_modes={"gate/far": "depth"}) as server:
        yield server


def moved(first: Any, second: Any) -> bool:
    """Whether two pictures differ by more than what rendering twice may."""
    return bool((np.abs(first.astype(float) - second.astype(float)) > 0.2 * float(np.ptp(first))).any())


@pytest.mark.opengl
@pytest.mark.parametrize("mode", ["direct", "puppet"])
async def test_a_picture_costs_no_step(connect: Any, server: Any, mode: str) -> None:
    client = connect(server, step_mode=mode)
    await client.discover()
    gate = client.articulations["gate"]
    near = gate.cameras["near"]
    before = await near.capture()
    gate.ctrl_array[:] = 1.0
    await client.step(100, include_cameras={"near": "sync"})
    shown, count, at = near.latest_frame, client.step_count, client.sim_time
    after = await near.capture()
    assert moved(before.pixels, after.pixels)
    assert not moved(shown, after.pixels)
    assert (after.camera, after.mode, after.pixels.shape) == ("near", "real", (24, 32, 4))
    assert after.sim_time == pytest.approx(at)
    assert near.latest_frame is after.pixels
    assert (client.step_mode, client.step_count) == (mode, count)
    assert (await client.runtime.forward()).time == pytest.approx(at)
    assert (await client.step()).time == pytest.approx(at + 0.002)


@pytest.mark.opengl
async def test_in_live_mode_time_goes_on_or_rests_as_before(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="live")
    await client.discover()
    await client.runtime.set_control_source("zmq")
    near = client.articulations["gate"].cameras["near"]
    first = await near.capture()
    assert (await client.runtime.forward()).time == 0.0, "it is paused, and stays so"
    client.articulations["gate"].ctrl_array[:] = 1.0
    await client.step()
    await client.runtime.set_paused(False)
    await client.wait_until(lambda: client.sim_time > 0.4)
    second = await near.capture()
    assert moved(first.pixels, second.pixels)
    now = (await client.runtime.forward()).time
    await client.wait_until(lambda: client.sim_time > now)


@pytest.mark.opengl
async def test_several_at_once_show_one_moment(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="direct")
    await client.discover()
    await client.step(10)
    pictures = await client.capture()
    assert {name: (p.mode, p.pixels.dtype) for name, p in pictures.items()} == {
        "near": ("real", np.uint8),
        "far": ("depth", np.float32),
    }
    assert [p.sim_time for p in pictures.values()] == [pytest.approx(client.sim_time)] * 2
    assert list(await client.capture(["gate/far"])) == ["gate/far"]
    assert await client.capture([]) == {}
    with pytest.raises(KeyError, match="nowhere"):
        await client.capture(["near", "nowhere"])
    with pytest.raises(TypeError, match=r"client\.camera\('near'\)\.capture\(\)"):
        await client.capture("near")


@pytest.mark.opengl
async def test_a_pause_that_the_user_set_outlasts_it(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="direct")
    await client.discover()
    await client.runtime.set_paused(True)
    await client.camera("near").capture()
    await client.runtime.set_mode("live")
    assert "paused" in str(await client.explain())


async def test_what_stands_in_the_way_is_said(connect: Any, server: Any) -> None:
    client = connect(server, step_mode="direct")
    await client.discover()
    near = client.camera("near")
    await client.sim.stop()
    with pytest.raises(NoActiveManager):
        await near.capture()


async def test_a_pinned_mode_is_left_alone(connect: Any, serve: Any, models: Path) -> None:
    file = models / "gate.xml"
    file.write_text(MODEL)
    with serve(file, play=True, camera_size=(32, 24), step_mode="direct") as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.step()
        with pytest.raises(ModeLocked, match="include_cameras"):
            await client.camera("near").capture()
        assert (await client.step()).step == 2


@pytest.mark.opengl
async def test_a_live_step_brings_pictures_where_the_server_sends_them(connect: Any, serve: Any, dialect: str) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        one = await client.step(include_cameras={"wrist": "latest"})
        every = await client.step(include_cameras=True)
    if dialect == "alpha":  # its steps bring pictures in direct mode only
        assert not one.cameras
        assert not every.cameras
    else:
        assert set(one.cameras) == {"wrist"}
        assert set(every.cameras) == {"wrist", "overview"}
        assert one.cameras["wrist"].data
