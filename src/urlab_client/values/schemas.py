"""JSON schemas of structs, with what their docstrings say of their fields, and structs as fields of pydantic models.

Pydantic is not imported; it calls `core_schema` and `json_schema` through the hooks of `Serializable`. No I/O.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import NODEFAULT, Struct
from numpy.typing import NDArray

from urlab_client.values.plain import kinds_of, plain, read_array, read_bytes

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


Schema = dict[str, Any]

_UNDER_WAY: ContextVar[frozenset[str]] = ContextVar("structs that are being described")


def core_schema(struct: type[Struct], handler: Any) -> Schema:
    """Return the schema by which pydantic validates and serialises a struct.

    Args:
        struct: The struct, or the base class of several kinds, which accepts any of them.
        handler: Pydantic's `GetCoreSchemaHandler`.
    """
    ref = f"{struct.__module__}.{struct.__qualname__}:{id(struct)}"
    under_way = _UNDER_WAY.get(frozenset())
    if ref in under_way:
        return {"type": "definition-ref", "schema_ref": ref}
    token = _UNDER_WAY.set(under_way | {ref})
    try:
        kinds = kinds_of(struct)
        inner = _one_of(kinds, handler) if kinds else _of_fields(struct, handler)
    finally:
        _UNDER_WAY.reset(token)
    return {
        **inner,
        "ref": ref,
        "serialization": {"type": "function-plain", "function": _serialized, "info_arg": True},
    }


def json_schema(struct: type[Struct], schema: Schema, handler: Any) -> Schema:
    """Return the JSON schema of a struct, with its descriptions.

    Args:
        struct: The struct.
        schema: Result of `core_schema`.
        handler: Pydantic's `GetJsonSchemaHandler`.
    """
    made = handler(schema)
    own = handler.resolve_ref_schema(made)
    own |= {"title": struct.__name__, "description": prose(struct)}
    properties: dict[str, Schema] = own.get("properties", {})
    for name, note in field_notes(struct).items():
        if name in properties:
            properties[name]["description"] = note
    return made


def _one_of(kinds: Mapping[str, type[Struct]], handler: Any) -> Schema:
    tag_field = next(iter(kinds.values())).__struct_config__.tag_field

    def tag(value: Any) -> Any:
        if isinstance(value, Struct):
            return value.__struct_config__.tag
        return cast("Mapping[Any, Any]", value).get(tag_field) if isinstance(value, Mapping) else None

    choices = {name: handler.generate_schema(kind) for name, kind in kinds.items()}
    return {"type": "tagged-union", "discriminator": tag, "choices": choices}


def _of_fields(struct: type[Struct], handler: Any) -> Schema:
    def make(value: Any, inner: Callable[[Any], dict[str, Any]]) -> Any:
        if isinstance(value, struct):
            return value
        return struct(**{name: item for name, item in inner(value).items() if name != config.tag_field})

    config = struct.__struct_config__
    fields: Schema = {}
    if config.tag_field is not None:
        tag = {"type": "literal", "expected": [config.tag]}
        fields[config.tag_field] = {"type": "typed-dict-field", "schema": tag, "required": False}
    for field in msgspec.structs.fields(struct):
        kind = _understood(field.type)
        if kind is not msgspec.Raw:
            schema = handler.generate_schema(kind)
            if field.default is not NODEFAULT:
                schema = {"type": "default", "schema": schema, "default": field.default}
            fields[field.name] = {"type": "typed-dict-field", "schema": schema, "required": field.required}
    return {
        "type": "function-wrap",
        "function": {"type": "no-info", "function": make},
        "schema": {"type": "typed-dict", "fields": fields, "cls_name": struct.__name__},
    }


def _serialized(value: Any, info: Any) -> Any:
    """Serialise for pydantic. To select the form of arrays: `dump_json(…, context={"arrays": "base64"})`."""
    context: dict[str, Any] = info.context or {}
    return plain(value, context.get("arrays", "list") if info.mode == "json" else None)


# Types that JSON or pydantic represents differently.


def _understood(annotation: Any) -> Any:
    """Return a type in which everything is known to pydantic."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if annotation in _LEAVES:
        return _LEAVES[annotation]
    if origin is np.ndarray:
        return Annotated[Any, _Array(np.dtype(get_args(arguments[1])[0]))]
    if origin is Annotated:
        return _understood(arguments[0])  # msgspec's metadata, which pydantic does not know
    if origin is Literal or not arguments:
        return annotation
    inner = tuple(map(_understood, arguments))
    return Union[inner] if origin in {Union, UnionType} else origin[inner]  # noqa: UP007  # made at run time


class Number:
    """A number, possibly not finite."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Schema:
        return {"type": "float", "ref": f"{cls.__module__}.{cls.__qualname__}"}  # a separate name in JSON schemas

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> Schema:
        made = handler(schema)
        own = handler.resolve_ref_schema(made)
        own.pop("type")
        own |= {"anyOf": [{"type": "number"}, {"enum": ["NaN", "Infinity", "-Infinity"]}]}
        return made


class _Bytes:
    """Bytes; base64 text in JSON."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Schema:
        return {"type": "function-plain", "function": {"type": "no-info", "function": read_bytes}}

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> Schema:
        return {"type": "string", "contentEncoding": "base64"}


class _Array:
    """A NumPy array, with two forms in JSON."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Schema:
        # Arrays from the wire are flat float64; others are pictures.
        items = handler.generate_schema(Number if self._dtype == np.float64 else list[Any])

        def read(value: Any, inner: object) -> NDArray[Any]:
            return read_array(value, self._dtype)

        return {
            "type": "function-wrap",
            "function": {"type": "no-info", "function": read},
            "schema": {"type": "list", "items_schema": items},  # for JSON schemas only
        }


_LEAVES: Final[Mapping[Any, Any]] = {float: Number, bytes: _Bytes}
