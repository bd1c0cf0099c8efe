"""`client.step()` against a server that answers at once."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from benchmarks.canned import LAST_STEP, Requester, server
from benchmarks.conditions import long, warm
from benchmarks.harness import Pair, Row, each
from benchmarks.robots import recorded
from urlab_client import URLabClient, aio

__all__ = ["ROWS"]

_JOINTS = 29


@contextlib.contextmanager
def asynchronous(loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None) -> Iterator[Pair]:
    """Steps of the async client in a loop that does nothing else."""
    with (
        server(recorded(_JOINTS)) as port,
        asyncio.Runner(loop_factory=loop_factory) as runner,
        Requester(port) as floor,
    ):
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct")
        runner.run(client.discover())
        runner.run(client.step())

        async def steps(count: int) -> list[float]:
            clock = time.perf_counter
            times: list[float] = []
            for _ in range(count):
                started = clock()
                await client.step()
                times.append(clock() - started)
            return times

        ask = floor.asking(floor.ask(LAST_STEP))
        try:
            yield Pair(ours=lambda count: runner.run(steps(count)), floor=each(ask))
        finally:
            runner.run(client.close())


@contextlib.contextmanager
def blocking() -> Iterator[Pair]:
    """Steps of the façade."""
    with (
        server(recorded(_JOINTS)) as port,
        Requester(port) as floor,
        URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct") as client,
    ):
        client.discover()
        client.step()
        yield Pair(ours=each(client.step), floor=each(floor.asking(floor.ask(LAST_STEP))))


@contextlib.contextmanager
def _busy_thread() -> Iterator[None]:
    stop = threading.Event()

    def burn() -> None:
        while not stop.is_set():
            sum(range(1000))

    thread = threading.Thread(target=burn, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextlib.contextmanager
def asynchronous_beside_busy_thread() -> Iterator[Pair]:
    """The same while another Python thread computes."""
    with asynchronous() as pair, _busy_thread():
        yield pair


@contextlib.contextmanager
def blocking_beside_busy_thread() -> Iterator[Pair]:
    """The same while another Python thread computes."""
    with blocking() as pair, _busy_thread():
        yield pair


_FLOOR = "blocking REQ loop, same bytes, same server, no decoding"

_AIO = Row(
    name="step-aio",
    what="await client.step(), 29 DoF, standard observations, answered at once",
    floor=_FLOOR,
    reach=1.8,
    p99=2.0,
    prepare=asynchronous,
)
_FACADE = Row(name="step-facade", what="client.step(), the same", floor=_FLOOR, reach=2.0, prepare=blocking)


def _on_uvloop() -> tuple[Row, ...]:
    if importlib.util.find_spec("uvloop") is None:
        return ()
    import uvloop  # noqa: PLC0415  # where it is installed

    row = replace(
        _AIO,
        name="step-uvloop",
        what="await client.step() on uvloop",
        prepare=lambda: asynchronous(uvloop.new_event_loop),
    )
    return row, warm(row, reach=2.2, p99=2.0, processor=2.9)


ROWS = (
    _AIO,
    _FACADE,
    warm(_AIO, reach=1.8, p99=2.0, processor=2.9),
    warm(_FACADE, reach=2.2, p99=2.0, processor=3.6),
    long(_AIO),
    long(_FACADE),
    long(warm(_AIO, reach=1.8)),
    long(warm(_FACADE, reach=2.2)),
    *_on_uvloop(),
    Row(
        name="step-aio-busy",
        what="await client.step() beside a CPU-bound Python thread",
        floor="blocking REQ loop beside the same thread",
        reach=1.2,
        prepare=asynchronous_beside_busy_thread,
        count=20,
    ),
    Row(
        name="step-facade-busy",
        what="client.step() beside a CPU-bound Python thread",
        floor="blocking REQ loop beside the same thread",
        reach=1.2,
        prepare=blocking_beside_busy_thread,
        count=20,
    ),
)
