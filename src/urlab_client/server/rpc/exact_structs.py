"""Structs that decode requests of exactly the declared types, and reject all others."""

from __future__ import annotations

import types
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, Final, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import NODEFAULT, Struct, inspect

from urlab_client.server.rpc.coercion import INT32_MAX, INT32_MIN

__all__ = ["collision_test_of", "longest_string", "strict_array", "strict_struct", "string_measures_of", "type_info"]


# Cached: inspecting the types took most of a server's start, and the result is the same for every server.
type_info = cache(inspect.type_info)


def strict_array(kind: type, value: object) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Decode an array; its elements must be numbers."""
    del kind
    return np.array(msgspec.convert(value, list[float]), dtype=np.float64)


@cache
def strict_struct(struct: type[Struct]) -> type[Struct]:
    """Derive a struct that rejects unknown fields and integers beyond 32 bits, also in nested structs.

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
    """Return a test for maps with keys that differ only in case, which collapse; None if there can be none."""
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
    """Return a test for maps with keys that differ only in case, which collapse; None if there can be none."""
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


def longest_string(value: object) -> int:
    """Return the length of the longest string in any value of a request."""
    match value:
        case str():
            return len(value)
        case dict():
            items = cast("dict[object, object]", value)
            return max((max(longest_string(key), longest_string(item)) for key, item in items.items()), default=0)
        case list() | tuple():
            return max(map(longest_string, cast("list[object]", value)), default=0)
        case Struct():
            return max((longest_string(getattr(value, name)) for name in value.__struct_fields__), default=0)
        case _:
            return 0


@cache
def string_measures_of(kind: type[Struct]) -> tuple[tuple[str, Callable[[Any], int]], ...]:
    """Return functions that find the longest string in each field that can hold one, for values of exactly this type.

    Fields that hold only numbers, which are most of a step with many robots, are skipped.
    """
    fields = msgspec.structs.fields(kind)
    return tuple((f.name, measure) for f in fields if (measure := _string_measure(type_info(f.type))) is not None)


def _string_measure(info: inspect.Type) -> Callable[[Any], int] | None:  # noqa: PLR0911
    match info:
        case inspect.Metadata(type=inner):
            return _string_measure(inner)
        case inspect.UnionType(types=members):
            present = [member for member in members if not isinstance(member, inspect.NoneType)]
            if len(present) == 1:
                return _optional_measure(_string_measure(present[0]))
            return longest_string if any(_string_measure(member) is not None for member in present) else None
        case inspect.DictType(value_type=item):
            return _dict_measure(_string_measure(item))
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item):
            measure = _string_measure(item)
            return None if measure is None else lambda values: max(map(measure, values), default=0)
        case inspect.StructType(cls=cls):
            return _struct_measure(cls)
        case inspect.FloatType() | inspect.IntType() | inspect.BoolType() | inspect.NoneType() | inspect.CustomType():
            return None
        case _:
            return longest_string


def _optional_measure(measure: Callable[[Any], int] | None) -> Callable[[Any], int] | None:
    return None if measure is None else lambda value: 0 if value is None else measure(value)


def _dict_measure(of_items: Callable[[Any], int] | None) -> Callable[[Any], int]:
    def measure(value: dict[str, Any]) -> int:
        of_keys = max(map(len, value), default=0)
        return of_keys if of_items is None else max(of_keys, max(map(of_items, value.values()), default=0))

    return measure


def _struct_measure(kind: type[Struct]) -> Callable[[Any], int]:
    def measure(value: Struct) -> int:
        return max((of_field(getattr(value, name)) for name, of_field in string_measures_of(kind)), default=0)

    return measure
