"""Declaring a tool: a method, whose signature becomes the input schema, whose docstring what agents read of it."""

from __future__ import annotations

import inspect
import json
from collections.abc import Awaitable, Callable
from enum import Enum
from typing import Any, TypeVar, get_type_hints

import msgspec
from mcp.types import Tool, ToolAnnotations
from msgspec import Struct

from urlab_client.protocol.schemas import schemas

__all__ = ["Declared", "Moment", "Needs", "declared", "tool"]

F = TypeVar("F", bound=Callable[..., Awaitable[Any]])

_MARK = "_urlab_tool"


class Needs(Enum):
    """What an agent must be given: the command's option for it."""

    NOTHING = ""
    SESSION = "--take-over"
    DRIVE = "--allow-drive"
    EDIT = "--allow-edit"


class Moment(Struct):
    """When a result was made; every result has these fields, too.

    Attributes:
        sim_time: Simulation time, seconds.
        step: Physics steps since the session began or the last reset; not counted in mode `live`.
        mode: `direct`: time passes only while a tool lets it; `live`: time passes by itself unless paused.
    """

    sim_time: float
    step: int
    mode: str


class Declared:
    """One tool.

    Args:
        method: What it does. A parameter `progress` is not the agent's to give.
        needs: What an agent must be given.
        hints: What hosts get to know of it.

    Attributes:
        name: Its name.
        takes_progress: Whether it reports progress.
    """

    def __init__(self, method: Callable[..., Awaitable[Any]], needs: Needs, hints: ToolAnnotations) -> None:
        self.name: str = method.__name__
        self.needs = needs
        self._method = method
        self._hints = hints
        parameters = inspect.signature(method).parameters
        self.takes_progress: bool = "progress" in parameters
        self._given = {name: one.default for name, one in parameters.items() if name not in {"self", "progress"}}

    def _arguments(self) -> type[Struct]:
        """Return the method's parameters as a struct."""
        types = get_type_hints(self._method, include_extras=True)
        required = inspect.Parameter.empty
        fields = [
            (name, types[name]) if default is required else (name, types[name], default)
            for name, default in self._given.items()
        ]
        return msgspec.defstruct(self.name, fields, forbid_unknown_fields=True, kw_only=True)

    def described(self) -> Tool:
        """Return what an agent gets to know."""
        result = get_type_hints(self._method)["return"]
        output, when = _schema(result.__args__[0] if hasattr(result, "__args__") else result), _schema(Moment)
        output["properties"] |= when["properties"]
        output["required"] = [*output.get("required", ()), *when["required"]]
        return Tool(
            name=self.name,
            title=self.name.replace("_", " ").capitalize(),
            description=inspect.cleandoc(self._method.__doc__ or ""),
            input_schema=_schema(self._arguments()),
            output_schema=output,
            annotations=self._hints,
        )

    def parse(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments of a call.

        Raises:
            ValueError: They do not fit; the text says which does not, and which there are.
        """
        plain = {name: _from_text(value) for name, value in given.items()}
        try:
            made = msgspec.convert(plain, self._arguments(), strict=False)
        except msgspec.ValidationError as error:
            raise ValueError(f"{self.name}: {error}. It takes: {', '.join(self._given) or 'no arguments'}.") from None
        return {name: getattr(made, name) for name in self._given}


def tool(needs: Needs, *, destructive: bool = False, idempotent: bool = False) -> Callable[[F], F]:
    """Declare a method as a tool.

    Args:
        needs: What an agent must be given.
        destructive: Whether it may undo what was there.
        idempotent: Whether a second call with the same arguments changes nothing more.
    """

    def mark(method: F) -> F:
        hints = ToolAnnotations(
            read_only_hint=needs in {Needs.NOTHING, Needs.SESSION},
            destructive_hint=destructive,
            idempotent_hint=idempotent,
            open_world_hint=False,
        )
        setattr(method, _MARK, Declared(method, needs, hints))
        return method

    return mark


def declared(owner: type) -> dict[str, Declared]:
    """Return the tools of a class by name, in their order."""
    members = [member for base in reversed(owner.__mro__) for member in vars(base).values()]
    marks = [getattr(member, _MARK, None) for member in members]
    return {mark.name: mark for mark in marks if isinstance(mark, Declared)}


def _schema(struct: type[Struct]) -> dict[str, Any]:
    """Return a JSON schema with an object at its root, as the protocol wants it."""
    parts = schemas([struct], "#/$defs/{name}")
    root = parts.pop(struct.__name__)
    return {**root, "$defs": parts} if parts else root


def _from_text(value: Any) -> Any:
    """Return what a text contains if that is a JSON object or array: some hosts send those as text."""
    if isinstance(value, str) and value[:1] in {"{", "["}:
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value
