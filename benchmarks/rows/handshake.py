"""`discover()` with a large model."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco

from benchmarks.canned import Requester, server
from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import recorded
from urlab_client import aio
from urlab_client.protocol.codec import decode_reply, encode_request, op_of
from urlab_client.protocol.messages.session import Hello, HelloOk, Meta

__all__ = ["ROWS"]

_TERRAIN = 4200  # samples along each side: a model of 70 MB


@contextlib.contextmanager
def _handshake() -> Iterator[Pair]:
    answers = recorded(29, terrain=_TERRAIN)
    size = len(answers["hello"])
    model = decode_reply(op_of(Hello), HelloOk, answers["hello"]).mjb
    assert model is not None  # noqa: S101
    requests = [encode_request(request, "") for request in (Hello(observations="standard"), Meta())]
    with server(answers) as port:

        async def discover() -> None:
            async with aio.URLabClient(f"tcp://127.0.0.1:{port}") as client:
                await client.discover(timeout=60)

        def ours(count: int) -> list[float]:
            return [_timed(lambda: asyncio.run(discover())) for _ in range(count)]

        def transfer_and_load() -> None:
            with Requester(port) as floor:
                for request in requests:
                    floor.ask(request)
                loaded = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": model})
                mujoco.mj_forward(loaded, mujoco.MjData(loaded))

        yield Pair(
            ours=ours,
            floor=lambda count: [_timed(transfer_and_load) for _ in range(count)],
            figures=lambda: _memory(lambda: ours(1), size),
        )


def _timed(operation: Callable[[], object]) -> float:
    started = time.perf_counter()
    operation()
    return time.perf_counter() - started


def _memory(operation: Callable[[], object], reply: int) -> list[Figure]:
    """Return the growth of the process's peak, by the size of the reply; nothing where the system cannot reset it."""
    try:
        gc.collect()
        Path("/proc/self/clear_refs").write_text("5")
        before = _peak()
        operation()
        grown = _peak() - before
    except OSError:
        return []
    return [Figure(name="peak memory / size of the reply", value=grown / reply, at_most=2.5)]


def _peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))


ROWS = (
    Row(
        name="handshake",
        what="discover() with a 70 MB model",
        floor="raw transfer of the same bytes, MjModel load, mj_forward",
        reach=1.15,
        prepare=_handshake,
        count=1,
    ),
)
