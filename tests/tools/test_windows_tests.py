"""`tools/windows/run_tests.py`: what hangs ends within its time, and nothing that did not pass is left out."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytestmark = pytest.mark.long

FILE = "tests/x.py"


@pytest.fixture
def run_tests(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, which waits for a quarter of a second where it would for half a minute."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools" / "windows"))
    import run_tests  # pyright: ignore[reportMissingImports]

    for name in ("TEST_S", "SILENCE_S", "LEFTOVER_S"):
        monkeypatch.setattr(run_tests, name, 0.25)
    monkeypatch.setattr(run_tests, "ATTEMPTS", 2)
    return run_tests


def run(run_tests: ModuleType, folder: Path, program: str, *tests: str, limit: float = 60) -> Any:
    """Run a shell's program in place of the interpreter, for tests of these names."""
    interpreter = folder / "winpy"
    interpreter.write_text(f"#!/bin/bash\n{program}\n")
    interpreter.chmod(0o755)
    prefix = run_tests.Prefix(folder / "prefix", interpreter)
    meant = [f"{FILE}::{test}" for test in tests]
    return run_tests.run(run_tests.Outcome(FILE, [FILE], meant, meant), prefix, folder / "log", run_tests.Clock(limit))


@pytest.mark.parametrize(
    ("program", "limit", "result", "broken_off"),
    [
        pytest.param("echo tests/x.py::test_a PASSED; sleep inf & exit 0", 60, "PASSED", False, id="leftover"),
        pytest.param("echo tests/x.py::test_a; sleep inf", 60, "ERROR", False, id="silent"),
        pytest.param("trap '' TERM; while :; do echo; sleep 0.1; done", 0.5, None, True, id="time up"),
    ],
)
def test_what_hangs_ends(
    run_tests: ModuleType, tmp_path: Path, program: str, limit: float, result: str | None, broken_off: bool
) -> None:
    outcome = run(run_tests, tmp_path, program, "test_a", limit=limit)
    assert outcome.results.get(f"{FILE}::test_a") == result
    assert outcome.broken_off is broken_off


@pytest.mark.parametrize(
    ("program", "problem"),
    [
        pytest.param("echo 'tests/x.py::test_a SKIPPED (why)'", "SKIPPED tests/x.py::test_a", id="skipped"),
        pytest.param("exit 0", "NOT RUN tests/x.py::test_a", id="not collected there"),
        pytest.param("exit 2", "NOT RUN tests/x.py::test_a", id="cannot be imported"),
        pytest.param("echo tests/x.py::test_a; exit 5", "ERROR tests/x.py::test_a", id="ended within it"),
        pytest.param("exit 9", "NOT RUN tests/x.py::test_a", id="ended before it"),
        pytest.param("sleep inf", "NOT RUN tests/x.py::test_a", id="hung before it"),
    ],
)
def test_a_test_without_a_result_has_failed(run_tests: ModuleType, tmp_path: Path, program: str, problem: str) -> None:
    outcome = run(run_tests, tmp_path, program, "test_a")
    assert problem in outcome.problems
    assert (outcome.passed, outcome.failed) == (0, 1)
    assert run_tests.table([outcome]).splitlines()[-1].startswith("| together | 1 | 0 |")


def test_a_crash_costs_one_test_and_not_those_whose_names_begin_alike(run_tests: ModuleType, tmp_path: Path) -> None:
    program = """
        for last; do :; done
        if grep -q :: "${last#@Z:}"
        then sed 's/$/ PASSED/' "${last#@Z:}"
        else echo tests/x.py::test_a Assertion failed; exit 9
        fi
    """
    outcome = run(run_tests, tmp_path, program, "test_a", "test_a_too", "test_b[x]")
    assert outcome.problems == ["ERROR tests/x.py::test_a"]
    assert outcome.passed == 2


def test_an_interpreter_that_does_not_start_is_started_again(run_tests: ModuleType, tmp_path: Path) -> None:
    program = f"mkdir {tmp_path}/once && exit 1; echo tests/x.py::test_a PASSED"
    outcome = run(run_tests, tmp_path, program, "test_a")
    assert outcome.passed == 1
    assert outcome.problems == ["the interpreter ended with 1 outside tests"]


def test_a_crash_after_the_last_test_is_told(run_tests: ModuleType, tmp_path: Path) -> None:
    outcome = run(run_tests, tmp_path, "echo tests/x.py::test_a PASSED; exit 9", "test_a")
    assert outcome.passed == 1
    assert outcome.problems == ["the interpreter ended with 9 outside tests"]


def test_of_a_file_those_tests_run_that_are_named(run_tests: ModuleType) -> None:
    file = "tests/test_no_pickle.py"
    names = {test.partition("::")[2] for test in run_tests.on_linux(sys.executable, [file])[0].on_linux}
    name = min(names)
    for path in (f"{file}::{name}", str(Path(__file__).parents[1] / f"test_no_pickle.py::{name}")):
        [outcome] = run_tests.on_linux(sys.executable, [path])
        assert (outcome.asked, outcome.on_linux) == ([f"{file}::{name}"], [f"{file}::{name}"])
    for paths in (["tests/test_no_pickle.py"], ["tests/test_no_pickle.py", f"{file}::{name}"]):
        [outcome] = run_tests.on_linux(sys.executable, paths)
        assert outcome.asked == [file]
        assert len(outcome.on_linux) == len(names)
