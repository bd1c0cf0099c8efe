"""Every extra is installed at its lowest version, and tested there."""

from __future__ import annotations

import re

import check_versions

NOT_AT_RUN_TIME = {"dev", "docs", "mutants", "test", "types"}


def test_every_extra_has_tests_at_its_lowest_version() -> None:
    extras = check_versions.project()["optional-dependencies"]
    assert set(check_versions.SMOKE) == set(extras) - NOT_AT_RUN_TIME
    assert set(check_versions.SMOKE) >= check_versions.GIGABYTES
    for file in check_versions.SMOKE.values():
        assert (check_versions.ROOT / file).is_file(), file
    pinned = check_versions.lowest_of(["web", "mcp"])
    assert "uvicorn==0.35" in pinned
    assert "mcp==2.3" in pinned
    assert len(pinned) == len({re.split("==", one)[0] for one in pinned}), "two extras have different lowest versions"


def test_a_marker_of_a_requirement_stays() -> None:
    assert check_versions.LOWEST.sub(r"==\1", "uvloop>=0.21,<1; sys_platform != 'win32'") == (
        "uvloop==0.21; sys_platform != 'win32'"
    )
