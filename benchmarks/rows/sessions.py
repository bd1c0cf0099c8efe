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


class _Sessions:
    """Steps some clients at the same time, and keeps count of the processor time that takes."""

    def __init__(self, runner: asyncio.Runner, clients: list[aio.URLabClient]) -> None:
        self._runner = runner
        self._clients = clients
        self._steps = 0
        self._cpu_s = 0.0

    @property
    def cpu_of_a_step_s(self) -> float:
        """Processor time of this process, all threads together, by the number of steps."""
        return self._cpu_s / self._steps

    def burst(self, count: int) -> list[float]:
        """Return seconds per step, over all clients together."""
        share = max(1, count // len(self._clients))
        total = share * len(self._clients)

        async def steps(client: aio.URLabClient) -> None:
            for _ in range(share):
                await client.step()

        async def all_steps() -> None:
            await asyncio.gather(*map(steps, self._clients))

        started, cpu = time.perf_counter(), time.process_time()
        self._runner.run(all_steps())
        took = time.perf_counter() - started
        self._cpu_s += time.process_time() - cpu
        self._steps += total
        return [took / total]


@contextlib.contextmanager
def _sessions() -> Iterator[Pair]:
    # One server process answers all: a process for each would compete with the clients for the cores.
    with server(recorded(29)) as port, asyncio.Runner() as runner:
        clients = [aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct") for _ in range(_SESSIONS)]
        runner.run(clients[0].discover())  # what is loaded once is nobody's memory
        before = _resident_bytes()
        for client in clients[1:]:
            runner.run(client.discover())
        each_mb = (_resident_bytes() - before) / (_SESSIONS - 1) / 1e6
        many, one = _Sessions(runner, clients), _Sessions(runner, clients[:1])

        def figures() -> list[Figure]:
            cpu_us = [
                Figure(name=f"processor time of a step, {who}, µs", value=1e6 * them.cpu_of_a_step_s, at_most=most)
                for who, them, most in (("together", many, 60.0), ("alone", one, None))
            ]
            memory = Figure(name="memory of an idle session, MB", value=each_mb, at_most=3.0)
            return [*cpu_us, memory] if before else cpu_us

        async def close() -> None:
            await asyncio.gather(*(client.close() for client in clients))

        try:
            yield Pair(ours=many.burst, floor=one.burst, figures=figures)
        finally:
            runner.run(close())


def _resident_bytes() -> int:
    """Return the memory of this process; 0 where the system does not tell."""
    try:
        pages = Path("/proc/self/statm").read_text().split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


ROWS = (
    Row(
        name="sessions-32",
        what=f"steps per second of {_SESSIONS} sessions in one event loop, against one canned server",
        floor="one session",
        reach=1.0,
        kind="rate",
        prepare=_sessions,
        count=_SESSIONS * 10,
    ),
)
