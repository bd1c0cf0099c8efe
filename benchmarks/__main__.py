"""`python -m benchmarks`: print the table and write the JSON file."""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from benchmarks.harness import Result, Row, measure
from benchmarks.machine import commit, describe
from benchmarks.robots import DIALECT
from benchmarks.rows import all_rows, one_row
from urlab_client.server import RenderingUnavailable

RELEASED = Path(__file__).parent / "released.json"
"""Figures of the latest release, on a machine that does nothing else."""


def main() -> int:
    """Run the command line; return the exit code."""
    parser = _parser()
    options = parser.parse_args()
    os.environ[DIALECT] = options.dialect
    rows = _chosen(options.row, options.only)
    if options.brief:
        rows = _one_of_each_kind(rows)
    if not rows:
        parser.error(f"no row is named like {' or '.join(options.only or [options.row])}")
    if options.list:
        for row in rows:
            print(f"{row.name:<30}{row.what} / {row.floor}")
        return 0
    if options.released:
        if options.only or options.row:
            parser.error("--released takes every row: leave out --only and --row")
        if commit() is None or str(commit()).endswith("+"):
            parser.error("--released: the figures name a commit; commit the changes first")
        options.json = RELEASED
    seconds = options.seconds or (1.0 if options.quick else 10.0)
    before = describe()
    print(f"{before['cpu']}, {before['cores']} cores, load {before['load']}, Python {before['python']}\n")
    print(
        f"{'row':<30}{'ratio':>7}  {'(10-90 % of rounds)':<18}{'to reach':>9}{'p99':>7}{'to keep':>9}"
        f"{'µs':>8}{'floor':>8}{'processor':>11}{'floor':>7}{'to keep':>9}  rounds"
    )
    results: list[Result] = []
    for row in rows:
        started = time.perf_counter()
        try:
            result = measure(row, seconds)
        except RenderingUnavailable as missing:
            print(f"{row.name:<30}not measured: {missing}")
            continue
        results.append(result)
        _print(result, time.perf_counter() - started)
    if not results:
        return 1
    document = {"before": before, "after": describe(), "seconds": seconds, "rows": [_plain(r) for r in results]}
    if options.against is not None:
        _compare(results, options.against)  # before it may be written over
    options.json.write_bytes(msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")
    print(f"\nwritten: {options.json}")
    missed = [result.row.name for result in results if result.misses]
    if missed:
        print(f"missed: {', '.join(missed)}")
    return int(options.check and bool(missed))


def _chosen(name: str | None, parts: Sequence[str] | None) -> list[Row]:
    """Return the row of that name, or else those whose name contains one of `parts`; without parts, all."""
    if name:
        found = one_row(name)
        return [] if found is None else [found]
    return [row for row in all_rows() if not parts or any(part in row.name for part in parts)]


def _one_of_each_kind(rows: Sequence[Row]) -> list[Row]:
    """Return the first of the rows whose names are the same up to a number, asleep or awake."""
    kinds: dict[str, Row] = {}
    for row in rows:
        kinds.setdefault(re.sub(r"-?\d.*", "", row.name.removeprefix("warm-")), row)
    return [*kinds.values()]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="under a minute; noisier")
    parser.add_argument(
        "--brief", action="store_true", help="only one of the rows that differ by a number, or by sleep"
    )
    parser.add_argument("--only", action="append", metavar="NAME", help="rows whose name contains NAME; repeatable")
    parser.add_argument("--row", metavar="NAME", help="the one row of that name")
    parser.add_argument("--against", type=Path, metavar="FILE", help="figures of another run to report the change from")
    parser.add_argument("--json", type=Path, default=Path("benchmarks.json"), help="file to write (%(default)s)")
    parser.add_argument("--check", action="store_true", help="exit with 1 if a row misses what it is to reach or keep")
    parser.add_argument(
        "--released", action="store_true", help=f"write {RELEASED.parent.name}/{RELEASED.name}: every row of a commit"
    )
    parser.add_argument("--seconds", type=float, help="seconds to measure each row, instead of 10, or 1 with --quick")
    parser.add_argument(
        "--dialect", choices=("alpha", "beta"), default="alpha", help="what the rows' servers speak (%(default)s)"
    )
    parser.add_argument("--list", action="store_true", help="list the rows and stop")
    return parser


def _compare(results: Sequence[Result], against: Path) -> None:
    """Report how far the ratios are from those of another run, which may be of another machine."""
    if not against.exists():
        print(f"\nno figures to compare with: {against} does not exist")
        return
    document = msgspec.json.decode(against.read_bytes())
    known = {row["name"]: row for row in document["rows"]}
    then = document["before"]
    print(
        f"\nratios by those of {against}, {then.get('time', 'at an unknown time')}, commit {then.get('commit')}, "
        f"{then['cpu']}, {then['cores']} cores, load {then['load']}; in brackets the 10-90 % of rounds, then and now"
    )
    for result in results:
        row = known.get(result.row.name)
        if row is None:
            print(f"{result.row.name:<30}new")
            continue
        apart = result.low > row["high"] or result.high < row["low"]
        print(
            f"{result.row.name:<30}{row['ratio']:>6.2f} ({row['low']:.2f} - {row['high']:.2f})"
            f"{result.ratio:>8.2f} ({result.low:.2f} - {result.high:.2f}){'  changed' if apart else ''}"
        )


def _print(result: Result, seconds: float) -> None:
    row = result.row
    sign = "≥" if row.kind == "rate" else "≤"
    spread = f"({result.low:.2f} - {result.high:.2f})"
    p99 = "" if result.p99 is None else f"{result.p99:.2f}"
    keep = "" if row.p99 is None else f"≤ {row.p99:.2f}"
    missed = f"  missed: {', '.join(result.misses)}" if result.misses else ""
    ours, floor = ("", "") if result.cpu_us is None else (f"{each:.1f}" for each in result.cpu_us)
    most = "" if row.processor is None else f"≤ {row.processor:.2f}"
    took, floor_took = (f"{1e6 * each:.1f}" for each in result.median_s)
    print(
        f"{row.name:<30}{result.ratio:>7.2f}  {spread:<18}{f'{sign} {row.reach:.2f}':>9}{p99:>7}{keep:>9}"
        f"{took:>8}{floor_took:>8}{ours:>11}{floor:>7}{most:>9}  {result.rounds} in {seconds:.0f} s{missed}"
    )
    for figure in result.figures:
        limit = "" if figure.at_most is None else f"  (to keep: ≤ {figure.at_most:g})"
        print(f"  {figure.name}: {figure.value:.3g}{limit}")
    sys.stdout.flush()


def _plain(result: Result) -> dict[str, object]:
    row = result.row
    return {
        "name": row.name,
        "what": row.what,
        "floor": row.floor,
        "kind": row.kind,
        "ratio": result.ratio,
        "low": result.low,
        "high": result.high,
        "reach": row.reach,
        "p99": result.p99,
        "p99_to_keep": row.p99,
        "cpu_us": None if result.cpu_us is None else {"ours": result.cpu_us[0], "floor": result.cpu_us[1]},
        "processor_to_keep": row.processor,
        "rounds": result.rounds,
        "samples": result.samples,
        "median_s": {"ours": result.median_s[0], "floor": result.median_s[1]},
        "figures": [{"name": f.name, "value": f.value, "at_most": f.at_most} for f in result.figures],
        "missed": result.misses,
    }


if __name__ == "__main__":
    sys.exit(main())
