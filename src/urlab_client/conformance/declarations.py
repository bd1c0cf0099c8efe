"""What a check is, how it says what it expects, and the statements that it proves."""

from __future__ import annotations

import tomllib
from collections.abc import Awaitable, Callable, Generator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from msgspec import Struct

from urlab_client.errors import ProtocolError

if TYPE_CHECKING:
    from urlab_client.conformance.bench import Bench

Body: TypeAlias = "Callable[[Bench], Awaitable[None]]"


class Group(StrEnum):
    """What a check may do to the user's world."""

    READ = "read"
    """Nothing; it opens a session, which ends that of another client."""
    PLAY = "play"
    """It drives the robots of a play session, and begins one if none runs."""
    AUTHOR = "author"
    """It makes a level of its own, and opens the user's again."""


class Verdict(StrEnum):
    """What became of a statement."""

    HOLDS = "holds"
    DIFFERS = "differs"
    NOT_TRIED = "not_tried"


class Differs(Exception):
    """The server answers otherwise than a statement says."""

    def __init__(self, expected: object, got: object) -> None:
        super().__init__(f"expected {_short(expected)}, got {_short(got)}")


class NotTried(Exception):
    """A check cannot be made here; its text says what it needs."""


class Check(Struct, frozen=True, eq=False):
    """A check of a server.

    Attributes:
        title: What it does, in one sentence.
        statements: The statements that it proves, such as `Beta 12`.
        group: What it may do to the user's world. One that plays begins at the start, in direct mode.
        dialects: The generations that it is about: `alpha`, `june`, `beta`.
        needs: What must be there; see `bench.NEEDS`.
        body: The check itself.
        last: Whether it judges what the others found, and so runs after them.
    """

    title: str
    statements: tuple[str, ...]
    group: Group
    dialects: tuple[str, ...]
    needs: tuple[str, ...]
    body: Body
    last: bool = False


class StatementResult(Struct):
    """What a run says of one statement."""

    id: str
    title: str
    verdict: Verdict
    detail: str = ""
    frames: list[str] = []
    """Numbers of the recorded exchanges that belong to it, where it differs."""


CHECKS: Final[list[Check]] = []
"""Every check, in the order in which they run."""

ALL: Final = ("alpha", "june", "beta")
OLDER: Final = ("alpha", "june")
NEWER: Final = ("june", "beta")
BETA: Final = ("beta",)
ALPHA: Final = ("alpha",)


def check(
    *statements: str,
    group: Group = Group.READ,
    dialects: tuple[str, ...] = ALL,
    needs: tuple[str, ...] = (),
    last: bool = False,
) -> Callable[[Body], Body]:
    """Declare the decorated function as a check of some statements; its docstring is the title."""
    if unknown := [name for name in statements if name not in statement_titles()]:
        raise ValueError(f"no statements are called {', '.join(unknown)}")

    def declare(body: Body) -> Body:
        title = (body.__doc__ or "").strip().rstrip(".")
        CHECKS.append(Check(title, statements, group, dialects, needs, body, last))
        return body

    return declare


def holds(condition: object, expected: object, got: object) -> None:
    """Check a condition.

    Raises:
        Differs: It is false.
    """
    if not condition:
        raise Differs(expected, got)


@contextmanager
def expecting(what: str) -> Generator[None]:
    """Report what the block cannot read as a difference from what was expected."""
    try:
        yield
    except (ValueError, OSError, ProtocolError) as error:
        raise Differs(what, str(error)) from error


def same(what: str, expected: Any, got: Any, tolerance: float = 0.0) -> None:
    """Check that two values agree; arrays and numbers within a tolerance, relative where they are above 1.

    Raises:
        Differs: They do not.
    """
    if isinstance(expected, np.ndarray) or isinstance(got, np.ndarray):
        one, other = np.asarray(expected, dtype=float), np.asarray(got, dtype=float)
        if one.shape != other.shape:
            raise Differs(f"{what} of shape {one.shape}", other.shape)
        gap = np.abs(one - other) > tolerance * np.maximum(1.0, np.abs(one))
        if np.any(gap | (np.isnan(one) != np.isnan(other))):
            at = int(np.argmax(gap))
            raise Differs(f"{what}[{at}] = {one.item(at)!r}", other.item(at))
    elif isinstance(expected, float) and tolerance and isinstance(got, int | float):
        holds(abs(expected - got) <= tolerance, f"{what} = {expected!r}", got)
    else:
        holds(expected == got, f"{what} = {expected!r}", got)


def has(reply: Mapping[str, Any], tolerance: float = 1e-9, /, **fields: Any) -> None:
    """Check that a map has fields of the given values; None stands for a field that is absent.

    Raises:
        Differs: One of them is another.
    """
    for name, expected in fields.items():
        same(name, expected, reply.get(name), tolerance)


@cache
def statement_titles() -> Mapping[str, str]:
    """Return the statement of each id."""
    text = files("urlab_client.conformance").joinpath("statements.toml").read_text(encoding="utf-8")
    listed: dict[str, dict[str, str]] = tomllib.loads(text)
    return {f"{family} {number}": title for family, rows in listed.items() for number, title in rows.items()}


_CLIENTS: Final[Mapping[str, tuple[range, ...]]] = {
    "Beta": (range(67, 86), range(97, 100)),
    "Generation 2": (range(45, 61),),
}
_SUPERSEDED: Final = frozenset({18, 23, 29, 31, 32, 33, 42})


def why_without_check(statement: str, dialect: str) -> str:
    """Return why a statement that no check proves in this run was not tried."""
    family, _, number = statement.rpartition(" ")
    if family in _CLIENTS and any(int(number) in numbers for numbers in _CLIENTS[family]):
        return "it is about clients, so it needs a scripted server: the project's own tests hold it"
    if family == "Generation 2" and dialect == "beta" and int(number) in _SUPERSEDED:
        return "the beta does otherwise, and a statement of its own says how"
    if own := [check for check in CHECKS if statement in check.statements]:
        if all(dialect not in check.dialects for check in own):
            return f"needs a server of another generation: {', '.join(own[0].dialects)}"
        return "its check was not chosen"
    return "needs a scene made for it, which no check of this command builds yet"


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"


_LONGEST: Final = 300
