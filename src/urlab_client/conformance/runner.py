"""Runs checks in order, keeps what came of each, and brings the user's world back whatever happens."""

from __future__ import annotations

import asyncio
import itertools
import statistics
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

from msgspec import Struct

from urlab_client.conformance import authoring as _authoring
from urlab_client.conformance import cameras as _cameras
from urlab_client.conformance import playing as _playing
from urlab_client.conformance import reading as _reading
from urlab_client.conformance.bench import Bench, decoded, to_the_end
from urlab_client.conformance.declarations import (
    CHECKS,
    Check,
    Differs,
    Group,
    NotTried,
    StatementResult,
    Verdict,
    statement_titles,
    why_without_check,
)
from urlab_client.errors import URLabError

_LONGEST_S: Final = 120.0
_FRAMES: Final = 8
_UNREADABLE: Final = (LookupError, TypeError, ValueError, AttributeError)
"""Errors by which it shows that a reply, which is plain data here, lacks something, or has another type."""
_DECLARING: Final = (_reading, _cameras, _playing, _authoring)
"""The modules that declare the checks, which are known once these are imported."""


class CheckResult(Struct):
    """What came of one check."""

    title: str
    statements: tuple[str, ...]
    group: Group
    verdict: Verdict
    detail: str = ""
    frames: tuple[int, int] = (0, 0)
    """First and last number of its exchanges."""


class Report(Struct):
    """What a run found.

    Attributes:
        server: Who answered: versions, generation, what was open.
        statements: Every statement with its verdict.
        checks: Every check of the run.
        measurements: What was measured, without judgement.
        left: What could not be put back.
        stopped: Why the run ended early; empty if it did not.
    """

    server: dict[str, Any]
    statements: list[StatementResult]
    checks: list[CheckResult]
    measurements: dict[str, Any]
    left: list[str] = []
    stopped: str = ""

    @property
    def differing(self) -> list[StatementResult]:
        """The statements that do not hold."""
        return [statement for statement in self.statements if statement.verdict is Verdict.DIFFERS]


class Choice(Struct, frozen=True):
    """Which checks to run.

    Attributes:
        groups: What they may do.
        words: They have one of these in their title; empty for all.
        statements: They prove one of these; empty for all.
        measure: Whether to measure, too.
    """

    groups: frozenset[Group] = frozenset({Group.READ})
    words: tuple[str, ...] = ()
    statements: tuple[str, ...] = ()
    measure: bool = True

    def takes(self, check: Check) -> bool:
        """Whether a check is among them."""
        if self.statements and not set(self.statements) & set(check.statements):
            return False
        return not self.words or any(word.lower() in check.title.lower() for word in self.words)


Progress = Callable[[CheckResult, int, int], None]
"""Called after each check with its result, its number and the number of all."""


async def run(
    bench: Bench,
    choice: Choice,
    progress: Progress = lambda _result, _number, _all: None,
    interrupted: Callable[[Report], None] = lambda _: None,
) -> Report:
    """Run the chosen checks against an opened bench, and bring the user's world back.

    Cancelling it brings the world back, too; then `interrupted` is called with what was found until then.
    """
    wanted = [check for check in CHECKS if choice.takes(check) and bench.dialect in check.dialects]
    results: list[CheckResult] = []
    measurements: dict[str, Any] = {}
    stopped = ""

    def report() -> Report:
        measured = measurements | bench.measured
        return Report(_server(bench), _statements(bench, results), results, measured, bench.left, stopped)

    try:
        for group in Group:
            chosen = [check for check in wanted if check.group is group and not check.last]
            obstacle, differs = await _begin(bench, group, choice, chosen)
            if differs:
                title, statements = f"The {group} checks can begin", _BEGINNING[group]
                results.append(CheckResult(title, statements, group, Verdict.DIFFERS, obstacle))
            for check in chosen:
                if obstacle or stopped:
                    result = CheckResult(check.title, check.statements, group, Verdict.NOT_TRIED, obstacle or stopped)
                else:
                    result = await one(bench, check)
                    if result.verdict is Verdict.DIFFERS and not await _answers(bench):
                        stopped = "the server does not answer any more"
                results.append(result)
                progress(result, len(results), len(wanted))
            if choice.measure and not obstacle and not stopped and group in choice.groups and not choice.words:
                measurements |= await _measure(bench, group)
            await bench.put_back()
        for check in wanted if not stopped else ():
            if check.last:
                results.append(await one(bench, check))
                progress(results[-1], len(results), len(wanted))
    except asyncio.CancelledError:
        await bench.put_back()
        stopped, done = "interrupted", {result.title for result in results}
        results += (
            CheckResult(
                check.title, check.statements, check.group, Verdict.NOT_TRIED, _closed(check.group, choice) or stopped
            )
            for check in wanted
            if check.title not in done
        )
        interrupted(report())
        raise
    finally:
        await bench.put_back()
    return report()


async def one(bench: Bench, check: Check) -> CheckResult:
    """Run a check on a bench that is prepared for its group."""
    before, undone = bench.wire.count, bench.undone
    verdict, detail = Verdict.HOLDS, ""
    try:
        for need in check.needs:
            bench.need(need)
        async with asyncio.timeout(_LONGEST_S):
            if check.group is Group.PLAY:
                bench.start = await bench.restart()
            await check.body(bench)
    except NotTried as reason:
        verdict, detail = Verdict.NOT_TRIED, str(reason)
    except (Differs, URLabError) as error:
        verdict, detail = Verdict.DIFFERS, str(error)
    except TimeoutError:
        verdict, detail = Verdict.DIFFERS, f"expected an end within {_LONGEST_S:g} s, got none"
    except _UNREADABLE as error:
        verdict, detail = Verdict.DIFFERS, f"expected the declared fields, got {type(error).__name__}: {error}"
    await bench.put_back(undone)
    return CheckResult(check.title, check.statements, check.group, verdict, detail, (before + 1, bench.wire.count))


def _closed(group: Group, choice: Choice) -> str:
    return "" if group in choice.groups else f"changes the world, so it needs --{group}"


async def _begin(bench: Bench, group: Group, choice: Choice, checks: Collection[Check]) -> tuple[str, bool]:
    """Prepare the world for a group; return what stands in the way, and whether the server answers wrongly."""
    if closed := _closed(group, choice):
        return closed, False
    if not checks or group is Group.READ:
        return "", False
    try:
        await to_the_end(bench.play() if group is Group.PLAY else bench.author())
    except NotTried as reason:
        return str(reason), False
    except (Differs, URLabError, *_UNREADABLE) as error:
        return f"the {group} checks could not begin: {error}", True
    return "", False


_BEGINNING: Final = {
    Group.PLAY: ("Session 9.6", "Editor 3.2 begin_pie"),
    Group.AUTHOR: ("Editor 3.1 create_level", "Editor 3.1 import_xml"),
}


async def _answers(bench: Bench) -> bool:
    try:
        await bench.wire.raw("meta")
    except (TimeoutError, URLabError):
        return False
    except Differs:
        return True
    return True


def _statements(bench: Bench, results: Sequence[CheckResult]) -> list[StatementResult]:
    rows: list[StatementResult] = []
    for name, title in statement_titles().items():
        own = [result for result in results if name in result.statements]
        worst = next((result for result in own if result.verdict is Verdict.DIFFERS), None)
        best = worst or next((result for result in own if result.verdict is Verdict.HOLDS), None)
        row = StatementResult(name, title, Verdict.NOT_TRIED)
        if best is not None:
            row.verdict, row.detail = best.verdict, f"{best.title}: {best.detail}" if best.detail else best.title
            if worst is not None:
                first, last = worst.frames
                row.frames = [str(number) for number in range(max(first, last - _FRAMES + 1), last + 1)]
        else:
            row.detail = own[0].detail if own else why_without_check(name, bench.dialect)
        rows.append(row)
    return rows


def _server(bench: Bench) -> dict[str, Any]:
    hello = bench.plain_hello
    return {
        "address": bench.wire.transport.endpoint,
        "generation": bench.features.generation,
        "urlab_version": hello.get("urlab_version"),
        "mujoco_version": hello.get("mujoco_version"),
        "ops": len(bench.ops),
        "robots": len(bench.robots),
        "cameras": sum(len(robot.info.camera_topics) for robot in bench.robots),
        "capabilities": sorted(bench.features.capabilities),
        "requests": bench.wire.count,
        "over_shared_memory": bench.wire.transport.stats.over_shm,
    }


# Measurements, without judgement: times and rates, such as a simulated server should have, too.

_SAMPLES: Final = 50
_LIVE_S: Final = 2.0


async def _measure(bench: Bench, group: Group) -> dict[str, Any]:
    """Measure what a group may do to the user's world; what stops it is among the results."""
    measured: dict[str, Any] = {}
    try:
        if group is Group.READ:
            for _ in range(_SAMPLES):
                await bench.ask("meta")
        elif group is Group.PLAY:
            await bench.restart()
            measured["steps_per_second"] = {str(n): await _step_rate(bench, n) for n in (1, 10, 100)}
            measured["live"] = await _live(bench)
            await bench.restart()
            measured["pictures"] = await _pictures(bench)
    except (Differs, NotTried, URLabError, LookupError) as error:
        measured[f"{group}_stopped"] = str(error)
    return measured | {"round_trip_ms": {op: _times(times) for op, times in sorted(bench.wire.times.items())}}


def _times(seconds: Sequence[float]) -> dict[str, float]:
    spread = {"min": min(seconds), "median": statistics.median(seconds), "max": max(seconds)}
    return {"count": len(seconds), **{name: round(1e3 * value, 3) for name, value in spread.items()}}


async def _step_rate(bench: Bench, n: int) -> float:
    await bench.step(n_steps=n)
    began = time.perf_counter()
    for _ in range(_SAMPLES):
        await bench.step(n_steps=n)
    return round(_SAMPLES * n / (time.perf_counter() - began), 1)


async def _live(bench: Bench) -> dict[str, Any]:
    """Measure how evenly snapshots come in live mode, and how fast time passes."""
    await bench.enter("live")
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
                reply = await bench.step(include_cameras={name: "sync"}, **extra)
                if reply.get("cameras"):
                    times.append(time.perf_counter() - began)
                await asyncio.sleep(0)
            sizes[size] = (
                {"step_to_picture_ms": _times(times), "per_second": round(len(times) / sum(times), 1)}
                if times
                else "no picture came"
            )
    return sizes
