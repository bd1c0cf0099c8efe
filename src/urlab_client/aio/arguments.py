"""Checks of arguments, made before anything is sent; the errors name the parameter.

NaN, infinity and None would silently end a simulation.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Iterable, Mapping
from typing import SupportsFloat, TypeGuard, TypeVar, cast

import numpy as np

from urlab_client.protocol.base import Floats

V = TypeVar("V")


def require(what: str, value: object, kind: type, takes: str) -> None:
    """Raise `TypeError` unless an argument is of a type; `takes` says in words which."""
    if not isinstance(value, kind):
        raise TypeError(f"{what} takes {takes}, got {value!r:.80}.")


def mapping(what: str, value: Mapping[str, V], of: str) -> Mapping[str, V]:
    """Return a mapping unchanged; `of` says what it must contain, such as `actuator names to numbers`."""
    require(what, value, Mapping, f"a dictionary of {of}")
    return value


def collection(what: str, values: Collection[V]) -> Collection[V]:
    """Return a collection unchanged. Refuses single values, and strings, whose items would be characters."""
    if isinstance(values, str):
        raise TypeError(f"{what} takes a collection, such as ({values!r:.80},), not one of its items.")
    require(what, values, Collection, "a collection, such as a tuple")
    return values


def integer(what: str, value: int) -> int:
    """Return an integer as a plain `int`."""
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{what} takes an integer, got {value!r:.80}.") from None


def at_least(what: str, value: int, least: int) -> int:
    """Return an integer that is not below a bound."""
    found = integer(what, value)
    if found < least:
        raise ValueError(f"{what} must be at least {least}, not {found}")
    return found


def numbers(what: str, values: Iterable[float], count: int) -> list[float]:
    """Return exactly `count` numbers as a list."""
    try:
        found = [float(value) for value in values]
    except TypeError:
        raise TypeError(f"{what} takes {count} numbers, got {values!r:.80}.") from None
    except ValueError:
        raise ValueError(f"{what} takes {count} numbers, got {values!r:.80}.") from None
    if len(found) != count:
        raise ValueError(f"{what} takes {count} numbers, got {len(found)}")
    return found


def text(what: str, value: str) -> str:
    """Return a string unchanged."""
    require(what, value, str, "a string")
    return value


def is_array(value: object) -> TypeGuard[Iterable[float]]:
    """Return whether a value holds several numbers: a sequence or an array of any library."""
    return not isinstance(value, (float, int, np.generic)) and isinstance(value, Iterable)


def finite(what: str, value: object) -> float:
    """Return a number as a float. Refuses NaN and infinity."""
    if not isinstance(value, (float, SupportsFloat)):
        raise TypeError(f"{what} takes a number, got {value!r}.")
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{what} takes a finite number, got {number}.")
    return number


def finite_array(what: str, values: Iterable[float]) -> Floats:
    """Return numbers as a new array. Refuses NaN and infinity."""
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
