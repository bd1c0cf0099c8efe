"""Compare what two commits cost, row by row: in turn, in pairs, so that a busy machine disturbs both alike.

    python tools/compare_commits.py main                        # the working tree against main, all rows
    python tools/compare_commits.py v0.1.0 HEAD --only step --pairs 8
    python tools/compare_commits.py HEAD~5 --list

Each commit's package is measured with the benchmarks of this working tree, by this interpreter. A pair is one run of a
row on either commit, each with its own floor; the order changes from pair to pair. What is compared are the rows'
ratios and, where a row has it, the processor time, which a busy machine disturbs least. A change counts as one when all
pairs but one in eight agree on its direction and their median exceeds `--from` percent. The exit code is 0 whatever
comes out: this only reports.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parent.parent
WORKING_TREE = "working tree"
RUN_S = 300.0  # for one run of one row: far more than any takes


class Figures(msgspec.Struct):
    """What the benchmarks say of one row."""

    name: str
    kind: str
    ratio: float
    cpu_us: dict[str, float] | None = None


class Document(msgspec.Struct):
    """What `python -m benchmarks --json` writes."""

    rows: list[Figures]


@dataclass
class Change:
    """Pairs of one figure: after by before, above 1 for slower."""

    what: str
    factors: list[float] = field(default_factory=list[float])

    def verdict(self, least: float) -> str:
        """Return how the figure changed, in words."""
        middle = statistics.median(self.factors)
        agree = sum((factor > 1) == (middle > 1) for factor in self.factors)
        clear = agree >= len(self.factors) - len(self.factors) // 8 and abs(middle - 1) * 100 >= least
        if not clear:
            return "no clear change"
        return "SLOWER" if middle > 1 else "quicker"


def tree_of(commit: str, into: Path) -> Path:
    """Return a directory with the package as it is in a commit."""
    if commit == WORKING_TREE:
        return ROOT
    archive = subprocess.run(  # noqa: S603  # a commit that the user names
        ["git", "archive", commit, "src"],  # noqa: S607
        cwd=ROOT,
        check=True,
        capture_output=True,
    ).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as tar:
        tar.extractall(into, filter="data")
    return into


def run(tree: Path, row: str, seconds: float, folder: Path) -> Figures | None:
    """Measure one row with the package of a tree; None where it cannot be measured there."""
    output = folder / "figures.json"
    output.unlink(missing_ok=True)
    command = [sys.executable, "-m", "benchmarks", "--row", row, "--seconds", str(seconds), "--json", str(output)]
    environment = os.environ | {"PYTHONPATH": str(tree / "src")}
    try:
        done = subprocess.run(  # noqa: S603  # ourselves
            command, cwd=ROOT, env=environment, check=False, capture_output=True, text=True, timeout=RUN_S
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode or not output.exists():
        return None
    return msgspec.json.decode(output.read_bytes(), type=Document).rows[0]


def compare(row: str, trees: tuple[Path, Path], pairs: int, seconds: float, folder: Path) -> list[Change]:
    """Measure a row on both trees, pair by pair; empty where one of them cannot."""
    ratio, processor = Change("ratio"), Change("processor")
    for number in range(pairs):
        order = (0, 1) if number % 2 else (1, 0)
        found: dict[int, Figures] = {}
        for index in order:
            figures = run(trees[index], row, seconds, folder)
            if figures is None:
                return []
            found[index] = figures
        before, after = found[0], found[1]
        ratio.factors.append(before.ratio / after.ratio if after.kind == "rate" else after.ratio / before.ratio)
        if before.cpu_us and after.cpu_us:
            processor.factors.append(after.cpu_us["ours"] / before.cpu_us["ours"])
    return [change for change in (ratio, processor) if change.factors]


def row_names(only: Sequence[str]) -> list[str]:
    """Return the rows of the benchmarks whose names contain one of these."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.rows import all_rows

    return [row.name for row in all_rows() if not only or any(part in row.name for part in only)]


def main() -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", help="commit to compare with")
    parser.add_argument("after", nargs="?", default=WORKING_TREE, help="commit to compare; the %(default)s by default")
    parser.add_argument("--only", action="append", metavar="NAME", help="rows whose name contains NAME; repeatable")
    parser.add_argument("--pairs", type=int, default=6, help="pairs of runs for each row (%(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="seconds of each run (%(default)s)")
    parser.add_argument(
        "--from", type=float, default=3.0, dest="least", help="least change to call one, %% (%(default)s)"
    )
    parser.add_argument("--list", action="store_true", help="list the rows and stop")
    options = parser.parse_args()
    rows = row_names(options.only or ())
    if options.list:
        print("\n".join(rows))
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        trees = tree_of(options.before, folder / "before"), tree_of(options.after, folder / "after")
        print(
            f"{options.after} by {options.before}, {options.pairs} pairs of {options.seconds:g} s; 1.05 is 5 % more\n"
        )
        print(f"{'row':<30}{'figure':<12}{'median':>7}  {'of pairs':<16}")
        for row in rows:
            changes = compare(row, trees, options.pairs, options.seconds, folder)
            if not changes:
                print(f"{row:<30}cannot be measured on both")
            for change in changes:
                low, high = min(change.factors), max(change.factors)
                spread = f"({low:.2f} - {high:.2f})"
                middle = statistics.median(change.factors)
                print(f"{row:<30}{change.what:<12}{middle:>7.3f}  {spread:<16}{change.verdict(options.least)}")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
