"""Shared memory: steps against the same client over ZeroMQ, and pictures against copying memory."""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.canned import server
from benchmarks.canned_memory import memory_server
from benchmarks.harness import Burst, Pair, Row, each
from benchmarks.robots import recorded
from urlab_client import aio
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.shm import camera_file

__all__ = ["ROWS"]

_JOINTS = 29


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
def _steps(*, bell: bool) -> Iterator[Pair]:
    answers = recorded(_JOINTS)
    with (
        _directory() as directory,
        memory_server(answers, directory, bell=bell) as shared,
        server(answers) as port,
        asyncio.Runner() as runner,
        _stepping(runner, shared, transport="shm") as ours,
        _stepping(runner, port) as floor,
    ):
        yield Pair(ours=ours, floor=floor)


def _with_camera(width: int, height: int) -> dict[str, bytes]:
    answers = dict(recorded(_JOINTS))
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
def _pictures(width: int, height: int) -> Iterator[Pair]:
    answers = _with_camera(width, height)
    prefix = msgspec.msgpack.decode(answers["hello"])["articulations"][0]["prefix"]
    camera = camera_file(prefix, "eye"), width, height
    with (
        _directory() as directory,
        memory_server(answers, directory, bell=False, camera=camera) as port,
        asyncio.Runner() as runner,
    ):
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="direct", transport="shm")
        runner.run(client.discover())
        view = client.articulations[prefix].cameras["eye"]
        stream = view.frames(timeout=5.0)

        async def frames(count: int) -> list[float]:
            clock = time.perf_counter
            times: list[float] = []
            for _ in range(count):
                started = clock()
                await stream.receive()
                times.append(clock() - started)
            return times

        pixels = np.zeros((height, width, 4), np.uint8)
        target = np.empty_like(pixels)
        copy: Callable[[], object] = lambda: np.copyto(target, pixels)  # noqa: E731
        try:
            yield Pair(ours=lambda count: runner.run(frames(count)), floor=each(copy))
        finally:
            runner.run(client.close())


ROWS = (
    Row(
        name="step-shm-doorbell",
        what="await client.step() over shared memory with a doorbell",
        floor="the same over ZeroMQ",
        reach=0.5,
        prepare=lambda: _steps(bell=True),
    ),
    Row(
        name="step-shm-polling",
        what="await client.step() over shared memory, server looks every 100 µs",
        floor="the same over ZeroMQ",
        reach=0.8,
        prepare=lambda: _steps(bell=False),
    ),
    Row(
        name="frames-shm-vga",
        what="await frames.receive(), 640x480 RGBA at 2000 per second",
        floor="copying such a picture",
        reach=40.0,
        prepare=lambda: _pictures(640, 480),
    ),
)
