"""Both flavours over the shared memory of a simulated server: the same program, the same state, fewer sockets."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import DEADLINE_S

from urlab_client.protocol.base import DialectName
from urlab_client.server import SimulatedServer


@pytest.fixture
def transport() -> str:
    """Of these tests, unless they say another one."""
    return "shm"


@pytest.fixture
def server(serve: Any) -> Iterator[SimulatedServer]:
    with serve("quadruped", play=True, camera_size=(64, 48)) as server:
        yield server


async def discovered(connect: Any, server: SimulatedServer, **options: Any) -> Any:
    client = connect(server, **({"step_mode": "direct"} | options))
    await client.discover()
    return client


async def test_a_rollout_is_the_same_over_either_transport(connect: Any, server: SimulatedServer) -> None:
    async def rollout(transport: str) -> list[Any]:
        client = await discovered(connect, server, transport=transport)
        await client.reset("quadruped_home")
        robot = client.articulations["quadruped"]
        states = []
        for count in range(40):
            robot.ctrl_array[:] = -80.0 * robot.dof_qpos - 2.0 * robot.dof_qvel
            reply = await client.step(1 + count % 3)
            states.append((reply.step, reply.time, *robot.qpos_array, *np.concatenate([*robot.get_sensors().values()])))
        if transport == "shm":
            assert client.transport_stats.over_shm >= 38
        await client.close()
        return states

    assert await rollout("shm") == await rollout("zmq")


@pytest.mark.opengl
async def test_every_kind_of_op_works_beside_it(connect: Any, server: SimulatedServer) -> None:
    client = await discovered(connect, server, transport="shm")
    await client.step()
    blueprint = await client.scene.import_xml("ball")
    assert await client.outliner.list_actors()
    assert await client.runtime.set_paused(False) is False
    await client.step(include_cameras={"quadruped/head": "sync"})
    assert client.articulations["quadruped"].cameras["head"].latest_frame.shape == (48, 64, 4)
    assert client.step_count == 2
    assert blueprint.class_path
    over_zmq = client.transport_stats.over_zmq
    assert client.transport_stats.over_shm >= 2
    assert any("editor" in reason for reason in over_zmq)


@pytest.mark.opengl
async def test_state_and_pictures_stream_in_live_mode(connect: Any, server: SimulatedServer) -> None:
    client = await discovered(connect, server, transport="shm", step_mode="live")
    await client.runtime.set_paused(False)
    stream = client.state_stream()
    async with asyncio.timeout(DEADLINE_S):
        while (time := (await stream.receive(timeout=10)).time) == 0:
            pass  # of the pause, and still on its way
    times = [time, *[(await stream.receive(timeout=10)).time for _ in range(4)]]
    assert times == sorted(set(times))
    frames = client.articulations["quadruped"].cameras["side"].frames()
    sample = await frames.receive(timeout=10)
    assert sample.pixels.shape == (48, 64, 4)
    assert sample.pixels[..., 3].min() == 255


async def test_a_second_client_goes_on_over_zmq(connect: Any, server: SimulatedServer) -> None:
    first = await discovered(connect, server, transport="shm")
    await first.step()
    await first.step()
    second = await discovered(connect, server, transport="shm")
    await second.step()
    await second.step()
    assert second.transport_stats.over_shm == 0
    assert any("another client" in reason for reason in second.transport_stats.over_zmq)


async def test_a_server_of_ones_own_has_it_too(connect: Any, dialect: DialectName) -> None:
    client = connect(address=f"sim://ball?dialect={dialect}", transport="shm", step_mode="direct")
    await client.discover()
    for _ in range(4):
        await client.step()
    assert client.transport_stats.over_shm >= 2
    assert client.step_count == 4


async def test_a_server_without_it_is_a_clear_error(connect: Any, dialect: DialectName) -> None:
    from urlab_client import URLabConnectionError

    with SimulatedServer("ball", play=True, dialect=dialect) as server:
        client = connect(server, transport="shm")
        with pytest.raises(URLabConnectionError, match="reports no shared-memory directory"):
            await client.discover()


async def test_nothing_stays_in_the_directory(connect: Any, dialect: DialectName, tmp_path: Path) -> None:
    with SimulatedServer("ball", play=True, shm_dir=tmp_path, dialect=dialect) as server:
        client = await discovered(connect, server, transport="shm")
        await client.step()
        await client.step()
        await client.close()
    assert os.listdir(tmp_path) == []
