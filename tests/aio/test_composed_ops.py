"""What takes several requests is not disturbed by other tasks of the same client."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from itertools import pairwise

import pytest
from waiting import until
from wire_log import WireLog

from urlab_client import URLabAsset, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer


@pytest.fixture
async def client() -> AsyncIterator[URLabClient]:
    async with (
        SimulatedServer("ball", play=True, dialect="beta") as server,
        URLabClient(**server.client_options(), step_mode="direct") as made,
    ):
        await made.discover()
        yield made


ASSETS = [URLabAsset(xml="ball", actor_id=f"ball{i}", location=(i, 0, 1)) for i in range(2)]


async def test_nothing_comes_between_the_parts_of_a_scene(client: URLabClient) -> None:
    await client.sim.stop()
    log = WireLog(client)
    await asyncio.gather(
        client.scene.apply_scene("lab", ASSETS),
        client.scene.create_level("other"),
        client.scene.current_level(),
    )
    changes = [(r["op"], r.get("name")) for r in log.requests if r["op"] not in ("op_status", "current_level")]
    assert changes[0] == ("create_level", "lab")
    assert changes[-2:] == [("save_level", None), ("create_level", "other")]


async def test_a_change_waits_for_a_scene_as_long_as_it_may(client: URLabClient) -> None:
    await client.sim.stop()

    log = WireLog(client)
    applying = asyncio.create_task(client.scene.apply_scene("lab", ASSETS))
    await until(lambda: log.of("create_level"))
    with pytest.raises(URLabTimeoutError, match="create_level: another call held"):
        await client.scene.create_level("third", timeout=0.0)
    await applying
    assert [r["name"] for r in log.of("create_level")] == ["lab"]


async def test_two_replays_do_not_start_each_others_sessions(client: URLabClient) -> None:
    names = []
    for name in ("one", "two"):
        await client.recording.start()
        await client.step()
        await client.recording.stop()
        names.append((await client.recording.save(f"{name}.json")).name)
        await client.recording.clear()
    log = WireLog(client)
    played = await asyncio.gather(*(client.replay.play(name) for name in names))
    started = [r["reply"]["active_session"] for r in log.of("replay_start")]
    assert started == [session.name for session in played]
    assert len(set(started)) == 2
    ops = [r["op"] for r in log.requests]
    assert ("replay_load", "replay_start") in pairwise(ops)
    assert ("replay_load", "replay_load") not in pairwise(ops)


@pytest.mark.parametrize("mode", ["direct", "live"])
async def test_a_reset_meanwhile_does_not_prolong_what_waits_for_simulation_time(mode: str) -> None:
    async with (
        SimulatedServer("ball", play=True) as server,
        URLabClient(**server.client_options(), step_mode=mode) as client,
    ):
        await client.discover()
        if mode == "live":
            await client.runtime.set_paused(False)
        await client.run_for(1.0)
        began, resets = client.sim_time, list[asyncio.Task[object]]()

        def reset_on_the_way() -> bool:
            if not resets and client.sim_time > began + 0.1:
                resets.append(asyncio.create_task(client.reset()))
            return False

        with pytest.raises(URLabTimeoutError, match=r"within 0\.3 s of simulation time"):
            await client.wait_until(reset_on_the_way, timeout=0.3)
        await resets[0]
        assert client.sim_time < 0.9, "it waited for the time of before the reset"
