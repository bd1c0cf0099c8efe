"""What is measured without judgement: times and rates, such as a simulated server should have, too."""

from __future__ import annotations

import asyncio
import itertools
import statistics
import time
from collections.abc import Sequence
from typing import Any, Final

from urlab_client.conformance.bench import Bench, decoded
from urlab_client.conformance.declarations import Group

_SAMPLES: Final = 50
_LIVE_S: Final = 2.0


async def measure(bench: Bench, group: Group) -> dict[str, Any]:
    """Measure what a group may do to the user's world."""
    if group is Group.READ:
        for _ in range(_SAMPLES):
            await bench.wire.ask("meta")
    measured: dict[str, Any] = {"round_trip_ms": {op: _times(times) for op, times in sorted(bench.wire.times.items())}}
    if group is not Group.PLAY:
        return measured
    await bench.direct()
    measured["steps_per_second"] = {str(n): await _step_rate(bench, n) for n in (1, 10, 100)}
    measured["live"] = await _live(bench)
    if any(robot.info.camera_topics for robot in bench.robots):
        await bench.direct()
        measured["pictures"] = await _pictures(bench)
    return measured


def _times(seconds: Sequence[float]) -> dict[str, float]:
    spread = {"min": min(seconds), "median": statistics.median(seconds), "max": max(seconds)}
    return {"count": len(seconds), **{name: round(1e3 * value, 3) for name, value in spread.items()}}


async def _step_rate(bench: Bench, n: int) -> float:
    await bench.wire.ask("step", n_steps=n)
    began = time.perf_counter()
    for _ in range(_SAMPLES):
        await bench.wire.ask("step", n_steps=n)
    return round(_SAMPLES * n / (time.perf_counter() - began), 1)


async def _live(bench: Bench) -> dict[str, Any]:
    """Measure how evenly snapshots come in live mode, and how fast time passes."""
    bench.later("set_mode", mode="direct")
    await bench.wire.ask("set_mode", mode="live")
    await bench.wire.ask("set_paused", paused=False)
    messages = await bench.wire.listen(bench.state_endpoint, _LIVE_S, lambda _: False)
    snapshots = [message for message in messages if message.topic == b"state/full"]
    if len(snapshots) < _FEWEST:
        return {"snapshots": len(snapshots)}
    gaps = [1e3 * (after.at - before.at) for before, after in itertools.pairwise(snapshots)]
    took = snapshots[-1].at - snapshots[0].at
    passed = float(decoded(snapshots[-1])["time"]) - float(decoded(snapshots[0])["time"])
    return {
        "snapshots_per_second": round((len(snapshots) - 1) / took, 1),
        "gap_ms": {"median": round(statistics.median(gaps), 3), "max": round(max(gaps), 3)},
        "jitter_ms": round(statistics.pstdev(gaps), 3),
        "real_time_factor": round(passed / took, 3),
    }


_FEWEST: Final = 3


async def _pictures(bench: Bench) -> dict[str, Any]:
    """Measure the time of steps with a picture, by the picture's size."""
    sizes: dict[str, Any] = {}
    for robot in bench.robots:
        for name, info in robot.info.camera_topics.items():
            size = "x".join(map(str, info.resolution))
            if size in sizes:
                continue
            times: list[float] = []
            extra = {"render": "sync", "camera_timeout_ms": 10_000.0} if bench.features.renders_sync else {}
            for _ in range(5):
                began = time.perf_counter()
                reply = await bench.wire.ask("step", include_cameras={name: "sync"}, **extra)
                if reply.get("cameras"):
                    times.append(time.perf_counter() - began)
                await asyncio.sleep(0)
            sizes[size] = (
                {"step_to_picture_ms": _times(times), "per_second": round(len(times) / sum(times), 1)}
                if (times)
                else "no picture came"
            )
    return sizes
