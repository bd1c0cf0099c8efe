"""What `tests/not_on_windows.toml` lists."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from pathlib import Path

LIST = Path(__file__).parents[1] / "not_on_windows.toml"


def listed(*, wine: bool) -> dict[str, str]:
    """Return the tests, files and folders that do not run on Windows, or under Wine, and why."""
    systems = tomllib.loads(LIST.read_text("utf-8"))
    groups = [*systems["windows"], *(systems["wine"] if wine else [])]
    return {test: group["why"] for group in groups for test in group["tests"]}


def names(entries: Iterable[str], test: str) -> bool:
    """Whether one of these entries names a test, its class, its file or its folder."""
    name = test.partition("[")[0]
    return any(entry in (test, name) or name.startswith((f"{entry}::", f"{entry}/")) for entry in entries)
