"""The list of what Windows cannot run names tests that there are."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LISTED = tomllib.loads((ROOT / "tests" / "not_on_windows.toml").read_text("utf-8"))


@pytest.mark.parametrize("system", ["windows", "wine"])
def test_what_is_listed_exists_and_has_a_reason(system: str) -> None:
    for group in LISTED[system]:
        assert group["why"].endswith(".")
        for test in group["tests"]:
            file, *names = test.partition("[")[0].split("::")
            assert (ROOT / file).exists(), file
            for name in names:
                assert re.search(rf"(def|class) {name}\b", (ROOT / file).read_text("utf-8")), test


def test_the_systems_are_those_that_are_looked_for() -> None:
    assert set(LISTED) == {"windows", "wine"}
