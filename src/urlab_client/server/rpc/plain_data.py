"""From the bytes of a frame to plain data, as the plugin's decoder delivers it."""

from __future__ import annotations

import base64
from typing import Any, Final, TypeAlias, cast

import msgspec

from urlab_client.server.refusal import Refusal

__all__ = ["Plain", "bad_request", "decode_plain", "fold_keys"]

Plain: TypeAlias = Any
"""Contents of a frame: None, bool, int, float, str, list, or dict with str keys."""

_JSON_FIRST = frozenset(b"{ \t\r\n")


def decode_plain(frame: bytes, depth: int) -> dict[str, Plain]:
    """Return the map of a frame, in msgpack or JSON.

    Args:
        frame: The frame.
        depth: Maximum nesting depth.

    Raises:
        Refusal: `bad_request`.
    """
    data: Plain = None
    if frame[:1] and frame[0] not in _JSON_FIRST:
        data = _decode_msgpack(frame)
    if not isinstance(data, dict):
        data = _decode_json(frame)
    if not isinstance(data, dict):
        raise bad_request("the request is neither a msgpack map nor a JSON object")
    return _tidy(cast("Plain", data), depth, depth)


def _decode_msgpack(frame: bytes) -> Plain:
    end = _object_end(frame)
    try:
        return None if end is None else msgspec.msgpack.decode(frame[:end])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def _decode_json(frame: bytes) -> Plain:
    try:
        return msgspec.json.decode(frame)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None


def _tidy(value: Plain, depth: int, most: int) -> Plain:
    """Replace values that the plugin's decoder does not deliver, recursively."""
    if depth < 0:
        raise bad_request(f"the request is nested deeper than {most} levels (limit request_depth)")
    match value:
        case dict():
            return _tidy_map(cast("dict[object, Plain]", value), depth, most)
        case list() | tuple():
            return [_tidy(item, depth - 1, most) for item in cast("list[Plain]", value)]
        case bytes():
            return base64.b64encode(value).decode("ascii")
        case None | bool() | int() | float() | str():
            return value
        case _:
            return None  # extension types and timestamps


def _tidy_map(value: dict[object, Plain], depth: int, most: int) -> dict[str, Plain]:
    tidy: dict[str, Plain] = {}
    seen: dict[str, str] = {}
    for key, item in value.items():
        if isinstance(key, str):
            # A byte string moves to another key, so the plain key is absent.
            name = f"{key}__b64__" if isinstance(item, bytes) else key
            folded = name.lower()
            if folded in seen:
                del tidy[seen[folded]]
            seen[folded] = name
            tidy[name] = _tidy(item, depth - 1, most)
    return tidy


def fold_keys(fields: dict[str, Plain]) -> dict[str, Plain]:
    """Return the fields by their keys in lower case."""
    return {key.lower(): value for key, value in fields.items()}


def _object_end(frame: bytes) -> int | None:
    """Return the end of the first msgpack object, or None if it is truncated. Bytes after it are ignored."""
    at, open_items, size = 0, 1, len(frame)
    while open_items:
        if at >= size:
            return None
        first = frame[at]
        at += 1
        open_items -= 1
        if first <= 0x7F or first >= 0xE0:
            continue
        if first <= 0x8F:
            open_items += 2 * (first & 0x0F)
        elif first <= 0x9F:
            open_items += first & 0x0F
        elif first <= 0xBF:
            at += first & 0x1F
        else:
            width, fixed, children = _SHAPES[first - 0xC0]
            length = int.from_bytes(frame[at : at + width], "big")
            at += width + fixed + (0 if children else length)
            open_items += children * length
        if open_items > size - at:
            return None
    return at if at <= size else None


_SHAPES: Final = (
    *((0, 0, 0),) * 4,  # nil, unused, false, true
    *((width, 0, 0) for width in (1, 2, 4)),  # bin
    *((width, 1, 0) for width in (1, 2, 4)),  # ext
    *((0, fixed, 0) for fixed in (4, 8)),  # float
    *((0, fixed, 0) for fixed in (1, 2, 4, 8)),  # uint
    *((0, fixed, 0) for fixed in (1, 2, 4, 8)),  # int
    *((0, 1 + fixed, 0) for fixed in (1, 2, 4, 8, 16)),  # fixext
    *((width, 0, 0) for width in (1, 2, 4)),  # str
    *((width, 0, 1) for width in (2, 4)),  # array
    *((width, 0, 2) for width in (2, 4)),  # map
)
"""By first byte from 0xC0: bytes of the length field, bytes of further content, items per unit of length."""


def bad_request(why: str) -> Refusal:
    """Return the refusal of a frame that is not a request."""
    return Refusal("bad_request", why)
