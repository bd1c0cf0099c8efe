"""Run tests on Windows' Python under Wine, file by file, and say what share of Linux's tests that is.

run_tests.py INTERPRETER PYTHON [--limit SECONDS] [--workers N] [--logs FOLDER] PATH...

INTERPRETER is what make_python.sh made, PYTHON one of this system that has the project's test dependencies: it says
which tests run on Linux. A test that ends or hangs the interpreter fails; the rest of its file runs in another one.
Where Wine does not start, one line says so, and where the time is up, what has not run; neither is a failure.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import contextlib
import dataclasses
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from wine import NotStarted, Prefix, prefixes, screen

ROOT = Path(__file__).resolve().parents[2]
RESULT = re.compile(r"(tests/\S.*?)(?: (PASSED|FAILED|ERROR|SKIPPED)\b.*| \++ Timeout \++)?")
TEST_S = 200
SILENCE_S = 40  # beyond a test's time: the interpreter does not start, or end
FILE_S = 1200
COLLECT_S = 120
LEFTOVER_S = 3  # what a test leaves behind may keep the interpreter's output open
ATTEMPTS = 4
NOT_COLLECTED, NOTHING_LEFT, CRASHED, STOPPED = 2, 5, -1, -2  # exit codes: the first two are pytest's


@dataclasses.dataclass
class Outcome:
    """How the tests of a file ended, and how often the interpreter did between them."""

    file: str
    results: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    problems: list[str] = dataclasses.field(default_factory=list[str])
    seconds: float = 0.0
    crashes: int = 0
    broken_off: bool = False

    def count(self, *words: str) -> int:
        """Return how many tests ended in one of these ways."""
        return sum(result in words for result in self.results.values())

    @property
    def ran(self) -> int:
        """The number of tests that ran, however they ended."""
        return self.count("PASSED", "FAILED", "ERROR")


class Clock:
    """The time for everything; ending it ends what runs."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.test_s = min(TEST_S, seconds / 3)
        self._started = time.monotonic()
        self._ended = threading.Event()

    @property
    def passed(self) -> float:
        """The seconds that have passed."""
        return time.monotonic() - self._started

    @property
    def up(self) -> bool:
        """Whether the time is up."""
        return self._ended.is_set() or self.passed > self.seconds

    def end(self) -> None:
        """Be up at once."""
        self._ended.set()


def on_linux(python: str, paths: list[str]) -> collections.Counter[str]:
    """Return the number of tests that run on Linux, by file."""
    command = [python, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", *paths]
    try:
        done = subprocess.run(  # noqa: S603
            command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=COLLECT_S
        )
    except subprocess.TimeoutExpired:
        sys.exit(f"the tests could not be collected here within {COLLECT_S} s")
    if done.returncode:
        sys.exit(f"the tests cannot be collected here:\n{done.stdout}{done.stderr}")
    return collections.Counter(line.partition("::")[0] for line in done.stdout.splitlines() if "::" in line)


def run(file: str, prefix: Prefix, log: Path, clock: Clock) -> Outcome:
    """Run a file's tests."""
    outcome = Outcome(file)
    started = time.monotonic()
    log.unlink(missing_ok=True)
    for _ in range(ATTEMPTS):
        met, code = run_rest(outcome, prefix, log, clock)
        interrupted = [test for test, result in outcome.results.items() if not result]
        if code == STOPPED and clock.up:
            outcome.broken_off = True
            break
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


def run_rest(outcome: Outcome, prefix: Prefix, log: Path, clock: Clock) -> tuple[int, int]:
    """Run those of a file's tests that have no result yet; return how many were met, and the exit code."""
    options = ["-v", "--tb=short", "-n", "0", "-p", "no:cacheprovider", "-o", "timeout_method=thread"]
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".txt") as arguments:
        arguments.writelines(f"--deselect={test}\n" for test in outcome.results)
        arguments.flush()
        listed = [f"@Z:{arguments.name}"] if outcome.results else []
        process = subprocess.Popen(  # noqa: S603
            [prefix.interpreter, "-m", "pytest", *options, f"--timeout={clock.test_s:.0f}", *listed, outcome.file],
            cwd=ROOT,
            env=prefix.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        met, crashed = 0, False
        try:
            with log.open("a", buffering=1, encoding="utf-8") as written:
                for line in lines(process, clock):
                    written.write(line)
                    crashed = crashed or line.startswith("wine: Unhandled ")
                    if found := RESULT.fullmatch(line.rstrip().replace("\\", "/")):
                        test, result = found.groups()
                        if "::" in test:
                            met += 1
                            outcome.results[test] = result or ""
            stopped = process.poll() is None
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return met, STOPPED if stopped else CRASHED if crashed else process.returncode


def lines(process: subprocess.Popen[str], clock: Clock) -> Iterator[str]:
    """Yield what a process prints, until it ends, has printed nothing for long, or the time is up."""
    printed: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        assert process.stdout is not None  # noqa: S101
        with process.stdout:
            for line in process.stdout:
                printed.put(line)
        printed.put(None)

    threading.Thread(target=read, daemon=True).start()
    heard = time.monotonic()
    while not clock.up:
        limit = LEFTOVER_S if process.poll() is not None else clock.test_s + SILENCE_S
        try:
            line = printed.get(timeout=0.5)
        except queue.Empty:
            if time.monotonic() - heard > limit:
                return
            continue
        if line is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(LEFTOVER_S)
            return
        heard = time.monotonic()
        yield line


def main() -> int:
    parser = argparse.ArgumentParser(description="Run tests on Windows' Python under Wine.")
    parser.add_argument("interpreter", type=Path)
    parser.add_argument("python")
    parser.add_argument("--limit", type=float, default=1e6, metavar="SECONDS", help="for everything")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--logs", type=Path, metavar="FOLDER", help="keep the output there")
    parser.add_argument("paths", nargs="+", metavar="PATH")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that nothing stays
    clock = Clock(arguments.limit)
    print(f"Windows: looking for the tests that run on Linux, at most {COLLECT_S} s", flush=True)
    linux = on_linux(arguments.python, arguments.paths)
    with contextlib.ExitStack() as stack:
        logs = arguments.logs or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        logs.mkdir(parents=True, exist_ok=True)
        try:
            os.environ["DISPLAY"] = stack.enter_context(screen())
            running = stack.enter_context(prefixes(arguments.interpreter.resolve(), arguments.workers))
        except NotStarted as problem:
            print(f"the tests on Windows were not run: {problem}")
            return 0
        print(f"Windows: running {linux.total()} tests of {len(linux)} files", flush=True)
        outcomes = run_all(linux, running, logs, clock)
    if left := [file for file in linux if file not in {done.file for done in outcomes if not done.broken_off}]:
        print(f"the time of {clock.seconds:.0f} s was up; not run, or not to the end: {', '.join(left)}")
    ran, total = sum(outcome.ran for outcome in outcomes), linux.total()
    passed = sum(outcome.count("PASSED") for outcome in outcomes)
    print(
        f"{ran} of {total} tests that run on Linux ran here: {100 * ran / total:.1f} %, {passed} passed, "
        f"{ran - passed} failed, in {clock.passed:.0f} s"
    )
    return 1 if any(outcome.problems for outcome in outcomes) else 0


def run_all(linux: collections.Counter[str], running: list[Prefix], logs: Path, clock: Clock) -> list[Outcome]:
    """Run the files' tests, as many files at a time as there are Wines, and print how they ended."""
    free: queue.SimpleQueue[Prefix] = queue.SimpleQueue()
    for prefix in running:
        free.put(prefix)

    def one(file: str) -> Outcome | None:
        prefix = free.get()
        try:
            return None if clock.up else run(file, prefix, logs / f"{file.replace('/', '_')}.log", clock)
        finally:
            free.put(prefix)

    outcomes: list[Outcome] = []
    with concurrent.futures.ThreadPoolExecutor(len(running)) as pool:
        try:
            for done in concurrent.futures.as_completed([pool.submit(one, file) for file in linux]):
                if outcome := done.result():
                    outcomes.append(outcome)
                    show(outcome, linux[outcome.file])
        except BaseException:
            clock.end()
            raise
    return outcomes


def show(outcome: Outcome, number: int) -> None:
    """Print how a file's tests ended, of so many on Linux."""
    end = ", broken off" if outcome.broken_off else ""
    counts = f"{outcome.count('PASSED')} passed, {number} on Linux"
    print(f"{outcome.file}: {counts}, {outcome.seconds:.0f} s{end}", flush=True)
    if outcome.crashes:
        print(f"    the interpreter crashed {outcome.crashes} times outside tests", flush=True)
    for problem in outcome.problems:
        print(f"    {problem}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
