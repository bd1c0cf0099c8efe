"""What the server publishes: state in live mode, and pictures."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import statistics
import time
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
import zmq

from benchmarks.canned import Publisher, publisher, server
from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import recorded
from urlab_client import aio
from urlab_client.aio.cameras import URLabCameraView
from urlab_client.aio.launch import transport_to
from urlab_client.aio.session.session import Session
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import CameraSample, StateSnapshot
from urlab_client.protocol.topics import STATE_FULL, camera_filter

__all__ = ["ROWS"]

_SNAPSHOTS = 500
_HANGS_S = 60.0
_HZ = 1000.0
_PACED = 2000
_PACED_RUNS = 3


def _snapshots(count: int) -> list[bytes]:
    """Return what the server publishes of three robots, snapshot after snapshot."""
    plain = msgspec.msgpack.decode(recorded(29, 3)["step"])
    plain["op"] = "state_full"
    return [msgspec.msgpack.encode({**plain, "step": float(i), "time": i * 0.001}) for i in range(1, count + 1)]


@contextlib.contextmanager
def _state() -> Iterator[Pair]:
    """The live client takes each burst over; the floor decodes the same messages from memory."""
    answers = recorded(29, 3, mode="live")
    snapshots = _snapshots(_SNAPSHOTS)  # after them: the client leaves out what was sent before the last answer
    messages = [(STATE_FULL, snapshot) for snapshot in snapshots]
    with (
        server(answers) as port,
        publisher([messages]) as source,
        asyncio.Runner() as runner,
    ):
        client = aio.URLabClient(f"tcp://127.0.0.1:{port}", step_mode="live", state_port=source.ports[0])
        runner.run(client.discover())
        runner.run(_subscribed(source))
        robot = next(iter(client.articulations.values()))

        async def burst() -> float:
            source.send(0, _SNAPSHOTS)
            started = time.perf_counter()
            async with asyncio.timeout(_HANGS_S):
                while client.step_count != _SNAPSHOTS:  # noqa: ASYNC110  # an event would be set by what is measured
                    await asyncio.sleep(0.0002)
            took = time.perf_counter() - started
            client._state.clocks.step_count = 0  # noqa: SLF001  # so that the next burst's end is seen
            return took / _SNAPSHOTS

        async def paced() -> tuple[float, int, int]:
            """Return the share of a core, messages that got lost, and those overtaken by a newer one in their batch."""
            stats = client._state._live.stats  # noqa: SLF001  # the client shows no more than what came last
            received, absorbed = stats.received, stats.absorbed
            source.send(0, _PACED, _HZ)
            busy, wall = time.process_time(), time.perf_counter()
            late = wall + 2 * _PACED / _HZ
            while stats.received < received + _PACED and time.perf_counter() < late:  # noqa: ASYNC110  # as above
                await asyncio.sleep(0.02)
            share = (time.process_time() - busy) / (time.perf_counter() - wall)
            arrived = stats.received - received
            return share, _PACED - arrived, arrived - (stats.absorbed - absorbed)

        async def paced_with_stream() -> tuple[float, int]:
            """Return the same of a client that also reads every message from a stream."""
            async with client.state_stream("all", buffer=_PACED) as stream:
                await asyncio.sleep(0.1)
                source.send(0, _PACED, _HZ)
                busy, wall = time.process_time(), time.perf_counter()
                taken = dropped = 0
                async for item in stream:
                    robot.qpos_array  # noqa: B018  # what a user does
                    taken += 1
                    dropped += item.dropped
                    if taken + dropped >= _PACED:
                        break
                share = (time.process_time() - busy) / (time.perf_counter() - wall)
            return share, dropped

        def figures() -> list[Figure]:
            shares, dropped, overtaken = zip(*[runner.run(paced()) for _ in range(_PACED_RUNS)], strict=True)
            more_shares, more_dropped = zip(*[runner.run(paced_with_stream()) for _ in range(_PACED_RUNS)], strict=True)
            return [
                Figure(name="messages dropped at 1 kHz", value=sum(dropped), at_most=0),
                Figure(name="share of messages at 1 kHz overtaken", value=sum(overtaken) / (_PACED * _PACED_RUNS)),
                Figure(name="share of a core at 1 kHz", value=statistics.median(shares), at_most=0.25),
                Figure(name="dropped with a stream of all beside it", value=sum(more_dropped), at_most=0),
                Figure(name="share of a core with that", value=statistics.median(more_shares)),
            ]

        def decode(count: int) -> list[float]:
            started = time.perf_counter()
            for _ in range(count):
                for snapshot in snapshots:
                    StateSnapshot.decode(snapshot)
            return [(time.perf_counter() - started) / (count * _SNAPSHOTS)]

        yield Pair(
            ours=lambda count: [runner.run(burst()) for _ in range(count)],
            floor=decode,
            figures=figures,
        )
        runner.run(client.close())


@contextlib.contextmanager
def _pictures(mode: str, width: int, height: int) -> Iterator[Pair]:
    """The same burst of pictures to a camera stream, and to a bare socket."""
    per_burst = 24  # or waiting for the first one would weigh more than it does in a stream
    generator = np.random.default_rng(0)
    data = [
        generator.uniform(50, 500, (height, width)).astype("<f4").tobytes()
        if mode == "depth"
        else generator.integers(0, 256, (height, width, 4), np.uint8).tobytes()
        for _ in range(4)
    ]
    topic = camera_filter("robot/camera/eye")
    messages = [(topic, picture) for picture in data]
    with publisher([messages, messages]) as source, asyncio.Runner() as runner, _listening(source, 1, topic) as raw:
        endpoint = f"tcp://127.0.0.1:{source.ports[0]}"
        info = CameraInfo(
            mode=mode, resolution=(width, height), fovy=45.0, zmq_endpoint=endpoint, zmq_topic="robot/camera/eye"
        )
        session = Session(transport_to(endpoint, 0, None), default_timeout=10.0)
        publishers = Publishers(session, lambda: 0, live=lambda: True)
        stream = URLabCameraView("eye", info, publishers).frames("all", buffer=per_burst, buffer_bytes=1 << 30)

        async def read(pictures: int) -> float:
            source.send(0, pictures)
            started = time.perf_counter()
            for _ in range(pictures):
                await anext(stream)
            return (time.perf_counter() - started) / pictures

        def receive(count: int) -> list[float]:
            times: list[float] = []
            for _ in range(count):
                source.send(1, per_burst)
                started = time.perf_counter()
                for _ in range(per_burst):
                    raw.recv_multipart(copy=False)
                times.append((time.perf_counter() - started) / per_burst)
            return times

        runner.run(_open(stream))
        runner.run(_subscribed(source))
        source.wait_subscribed(1)
        yield Pair(ours=lambda count: [runner.run(read(per_burst)) for _ in range(count)], floor=receive)
        runner.run(_close(publishers))


async def _open(stream: aio.Stream[CameraSample]) -> None:
    await stream.__aenter__()


async def _subscribed(source: Publisher) -> None:
    """Wait until the client has subscribed, which takes its loop."""
    await asyncio.to_thread(source.wait_subscribed, 0)


async def _close(publishers: Publishers) -> None:
    publishers.close()


@contextlib.contextmanager
def _listening(source: Publisher, socket: int, topic: bytes) -> Iterator[zmq.Socket[bytes]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    raw = context.socket(zmq.SUB)
    raw.rcvtimeo = 10_000
    raw.rcvhwm = 4
    raw.connect(f"tcp://127.0.0.1:{source.ports[socket]}")
    raw.subscribe(topic)
    try:
        yield raw
    finally:
        raw.close(linger=0)
        context.term()


def _camera_rows(sizes: Sequence[tuple[str, int, int]]) -> list[Row]:
    return [
        Row(
            name=f"camera-{name}-{mode}",
            what=f"frames() of a {width}x{height} camera, {'metres' if mode == 'depth' else 'BGRA to RGBA'} included",
            floor="raw recv_multipart(copy=False)",
            reach=0.6 if height > 1000 else 0.7,
            prepare=functools.partial(_pictures, mode, width, height),
            kind="rate",
            burst_s=0.1,
        )
        for name, width, height in sizes
        for mode in ("real", "depth")
    ]


ROWS = (
    Row(
        name="live-state",
        what="live state of 3 robots into their articulations, as fast as it is sent",
        floor="decoding the same frames from memory",
        reach=0.5,
        prepare=_state,
        kind="rate",
        burst_s=0.1,
    ),
    *_camera_rows((("vga", 640, 480), ("1080p", 1920, 1080))),
)
