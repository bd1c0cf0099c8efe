"""Where the async client can run: on one event loop of asyncio's, and nowhere else."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
import trio
from plugin_memory import PluginMemory
from shm_clients import shared, shm_clients

from urlab_client import URLabError
from urlab_client.aio import URLabClient

SESSION = "11111111-2222-3333-4444-555555555555"


async def elsewhere(call: Callable[[], Awaitable[object]]) -> None:
    """Await it on another event loop."""

    async def main() -> None:
        await call()

    await asyncio.to_thread(asyncio.run, main())


async def test_a_client_stays_with_its_loop(scripted: Any) -> None:
    async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as client:
        await client.discover()
        with pytest.raises(URLabError, match=r"This client belongs to another event loop\. Create one per loop"):
            await elsewhere(client.discover)


async def test_over_shared_memory_it_does_so_too(scripted: Any, tmp_path: Path) -> None:
    scripted.on(
        "hello",
        scripted.answers["hello"]({})
        | {"manager_present": True, "shm_session_dir": str(tmp_path / SESSION), "session_id": SESSION},
    )
    scripted.on("step", {"op": "step_ok", "time": 0.5, "step": 1.0, "per_articulation": {}})
    memory = PluginMemory(tmp_path / "live", scripted.answers, session_id=SESSION)
    try:
        async with shm_clients(scripted.port) as connect:
            client = await shared(connect())
            await client.step()
            assert client.transport_stats.over_shm == 1
            with pytest.raises(URLabError, match="This client belongs to another event loop"):
                await elsewhere(client.step)
            await client.step()
            assert client.transport_stats.over_shm == 2
    finally:
        memory.close()


@pytest.mark.parametrize("run", [trio.run, lambda main: anyio.run(main, backend="trio")], ids=["trio", "anyio"])
@pytest.mark.parametrize(
    "use",
    [
        lambda client: client.__aenter__(),
        lambda client: client.runtime.forward(),
        lambda client: client.discover(timeout=1),
        lambda client: client.state_stream().receive(),
        lambda client: client.sim.start(),
        lambda client: client.explain(),
    ],
    ids=["enter", "call", "call with a deadline", "read", "play", "explain"],
)
def test_on_trio_it_says_so_at_once(run: Callable[[Any], object], use: Callable[[URLabClient], Any]) -> None:
    client = URLabClient("tcp://127.0.0.1", step_port=1)

    async def main() -> None:
        with pytest.raises(URLabError, match=r"runs on asyncio's event loop, but this code runs on trio.*to_thread"):
            await use(client)

    run(main)


def test_anyios_asyncio_backend_is_a_loop_like_any_other(scripted: Any) -> None:
    level = {"op": "current_level_ok", "level_path": "/Game/Levels/lab"}
    scripted.on("current_level", None)

    async def main() -> None:
        async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as client:
            await client.discover()
            with anyio.move_on_after(0.05) as gave_up:
                await client.scene.current_level(timeout=None)
            assert gave_up.cancelled_caught
            scripted.on("current_level", level)
            scripted.release(level)
            found: list[str] = []

            async def ask() -> None:
                found.append(await client.scene.current_level())

            async with anyio.create_task_group() as tasks:
                for _ in range(3):
                    tasks.start_soon(ask)
            assert found == ["/Game/Levels/lab"] * 3

    anyio.run(main, backend="asyncio")


def test_without_any_loop_it_says_so() -> None:
    client = URLabClient("tcp://127.0.0.1", step_port=1)
    with pytest.raises(URLabError, match="but no event loop is running"):
        client.runtime.forward().send(None)  # as an event loop of somebody else's would
