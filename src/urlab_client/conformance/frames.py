"""Reply frames, held against the declarations: which fields are unknown, missing or of another type. No I/O.

The client ignores unknown fields and converts numbers, so that it can talk to newer servers. A check of a server
wants to know of each of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Final, cast

import msgspec
from msgspec.inspect import (
    AnyType,
    BoolType,
    BytesType,
    CustomType,
    DictType,
    EnumType,
    FloatType,
    IntType,
    ListType,
    LiteralType,
    Metadata,
    NoneType,
    RawType,
    StrType,
    StructType,
    TupleType,
    Type,
    UnionType,
    VarTupleType,
    type_info,
)

from urlab_client.protocol.codec import building

_SIZED: Final = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
_CONTAINERS: Final = {0xDC: (1, 2), 0xDD: (1, 4), 0xDE: (2, 2), 0xDF: (2, 4)}
_FLOAT64: Final = 0xCB
_NUMBERS: Final = {
    **dict.fromkeys(range(0x80), (0, "integer")),
    **dict.fromkeys(range(0xE0, 0x100), (0, "integer")),
    0xC0: (0, "nil"),
    0xCA: (4, "float32"),
    **{0xCC + i: (1 << i, "integer") for i in range(4)},
    **{0xD0 + i: (1 << i, "integer") for i in range(4)},
}


def other_numbers(frame: bytes) -> dict[str, int]:
    """Count what a msgpack frame has in place of float64 numbers: integers, float32 numbers and nil.

    Raises:
        ValueError: The frame is not one msgpack value.
    """
    found: dict[str, int] = {}
    try:
        end = _walk(frame, 0, found)
    except (IndexError, KeyError) as error:
        raise ValueError("it is not msgpack") from error
    if end != len(frame):
        raise ValueError(f"{len(frame) - end} bytes follow the message")
    return found


def _walk(frame: bytes, at: int, found: dict[str, int]) -> int:
    first = frame[at]
    at += 1
    if first in (0xC2, 0xC3):
        return at
    if first == _FLOAT64:
        return at + 8
    if 0xA0 <= first <= 0xBF:
        return at + (first & 0x1F)
    if first in _SIZED:
        width = _SIZED[first]
        return at + width + int.from_bytes(frame[at : at + width], "big")
    if first in _NUMBERS and not 0x80 <= first <= 0x9F:
        width, kind = _NUMBERS[first]
        found[kind] = found.get(kind, 0) + 1
        return at + width
    if 0x80 <= first <= 0x9F:
        count = (first & 0x0F) * (2 if first < 0x90 else 1)
    else:
        each, width = _CONTAINERS[first]
        count = each * int.from_bytes(frame[at : at + width], "big")
        at += width
    for _ in range(count):
        at = _walk(frame, at, found)
    return at


def oddities(value: Any, declared: Any) -> list[str]:
    """Return where a decoded reply departs from its declaration, one line for each place.

    Args:
        value: The reply as plain data.
        declared: The reply's struct, or any annotation.
    """
    return list(dict.fromkeys(_odd(value, _info(declared), "")))


@cache
def _info(declared: Any) -> Type:
    with building():
        return type_info(declared)


def _odd(value: Any, info: Type, where: str) -> Iterator[str]:
    match info:
        case Metadata():
            yield from _odd(value, info.type, where)
        case AnyType() | RawType():
            return
        case UnionType():
            kinds = [one for one in info.types if value is None or not isinstance(one, NoneType)]
            # The alternative of the right kind, whatever is wrong inside.
            yield from min(
                (list(_odd(value, one, where)) for one in kinds),
                key=lambda lines: (any(line.startswith(f"{where[1:]} is ") for line in lines), len(lines)),
            )
        case StructType():
            yield from _odd_map(value, info, where)
        case DictType() if isinstance(value, dict):
            for key, item in cast("dict[str, Any]", value).items():
                yield from _odd(item, info.value_type, f"{where}.{key}")
        case ListType() | VarTupleType() if isinstance(value, list):
            for item in cast("list[Any]", value):
                yield from _odd(item, info.item_type, f"{where}[]")
        case TupleType() if isinstance(value, list) and len(cast("list[Any]", value)) == len(info.item_types):
            for item, kind in zip(cast("list[Any]", value), info.item_types, strict=True):
                yield from _odd(item, kind, f"{where}[]")
        case _ if not _fits(value, info):
            yield f"{where[1:]} is {_said(value)}, declared {_named(info)}"
        case _:
            return


def _odd_map(value: Any, info: StructType, where: str) -> Iterator[str]:
    if not isinstance(value, dict):
        yield f"{where[1:] or 'the reply'} is {_said(value)}, declared a map"
        return
    given = dict(cast("dict[str, Any]", value))
    if info.tag_field is not None:
        given.pop(info.tag_field, None)
    for field in info.fields:
        if field.encode_name in given:
            yield from _odd(given.pop(field.encode_name), field.type, f"{where}.{field.encode_name}")
        elif field.required:
            yield f"{where[1:]}{'.' if where else ''}{field.encode_name} is missing"
    for name in given:
        yield f"{where[1:]}{'.' if where else ''}{name} is not declared"


def _fits(value: Any, info: Type) -> bool:  # noqa: PLR0911
    number = isinstance(value, int | float) and not isinstance(value, bool)
    match info:
        case FloatType():
            return number
        case IntType():
            return number and float(value).is_integer()
        case BoolType():
            return isinstance(value, bool)
        case StrType():
            return isinstance(value, str)
        case LiteralType():
            return value in info.values
        case EnumType():
            return value in {member.value for member in info.cls}
        case BytesType():
            return isinstance(value, bytes)
        case NoneType():
            return value is None
        case CustomType():  # an array
            items = cast("list[Any]", value) if isinstance(value, list) else [None]
            return all(isinstance(item, int | float) and not isinstance(item, bool) for item in items)
        case _:
            return False


def _named(info: Type) -> str:
    if isinstance(info, CustomType):
        return "numbers"
    return type(info).__name__.removesuffix("Type").lower()


def _said(value: Any) -> str:
    return f"{type(value).__name__} {value!r:.40}"


def plain(frame: bytes) -> dict[str, Any]:
    """Return a reply as plain data; the first byte shows whether it is msgpack or JSON.

    Raises:
        ValueError: It is neither, or not a map.
    """
    try:
        value = msgspec.json.decode(frame) if frame[:1] == b"{" else msgspec.msgpack.decode(frame)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"a reply of {len(frame)} bytes cannot be decoded: {error}") from error
    if not isinstance(value, dict):
        raise ValueError(f"a reply is {_said(value)} instead of a map")  # noqa: TRY004 - of the wire, not of a caller
    return cast("dict[str, Any]", value)


_LONG: Final = 1024


def thinned(frame: bytes) -> bytes:
    """Return a reply with the size in the place of each long text and each long run of bytes."""

    def visit(value: Any) -> Any:
        match value:
            case str() | bytes() if len(value) > _LONG:
                return f"({len(value)} bytes)"
            case dict():
                return {name: visit(item) for name, item in cast("dict[str, Any]", value).items()}
            case list():
                return [visit(item) for item in cast("list[Any]", value)]
            case _:
                return value

    codec = msgspec.json if frame[:1] == b"{" else msgspec.msgpack
    try:
        return codec.encode(visit(codec.decode(frame)))
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return frame
