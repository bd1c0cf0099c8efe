"""What further robots in a scene cost the client."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator, Mapping

from benchmarks.canned import server
from benchmarks.harness import Burst, Pair, Row
from benchmarks.robots import recorded
from urlab_client import aio

__all__ = ["ROWS"]

_JOINTS = 30
_SMALL_JOINTS = 12


@contextlib.contextmanager
def _client(runner: asyncio.Runner, answers: Mapping[str, bytes]) -> Iterator[aio.URLabClient]:
    with server(answers) as port:
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct")
        runner.run(client.discover())
        runner.run(client.step())
        try:
            yield client
        finally:
            runner.run(client.close())


def _steps(runner: asyncio.Runner, client: aio.URLabClient) -> Burst:
    async def steps(count: int) -> list[float]:
        clock = time.perf_counter
        times: list[float] = []
        for _ in range(count):
            started = clock()
            await client.step()
            times.append(clock() - started)
        return times

    return lambda count: runner.run(steps(count))


def _processor_per_robot(runner: asyncio.Runner, client: aio.URLabClient) -> Burst:
    async def steps(count: int) -> list[float]:
        started = time.process_time()
        for _ in range(count):
            await client.step()
        return [(time.process_time() - started) / count / len(client.articulations)]

    return lambda count: runner.run(steps(count))


def _one_like(robots: int) -> Mapping[str, bytes]:
    """Return what is answered about one robot whose replies have as many bytes as those of so many robots."""
    size = len(recorded(_JOINTS, robots)["step"])
    small, large = (len(recorded(joints)["step"]) for joints in (_JOINTS, 2 * _JOINTS))
    return recorded(_JOINTS + round((size - small) / (large - small) * _JOINTS))


@contextlib.contextmanager
def _same_bytes() -> Iterator[Pair]:
    with (
        asyncio.Runner() as runner,
        _client(runner, recorded(_JOINTS, 8)) as many,
        _client(runner, _one_like(8)) as one,
    ):
        yield Pair(ours=_steps(runner, many), floor=_steps(runner, one))


@contextlib.contextmanager
def _sixty_four() -> Iterator[Pair]:
    with (
        asyncio.Runner() as runner,
        _client(runner, recorded(_SMALL_JOINTS, 64)) as many,
        _client(runner, recorded(_SMALL_JOINTS)) as one,
    ):
        yield Pair(ours=_processor_per_robot(runner, many), floor=_processor_per_robot(runner, one))


ROWS = (
    Row(
        name="robots-8",
        what=f"await client.step(), 8 robots of {_JOINTS} joints and a free base",
        floor="the same of one robot with replies of as many bytes",
        reach=1.3,
        prepare=_same_bytes,
    ),
    Row(
        name="robots-64",
        what=f"processor time of await client.step() per robot, 64 robots of {_SMALL_JOINTS} joints",
        floor="that of one such robot alone",
        reach=1.0,
        prepare=_sixty_four,
        burst_s=0.1,
    ),
)
