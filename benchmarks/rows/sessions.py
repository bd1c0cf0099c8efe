"""Many sessions in one process and one event loop."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.canned import server
from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import recorded
from urlab_client import aio

__all__ = ["ROWS"]

_SESSIONS = 32


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


async def _steps(clients: list[aio.URLabClient], count: int) -> list[float]:
    """Return seconds per step, over all clients together."""

    async def steps(client: aio.URLabClient) -> None:
        for _ in range(share):
            await client.step()

    share = max(1, count // len(clients))
    started = time.perf_counter()
    await asyncio.gather(*map(steps, clients))
    return [(time.perf_counter() - started) / (share * len(clients))]


@contextlib.contextmanager
def _sessions() -> Iterator[Pair]:
    # Each session has a server, as in real life: one server has one session.
    with contextlib.ExitStack() as stack:
        answers = recorded(29)
        ports = [stack.enter_context(server(answers)) for _ in range(_SESSIONS)]
        runner = stack.enter_context(asyncio.Runner())
        clients = [aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct") for port in ports]
        runner.run(clients[0].discover())  # what is loaded once is nobody's memory
        before = _resident_bytes()
        for client in clients[1:]:
            runner.run(client.discover())
        each_mb = (_resident_bytes() - before) / (_SESSIONS - 1) / 1e6

        async def close() -> None:
            await asyncio.gather(*(client.close() for client in clients))

        try:
            yield Pair(
                ours=lambda count: runner.run(_steps(clients, count)),
                floor=lambda count: runner.run(_steps(clients[:1], count)),
                figures=lambda: [Figure(name="memory of an idle session, MB", value=each_mb, at_most=3.0)],
            )
        finally:
            runner.run(close())


ROWS = (
    Row(
        name="sessions-32",
        what=f"steps per second of {_SESSIONS} sessions in one event loop",
        floor="one session",
        reach=1.0,
        kind="rate",
        prepare=_sessions,
        burst_s=0.2,
        count=_SESSIONS * 10,
    ),
)
