"""Type checks of arguments, made before anything is sent; the errors name the parameter."""

from __future__ import annotations

import operator
from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

V = TypeVar("V")


def require(what: str, value: object, kind: type, takes: str) -> None:
    """Check that an argument is an instance of a type.

    Args:
        what: The method and, if it has several, the parameter.
        value: The argument.
        kind: The required type.
        takes: The required type in words.

    Raises:
        TypeError: The argument has another type.
    """
    if not isinstance(value, kind):
        raise TypeError(f"{what} takes {takes}, got {value!r:.80}.")


def mapping(what: str, value: Mapping[str, V], of: str) -> Mapping[str, V]:
    """Return a mapping unchanged.

    Args:
        what: The method and, if it has several, the parameter.
        value: The argument.
        of: The required contents, such as `actuator names to numbers`.

    Raises:
        TypeError: The argument is not a mapping.
    """
    require(what, value, Mapping, f"a dictionary of {of}")
    return value


def collection(what: str, values: Collection[V]) -> Collection[V]:
    """Return a collection unchanged.

    Raises:
        TypeError: The argument is a single value, or a string, whose items would be its characters.
    """
    if isinstance(values, str):
        raise TypeError(f"{what} takes a collection, such as ({values!r:.80},), not one of its items.")
    require(what, values, Collection, "a collection, such as a tuple")
    return values


def integer(what: str, value: int) -> int:
    """Return an integer as a plain `int`.

    Raises:
        TypeError: The argument is not an integer.
    """
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{what} takes an integer, got {value!r:.80}.") from None


def numbers(what: str, values: Iterable[float], count: int) -> list[float]:
    """Return exactly `count` numbers as a list.

    Raises:
        TypeError: The argument is not iterable or contains items that are not numbers.
        ValueError: There are more or fewer items, or one is a string that is not a number.
    """
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
    """Return a string unchanged.

    Raises:
        TypeError: The argument is not a string.
    """
    require(what, value, str, "a string")
    return value
