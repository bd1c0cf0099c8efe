"""Requests as the plugin reads them, whatever their spelling.

A frame becomes plain data, and that becomes the struct of an op, field by field: names in any letter case, several
spellings of a value. A value that cannot be used counts as absent, which is `ABSENT` here.

msgspec's own lax conversion follows other rules: it refuses the whole request for one value, reads no number as text,
and accepts exponents.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cache
from typing import Any, Final, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import NODEFAULT, UNSET, Struct, inspect

from urlab_client.protocol.base import INT32_MAX, INT32_MIN
from urlab_client.server.refusal import Refusal

Plain: TypeAlias = Any
"""Contents of a frame: None, bool, int, float, str, list, or dict with str keys."""

_JSON_FIRST: Final = frozenset(b"{ \t\r\n")

_BINARY_SUFFIX: Final = "__b64__"
"""What the plugin's decoder adds to the key of a byte string, whose value becomes base64 text."""

_TRAILING: Final = re.compile(r"trailing characters \(byte (\d+)\)")

_DECIMAL: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)

_INTEGER: Final = re.compile(r"[+-]?\d+", re.ASCII)


class _Absent(Enum):
    ABSENT = "absent"


ABSENT: Any = _Absent.ABSENT


def bad_request(why: str) -> Refusal:
    """Return the refusal of a frame that is not a request."""
    return Refusal("bad_request", why)


def read_plain(frame: bytes, depth: int) -> dict[str, Plain]:
    """Return the map of a frame, in msgpack or JSON."""
    data: Plain = None
    if frame[:1] and frame[0] not in _JSON_FIRST:
        data = _decoded(frame, msgspec.msgpack.decode)
    if not isinstance(data, dict):
        data = _decoded(frame, msgspec.json.decode)
    if not isinstance(data, dict):
        raise bad_request("the request is neither a msgpack map nor a JSON object")
    return _tidy(cast("Plain", data), depth, depth)


def _decoded(frame: bytes, decode: Callable[[bytes], Plain]) -> Plain:
    try:
        return decode(frame)
    except (ValueError, RecursionError) as error:
        # The plugin ignores what follows the first object in msgpack. msgspec does not, but says where it begins.
        surplus = _TRAILING.search(str(error)) if decode is msgspec.msgpack.decode else None
        return None if surplus is None else decode(frame[: int(surplus[1])])


def _tidy(value: Plain, depth: int, most: int) -> Plain:
    """Replace values that the plugin's decoder does not deliver, recursively."""
    if depth < 0:
        raise bad_request(f"the request is nested deeper than {most} levels (limit request_depth)")
    match value:
        case dict():
            tidy: dict[str, tuple[str, Plain]] = {}  # by folded key: of keys that differ in case, the last one counts
            for key, item in cast("dict[object, Plain]", value).items():
                if isinstance(key, str):
                    # A byte string moves to another key, so the plain key is absent.
                    name = key + _BINARY_SUFFIX if isinstance(item, bytes) else key
                    tidy[name.lower()] = name, _tidy(item, depth - 1, most)
            return dict(tidy.values())
        case list() | tuple():
            return [_tidy(item, depth - 1, most) for item in cast("list[Plain]", value)]
        case bytes():
            return base64.b64encode(value).decode("ascii")
        case None | bool() | int() | float() | str():
            return value
        case _:
            return None  # extension types and timestamps


def fold_keys(fields: Mapping[str, Plain]) -> dict[str, Plain]:
    """Return the fields by their keys in lower case."""
    return {key.lower(): value for key, value in fields.items()}


def fill(struct: type[Struct], fields: Mapping[str, Plain]) -> Any:
    """Return a `struct` with the values of a map.

    A required field whose value is missing or unusable holds `msgspec.UNSET`.
    """
    folded = fold_keys(fields)
    values: dict[str, Any] = {}
    for name, key, kind, default in _plan(struct):
        sent = folded.get(key, ABSENT)
        if sent is ABSENT and isinstance(kind, inspect.BytesType):
            sent = folded.get(key + _BINARY_SUFFIX, ABSENT)
        value = ABSENT if sent is ABSENT else _read(kind, sent)
        values[name] = default() if value is ABSENT else value
    return struct(**values)


@cache
def _plan(struct: type[Struct]) -> tuple[tuple[str, str, inspect.Type, Callable[[], Any]], ...]:
    """Return name, key, type and default of each field of a struct."""
    return tuple(
        (field.name, field.encode_name.lower(), bare(inspect.type_info(field.type)), _default(field))
        for field in msgspec.structs.fields(struct)
    )


def bare(kind: inspect.Type) -> inspect.Type:
    """Return a type without its description."""
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def _default(field: msgspec.structs.FieldInfo) -> Callable[[], Any]:
    if field.default_factory is not NODEFAULT:
        return field.default_factory
    value = UNSET if field.default is NODEFAULT else field.default
    return lambda: value


def _read(kind: inspect.Type, value: Plain) -> Any:  # noqa: PLR0911 - one line per type
    """Return a value as the plugin reads it where it wants this type."""
    convert = _SIMPLE.get(type(kind))
    if convert is not None:
        return convert(value)
    match kind:
        case inspect.Metadata(type=inner):
            return _read(inner, value)
        case inspect.UnionType(types=members):
            readings = (_read(member, value) for member in members)
            return next((reading for reading in readings if reading is not ABSENT), ABSENT)
        case inspect.LiteralType(values=choices):
            text = as_text(value)
            return ABSENT if text is ABSENT else {str(c).lower(): c for c in choices}.get(text.lower(), ABSENT)
        case inspect.StructType(cls=cls):
            return fill(cls, cast("dict[str, Plain]", value)) if isinstance(value, dict) else ABSENT
        case inspect.DictType(value_type=item) if isinstance(value, dict):
            entries = ((key, _element(item, part)) for key, part in cast("dict[str, Plain]", value).items())
            return {key: part for key, part in entries if part is not ABSENT}
        case inspect.ListType(item_type=item) if isinstance(value, list):
            elements = (_list_element(item, part) for part in cast("list[Plain]", value))
            return [element for element in elements if element is not ABSENT]
        case inspect.TupleType(item_types=items) if isinstance(value, list):
            parts = cast("list[Plain]", value)
            return tuple(map(_element, items, parts)) if len(parts) == len(items) else ABSENT
        case _:
            return ABSENT


def _element(kind: inspect.Type, value: Plain) -> Any:
    """Read an element: an unusable number is 0, and an unusable string empty; others are `ABSENT`."""
    element = _read(kind, value)
    if element is not ABSENT:
        return element
    members = kind.types if isinstance(kind, inspect.UnionType) else (bare(kind),)
    if isinstance(members[0], inspect.FloatType):
        return 0.0
    return "" if any(isinstance(member, inspect.StrType) for member in members) else ABSENT


def _list_element(kind: inspect.Type, value: Plain) -> Any:
    """Read an element of a list, in which a map is never absent: at worst it has defaults."""
    return _element(kind, {} if isinstance(kind, inspect.StructType) and not isinstance(value, dict) else value)


def as_text(value: Plain) -> Any:
    """Return the value that the plugin reads as a string, or `ABSENT`."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else str(value)
    return str(float(value) if value.bit_length() > 1024 else value) if isinstance(value, int) else ABSENT


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


def _binary(value: Plain) -> Any:
    try:
        return base64.b64decode(value, validate=True) if isinstance(value, str) else ABSENT
    except ValueError:
        return ABSENT


def _array(value: Plain) -> Any:
    if not isinstance(value, list):
        return ABSENT
    return np.array([_element(inspect.FloatType(), part) for part in cast("list[Plain]", value)], dtype=np.float64)


_SIMPLE: Final[Mapping[type[inspect.Type], Callable[[Plain], Any]]] = {
    inspect.StrType: as_text,
    inspect.BytesType: _binary,
    inspect.BoolType: _flag,
    inspect.IntType: _whole,
    inspect.FloatType: _number,
    inspect.CustomType: _array,
    inspect.NoneType: lambda value: None if value is None else ABSENT,
    inspect.AnyType: lambda value: value,
}
