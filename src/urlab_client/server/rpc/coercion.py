"""From plain data to a request struct, field by field, by the plugin's rules of coercion.

Unusual spellings are accepted, and unusable values count as absent. There is one converter per field type; it returns
`ABSENT` for unusable values.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from functools import cache
from typing import Any, Final, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import NODEFAULT, UNSET, Struct, inspect

from urlab_client.server.rpc.plain_data import Plain, fold_keys

__all__ = ["ABSENT", "INT32_MAX", "INT32_MIN", "as_text", "struct_converter"]

_BINARY_SUFFIX: Final = "__b64__"
"""From plain data to a request struct, field by field, by the plugin's rules of coercion.

Unusual spellings are accepted, and unusable values count as absent. There is one converter per field type; it returns
`ABSENT` for unusable values.
"""


INT32_MIN: Final = -(2**31)

INT32_MAX: Final = 2**31 - 1


class _Absent(Enum):
    ABSENT = "absent"


ABSENT: Any = _Absent.ABSENT

Converter: TypeAlias = Callable[[Plain], Any]

_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)

_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)


def _number(value: Plain) -> Any:
    if isinstance(value, str):
        return float(value) if _DECIMAL.fullmatch(value) else ABSENT
    if not isinstance(value, (int, float)):
        return ABSENT
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _whole(value: Plain) -> Any:
    number = _number(value)
    if number is ABSENT or not math.isfinite(number):
        return ABSENT
    rounded = math.trunc(number + math.copysign(0.5, number))
    return rounded if INT32_MIN <= rounded <= INT32_MAX else ABSENT


def _flag(value: Plain) -> Any:
    if isinstance(value, str):
        return value.lower() in ("true", "yes", "on") or (
            _INTEGER.fullmatch(value) is not None and value.strip("+-0") != ""
        )
    return value != 0 if isinstance(value, (bool, int, float)) else ABSENT


def as_text(value: Plain) -> Any:
    """Return the value that the plugin reads as a string, or `ABSENT`."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else str(value)
    return str(float(value) if value.bit_length() > 1024 else value) if isinstance(value, int) else ABSENT


def _array(value: Plain) -> Any:
    if not isinstance(value, list):
        return ABSENT
    return np.array([_or_zero(_number(item)) for item in cast("list[Plain]", value)], dtype=np.float64)


def _or_zero(number: Any) -> Any:
    return 0.0 if number is ABSENT else number


def _converter(info: inspect.Type) -> Converter:
    simple = _SIMPLE.get(type(info))
    if simple is not None:
        return simple
    match info:
        case inspect.Metadata(type=inner):
            convert = _converter(inner)
        case inspect.LiteralType(values=choices):
            convert = _choice_converter(choices)
        case inspect.UnionType(types=members):
            convert = _union_converter(members)
        case inspect.TupleType(item_types=items):
            convert = _tuple_converter([_item_converter(item) for item in items])
        case inspect.ListType(item_type=inspect.StructType(cls=cls)):
            nested = _nested_converter(cls)
            convert = _list_converter(lambda value: nested(value if isinstance(value, dict) else {}))
        case inspect.ListType(item_type=item):
            convert = _list_converter(_item_converter(item))
        case inspect.DictType(value_type=item):
            convert = _map_converter(_item_converter(item))
        case inspect.StructType(cls=cls):
            convert = _nested_converter(cls)
        case _:
            raise TypeError(f"no conversion to {info!r} is known")
    return convert


def _binary(value: Plain) -> Any:
    """Return bytes; JSON carries them as base64 text."""
    if isinstance(value, str):
        try:
            return base64.b64decode(value, validate=True)
        except ValueError:
            return ABSENT
    return value if isinstance(value, bytes) else ABSENT


def _same(value: Plain) -> Plain:
    return value


_SIMPLE: Final[Mapping[type[inspect.Type], Converter]] = {
    inspect.StrType: as_text,
    inspect.BytesType: _binary,
    inspect.BoolType: _flag,
    inspect.IntType: _whole,
    inspect.FloatType: _number,
    inspect.CustomType: _array,
    inspect.AnyType: _same,
}


def _item_converter(info: inspect.Type) -> Converter:
    """Convert an element: unusable numbers read as 0, unusable strings as empty; other unusable elements are
    omitted."""
    convert = _converter(info)
    if convert is _number:
        return lambda value: _or_zero(convert(value))
    if inspect.StrType() in _members(info):
        return lambda value: "" if (text := convert(value)) is ABSENT else text
    return convert


def _members(info: inspect.Type) -> Iterable[inspect.Type]:
    return info.types if isinstance(info, inspect.UnionType) else (info,)


def _choice_converter(choices: Iterable[Any]) -> Converter:
    folded = {str(choice).lower(): choice for choice in choices}

    def convert(value: Plain) -> Any:
        text = as_text(value)
        return ABSENT if text is ABSENT else folded.get(text.lower(), ABSENT)

    return convert


def _union_converter(members: Iterable[inspect.Type]) -> Converter:
    optional = False
    of_maps: Converter | None = None
    others: Converter | None = None
    for member in members:
        bare = member.type if isinstance(member, inspect.Metadata) else member
        if isinstance(bare, inspect.NoneType):
            optional = True
        elif isinstance(bare, (inspect.DictType, inspect.StructType)):
            of_maps = _converter(bare)
        else:
            others = _converter(bare)

    def convert(value: Plain) -> Any:
        if value is None:
            return None if optional else ABSENT
        chosen = of_maps if isinstance(value, dict) else others
        return ABSENT if chosen is None else chosen(value)

    return convert


def _tuple_converter(items: list[Converter]) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, list) or len(cast("list[Plain]", value)) != len(items):
            return ABSENT
        return tuple(item(part) for item, part in zip(items, cast("list[Plain]", value), strict=True))

    return convert


def _list_converter(item: Converter) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, list):
            return ABSENT
        converted = (item(part) for part in cast("list[Plain]", value))
        return [part for part in converted if part is not ABSENT]

    return convert


def _map_converter(item: Converter) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, dict):
            return ABSENT
        converted = ((key, item(part)) for key, part in cast("dict[str, Plain]", value).items())
        return {key: part for key, part in converted if part is not ABSENT}

    return convert


def _nested_converter(struct: type[Struct]) -> Converter:
    of_fields = struct_converter(struct)

    def convert(value: Plain) -> Any:
        if not isinstance(value, dict):
            return ABSENT
        return of_fields(fold_keys(cast("dict[str, Plain]", value)))

    return convert


@cache
def struct_converter(struct: type[Struct]) -> Callable[[dict[str, Plain]], Any]:
    """Return a function that fills a `struct` from a map with lower-case keys."""
    plan: list[tuple[str, str, str, Converter, Callable[[], Any]]] = []
    for field in msgspec.structs.fields(struct):
        info = inspect.type_info(field.type)
        key = field.encode_name.lower()
        binary = isinstance(info.type if isinstance(info, inspect.Metadata) else info, inspect.BytesType)
        plan.append((field.name, key, key + _BINARY_SUFFIX if binary else key, _converter(info), _default(field)))

    def convert(fields: dict[str, Plain]) -> Any:
        values: dict[str, Any] = {}
        for name, key, other, of_field, default in plan:
            sent = key if key in fields else other
            value = of_field(fields[sent]) if sent in fields else ABSENT
            values[name] = default() if value is ABSENT else value
        return struct(**values)

    return convert


def _default(field: msgspec.structs.FieldInfo) -> Callable[[], Any]:
    if field.default_factory is not NODEFAULT:
        return field.default_factory
    value = UNSET if field.default is NODEFAULT else field.default
    return lambda: value
