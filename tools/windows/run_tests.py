"""Run tests on Windows' Python under Wine, file by file, and say what share of Linux's tests that is.

run_tests.py INTERPRETER PYTHON [--workers N] [--logs FOLDER] PATH...

INTERPRETER is what make_python.sh made, PYTHON one of this system that has the project's test dependencies: it says
which tests run on Linux. A test that ends or hangs the interpreter fails; the rest of its file runs in another one.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import dataclasses
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RESULT = re.compile(r"(tests/\S.*?)(?: (PASSED|FAILED|ERROR|SKIPPED)\b.*| \++ Timeout \++)?")
STAYING = "import ctypes, time; ctypes.windll.user32.GetDesktopWindow(); time.sleep(1e6)"
TEST_S = 200
FILE_S = 1200
ATTEMPTS = 4
NOT_COLLECTED, NOTHING_LEFT, CRASHED = 2, 5, -1  # exit codes: the first two are pytest's


@dataclasses.dataclass
class Outcome:
    """How the tests of a file ended, and how often the interpreter did between them."""

    file: str
    results: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    problems: list[str] = dataclasses.field(default_factory=list[str])
    seconds: float = 0.0
    crashes: int = 0

    def count(self, *words: str) -> int:
        """Return how many tests ended in one of these ways."""
        return sum(result in words for result in self.results.values())

    @property
    def ran(self) -> int:
        """The number of tests that ran, however they ended."""
        return self.count("PASSED", "FAILED", "ERROR")


def on_linux(python: str, paths: list[str]) -> collections.Counter[str]:
    """Return the number of tests that run on Linux, by file."""
    command = [python, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", *paths]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode:
        sys.exit(f"the tests cannot be collected here:\n{done.stdout}{done.stderr}")
    return collections.Counter(line.partition("::")[0] for line in done.stdout.splitlines() if "::" in line)


def run(file: str, interpreter: Path, prefix: Path, log: Path) -> Outcome:
    """Run a file's tests."""
    outcome = Outcome(file)
    started = time.monotonic()
    log.unlink(missing_ok=True)
    for _ in range(ATTEMPTS):
        met, code = run_rest(outcome, interpreter, prefix, log)
        interrupted = [test for test, result in outcome.results.items() if not result]
        outcome.results |= dict.fromkeys(interrupted, "ERROR")
        if (code in {0, 1} and not interrupted) or (code == NOTHING_LEFT and not met):
            break
        if code == NOT_COLLECTED or time.monotonic() - started > FILE_S:
            outcome.problems.append(f"the interpreter ended with {code} before all tests had run")
            break
        outcome.crashes += not interrupted
    else:
        outcome.problems.append(f"the interpreter crashed {ATTEMPTS} times before all tests had run")
    outcome.seconds = time.monotonic() - started
    outcome.problems += [
        f"{result} {test}" for test, result in outcome.results.items() if result in {"FAILED", "ERROR"}
    ]
    return outcome


def run_rest(outcome: Outcome, interpreter: Path, prefix: Path, log: Path) -> tuple[int, int]:
    """Run those of a file's tests that have no result yet; return how many were met, and the exit code."""
    options = ["-v", "--tb=short", "-n", "0", "-p", "no:cacheprovider", "-o", "timeout_method=thread"]
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".txt") as arguments:
        arguments.writelines(f"--deselect={test}\n" for test in outcome.results)
        arguments.flush()
        listed = [f"@Z:{arguments.name}"] if outcome.results else []
        with (
            subprocess.Popen(  # noqa: S603
                [
                    *("timeout", "--kill-after=10", str(FILE_S)),
                    *(interpreter, "-m", "pytest", *options, f"--timeout={TEST_S}", *listed, outcome.file),
                ],
                cwd=ROOT,
                env={**os.environ, "WINEPREFIX": str(prefix)},
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            ) as process,
            log.open("a", buffering=1, encoding="utf-8") as lines,
        ):
            assert process.stdout is not None  # noqa: S101
            met, crashed = 0, False
            for line in process.stdout:
                lines.write(line)
                crashed = crashed or line.startswith("wine: Unhandled ")
                if found := RESULT.fullmatch(line.rstrip().replace("\\", "/")):
                    test, result = found.groups()
                    if "::" in test:
                        met += 1
                        outcome.results[test] = result or ""
        return met, CRASHED if crashed else process.returncode


def main() -> int:
    parser = argparse.ArgumentParser(description="Run tests on Windows' Python under Wine.")
    parser.add_argument("interpreter", type=Path)
    parser.add_argument("python")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--logs", type=Path, metavar="FOLDER", help="keep the output there")
    parser.add_argument("paths", nargs="+", metavar="PATH")
    arguments = parser.parse_args()
    linux = on_linux(arguments.python, arguments.paths)
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        logs = arguments.logs or Path(scratch)
        logs.mkdir(parents=True, exist_ok=True)
        prefixes: queue.SimpleQueue[Path] = queue.SimpleQueue()
        for path in copies(arguments.interpreter.parent, arguments.workers):
            start(path, arguments.interpreter.parent)
            prefixes.put(path)

        def one(file: str) -> Outcome:
            path = prefixes.get()
            try:
                return run(file, arguments.interpreter, path, logs / f"{file.replace('/', '_')}.log")
            finally:
                prefixes.put(path)

        outcomes: list[Outcome] = []
        with concurrent.futures.ThreadPoolExecutor(arguments.workers) as pool:
            for done in concurrent.futures.as_completed([pool.submit(one, file) for file in linux]):
                outcome = done.result()
                outcomes.append(outcome)
                counts = f"{outcome.count('PASSED')} passed, {linux[outcome.file]} on Linux"
                print(f"{outcome.file}: {counts}, {outcome.seconds:.0f} s", flush=True)
                if outcome.crashes:
                    print(f"    the interpreter crashed {outcome.crashes} times outside tests", flush=True)
                for problem in outcome.problems:
                    print(f"    {problem}", flush=True)
        while not prefixes.empty():
            environment = {**os.environ, "WINEPREFIX": str(prefixes.get())}
            subprocess.run(["wineserver", "-k"], env=environment, check=False)  # noqa: S607
    ran, total = sum(outcome.ran for outcome in outcomes), linux.total()
    passed = sum(outcome.count("PASSED") for outcome in outcomes)
    print(
        f"{ran} of {total} tests that run on Linux ran here: {100 * ran / total:.1f} %, {passed} passed, "
        f"{ran - passed} failed, in {time.monotonic() - started:.0f} s"
    )
    return 1 if any(outcome.problems for outcome in outcomes) else 0


def copies(folder: Path, number: int) -> list[Path]:
    """Return a Wine for each worker: that of the interpreter, and copies of it."""
    original = folder / "prefix"
    # Wine keeps the registry in memory until its server ends: a copy made before then crashes.
    for option in ("-k", "-w"):
        environment = {**os.environ, "WINEPREFIX": str(original)}
        subprocess.run(["wineserver", option], env=environment, check=False)  # noqa: S603, S607
    paths = [original, *(folder / f"prefix-{i}" for i in range(1, number))]
    for path in paths:
        if not path.exists():
            shutil.copytree(original, path, symlinks=True)
    return paths


def start(path: Path, folder: Path) -> None:
    """Start a Wine, with a server that gives way to what it serves."""
    environment = {**os.environ, "WINEPREFIX": str(path), "WINEDEBUG": "-all"}
    subprocess.run(["nice", "-n", "5", "wineserver", "-p"], env=environment, check=False)  # noqa: S607
    # Wine's services, and the desktop with the first window, start with the first program that asks for them and keep
    # its output open; a test's would not end. So this one comes first, and stays.
    subprocess.Popen(  # noqa: S603
        ["wine", str(folder / "py" / "python.exe"), "-c", STAYING],  # noqa: S607
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


if __name__ == "__main__":
    sys.exit(main())
