"""Servers and clients killed at random over shared memory: nothing hangs, nothing stale, the next session works.

`URLAB_KILLS=200` runs the long form.
"""

from __future__ import annotations

import asyncio
import os
import random
import sys
from pathlib import Path

import pytest
from ports import free_port
from waiting import DEADLINE_S, in_time

from urlab_client.aio import URLabClient
from urlab_client.errors import URLabError

SUPPORT = Path(__file__).parents[1] / "support"
KILLS = int(os.environ.get("URLAB_KILLS", "2"))
STEP_S = 1.0

CLIENT = """
import asyncio, sys
from urlab_client.aio import URLabClient

async def main():
    client = URLabClient(f"tcp://127.0.0.1:{sys.argv[1]}", transport="shm", step_mode="direct", local_model=False)
    await client.discover()
    n = 0
    while True:
        n += 1
        assert (await client.step(n)).step == n
        if n == 3:
            print("stepping", flush=True)

asyncio.run(main())
"""


async def start(directory: Path, port: int) -> asyncio.subprocess.Process:
    command = (sys.executable, str(SUPPORT / "plugin_process.py"), str(directory), str(port))
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    assert process.stdout is not None
    assert await process.stdout.readline()
    return process


def client_of(port: int) -> URLabClient:
    address = f"tcp://127.0.0.1:{port}"
    return URLabClient(address, transport="shm", step_mode="direct", local_model=False, rcv_timeout_ms=30_000)


async def over_shared_memory(client: URLabClient, first: int) -> int:
    """Step until one went over shared memory; return the next number."""
    sent = client.transport_stats.over_shm
    async with asyncio.timeout(DEADLINE_S):
        while client.transport_stats.over_shm == sent:
            assert (await client.step(first)).step == first
            first += 1
    return first


@pytest.mark.timeout(60 + 5 * KILLS)
async def test_servers_killed_while_a_client_steps(tmp_path: Path) -> None:
    chance = random.Random(5)
    port = free_port()
    server = await start(tmp_path, port)
    loop = asyncio.get_running_loop()
    number = 1
    try:
        async with client_of(port) as client:
            for _ in range(KILLS):
                await client.discover(timeout=60)
                number = await over_shared_memory(client, number)
                loop.call_later(chance.uniform(0.0, 0.05), server.kill)
                with pytest.raises(URLabError):  # noqa: PT012 - which of them fails is up to chance
                    while True:
                        assert (await in_time(STEP_S, client.step(number, timeout=STEP_S))).step == number
                        number += 1
                await server.wait()
                # The plugin's files are still there, and cut short in place while the client may have them mapped.
                server = await start(tmp_path, port)
            await client.discover(timeout=60)
            await over_shared_memory(client, number)
    finally:
        server.kill()
        await server.wait()


@pytest.mark.timeout(60 + 5 * KILLS)
async def test_clients_killed_while_they_step(tmp_path: Path) -> None:
    chance = random.Random(6)
    port = free_port()
    server = await start(tmp_path, port)
    try:
        for _ in range(KILLS):
            victim = await asyncio.create_subprocess_exec(
                sys.executable, "-c", CLIENT, str(port), stdout=asyncio.subprocess.PIPE
            )
            assert victim.stdout is not None
            assert (await victim.stdout.readline()).strip() == b"stepping"
            killed = asyncio.get_running_loop().create_future()
            asyncio.get_running_loop().call_later(chance.uniform(0.0, 0.02), killed.set_result, None)
            await killed
            victim.kill()
            await victim.wait()
            async with client_of(port) as client:
                await client.discover(timeout=60)
                await over_shared_memory(client, 1_000_000)
    finally:
        server.kill()
        await server.wait()
