"""Checks of users' numbers before anything is sent: NaN, infinity and None silently end a simulation."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import SupportsFloat, TypeGuard, cast

import numpy as np

from urlab_client.protocol.base import Floats


def is_array(value: object) -> TypeGuard[Iterable[float]]:
    """Return whether a value holds several numbers: a sequence or an array of any library."""
    return not isinstance(value, (float, int, np.generic)) and isinstance(value, Iterable)


def finite(what: str, value: object) -> float:
    """Return a number as a float.

    Raises:
        TypeError: The value is not a number.
        ValueError: The number is NaN or infinite.
    """
    if not isinstance(value, (float, SupportsFloat)):
        raise TypeError(f"{what} takes a number, got {value!r}.")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{what} takes a finite number, got {number}.")
    return number


def finite_array(what: str, values: Iterable[float]) -> Floats:
    """Return numbers as a new array.

    Raises:
        TypeError: A value is not a number.
        ValueError: A number is NaN or infinite.
    """
    given = np.asarray(values if hasattr(values, "__array__") else tuple(values))
    if given.dtype.kind not in "biuf" and given.size:
        raise TypeError(f"{what} takes numbers, got {cast('object', given.tolist())!r:.80}.")
    array = given.astype(np.float64)
    i = first_not_finite(array)
    if i is not None:
        raise ValueError(f"{what} takes finite numbers, got {array.flat[i]} at index {i}.")
    return array


def first_not_finite(array: Floats) -> int | None:
    """Return the index of the first number that is NaN or infinite, or None if all are finite."""
    # One call is faster than `isfinite(array).all()`. If a square overflows, check each number.
    if math.isfinite(np.vdot(array, array)):
        return None
    found = np.flatnonzero(~np.isfinite(array))
    return int(found[0]) if found.size else None
