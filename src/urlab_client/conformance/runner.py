"""Runs checks in order, keeps what came of each, and brings the user's world back whatever happens."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

from msgspec import Struct

from urlab_client.conformance import authoring
from urlab_client.conformance import cameras as _cameras
from urlab_client.conformance import playing as _playing
from urlab_client.conformance import reading as _reading
from urlab_client.conformance.bench import Bench
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
from urlab_client.conformance.measurements import measure
from urlab_client.errors import URLabConnectionError, URLabError

_LONGEST_S: Final = 120.0
_DECLARING: Final = (_reading, _cameras, _playing, authoring)
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


def _unseen(*_: object) -> None: ...


async def run(bench: Bench, choice: Choice, progress: Progress = _unseen) -> Report:
    """Run the chosen checks against an opened bench, and bring the user's world back.

    Cancelling it brings the world back, too. What was found until then is lost.
    """
    wanted = [check for check in CHECKS if choice.takes(check) and bench.dialect in check.dialects]
    results: list[CheckResult] = []
    measurements: dict[str, Any] = {}
    left: list[str] = []
    stopped = ""
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
                measurements |= await _measured(bench, group)
            left += await asyncio.shield(bench.put_back())
        for check in wanted if not stopped else ():
            if check.last:
                results.append(await one(bench, check))
                progress(results[-1], len(results), len(wanted))
    finally:
        if bench.undone:
            left += await asyncio.shield(bench.put_back())
    measurements |= bench.measured
    return Report(_server(bench), _statements(bench, results), results, measurements, left, stopped)


async def one(bench: Bench, check: Check) -> CheckResult:
    """Run a check on a bench that is prepared for its group."""
    before, undone = bench.wire.count, bench.undone
    verdict, detail = Verdict.HOLDS, ""
    try:
        for need in check.needs:
            bench.need(need)
        async with asyncio.timeout(_LONGEST_S):
            await check.body(bench)
    except NotTried as reason:
        verdict, detail = Verdict.NOT_TRIED, str(reason)
    except (Differs, URLabError) as error:
        verdict, detail = Verdict.DIFFERS, str(error)
    except TimeoutError:
        verdict, detail = Verdict.DIFFERS, f"expected an end within {_LONGEST_S:g} s, got none"
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        # A reply is plain data here: what is missing or of another type shows where it is used.
        verdict, detail = Verdict.DIFFERS, f"expected the declared fields, got {type(error).__name__}: {error}"
    await asyncio.shield(bench.put_back(undone))
    return CheckResult(check.title, check.statements, check.group, verdict, detail, (before + 1, bench.wire.count))


async def _begin(bench: Bench, group: Group, choice: Choice, checks: Collection[Check]) -> tuple[str, bool]:
    """Prepare the world for a group; return what stands in the way, and whether the server answers wrongly."""
    if group not in choice.groups:
        return f"changes the world, so it needs --{group}", False
    if not checks or group is Group.READ:
        return "", False
    try:
        await (bench.play() if group is Group.PLAY else authoring.prepare(bench))
    except NotTried as reason:
        return str(reason), False
    except (Differs, URLabError, LookupError, TypeError, ValueError) as error:
        return f"the {group} checks could not begin: {error}", True
    return "", False


_BEGINNING: Final = {
    Group.PLAY: ("Session 9.6", "Editor 3.2 begin_pie"),
    Group.AUTHOR: ("Editor 3.1 create_level", "Editor 3.1 import_xml"),
}


async def _answers(bench: Bench) -> bool:
    try:
        await bench.wire.raw("meta")
    except (URLabConnectionError, TimeoutError, URLabError):
        return False
    except Differs:
        return True
    return True


async def _measured(bench: Bench, group: Group) -> dict[str, Any]:
    try:
        return await measure(bench, group)
    except (Differs, NotTried, URLabError, LookupError) as error:
        return {f"{group}_stopped": str(error)}


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


_FRAMES: Final = 8


def _server(bench: Bench) -> dict[str, Any]:
    hello = bench.plain_hello
    return {
        "address": bench.wire.endpoint,
        "generation": bench.features.generation,
        "urlab_version": hello.get("urlab_version"),
        "mujoco_version": hello.get("mujoco_version"),
        "ops": len(bench.ops),
        "robots": len(bench.robots),
        "cameras": sum(len(robot.info.camera_topics) for robot in bench.robots),
        "capabilities": sorted(bench.features.capabilities),
        "requests": bench.wire.count,
        "over_shared_memory": bench.wire.over_shm,
    }
