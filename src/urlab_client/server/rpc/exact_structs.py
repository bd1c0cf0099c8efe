"""Structs that decode a request that means exactly what it says, and refuse all others."""

from __future__ import annotations

import types
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, Final, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import NODEFAULT, Struct, inspect

from urlab_client.server.rpc.coercion import INT32_MAX, INT32_MIN

__all__ = ["collision_test_of", "strict_array", "strict_struct", "type_info"]


# Inspecting the types took most of a server's start, and gives the same for every server.
type_info = cache(inspect.type_info)


def strict_array(kind: type, value: object) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Decode an array; its elements must be numbers."""
    del kind
    return np.array(msgspec.convert(value, list[float]), dtype=np.float64)


@cache
def strict_struct(struct: type[Struct]) -> type[Struct]:
    """Derive a struct that refuses unknown fields and integers beyond 32 bits, here and in the structs it holds.

    Raises:
        TypeError: A field takes any value.
    """
    hints = get_type_hints(struct, include_extras=True)
    changed: list[tuple[str, Any, Any]] = []
    for field in msgspec.structs.fields(struct):
        annotation = _strict_annotation(hints[field.name])
        if annotation is not hints[field.name]:
            changed.append((field.name, annotation, _same_default(field)))
    config = struct.__struct_config__
    return msgspec.defstruct(
        struct.__name__,
        changed,
        bases=(struct,),
        module=__name__,
        tag=config.tag,
        tag_field=config.tag_field,
        kw_only=True,
        forbid_unknown_fields=True,
    )


def _same_default(field: msgspec.structs.FieldInfo) -> Any:
    if field.default_factory is not NODEFAULT:
        return msgspec.field(default_factory=field.default_factory, name=field.encode_name)
    if field.default is not NODEFAULT:
        return msgspec.field(default=field.default, name=field.encode_name)
    return msgspec.field(name=field.encode_name)


_REWRITTEN: Final[frozenset[Any]] = frozenset((Annotated, Union, types.UnionType, list, dict, tuple))


def _strict_annotation(annotation: Any) -> Any:
    if annotation is int:
        return Annotated[int, msgspec.Meta(ge=INT32_MIN, le=INT32_MAX)]
    if annotation is Any:
        raise TypeError("a field that takes any value is read field by field")
    if inspect.is_struct_type(annotation):
        return strict_struct(annotation)
    origin: Any = get_origin(annotation)
    arguments: tuple[Any, ...] = get_args(annotation)
    if origin not in _REWRITTEN:
        return annotation
    strict = tuple(_strict_annotation(argument) for argument in arguments)
    if all(new is old for new, old in zip(strict, arguments, strict=True)):
        return annotation
    if origin is Annotated:
        return Annotated[(strict[0], *arguments[1:])]
    return (Union if origin is types.UnionType else origin)[strict]


def _collision_test(info: inspect.Type) -> Callable[[Any], bool] | None:
    """Return a test for maps with keys that differ in case only, which collapse; None if there can be none."""
    match info:
        case inspect.Metadata(type=inner):
            return _collision_test(inner)
        case inspect.UnionType(types=members):
            tests = [test for member in members if (test := _collision_test(member)) is not None]
            return tests[0] if tests else None
        case inspect.DictType(value_type=item):
            return _map_collision_test(_collision_test(item))
        case inspect.StructType(fields=fields):
            tests = [(field.name, test) for field in fields if (test := _collision_test(field.type)) is not None]
            return _struct_collision_test(tests) if tests else None
        case _:
            return None


@cache
def collision_test_of(kind: type) -> Callable[[Any], bool] | None:
    """Return a test for maps with keys that differ in case only, which collapse; None if there can be none."""
    return _collision_test(type_info(kind))


def _map_collision_test(test: Callable[[Any], bool] | None) -> Callable[[Any], bool]:
    def collides(value: Any) -> bool:
        if not isinstance(value, dict):
            return False
        items = cast("dict[str, Any]", value)
        if len(items) > 1 and len({key.lower() for key in items}) < len(items):
            return True
        return test is not None and any(map(test, items.values()))

    return collides


def _struct_collision_test(tests: list[tuple[str, Callable[[Any], bool]]]) -> Callable[[Any], bool]:
    def collides(value: Any) -> bool:
        for name, test in tests:
            item = getattr(value, name)
            if item is not None and test(item):
                return True
        return False

    return collides
