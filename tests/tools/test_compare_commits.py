"""tools/compare_commits.py: what counts as a change between two commits."""

from __future__ import annotations

import pytest

from compare_commits import Change


@pytest.mark.parametrize(
    ("factors", "verdict"),
    [
        ([1.2, 1.1, 1.3, 1.15], "SLOWER"),
        ([0.8, 0.9, 0.85, 0.7], "quicker"),
        ([1.2, 1.1, 0.9, 1.15], "no clear change"),  # one of four pairs says the opposite
        ([1.2, 1.1, 0.9, 1.15, 1.2, 1.1, 1.1, 1.2], "SLOWER"),  # one of eight may
        ([1.01, 1.02, 1.01, 1.02], "no clear change"),  # all agree, on next to nothing
    ],
)
def test_pairs_must_agree_on_a_change_worth_the_name(factors: list[float], verdict: str) -> None:
    assert Change("ratio", factors).verdict(3.0) == verdict
