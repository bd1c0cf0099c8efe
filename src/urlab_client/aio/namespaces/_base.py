"""Base class of all namespaces, and conversion of arguments to wire values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, TypeVar, overload

from msgspec import Struct

from urlab_client.aio.arguments import numbers
from urlab_client.aio.defaults import Timeout
from urlab_client.aio.session.jobs import OnProgress
from urlab_client.aio.session.session import Session
from urlab_client.protocol.base import Reply, Request
from urlab_client.values.names import PublicDir
from urlab_client.values.rotation import Quat, Vec3

R = TypeVar("R", bound=Reply)
S = TypeVar("S", bound=Struct)

Vector = Iterable[float]
"""A tuple, list or array of numbers."""


class Namespace(PublicDir):
    """A group of ops on a client."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def __repr__(self) -> str:
        ops = sorted(name for name in dir(type(self)) if not name.startswith("_"))
        return f"<{type(self).__name__} {self._session.transport.endpoint}: {', '.join(ops)}>"

    async def _call(self, request: Request[R], timeout: Timeout, on_progress: OnProgress | None = None) -> R:
        return await self._session.call(request, timeout=timeout, on_progress=on_progress)


def fill(kind: type[S], *replies: Struct, **given: Any) -> S:
    """Return a `kind` with the given fields, and the rest from the first reply that has a field of the same name."""
    found = {name: getattr(reply, name) for reply in reversed(replies) for name in reply.__struct_fields__}
    return kind(**({name: found[name] for name in kind.__struct_fields__ if name in found} | given))


def target_by(by_name: bool) -> Literal["actor_id", "actor_name"]:
    """Return the wire value for the lookup of a target by name or by id."""
    return "actor_name" if by_name else "actor_id"


@overload
def as_vec3(name: str, values: None) -> None: ...
@overload
def as_vec3(name: str, values: Vector) -> Vec3: ...
def as_vec3(name: str, values: Vector | None) -> Vec3 | None:
    """Return three numbers as a tuple; None for None.

    Raises:
        TypeError: The values are not numbers.
        ValueError: There are more or fewer than three values.
    """
    if values is None:
        return None
    x, y, z = numbers(name, values, 3)
    return x, y, z


@overload
def as_quat(name: str, values: None) -> None: ...
@overload
def as_quat(name: str, values: Vector) -> Quat: ...
def as_quat(name: str, values: Vector | None) -> Quat | None:
    """Return four numbers as a tuple; None for None.

    Raises:
        TypeError: The values are not numbers.
        ValueError: There are more or fewer than four values.
    """
    if values is None:
        return None
    a, b, c, d = numbers(name, values, 4)
    return a, b, c, d
