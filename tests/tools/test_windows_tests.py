"""`tools/windows/run_tests.py`: what hangs ends within its time, and is named."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

pytestmark = pytest.mark.long


@pytest.fixture
def run_tests(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, which waits for a quarter of a second where it would for half a minute."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "tools" / "windows"))
    import run_tests  # pyright: ignore[reportMissingImports]

    for name in ("TEST_S", "SILENCE_S", "LEFTOVER_S"):
        monkeypatch.setattr(run_tests, name, 0.25)
    monkeypatch.setattr(run_tests, "ATTEMPTS", 1)
    return run_tests


@pytest.mark.parametrize(
    ("program", "limit", "results", "broken_off"),
    [
        pytest.param(
            "echo tests/x.py::test_a PASSED; sleep inf & exit 0", 60, {"test_a": "PASSED"}, False, id="leftover"
        ),
        pytest.param("echo tests/x.py::test_a; sleep inf", 60, {"test_a": "ERROR"}, False, id="silent"),
        pytest.param("trap '' TERM; while :; do echo; sleep 0.1; done", 0.5, {}, True, id="time up"),
    ],
)
def test_what_hangs_ends(
    run_tests: ModuleType, tmp_path: Path, program: str, limit: float, results: dict[str, str], broken_off: bool
) -> None:
    interpreter = tmp_path / "winpy"
    interpreter.write_text(f"#!/bin/bash\n{program}\n")
    interpreter.chmod(0o755)
    prefix = run_tests.Prefix(tmp_path / "prefix", interpreter)
    outcome = run_tests.run("tests/x.py", prefix, tmp_path / "log", run_tests.Clock(limit))
    assert outcome.results == {f"tests/x.py::{test}": result for test, result in results.items()}
    assert outcome.broken_off is broken_off
