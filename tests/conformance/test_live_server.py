"""Live mode against the simulated server: state and pictures come by themselves, in both flavours."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
import pytest
from waiting import DEADLINE_S


async def test_snapshots_arrive_and_the_robot_follows(connect: Any, serve: Any) -> None:
    with serve("ball", play=True, unpaused=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        stream = client.state_stream()
        (ball,) = client.articulations.values()
        first = await stream.receive(timeout=10)
        async with asyncio.timeout(DEADLINE_S):
            while (later := await stream.receive(timeout=10)).time < first.time + 0.1:
                pass
        height = ball.root_pos_w[2]
        assert later.seq > first.seq
        assert later.per_articulation[ball.prefix].qpos[2] < first.per_articulation[ball.prefix].qpos[2]
        async with asyncio.timeout(DEADLINE_S):
            while ball.root_pos_w[2] == height:
                await stream.receive(timeout=10)
        assert client.sim_time > 0, "no step was called: the background kept it current"
        with getattr(client, "twin", client)._data_lock:
            assert np.array_equal(client.data.qpos[:3], ball.qpos_array[:3])


async def test_rows_on_demand(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True, unpaused=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        (robot,) = client.articulations.values()
        rows = client.row_stream(robot.prefix, kinds=["joint"])
        seen: dict[str, float] = {}
        async with asyncio.timeout(DEADLINE_S):
            while len(seen) < 12:
                sample = await rows.receive(timeout=10)
                assert sample.owner == robot.prefix
                seen[sample.component] = sample.row.position
        assert set(seen) == set(robot.joints) - {"root"}


async def test_events_tell_the_story(connect: Any, serve: Any) -> None:
    with serve("ball", play=True) as server:
        client = connect(server, step_mode="direct")
        events = client.events()
        await client.discover()
        await client.sim.stop()
        told = [type(await events.receive(timeout=10)).__name__ for _ in range(4)]
        assert told == ["ServerConnected", "SessionOpened", "PlayStarted", "PlayEnded"]


@pytest.mark.opengl
async def test_pictures_by_themselves(connect: Any, serve: Any) -> None:
    with serve("quadruped", play=True, unpaused=True, camera_size=(64, 48)) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        (robot,) = client.articulations.values()
        camera = robot.cameras["head"]
        sample = await camera.frames().receive(timeout=30)
        width, height = camera.resolution
        assert sample.pixels.shape == (height, width, 4)
        assert sample.pixels.std() > 0, "an empty picture"
        assert camera.latest_frame is not None
