"""A step in puppet mode: physics here, the result pushed to the server."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator

import mujoco

from benchmarks.canned import LAST_STEP, Requester, server
from benchmarks.harness import Pair, Row
from benchmarks.robots import recorded
from urlab_client import aio

__all__ = ["ROWS"]


@contextlib.contextmanager
def _puppet() -> Iterator[Pair]:
    with server(recorded(29, mode="puppet")) as port, asyncio.Runner() as runner, Requester(port) as floor:
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="puppet")
        runner.run(client.discover())
        runner.run(client.step())
        model, data = client.model, client.data
        assert model is not None and data is not None  # noqa: S101, PT018
        own = mujoco.MjData(model)
        ask = floor.asking(floor.ask(LAST_STEP))

        async def steps(count: int) -> list[float]:
            mujoco.mj_resetData(model, data)
            times: list[float] = []
            for _ in range(count):
                started = time.perf_counter()
                await client.step()
                times.append(time.perf_counter() - started)
            return times

        def physics_and_round_trips(count: int) -> list[float]:
            mujoco.mj_resetData(model, own)
            times: list[float] = []
            for _ in range(count):
                started = time.perf_counter()
                mujoco.mj_step(model, own)
                ask()
                times.append(time.perf_counter() - started)
            return times

        yield Pair(ours=lambda count: runner.run(steps(count)), floor=physics_and_round_trips)
        runner.run(client.close())


ROWS = (
    Row(
        name="puppet",
        what="await client.step() in puppet mode, humanoid of 29 joints and a free base",
        floor="mj_step + blocking REQ round trip of the same bytes",
        reach=2.0,
        prepare=_puppet,
    ),
)
