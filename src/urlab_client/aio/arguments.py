"""Arguments of the wrong type, refused by the name of what they were given for, before anything is sent."""

from __future__ import annotations

import operator
from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

__all__ = ["collection", "integer", "mapping", "numbers", "require", "text"]

V = TypeVar("V")


def require(what: str, value: object, kind: type, takes: str) -> None:
    """Refuse what is of another kind.

    Args:
        what: The method and, if it has several, the parameter.
        value: What it was given.
        kind: What it must be an instance of.
        takes: The same in words.

    Raises:
        TypeError: It is not.
    """
    if not isinstance(value, kind):
        raise TypeError(f"{what} takes {takes}, got {value!r:.80}.")


def mapping(what: str, value: Mapping[str, V], of: str) -> Mapping[str, V]:
    """Return a mapping as it is.

    Args:
        what: The method and, if it has several, the parameter.
        value: What it was given.
        of: What it takes, such as `actuator names to numbers`.

    Raises:
        TypeError: It is not a mapping.
    """
    require(what, value, Mapping, f"a dictionary of {of}")
    return value


def collection(what: str, values: Collection[V]) -> Collection[V]:
    """Return several values as they are.

    Raises:
        TypeError: It is one value, or a text, which would be taken for its letters.
    """
    if isinstance(values, str):
        raise TypeError(f"{what} takes a collection, such as ({values!r:.80},), not one of its items.")
    require(what, values, Collection, "a collection, such as a tuple")
    return values


def integer(what: str, value: int) -> int:
    """Return an integer as a plain one.

    Raises:
        TypeError: It is not an integer.
    """
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{what} takes an integer, got {value!r:.80}.") from None


def numbers(what: str, values: Iterable[float], count: int) -> list[float]:
    """Return so many numbers as a list.

    Raises:
        TypeError: They are not numbers, or not several.
        ValueError: There are more or fewer, or a text that is not a number.
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
    """Return a text as it is.

    Raises:
        TypeError: It is not a text.
    """
    require(what, value, str, "a text")
    return value
