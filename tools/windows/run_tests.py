"""Run tests on Windows' Python under Wine, file by file, and say what share of Linux's tests that is.

run_tests.py INTERPRETER PYTHON [--limit SECONDS] [--workers N] [--logs FOLDER] PATH...

INTERPRETER is what make_python.sh made, PYTHON one of this system that has the project's test dependencies: it says
which tests run on Linux. A PATH is a folder, a file, or FILE::TEST. A test that ends or hangs the interpreter fails,
and the rest of its file runs in another one. Every test that runs on Linux and that `tests/not_on_windows.toml` does
not list has a result: it failed, too, if it was skipped, or if no interpreter came to it. Where Wine does not start,
one line says so, and where the time is up, what has not run; neither is a failure.
"""

from __future__ import annotations

import argparse
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
sys.path.append(str(ROOT / "tests" / "support"))

from not_on_windows import listed, names  # noqa: E402

RESULT = re.compile(r"((?:tests/\S.*?)?)(?: (PASSED|FAILED|ERROR|SKIPPED)\b.*| \++ Timeout \++)?")
TEST_S = 200
SILENCE_S = 40  # beyond a test's time: the interpreter does not start, or end
FILE_S = 1200
COLLECT_S = 120
LEFTOVER_S = 3  # what a test leaves behind may keep the interpreter's output open
ATTEMPTS = 4
NOT_COLLECTED, NOT_FOUND, NOTHING_LEFT, CRASHED, STOPPED = 2, 4, 5, -1, -2  # exit codes: the first three are pytest's
RAN_AND_FAILED = ("FAILED", "ERROR")
FAILED = (*RAN_AND_FAILED, "SKIPPED", "NOT RUN")


@dataclasses.dataclass
class Outcome:
    """How the tests of a file ended: what was asked for of it, those that run on Linux, and those meant to run here."""

    file: str
    asked: list[str]
    on_linux: list[str]
    meant: list[str]
    results: dict[str, str] = dataclasses.field(default_factory=dict[str, str])
    problems: list[str] = dataclasses.field(default_factory=list[str])
    seconds: float = 0.0
    broken_off: bool = False

    @property
    def rest(self) -> list[str]:
        """The tests that are meant to run and have no result."""
        return [test for test in self.meant if test not in self.results]

    def result(self, line: str) -> tuple[str, str] | None:
        """Return the test that a line of pytest's is about, and how it ended, or nothing as long as it runs."""
        # What ends the interpreter may print its last words behind the test's name.
        test = max((test for test in self.meant if f"{line} ".startswith(f"{test} ")), key=len, default="")
        found = RESULT.fullmatch(line.removeprefix(test))
        if test:
            return test, (found[2] or "") if found else ""
        return (found[1], found[2] or "") if found and "::" in found[1] else None

    def count(self, *words: str) -> int:
        """Return how many of the tests that are meant to run ended in one of these ways."""
        return sum(self.results.get(test) in words for test in self.meant)

    @property
    def passed(self) -> int:
        """The number of tests that passed."""
        return self.count("PASSED")

    @property
    def ran(self) -> int:
        """The number of tests that ran, however they ended."""
        return self.count("PASSED", *RAN_AND_FAILED)

    @property
    def failed(self) -> int:
        """The number of tests that failed, or did not run although there was time."""
        return self.count(*FAILED)


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


def on_linux(python: str, paths: list[str]) -> list[Outcome]:
    """Return what is to be found out: by file, the tests that run on Linux."""
    command = [python, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", *paths]
    try:
        done = subprocess.run(  # noqa: S603
            command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=COLLECT_S
        )
    except subprocess.TimeoutExpired:
        sys.exit(f"the tests could not be collected here within {COLLECT_S} s")
    if done.returncode:
        sys.exit(f"the tests cannot be collected here:\n{done.stdout}{done.stderr}")
    files: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        if "::" in line:
            files.setdefault(line.partition("::")[0], []).append(line)
    entries = listed(wine=True)
    return [
        Outcome(file, asked_of(file, paths), tests, [test for test in tests if not names(entries, test)])
        for file, tests in files.items()
    ]


def asked_of(file: str, paths: list[str]) -> list[str]:
    """Return what to run of a file: all, or the tests of it that the paths name."""
    plain = {path: Path(os.path.relpath(path.partition("::")[0], ROOT)) for path in paths}
    if any("::" not in path and Path(file).is_relative_to(plain[path]) for path in paths):
        return [file]
    return [file + path[path.index("::") :] for path in paths if "::" in path and plain[path] == Path(file)]


def run(outcome: Outcome, prefix: Prefix, log: Path, clock: Clock) -> Outcome:
    """Run a file's tests."""
    started = time.monotonic()
    log.unlink(missing_ok=True)
    crashes = 0
    while outcome.rest and not outcome.broken_off:
        met, code = run_rest(outcome, prefix, log, clock)
        interrupted = [test for test, result in outcome.results.items() if not result]
        if code == STOPPED and clock.up:
            outcome.broken_off = True
            break
        outcome.results |= dict.fromkeys(interrupted, "ERROR")
        if (code in {0, 1} and met and not interrupted) or (code == NOTHING_LEFT and not met):
            break
        crashes += 1
        if not interrupted:
            outcome.problems.append(f"the interpreter ended with {code} outside tests")
        if code in {NOT_COLLECTED, NOT_FOUND} or crashes == ATTEMPTS or time.monotonic() - started > FILE_S:
            break
    if not outcome.broken_off:
        outcome.results |= dict.fromkeys(outcome.rest, "NOT RUN")
    outcome.seconds = time.monotonic() - started
    outcome.problems += [f"{result} {test}" for test, result in outcome.results.items() if result in FAILED]
    return outcome


def run_rest(outcome: Outcome, prefix: Prefix, log: Path, clock: Clock) -> tuple[int, int]:
    """Run those of a file's tests that have no result yet; return how many were met, and the exit code."""
    options = ["-v", "--tb=short", "-n", "0", "-p", "no:cacheprovider", "-o", "timeout_method=thread"]
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".txt") as arguments:
        arguments.writelines(f"{test}\n" for test in (outcome.rest if outcome.results else outcome.asked))
        arguments.flush()
        process = subprocess.Popen(  # noqa: S603
            [prefix.interpreter, "-m", "pytest", *options, f"--timeout={clock.test_s:.0f}", f"@Z:{arguments.name}"],
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
                    if found := outcome.result(line.rstrip()):
                        met += 1
                        outcome.results |= [found]
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
    outcomes = on_linux(arguments.python, arguments.paths)
    with contextlib.ExitStack() as stack:
        logs = arguments.logs or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        logs.mkdir(parents=True, exist_ok=True)
        try:
            os.environ["DISPLAY"] = stack.enter_context(screen())
            running = stack.enter_context(prefixes(arguments.interpreter.resolve(), arguments.workers))
        except NotStarted as problem:
            print(f"the tests on Windows were not run: {problem}")
            return 0
        meant = sum(len(outcome.meant) for outcome in outcomes)
        print(f"Windows: running {meant} tests of {len(outcomes)} files", flush=True)
        run_all(outcomes, running, logs, clock)
    if left := [outcome.file for outcome in outcomes if outcome.broken_off]:
        print(f"the time of {clock.seconds:.0f} s was up; not run, or not to the end: {', '.join(left)}")
    print(table(outcomes))
    ran, total = sum(outcome.ran for outcome in outcomes), sum(len(outcome.on_linux) for outcome in outcomes)
    print(
        f"{ran} of {total} tests that run on Linux ran here: {100 * ran / total:.1f} %, "
        f"{sum(outcome.passed for outcome in outcomes)} passed; {sum(outcome.failed for outcome in outcomes)} failed, "
        f"were skipped or not reached, in {clock.passed:.0f} s"
    )
    return 1 if any(outcome.problems for outcome in outcomes) else 0


def table(outcomes: list[Outcome]) -> str:
    """Return the numbers by folder, as a table in Markdown."""
    folders: dict[str, list[Outcome]] = {}
    for outcome in sorted(outcomes, key=lambda outcome: outcome.file):
        parts = Path(outcome.file).parts
        folders.setdefault("/".join(parts[:2]) if len(parts) > 2 else "tests/test_*.py", []).append(outcome)
    lines = ["| tests | on Linux | listed | ran | passed | minutes |", "|---|---|---|---|---|---|"]
    for folder, those in [*((f"`{name}`", those) for name, those in folders.items()), ("together", outcomes)]:
        everywhere, meant = sum(len(one.on_linux) for one in those), sum(len(one.meant) for one in those)
        ran, passed = sum(one.ran for one in those), sum(one.passed for one in those)
        minutes = sum(one.seconds for one in those) / 60
        lines.append(f"| {folder} | {everywhere} | {everywhere - meant} | {ran} | {passed} | {minutes:.1f} |")
    return "\n".join(lines)


def run_all(outcomes: list[Outcome], running: list[Prefix], logs: Path, clock: Clock) -> None:
    """Run the files' tests, as many files at a time as there are Wines, and print how they ended."""
    free: queue.SimpleQueue[Prefix] = queue.SimpleQueue()
    for prefix in running:
        free.put(prefix)

    def one(outcome: Outcome) -> Outcome:
        prefix = free.get()
        try:
            if clock.up:
                outcome.broken_off = True
                return outcome
            return run(outcome, prefix, logs / f"{outcome.file.replace('/', '_')}.log", clock)
        finally:
            free.put(prefix)

    with concurrent.futures.ThreadPoolExecutor(len(running)) as pool:
        try:
            for done in concurrent.futures.as_completed([pool.submit(one, outcome) for outcome in outcomes]):
                show(done.result())
        except BaseException:
            clock.end()
            raise


def show(outcome: Outcome) -> None:
    """Print how a file's tests ended."""
    if outcome.broken_off and not outcome.results:
        return
    numbers = [f"{outcome.passed} passed"]
    numbers += [f"{outcome.failed} failed"] if outcome.failed else []
    numbers += [f"{len(outcome.on_linux)} on Linux", f"{outcome.seconds:.0f} s"]
    numbers += ["broken off"] if outcome.broken_off else []
    print(f"{outcome.file}: {', '.join(numbers)}", flush=True)
    for problem in outcome.problems:
        print(f"    {problem}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
