"""JSON schemas of structs, with what their docstrings say of their fields. No I/O."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from typing import Annotated, Any, Final, get_args, get_origin

import msgspec
from msgspec import Struct

_ATTRIBUTE: Final = re.compile(r"^ {8}(\w+): (.*(?:\n {9,}.*)*)", re.MULTILINE)


def schemas(structs: Iterable[type[Struct]], ref_template: str) -> dict[str, dict[str, Any]]:
    """Return the schemas of structs and of all that they are made of, by name.

    Args:
        structs: The structs. Arrays in them are lists of numbers.
        ref_template: How one refers to another, with `{name}` for its name.
    """
    wanted = list(structs)
    _, parts = msgspec.json.schema_components(wanted, schema_hook=_array, ref_template=ref_template)
    for kind in _all_of(wanted):
        part = parts.get(kind.__name__, {"properties": {}})  # a base of several kinds has no schema of its own
        if kind.__doc__:
            part["description"] = prose(kind)
        for name, note in field_notes(kind).items():
            if name in part["properties"]:
                part["properties"][name].setdefault("description", note)
    for part in parts.values():
        _simplify_tuples(part)
    return parts


def _simplify_tuples(schema: Any) -> None:
    """Describe tuples of one type by `items`: few code generators understand `prefixItems`."""
    match schema:
        case {"prefixItems": [first, *others]} if all(other == first for other in others):
            schema["items"] = first
            del schema["prefixItems"]
        case {**parts}:
            for part in parts.values():
                _simplify_tuples(part)
        case [*parts]:
            for part in parts:
                _simplify_tuples(part)
        case _:
            pass


def prose(struct: type[Struct]) -> str:
    """Return a struct's docstring without what it says of each field."""
    return inspect.cleandoc((struct.__doc__ or "").partition("\n    Attributes:\n")[0])


def field_notes(struct: type[Struct]) -> dict[str, str]:
    """Return what is said of fields, in their annotations or under `Attributes:`, by name."""
    told = dict(_ATTRIBUTE.findall((struct.__doc__ or "").partition("Attributes:\n")[2]))
    notes = {field.name: _note(field.type) or told.get(field.name, "") for field in msgspec.structs.fields(struct)}
    return {name: " ".join(note.split()) for name, note in notes.items() if note}


def _note(annotation: Any) -> str:
    metadata = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return next((meta.description for meta in metadata if isinstance(meta, msgspec.Meta) and meta.description), "")


def _array(kind: type) -> dict[str, Any]:
    return {"type": "array", "items": {"type": "number"}}  # the one type that msgspec does not know


def _all_of(wanted: list[type[Struct]]) -> set[type[Struct]]:
    """Return structs and those that their fields mention."""
    found: set[type[Struct]] = set()
    waiting: list[Any] = list(wanted)
    while waiting:
        one = waiting.pop()
        if isinstance(one, type) and issubclass(one, Struct):
            if one not in found:
                found.add(one)
                waiting += [field.type for field in msgspec.structs.fields(one)]
        else:
            waiting += get_args(one)
    return found
