"""Shared memory: steps against the same client over ZeroMQ, and pictures against copying memory."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.canned import server
from benchmarks.canned_memory import memory_server
from benchmarks.conditions import long, warm
from benchmarks.harness import Burst, Figure, Pair, Row, each
from benchmarks.robots import recorded
from urlab_client import URLabClient, aio
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.shm import camera_file

__all__ = ["ROWS"]

_JOINTS = 29
_WARM_UP = 20
_UNCACHED_BYTES = 128 * 2**20


@contextlib.contextmanager
def _directory() -> Iterator[Path]:
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None  # noqa: S108 - where a server puts it, too
    with tempfile.TemporaryDirectory(dir=base) as folder:
        yield Path(folder)


@contextlib.contextmanager
def _stepping(runner: asyncio.Runner, port: int, **options: str) -> Iterator[Burst]:
    client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct", **options)  # type: ignore[arg-type]  # all str
    runner.run(client.discover())
    for _ in range(3):
        runner.run(client.step())

    async def steps(count: int) -> list[float]:
        clock = time.perf_counter
        times: list[float] = []
        for _ in range(count):
            started = clock()
            await client.step()
            times.append(clock() - started)
        return times

    try:
        yield lambda count: runner.run(steps(count))
    finally:
        runner.run(client.close())


@contextlib.contextmanager
def _stepping_blocking(port: int, **options: str) -> Iterator[Burst]:
    with URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct", **options) as client:  # type: ignore[arg-type]  # all str
        client.discover()
        for _ in range(3):
            client.step()
        yield each(client.step)


@contextlib.contextmanager
def _blocking_steps() -> Iterator[Pair]:
    answers = recorded(_JOINTS)
    with (
        _directory() as directory,
        memory_server(answers, directory, doorbell=True) as shared,
        server(answers) as port,
        _stepping_blocking(shared, transport="shm") as ours,
        _stepping_blocking(port) as floor,
    ):
        yield Pair(ours=ours, floor=floor)


@contextlib.contextmanager
def _steps(*, doorbell: bool) -> Iterator[Pair]:
    answers = recorded(_JOINTS)
    with (
        _directory() as directory,
        memory_server(answers, directory, doorbell=doorbell) as shared,
        server(answers) as port,
        asyncio.Runner() as runner,
        _stepping(runner, shared, transport="shm") as ours,
        _stepping(runner, port) as floor,
    ):
        yield Pair(ours=ours, floor=floor)


def _with_camera(width: int, height: int) -> dict[str, bytes]:
    answers = dict(recorded(_JOINTS, spoken="alpha"))  # whose cameras need no switch; pictures are the same bytes
    hello = msgspec.msgpack.decode(answers["hello"])
    camera = CameraInfo(
        mode="real",
        resolution=(width, height),
        fovy=45.0,
        zmq_endpoint="tcp://127.0.0.1:9",
        zmq_topic=f"{hello['articulations'][0]['prefix']}/camera/eye",
    )
    hello["articulations"][0]["camera_topics"] = {"eye": msgspec.to_builtins(camera)}
    answers["hello"] = msgspec.msgpack.encode(hello)
    return answers


@contextlib.contextmanager
def _pictures(width: int, height: int, rate: float) -> Iterator[Pair]:
    """The processor time of pictures that are received without a pause, and of copying such pictures."""
    answers = _with_camera(width, height)
    prefix = msgspec.msgpack.decode(answers["hello"])["articulations"][0]["prefix"]
    camera = camera_file(prefix, "eye"), width, height, rate
    with (
        _directory() as directory,
        memory_server(answers, directory, doorbell=False, camera=camera) as port,
        asyncio.Runner() as runner,
    ):
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct", transport="shm")
        runner.run(client.discover())
        view = client.articulations[prefix].cameras["eye"]
        stream = view.frames(timeout=5.0)
        wall: list[float] = []
        processor: list[float] = []

        async def frames(count: int) -> list[float]:
            for _ in range(_WARM_UP):  # after a pause the client looks more and more rarely
                await stream.receive()
            started, busy = time.perf_counter(), time.process_time()
            for _ in range(count):
                await stream.receive()
            processor.append((time.process_time() - busy) / count)
            wall.append((time.perf_counter() - started) / count)
            return processor[-1:]

        # More than a cache holds, as what another process has just written is not in this core's either.
        pixels = np.ones((_UNCACHED_BYTES // (4 * width * height), height, width, 4), np.uint8)
        targets = np.ones_like(pixels)
        pairs = itertools.cycle(list(zip(targets, pixels, strict=True)))

        def copies(count: int) -> list[float]:
            busy = time.process_time()
            for target, source in itertools.islice(pairs, count):
                np.copyto(target, source)
            return [(time.process_time() - busy) / count]

        try:
            yield Pair(
                ours=lambda count: runner.run(frames(count)),
                floor=copies,
                figures=lambda: [
                    Figure(name="pictures per second", value=1 / statistics.median(wall)),
                    Figure(
                        name="share of a core at 1000 640x480 pictures per second, by bytes",
                        value=statistics.median(processor) * 1000 * (640 * 480) / (width * height),
                        at_most=0.3,
                    ),
                ],
            )
        finally:
            runner.run(client.close())


_DOORBELL = Row(
    name="step-shm-doorbell",
    what="await client.step() over shared memory with a doorbell",
    floor="the same over ZeroMQ",
    reach=0.5,
    prepare=lambda: _steps(doorbell=True),
)
_FACADE_DOORBELL = Row(
    name="step-facade-shm-doorbell",
    what="client.step() over shared memory with a doorbell",
    floor="the same over ZeroMQ",
    reach=0.6,
    prepare=_blocking_steps,
)
_POLLING = Row(
    name="step-shm-polling",
    what="await client.step() over shared memory, server looks every 100 µs",
    floor="the same over ZeroMQ",
    reach=1.35,  # the interval at which the server looks, whatever the client does
    prepare=lambda: _steps(doorbell=False),
)

ROWS = (
    _DOORBELL,
    _FACADE_DOORBELL,
    _POLLING,
    warm(_DOORBELL, reach=0.6),
    warm(_FACADE_DOORBELL, reach=0.6),
    warm(_POLLING, reach=1.7),
    long(_DOORBELL),
    long(_FACADE_DOORBELL),
    long(warm(_DOORBELL, reach=0.6)),
    long(warm(_FACADE_DOORBELL, reach=0.6)),
    Row(
        name="frames-shm-vga",
        what="processor time of await frames.receive(), 640x480 RGBA, 2000 per second",
        floor="that of copying such a picture from memory to memory",
        reach=5.0,
        prepare=lambda: _pictures(640, 480, 2000.0),
        burst_s=0.3,
    ),
    Row(
        name="frames-shm-hd",
        what="the same, 1920x1080, 250 per second",
        floor="the same",
        reach=1 / 0.6,
        prepare=lambda: _pictures(1920, 1080, 250.0),
        burst_s=0.3,
    ),
)
