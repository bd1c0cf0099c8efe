"""Declaring a tool: a method, whose signature becomes the input schema, whose docstring what agents read of it."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Awaitable, Callable
from enum import Enum
from functools import cached_property
from typing import Any, TypeVar, get_type_hints

import msgspec
from mcp.types import Tool, ToolAnnotations

from urlab_client.mcp.results import Result

__all__ = ["Declared", "Needs", "declared", "tool"]

F = TypeVar("F", bound=Callable[..., Awaitable[Any]])

_MARK = "_urlab_tool"


class Needs(Enum):
    """What an agent must be allowed to do."""

    READ = ""
    DRIVE = "--allow-drive"
    EDIT = "--allow-edit"


class Declared:
    """One tool.

    Attributes:
        name: Its name.
        needs: What an agent must be allowed to do.
        takes_progress: Whether the method has a parameter `progress`, which no agent gives.
    """

    def __init__(self, method: Callable[..., Awaitable[Any]], needs: Needs, hints: dict[str, bool]) -> None:
        self.name = method.__name__
        self.needs = needs
        self._method = method
        self._hints = hints
        self.takes_progress = "progress" in inspect.signature(method).parameters

    @cached_property
    def arguments(self) -> type[msgspec.Struct]:
        """The method's parameters as a struct."""
        types = get_type_hints(self._method, include_extras=True)
        fields: list[tuple[str, Any] | tuple[str, Any, Any]] = []
        for name, parameter in inspect.signature(self._method).parameters.items():
            if name in {"self", "progress"}:
                continue
            given = parameter.default
            fields.append((name, types[name]) if given is parameter.empty else (name, types[name], given))
        return msgspec.defstruct(self.name, fields, forbid_unknown_fields=True, kw_only=True)

    @cached_property
    def described(self) -> Tool:
        """What an agent gets to know."""
        result = get_type_hints(self._method)["return"]
        shown = result.__args__[0] if hasattr(result, "__args__") else result
        assert issubclass(shown, Result)  # noqa: S101 - a declaration without the moment
        return Tool(
            name=self.name,
            title=self.name.replace("_", " ").capitalize(),
            description=inspect.cleandoc(self._method.__doc__ or ""),
            input_schema=_schema(self.arguments),
            output_schema=_schema(shown),
            annotations=ToolAnnotations(
                read_only_hint=self.needs is Needs.READ,
                destructive_hint=self._hints["destructive"],
                idempotent_hint=self._hints["idempotent"],
                open_world_hint=False,
            ),
        )

    def parse(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments of a call.

        Raises:
            ValueError: They do not fit; the text says which does not, and which there are.
        """
        names = [field.name for field in msgspec.structs.fields(self.arguments)]
        plain = {name: _from_text(value) for name, value in given.items()}
        try:
            made = msgspec.convert(plain, self.arguments, strict=False)
        except msgspec.ValidationError as error:
            raise ValueError(f"{self.name}: {error}. It takes: {', '.join(names) or 'no arguments'}.") from None
        return {name: getattr(made, name) for name in names}


def tool(needs: Needs, *, destructive: bool = False, idempotent: bool = False) -> Callable[[F], F]:
    """Declare a method as a tool.

    Args:
        needs: What an agent must be allowed to do.
        destructive: Whether it may undo what was there.
        idempotent: Whether a second call with the same arguments changes nothing more.
    """

    def mark(method: F) -> F:
        setattr(method, _MARK, Declared(method, needs, {"destructive": destructive, "idempotent": idempotent}))
        return method

    return mark


def declared(owner: type) -> dict[str, Declared]:
    """Return the tools of a class by name, in their order."""
    members = [vars(base) for base in reversed(owner.__mro__)]
    marks = [getattr(member, _MARK, None) for scope in members for member in scope.values()]
    return {mark.name: mark for mark in marks if isinstance(mark, Declared)}


def _schema(struct: type[msgspec.Struct]) -> dict[str, Any]:
    """Return a JSON schema with an object at its root, as the protocol wants it."""
    (_,), parts = msgspec.json.schema_components([struct], ref_template="#/$defs/{name}")
    for part in parts.values():
        if "description" in part:
            part["description"] = _tell_attributes(part, part["description"])
    root = parts.pop(struct.__name__)
    for base in struct.__mro__[1:]:
        _tell_attributes(root, base.__doc__ or "")
    return {**root, "$defs": parts} if parts else root


def _tell_attributes(schema: dict[str, Any], doc: str) -> str:
    """Hand what a struct's docstring says of its attributes to these, and return the rest of it."""
    brief, _, listed = inspect.cleandoc(doc).partition("\n\nAttributes:\n")
    for entry in re.split(r"\n(?=    \w)", f"\n{listed}")[1:]:
        name, _, text = entry.strip().partition(": ")
        if name in schema.get("properties", {}):
            schema["properties"][name]["description"] = " ".join(text.split())
    return brief


def _from_text(value: Any) -> Any:
    """Return what a text contains if that is a JSON object or array: some hosts send those as text."""
    if isinstance(value, str) and value[:1] in {"{", "["}:
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value
