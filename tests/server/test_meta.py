"""The catalogue that `meta` sends against the one recorded from the plugin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from wire import Wire

DATA = Path(__file__).parents[1] / "data"


def by_name(catalogue: Mapping[str, Any]) -> dict[str, Any]:
    names = [op["name"] for op in catalogue["ops"]]
    assert len(names) == len(set(names))
    return dict(zip(names, catalogue["ops"], strict=True))


def mismatches(ours: Mapping[str, Any], recorded: Mapping[str, Any]) -> set[str]:
    """Return `op field` for each difference, `op` alone where one side lacks the op."""
    found = ours.keys() ^ recorded.keys()
    for name in ours.keys() & recorded.keys():
        one, other = ours[name], recorded[name]
        found |= {f"{name} {field}" for field in one.keys() | other.keys() if one.get(field) != other.get(field)}
    return found


def expected_mismatches() -> set[str]:
    lines = (DATA / "expected_mismatch.txt").read_text().splitlines()
    entries = [line for line in lines if line and not line.startswith("#")]
    for entry in entries:
        assert ": " in entry, f"expected_mismatch.txt: {entry!r} gives no reason"
    return {entry.partition(":")[0] for entry in entries}


def test_catalogue_is_the_recorded_one(serve: Callable[..., Wire]) -> None:
    recorded = by_name(msgspec.json.decode((DATA / "meta.json").read_bytes()))
    ours = by_name(serve().raw({"op": "meta"}))
    # Equality in both directions: an entry that no longer applies fails, too.
    assert mismatches(ours, recorded) == expected_mismatches()


def test_ops_without_lists_leave_the_keys_out(serve: Callable[..., Wire]) -> None:
    ours = by_name(serve().raw({"op": "meta"}))
    assert set(ours["recording_start"]) == {"name", "category", "namespace"}
    assert "required_fields" not in ours["stop_pie"]


def test_bootstrap_ops_are_not_listed(serve: Callable[..., Wire]) -> None:
    assert not {"hello", "meta"} & by_name(serve().raw({"op": "meta"})).keys()
