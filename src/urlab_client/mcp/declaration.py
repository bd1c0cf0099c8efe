"""Declaring tools: the signature of a function becomes the input schema, its docstring the description for agents.

Results have no schemas in the list of tools, which each agent reads before its first call: they would be most of it.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Awaitable, Callable
from enum import Enum
from functools import cached_property
from types import ModuleType
from typing import Any, Literal, cast, get_type_hints

import msgspec
from mcp.types import Tool, ToolAnnotations
from msgspec import Struct

from urlab_client.values.schemas import prose, schemas

_Function = Callable[..., Awaitable[Any]]
Wants = Literal["nothing", "server", "play"]


class Needs(Enum):
    """A permission: the command's option that grants it."""

    NOTHING = ""
    SESSION = "--take-over"
    DRIVE = "--allow-drive"
    EDIT = "--allow-edit"


class Declared:
    """One tool.

    Attributes:
        name: Name of the tool.
        drives: Whether it changes something, and therefore takes the controls.
        wants: What has to be there: `nothing`, the `server`, or `play`, a session of it.
        discards: What a call discards, or empty.
    """

    def __init__(
        self, function: _Function, needs: Needs, hints: ToolAnnotations, *, wants: Wants, discards: str, only: str
    ) -> None:
        self.name: str = function.__name__
        self.function = function
        self.needs = needs
        self.wants = wants
        self.discards = discards
        self._only = only
        self.drives: bool = needs in {Needs.DRIVE, Needs.EDIT}
        self._hints = hints
        self._parameters = list(inspect.signature(function).parameters.values())[1:]

    @cached_property
    def _arguments(self) -> type[Struct]:
        """Return the function's parameters as a struct."""
        types = get_type_hints(self.function, include_extras=True)
        fields = [
            (one.name, types[one.name]) if one.default is one.empty else (one.name, types[one.name], one.default)
            for one in self._parameters
        ]
        doc = (self.function.__doc__ or "").replace("\n    Args:\n", "\n    Attributes:\n")
        return msgspec.defstruct(
            self.name, fields, namespace={"__doc__": doc}, forbid_unknown_fields=True, kw_only=True
        )

    @cached_property
    def described(self) -> Tool:
        """The description for agents."""
        return Tool(
            name=self.name,
            description=" ".join(prose(self._arguments).split()),
            input_schema={key: part for key, part in _schema(self._arguments).items() if key != "description"},
            annotations=self._hints,
        )

    def question(self, arguments: dict[str, Any]) -> str:
        """Return the question to a person before a call that discards something, or an empty text."""
        asks = self.discards and (not self._only or self._only in arguments.values())
        return f"An agent wants to call {self.name}. {self.discards} Go on?" if asks else ""

    def parse(self, given: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments of a call."""
        plain = {name: _from_text(value) for name, value in given.items()}
        try:
            made = msgspec.convert(plain, self._arguments, strict=False)
        except (ValueError, RecursionError) as error:
            taken = ", ".join(one.name for one in self._parameters)
            raise ValueError(f"{self.name}: {error}. It takes: {taken or 'no arguments'}.") from None
        return {one.name: getattr(made, one.name) for one in self._parameters}


def tool(
    needs: Needs, *, wants: Wants = "play", discards: str = "", only: str = "", idempotent: bool = False
) -> Callable[[_Function], Declared]:
    """Declare a function as a tool.

    Args:
        needs: Permission.
        wants: What has to be there.
        discards: What a call discards, as a sentence.
        only: The argument with which it does; without it, always.
        idempotent: Whether a second call changes nothing more.
    """

    def declare(function: _Function) -> Declared:
        hints = ToolAnnotations(
            read_only_hint=needs in {Needs.NOTHING, Needs.SESSION},
            destructive_hint=bool(discards),
            idempotent_hint=idempotent,
            open_world_hint=False,
        )
        return Declared(function, needs, hints, wants=wants, discards=discards, only=only)

    return declare


def declared(module: ModuleType) -> dict[str, Declared]:
    """Return the tools of a module by name, in their order."""
    return {one.name: one for one in vars(module).values() if isinstance(one, Declared)}


def _schema(struct: type[Struct]) -> dict[str, Any]:
    """Return a JSON schema with an object at its root, as the protocol requires."""
    parts = schemas([struct], "#/$defs/{name}")
    root = parts.pop(struct.__name__)
    shown: dict[str, Any] = _shown({**root, "$defs": parts} if parts else root)
    return shown


def _shown(part: Any) -> Any:
    """Return a schema without titles, which repeat the names."""
    if isinstance(part, dict):
        fields = cast("dict[str, Any]", part)
        return {key: _shown(value) for key, value in fields.items() if key != "title" or isinstance(value, dict)}
    return [_shown(one) for one in cast("list[Any]", part)] if isinstance(part, list) else part


def _from_text(value: Any) -> Any:
    """Parse a text if it is a JSON object or array; some hosts send these as text."""
    if isinstance(value, str) and value[:1] in {"{", "["}:
        try:
            return json.loads(value)
        except (ValueError, RecursionError):
            return value
    return value
