"""How a ratio is taken: two things in turn, in many short bursts, so that what disturbs one disturbs the other."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Literal

__all__ = ["Figure", "Pair", "Result", "Row", "each", "measure", "percentile"]

Burst = Callable[[int], list[float]]
"""Does something a number of times; returns seconds per time, one value for each or one mean of all."""

_BURST_S = 0.03
_CALIBRATIONS = 3
_MIN_ROUNDS = 4
_MIN_ROUNDS_QUICK = 2


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A number beside the ratio of times.

    Attributes:
        name: What it is, with its unit if it has one.
        value: The number.
        at_most: The limit to keep, or None for a number that only informs.
    """

    name: str
    value: float
    at_most: float | None = None


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two things ready to be run.

    Attributes:
        ours: What is measured.
        floor: What it is measured against.
        figures: Other figures, taken once at the end.
    """

    ours: Burst
    floor: Burst
    figures: Callable[[], Sequence[Figure]] = tuple


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of the table.

    Attributes:
        name: Short name, for `--only`.
        what: What is measured.
        floor: What it is measured against.
        reach: The ratio of medians to reach.
        prepare: Makes the pair, and takes it down.
        kind: `time`: time by the floor's time, to be at most `reach`; `rate`: rate by the floor's rate, at least it.
        p99: The ratio of 99th percentiles to keep, where bursts return single times.
        processor: The ratio of processor times to keep, where bursts return single times.
        burst_s: Seconds per burst: longer than what disturbs single times, shorter than what disturbs whole bursts.
        count: Times per burst, where `burst_s` does not tell: 1 for what takes long.
    """

    name: str
    what: str
    floor: str
    reach: float
    prepare: Callable[[], AbstractContextManager[Pair]]
    kind: Literal["time", "rate"] = "time"
    p99: float | None = None
    processor: float | None = None
    burst_s: float = _BURST_S
    count: int | None = None


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came out.

    Attributes:
        row: The row.
        ratio: Median of the rounds' ratios of medians: what slows the machine down for a while spoils few of them.
        low: Tenth percentile of the rounds' own ratios; `high` the ninetieth. Far apart means a noisy machine.
        p99: Ratio of 99th percentiles; None where single times are not known.
        rounds: Rounds taken.
        samples: Times taken, of each of the two.
        cpu_us: Median of the rounds' processor times of ours and of the floor, microseconds each: of this process with
            all its threads, so without the server's. None where single times are not known.
        median_s: Median seconds of ours and of the floor on this machine, to look into; they are not comparable.
        figures: The other figures.
    """

    row: Row
    ratio: float
    low: float
    high: float
    p99: float | None
    rounds: int
    samples: int
    cpu_us: tuple[float, float] | None
    median_s: tuple[float, float]
    figures: Sequence[Figure] = field(default_factory=tuple)

    @property
    def misses(self) -> list[str]:
        """What is not reached."""
        row = self.row
        reached = self.ratio >= row.reach if row.kind == "rate" else self.ratio <= row.reach
        missed = [] if reached else ["median"]
        if row.p99 is not None and self.p99 is not None and self.p99 > row.p99:
            missed.append("p99")
        if row.processor and self.cpu_us is not None and self.cpu_us[0] > row.processor * self.cpu_us[1]:
            missed.append("processor time")
        return [*missed, *(f.name for f in self.figures if f.at_most is not None and f.value > f.at_most)]


def each(operation: Callable[[], object]) -> Burst:
    """Return a burst that times every single call of `operation`."""

    def burst(count: int) -> list[float]:
        clock = time.perf_counter
        times: list[float] = []
        for _ in range(count):
            started = clock()
            operation()
            times.append(clock() - started)
        return times

    return burst


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the value below which so many percent of `values` lie."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(percent / 100 * (len(ordered) - 1)))]


def measure(row: Row, seconds: float) -> Result:
    """Take a row's ratio in about `seconds`, preparation not counted."""
    with row.prepare() as pair:
        # Several times, as one that is disturbed gives a number that is far too small.
        counts = {
            burst: row.count or max(_count(burst, row.burst_s) for _ in range(_CALIBRATIONS))
            for burst in (pair.ours, pair.floor)
        }
        ours: list[list[float]] = []
        floor: list[list[float]] = []
        busy: dict[Burst, list[float]] = {pair.ours: [], pair.floor: []}
        gc.collect()
        end = time.perf_counter() + seconds
        least = _MIN_ROUNDS if seconds > 2 else _MIN_ROUNDS_QUICK
        while len(ours) < least or time.perf_counter() < end:
            turns = [(pair.ours, ours), (pair.floor, floor)]
            # The order changes, so that neither always has the other's aftermath to bear.
            for burst, taken in turns if len(ours) % 2 else reversed(turns):
                before = time.process_time()
                taken.append(burst(counts[burst]))
                busy[burst].append((time.process_time() - before) / counts[burst])
        figures = pair.figures()
    of_rounds = [_ratio(row, statistics.median(a), statistics.median(b)) for a, b in zip(ours, floor, strict=True)]
    all_ours = [time_s for taken in ours for time_s in taken]
    all_floor = [time_s for taken in floor for time_s in taken]
    medians = statistics.median(all_ours), statistics.median(all_floor)
    singles = min(len(all_ours), len(all_floor)) >= 100 and row.kind == "time"
    return Result(
        row=row,
        ratio=statistics.median(of_rounds),
        low=percentile(of_rounds, 10),
        high=percentile(of_rounds, 90),
        p99=percentile(all_ours, 99) / percentile(all_floor, 99) if singles else None,
        rounds=len(ours),
        samples=min(len(all_ours), len(all_floor)),
        cpu_us=(1e6 * statistics.median(busy[pair.ours]), 1e6 * statistics.median(busy[pair.floor]))
        if singles
        else None,
        median_s=medians,
        figures=figures,
    )


def _micros(seconds: Sequence[float]) -> float:
    return 1e6 * statistics.median(seconds)


def _ratio(row: Row, ours: float, floor: float) -> float:
    return floor / ours if row.kind == "rate" else ours / floor


def _count(burst: Burst, seconds: float) -> int:
    """Return how many times fill a burst. Warms up on the way."""
    count = 1
    while True:
        started = time.perf_counter()
        burst(count)
        took = time.perf_counter() - started
        if took >= seconds / 4:
            return max(1, round(count * seconds / took))
        count *= 4
