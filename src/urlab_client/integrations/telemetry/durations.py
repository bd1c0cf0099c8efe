"""Bucket boundaries of duration histograms: a step takes tenths of a millisecond, an import minutes."""

from typing import Final

__all__ = ["DURATIONS_S"]

DURATIONS_S: Final = (
    1e-4,
    2.5e-4,
    5e-4,
    1e-3,
    2.5e-3,
    5e-3,
    1e-2,
    2.5e-2,
    5e-2,
    0.1,
    0.25,
    0.5,
    1.0,
    2.5,
    5.0,
    10.0,
    60.0,
)
"""Upper limits, seconds."""
