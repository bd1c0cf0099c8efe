"""A server that is killed or stopped in each state of the protocol, over sockets and over shared memory.

CI takes each state once; `URLAB_LONG_TESTS=1` takes all combinations.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import threading
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from served import Served
from waiting import in_time, until

from urlab_client.aio import URLabClient
from urlab_client.errors import NotReady, URLabConnectionError, URLabRPCError, URLabTimeoutError

TIMEOUT_S = 0.3
LOST = (URLabTimeoutError, URLabConnectionError, URLabRPCError)
Strike = Callable[[], None]


async def sent(client: URLabClient, number: int) -> None:
    """Wait until so many requests have left."""
    await until(lambda: client.transport_stats.sent + client.transport_stats.over_shm >= number, look=0)


async def lose(client: URLabClient, strike: Strike, call: Awaitable[object]) -> None:
    """Strike when the call's first request has left; the call must end in time, with its reply or as lost."""
    stats = client.transport_stats
    already = stats.sent + stats.over_shm
    pending = asyncio.ensure_future(call)
    await sent(client, already + 1)
    strike()
    with contextlib.suppress(LOST):
        await in_time(TIMEOUT_S, pending)


async def before_hello(client: URLabClient, strike: Strike) -> None:
    strike()
    with pytest.raises(LOST):
        await in_time(TIMEOUT_S, client.discover(timeout=TIMEOUT_S))


async def during_hello(client: URLabClient, strike: Strike) -> None:
    await lose(client, strike, client.discover(timeout=TIMEOUT_S))


async def idle(client: URLabClient, strike: Strike) -> None:
    await client.discover()
    strike()


async def stepping(client: URLabClient, strike: Strike) -> None:
    await client.discover()
    for _ in range(20):  # so that with shared memory steps go there
        await client.step()
    await lose(client, strike, client.step(timeout=TIMEOUT_S))


async def in_a_long_step(client: URLabClient, strike: Strike) -> None:
    await client.discover()
    await lose(client, strike, client.step(300_000, timeout=TIMEOUT_S))


async def streaming(client: URLabClient, strike: Strike) -> None:
    await client.discover()
    async with client.state_stream("latest") as states, client.articulations["arm"].cameras["wrist"].frames():
        await states.receive()
        strike()

        async def read_on() -> None:
            while True:
                await states.receive(timeout=TIMEOUT_S)

        with pytest.raises(URLabTimeoutError):
            await in_time(2 * TIMEOUT_S, read_on())


async def ending_play(client: URLabClient, strike: Strike) -> None:
    await client.discover()
    await lose(client, strike, client.sim.stop(timeout=TIMEOUT_S))


STATES = [before_hello, during_hello, idle, stepping, in_a_long_step, streaming, ending_play]
COMBINATIONS = [
    pytest.param(state, death, transport, id=f"{state.__name__}-{death.name}-{transport}")
    for i, state in enumerate(STATES)
    for j, (death, transport) in enumerate(
        [(signal.SIGKILL, "zmq"), (signal.SIGSTOP, "shm"), (signal.SIGKILL, "shm"), (signal.SIGSTOP, "zmq")]
    )
    if os.environ.get("URLAB_LONG_TESTS") or i % 4 == j
]


def held() -> tuple[list[str], int]:
    """Our own threads, and all descriptors."""
    gc.collect()
    ours = [thread.name for thread in threading.enumerate() if thread.name.startswith("urlab")]
    return ours, len(list(Path("/proc/self/fd").iterdir()))


async def released(before: tuple[list[str], int]) -> None:
    """Wait until nothing more is held than before."""
    # Fewer is as good: something of another test may have gone meanwhile.
    await until(lambda: not Counter((now := held())[0]) - Counter(before[0]) and now[1] <= before[1])


@pytest.mark.parametrize(("state", "death", "transport"), COMBINATIONS)
async def test_no_call_outlives_its_server(
    state: Callable[[URLabClient, Strike], Awaitable[None]], death: signal.Signals, transport: str, tmp_path: Path
) -> None:
    async with Served(tmp_path if transport == "shm" else None) as served:
        before = held()
        async with URLabClient(**served.options(), step_mode="direct", transport=transport) as client:
            await state(client, lambda: served.send(death))
            with pytest.raises(LOST):
                await in_time(TIMEOUT_S, client.scene.current_level(timeout=TIMEOUT_S))
            if death is signal.SIGSTOP:
                served.send(signal.SIGCONT)
            else:
                await served.kill()
                await served.start()
            async with asyncio.timeout(60):
                while True:
                    with contextlib.suppress(NotReady):  # it is at the long step again
                        await client.discover(timeout=30)
                        break
                if not client.manager_present:
                    await client.sim.start(timeout=30)
                    await client.discover(timeout=30)
            reached = client.step_count
            assert (await client.step(3)).step == reached + 3
            assert client.articulations["arm"].qpos_array.size
        await released(before)


async def test_closing_while_the_server_dies(tmp_path: Path) -> None:
    async with Served(tmp_path) as served:
        before = held()
        for transport, death in (("zmq", signal.SIGSTOP), ("shm", signal.SIGSTOP), ("shm", signal.SIGKILL)):
            client = URLabClient(**served.options(), step_mode="direct", transport=transport)
            await client.discover()
            async with client.state_stream() as states:
                await states.receive()
                closing = asyncio.create_task(client.close())
                await asyncio.sleep(0)
                served.send(death)
                await in_time(1.0, closing)
            await client.close()
            await released(before)
            served.send(signal.SIGCONT)
