"""`with` blocks of play and of edits: how they begin, and how they end, also by an exception."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio.to_thread
import pytest

from urlab_client import PIEState, URLabPIEError

BOX = """
<mujoco model="box"><worldbody><body name="box" pos="0 0 1"><freejoint name="root"/>
<geom name="g" type="box" size=".1 .1 .1" mass="1"/></body></worldbody></mujoco>
"""


@asynccontextmanager
async def block(manager: Any) -> AsyncIterator[Any]:
    """Enter and leave a block of either flavour."""
    twin = getattr(manager, "twin", None)
    if twin is None:
        async with manager as value:
            yield value
        return
    value = await anyio.to_thread.run_sync(twin.__enter__)
    try:
        yield value
    except BaseException as error:
        await anyio.to_thread.run_sync(twin.__exit__, type(error), error, error.__traceback__)
        raise
    await anyio.to_thread.run_sync(twin.__exit__, None, None, None)


@pytest.fixture
async def level(connect: Any, serve: Any, tmp_path: Path) -> AsyncIterator[tuple[Any, Any]]:
    """A client whose level can be played, and the blueprint of a box."""
    with serve(model_roots=[tmp_path]) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        await client.scene.create_level("lab")
        await client.scene.ensure_manager()
        file = tmp_path / "box.xml"
        file.write_text(BOX)
        yield client, await client.scene.import_xml(str(file))


async def test_play_lasts_as_long_as_its_block(level: tuple[Any, Any]) -> None:
    client, box = level
    await client.scene.spawn_actor(box, "one")
    async with block(client.sim.playing()) as result:
        assert result.is_ready
        assert (await client.step(10)).step == 10
        async with block(client.sim.playing()):
            assert (await client.step()).step == 11, "it had been started already"
        assert (await client.step()).step == 12, "and goes on"
    assert (await client.sim.status()).state is PIEState.OFF
    with pytest.raises(ZeroDivisionError):
        async with block(client.sim.playing()):
            raise ZeroDivisionError
    assert (await client.sim.status()).state is PIEState.OFF


async def test_play_that_does_not_start_is_stopped(level: tuple[Any, Any]) -> None:
    client, _ = level
    await client.scene.create_level("bare")
    with pytest.raises(URLabPIEError, match="ensure_manager"):
        async with block(client.sim.playing(timeout_s=0.1)):
            raise AssertionError("it was entered")
    assert (await client.sim.status()).state is PIEState.OFF


async def test_many_edits_cost_one_restart(level: tuple[Any, Any]) -> None:
    client, box = level
    async with block(client.scene.edit()):
        await client.scene.spawn_actor(box, "one")
    assert (await client.sim.status()).state is PIEState.OFF, "nothing was playing"
    async with block(client.sim.playing()):
        await client.step(5)
        events = client.events(kinds=["play_started"])
        async with block(client.scene.edit()):
            await client.scene.spawn_actor(box, "two", location=(1, 0, 0))
            async with block(client.scene.edit()):
                await client.scene.set_actor_transform("one", location=(0, 2, 0))
            assert len(client.articulations) == 1
        assert {client.articulations_by_id[name].actor_id for name in ("one", "two")} == {"one", "two"}
        assert (await client.step()).step == 1
        assert events.stats.received == 1


async def test_edits_that_end_in_an_exception_leave_play_alone(level: tuple[Any, Any]) -> None:
    client, box = level
    await client.scene.spawn_actor(box, "one")
    async with block(client.sim.playing()):
        await client.step(5)

        async def fail() -> None:
            async with block(client.scene.edit()):
                await client.scene.spawn_actor(box, "two")
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError) as caught:
            await fail()
        assert "play was not restarted" in caught.value.__notes__[0]
        assert (await client.step()).step == 6
        assert "two" in {actor.actor_id for actor in await client.outliner.list_actors()}
        async with block(client.scene.edit()):
            pass
        assert (await client.step()).step == 1, "the next block brings what was edited then"
        assert len(client.articulations) == 2
