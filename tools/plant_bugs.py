"""Plant known bugs one at a time in a copy of the tree, and tell which of them the tests do not notice.

The bugs stand in planted_bugs.toml: what to replace by what, and the tests that are to fail then. The text to replace
occurs once in `src`, in whatever module; tests are named by their function, or by their module for all of it. So the
table outlives moves of modules, and fails its own check (`--check`, and a test) when the text is gone.

    python tools/plant_bugs.py                       # all, a few minutes each dozen
    python tools/plant_bugs.py --only wrench --only key
    python tools/plant_bugs.py --check

Exit code 1 when a bug survives, or an entry is not fit to tell.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from named_tests import named_tests, unnamed

ROOT = Path(__file__).resolve().parent.parent
TABLE = Path(__file__).with_name("planted_bugs.toml")
COPIED = ("src", "tests", "tools", "docs", "examples", "typings", "pyproject.toml", "README.md", "CHANGELOG.md")
DEADLINE_S = 300

PASSED, FAILED, NONE = 0, 1, 5  # exit codes of pytest; others say that it could not run the tests


@dataclass(frozen=True)
class Bug:
    """One entry of the table.

    Attributes:
        name: What is wrong.
        old: Text that occurs once in the sources.
        new: What takes its place.
        tests: Functions or modules of tests, by name.
    """

    name: str
    old: str
    new: str
    tests: Sequence[str]


def read(table: Path = TABLE) -> list[Bug]:
    """Return the bugs of a table."""
    return [Bug(**entry) for entry in tomllib.loads(table.read_text(encoding="utf-8"))["bug"]]


def sources(root: Path) -> dict[Path, str]:
    """Return the sources of a tree by their files."""
    return {path: path.read_text("utf-8") for path in sorted((root / "src").rglob("*.py"))}


def located(bug: Bug, texts: Mapping[Path, str]) -> Path:
    """Return the file that holds a bug's text.

    Raises:
        LookupError: None does, or it occurs more than once.
    """
    found = [path for path, text in texts.items() for _ in range(text.count(bug.old))]
    if len(found) != 1:
        raise LookupError(f"its text occurs {len(found)} times in src, not once")
    return found[0]


def problems(bugs: Sequence[Bug], root: Path) -> list[str]:
    """Return what is wrong with the entries of a table, for the tree below `root`."""
    found: list[str] = []
    ids, texts = named_tests(root / "tests"), sources(root)
    for bug in bugs:
        try:
            located(bug, texts)
        except LookupError as error:
            found.append(f"{bug.name}: {error}")
        if bug.old == bug.new:
            found.append(f"{bug.name}: old and new text are the same")
        found += [f"{bug.name}: {problem}" for problem in unnamed(bug.tests, ids)]
    return found


def run(tree: Path, ids: Sequence[str], *, stop: bool) -> subprocess.CompletedProcess[str]:
    """Run tests on the sources of a tree, also where those start processes of their own."""
    options = ["-q", "-p", "no:cacheprovider", "-n", "0", "--timeout=60", *(["-x"] if stop else [])]
    return subprocess.run(  # noqa: S603 - tests of this tree
        [sys.executable, "-m", "pytest", *options, *ids],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree / "src"), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )


def verdict(bug: Bug, tree: Path) -> str:
    """Plant a bug, run its tests, take it out; return `caught`, `SURVIVES`, `left out`, or why it cannot be told."""
    texts = sources(tree)
    path = located(bug, texts)
    text = texts[path]
    ids = named_tests(tree / "tests")
    try:
        path.write_text(text.replace(bug.old, bug.new), "utf-8")
        done = run(tree, [node for test in bug.tests for node in ids[test]], stop=True)
    except subprocess.TimeoutExpired:
        return "caught"  # it hangs, which nobody overlooks
    finally:
        path.write_text(text, "utf-8")
    if done.returncode == PASSED:
        return "SURVIVES"
    if done.returncode == FAILED:
        return "caught"
    if done.returncode == NONE:
        return "left out"  # the tests need an extra that is not installed
    return f"the tests cannot run (exit code {done.returncode}):\n{done.stdout[-2000:]}"


def main(argv: Sequence[str] | None = None, *, table: Path = TABLE, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="TEXT", help="bugs whose names contain TEXT")
    parser.add_argument("--part", metavar="I/N", help="the I-th of N parts of the table, from 1")
    parser.add_argument("--check", action="store_true", help="only see whether the table fits the tree")
    arguments = parser.parse_args(argv)
    bugs = [bug for bug in read(table) if not arguments.only or any(text in bug.name for text in arguments.only)]
    if arguments.part:
        part, parts = map(int, arguments.part.split("/"))
        bugs = bugs[part - 1 :: parts]
    wrong = problems(bugs, root)
    if wrong or arguments.check:
        print(*wrong, sep="\n", end="\n" if wrong else "")
        return 1 if wrong else 0
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif (root / name).exists():
                shutil.copy2(root / name, tree / name)
        ids = named_tests(tree / "tests")
        sound = run(tree, sorted({node for bug in bugs for test in bug.tests for node in ids[test]}), stop=False)
        if sound.returncode != PASSED:
            print(f"the tests fail without any bug:\n{sound.stdout[-3000:]}{sound.stderr[-1000:]}")
            return 1
        outcomes: list[str] = []
        for bug in bugs:
            outcomes.append(verdict(bug, tree))
            print(f"{outcomes[-1]:10} {bug.name}", flush=True)
    caught, left_out = outcomes.count("caught"), outcomes.count("left out")
    print(f"{caught} of {len(bugs)} caught, {outcomes.count('SURVIVES')} survive")
    return 0 if caught + left_out == len(bugs) else 1


if __name__ == "__main__":
    sys.exit(main())
