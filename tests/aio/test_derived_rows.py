"""Rows and snapshots from a server that publishes whole snapshots alone, and those in live mode only."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_beta import ScriptedBeta
from waiting import DEADLINE_S, pass_time

from urlab_client import RowSample, URLabError, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.protocol.base import DialectName
from urlab_client.protocol.rows import BaseStateRow, JointRow, SensorRow
from urlab_client.server import SimulatedServer

ROVER = """
<mujoco model="rover">
  <worldbody>
    <body name="base" pos="0 0 2">
      <freejoint name="root"/>
      <geom size="0.1"/>
      <body name="wheel">
        <joint name="axle" type="hinge" axis="0 1 0"/>
        <geom size="0.05"/>
        <body name="flag"><joint name="pole" type="slide"/><geom size="0.02"/></body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="axle"/></actuator>
  <sensor><jointpos name="turned" joint="axle"/><framepos name="place" objtype="body" objname="base"/></sensor>
</mujoco>
"""


@pytest.fixture
def rover(tmp_path: Path) -> Path:
    path = tmp_path / "rover.xml"
    path.write_text(ROVER)
    return path


@pytest.fixture
async def served(rover: Path) -> AsyncIterator[SimulatedServer]:
    async with SimulatedServer(rover, rover, play=True, dialect="beta") as server:
        yield server


def values_of(sample: RowSample) -> list[float]:
    match sample.row:
        case JointRow(id=number, position=position, velocity=velocity):
            return [number, position, velocity]
        case BaseStateRow(position=position, quat_xyzw=quat, linear_velocity=linear, angular_velocity=angular):
            return [*position, *quat, *linear, *angular]
        case SensorRow(id=number, values=values):
            return [number, *values]
        case _:
            raise AssertionError(f"a row of an unexpected kind: {sample}")


async def test_rows_are_those_that_an_alpha_publishes(rover: Path) -> None:
    found: dict[str, dict[tuple[str, ...], list[float]]] = {}
    dialects: tuple[DialectName, ...] = ("alpha", "beta")
    for dialect in dialects:
        rows = found[dialect] = {}
        async with (
            SimulatedServer(rover, play=True, dialect=dialect) as server,
            URLabClient(**server.client_options()) as client,
        ):
            await client.discover()  # play begins in live mode and paused, where both publish
            async with client.row_stream("rover", policy="all", timeout=DEADLINE_S) as stream:
                while len(rows) < 5:
                    sample = await anext(stream)
                    rows[sample.kind, sample.owner, sample.component] = values_of(sample)
                    if isinstance(sample.row, JointRow):
                        assert math.isnan(sample.row.acceleration) == (dialect == "beta")
    assert found["beta"].keys() == found["alpha"].keys()
    for key, values in found["alpha"].items():
        np.testing.assert_array_equal(found["beta"][key], values, err_msg=str(key))


async def test_rows_come_with_own_steps(served: SimulatedServer) -> None:
    async with URLabClient(**served.client_options(), step_mode="direct") as client:
        await client.discover()
        one = client.row_stream("copy1_rover", ["joint"], ["axle"], policy="all", timeout=DEADLINE_S)
        every = client.row_stream(kinds=["base_state"], timeout=DEADLINE_S)
        async with one, every:
            robot = client.articulations["copy1_rover"]
            for value in (0.5, -0.5):
                robot.set_ctrl({"drive": value})
                await client.step(5)
                sample = await anext(one)
                while values_of(sample)[1] == 0.0:  # published before the mode changed, and on its way since
                    sample = await one.receive(timeout=DEADLINE_S)
                assert (sample.owner, sample.component) == ("copy1_rover", "axle")
                assert values_of(sample)[1] == np.float32(robot.get_qpos()["axle"])
            assert {(await anext(every)).owner for _ in range(2)} == {"rover", "copy1_rover"}
            await client.reset()
            assert values_of(await anext(one))[1] == 0.0


async def test_rows_that_cannot_be_made(served: SimulatedServer) -> None:
    async with URLabClient(**served.client_options(), local_model=False) as client:
        await client.discover()
        with pytest.raises(URLabError, match="publishes no rows"):
            client.row_stream()


async def test_silence_between_steps_is_no_sign_of_death(served: SimulatedServer) -> None:
    """Beta statement 76."""
    async with URLabClient(**served.client_options(), step_mode="direct") as client:
        await client.discover()
        async with client.state_stream() as states, client.row_stream() as rows:
            first = [asyncio.ensure_future(anext(states)), asyncio.ensure_future(anext(rows))]
            await asyncio.sleep(0)
            pass_time(3600.0)
            await client.step(timeout=None)
            snapshot, row = await asyncio.gather(*first)
            while snapshot.time == 0.0:  # published before the mode changed, and on its way since
                snapshot = await states.receive(timeout=DEADLINE_S)
            assert snapshot.time == client.sim_time
            assert row.owner in {"rover", "copy1_rover"}
            with pytest.raises(URLabTimeoutError, match="state") as caught:
                await states.receive(timeout=0.01)
            assert "only in live mode" in str(caught.value.hint)


async def test_a_snapshot_of_another_world_is_counted(rover: Path) -> None:
    beta = ScriptedBeta()
    try:
        async with URLabClient("tcp://127.0.0.1", step_port=beta.port, step_mode="direct") as client:
            await client.discover()
            answer: Any = beta.answers["reset"]
            async with client.row_stream("arm_a", ["joint"], timeout=DEADLINE_S) as rows:
                beta.on("reset", lambda request: {**answer(request), "arts": {}})
                await client.reset()
                await client.step()
                assert (await anext(rows)).component == "j"
                assert rows.stats.received == 1
    finally:
        beta.close()
