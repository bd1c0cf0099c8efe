"""Numbers as users give them, checked before anything is sent: NaN, infinities and None end a simulation quietly."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import SupportsFloat, TypeGuard, cast

import numpy as np

from urlab_client.protocol.base import Floats

__all__ = ["finite", "finite_array", "first_not_finite", "is_array"]


def is_array(value: object) -> TypeGuard[Iterable[float]]:
    """Whether a value is several numbers: a sequence or an array of any library."""
    return not isinstance(value, (float, int, np.generic)) and isinstance(value, Iterable)


def finite(what: str, value: object) -> float:
    """Return a number as a float.

    Raises:
        TypeError: It is not a number.
        ValueError: It is NaN or infinite.
    """
    if not isinstance(value, (float, SupportsFloat)):
        raise TypeError(f"{what} takes a number, got {value!r}.")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{what} takes a finite number, got {number}.")
    return number


def finite_array(what: str, values: Iterable[float]) -> Floats:
    """Return numbers as an array of their own.

    Raises:
        TypeError: Some of them are not numbers.
        ValueError: Some of them are NaN or infinite.
    """
    given = np.asarray(values if hasattr(values, "__array__") else tuple(values))
    if given.dtype.kind not in "biuf" and given.size:
        raise TypeError(f"{what} takes numbers, got {cast('object', given.tolist())!r:.80}.")
    array = given.astype(np.float64)
    i = first_not_finite(array)
    if i is not None:
        raise ValueError(f"{what} takes finite numbers, got {array.flat[i]} at {i}.")
    return array


def first_not_finite(array: Floats) -> int | None:
    """Return the index of the first number that is NaN or infinite, None if there is none."""
    # One call, faster than `isfinite(array).all()`; where a square overflows each number is looked at.
    if math.isfinite(np.vdot(array, array)):
        return None
    found = np.flatnonzero(~np.isfinite(array))
    return int(found[0]) if found.size else None
