"""From the bytes of a request to a typed struct.

For the dispatcher. msgspec decodes a `step` and a chunk of an upload directly to their structs, as our client sends
them: they come at kilohertz rates, or with megabytes. What this strict decoder refuses, and all other ops, is read
leniently, as the plugin does it. Both ways agree where the first one succeeds.

The lenient way turns a frame into plain data, and that into a struct, field by field: names in any letter case, several
spellings of a value. A value that cannot be used counts as absent, which is `ABSENT` here. msgspec's own lax conversion
follows other rules: it refuses the whole request for one value, reads no number as text, and accepts exponents.
"""

from __future__ import annotations

import base64
import math
import re
import types
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final, TypeAlias, TypeVar, Union, cast

import msgspec
import numpy as np
from msgspec import NODEFAULT, UNSET, Struct, inspect
from msgspec.structs import astuple

from urlab_client.protocol.base import INT32_MAX, INT32_MIN, Op, Request
from urlab_client.protocol.codec import building
from urlab_client.protocol.registry import OPS
from urlab_client.server.dialects import ALPHA
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal

Plain: TypeAlias = Any
"""Contents of a frame: None, bool, int, float, str, list, or dict with str keys."""

_JSON_FIRST: Final = frozenset(b"{ \t\r\n")

_BINARY_SUFFIX: Final = "__b64__"
"""What the plugin's decoder adds to the key of a byte string, whose value becomes base64 text."""

_TRAILING: Final = re.compile(r"trailing characters \(byte (\d+)\)")

_DECIMAL: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)

_INTEGER: Final = re.compile(r"[+-]?\d+", re.ASCII)


_DEFAULT_LIMITS: Final = Limits()

_EXACT_NAMES: Final = frozenset({"hello", "meta"})
"""Ops that are recognised in lower case only."""

_NUMBERS: Final = frozenset({float, int})

T = TypeVar("T")


ABSENT: Final[Any] = UNSET


def read_plain(frame: bytes, depth: int) -> dict[str, Plain]:
    """Return the map of a frame, in msgpack or JSON."""
    data: Plain = None
    if frame[:1] and frame[0] not in _JSON_FIRST:
        data = _decoded(frame, msgspec.msgpack.decode)
    if not isinstance(data, dict):
        data = _decoded(frame, msgspec.json.decode)
    if not isinstance(data, dict):
        raise Refusal("bad_request", "the request is neither a msgpack map nor a JSON object")
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
        raise Refusal("bad_request", f"the request is nested deeper than {most} levels (limit request_depth)")
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
    return tuple(
        (field.name, field.encode_name.lower(), bare(inspect.type_info(field.type)), _default(field))
        for field in msgspec.structs.fields(struct)
    )


def bare(kind: inspect.Type) -> inspect.Type:
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


class Incoming(Struct, frozen=True):
    """One decoded request.

    Attributes:
        name: The op as sent, or None if it cannot be read as a string.
        op: Its declaration, or None if no op has this name, ignoring case.
        session_id: The session id in the request; empty if it has none.
        request: The typed request; None without a declaration. A required field whose value is missing or unusable
            holds `msgspec.UNSET`: read it through `need` or `usable`.
        missing: Declared required fields whose key is absent, in order of declaration. A key with a null or a value of
            the wrong type is present.
    """

    name: str | None
    op: Op | None = None
    session_id: str = ""
    request: Request[Any] | None = None
    missing: tuple[str, ...] = ()


def usable(value: T, otherwise: T) -> T:
    return otherwise if value is UNSET else value


def need(request: Request[Any], value: T, field: str) -> T:
    """Return the value of a required field; refuse it with `missing_field` if it is absent, unusable or empty."""
    if value is UNSET or (isinstance(value, str) and not value):
        op = request.__struct_config__.tag
        raise Refusal("missing_field", f"{op}: field '{field}' is missing, empty or of the wrong type")
    return value


class RequestReader:
    """Decodes frames into requests. Stateless, so any thread may use it."""

    def __init__(
        self,
        *,
        ops: Mapping[str, Op] = ALPHA.ops,
        structs: Mapping[str, type[Request[Any]]] = types.MappingProxyType({}),
        limits: Limits = _DEFAULT_LIMITS,
    ) -> None:
        """Create the reader of a server.

        Args:
            structs: Struct with more fields than the declared one, from which it must derive, by op name.
        """
        for name, struct in structs.items():
            if not issubclass(struct, OPS[name].request):
                raise TypeError(f"{struct.__name__} does not derive from {OPS[name].request.__name__}")
        self._ops = ops
        self._structs = structs
        self._limits = limits
        self._decode = _strict_decoder().decode
        self._hot: dict[type, Op] = {op.request: op for op in ops.values() if op.hot}

    def read(self, frame: bytes) -> Incoming:
        most = self._limits.request_bytes
        if len(frame) > most:
            raise Refusal("bad_request", f"a request of {len(frame)} bytes exceeds the limit request_bytes, {most}")
        try:
            request = self._decode(frame)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return self._read_leniently(frame)
        op = self._hot.get(type(request))
        if op is None or _names_collide(request):
            return self._read_leniently(frame)
        self._check_strings(op, request, frame)
        return Incoming(op.name, op, request.session_id, request)

    def _read_leniently(self, frame: bytes) -> Incoming:
        fields = fold_keys(read_plain(frame, self._limits.request_depth))
        name, session_id = as_text(fields.get("op")), as_text(fields.get("session_id"))
        if name is ABSENT:
            return Incoming(None)
        session_id = "" if session_id is ABSENT else session_id
        op = self._ops.get(name.lower())
        if op is None or (op.name in _EXACT_NAMES and name != op.name):
            return Incoming(name, session_id=session_id)
        missing = tuple(field for field in op.declared_required if field.lower() not in fields)
        request = fill(self._structs.get(op.name, op.request), fields)
        self._check_strings(op, request, frame)
        return Incoming(name, op, session_id, request, missing)

    def _check_strings(self, op: Op, request: Request[Any], frame: bytes) -> None:
        most = self._limits.string_chars
        if len(frame) <= most:  # true for nearly every request, so that no search is needed
            return
        for name, sent_as in zip(request.__struct_fields__, request.__struct_encode_fields__, strict=True):
            longest = _longest_string(getattr(request, name))
            if longest > most:
                raise Refusal(
                    "bad_request",
                    f"{op.name}: field '{sent_as}' holds a string of {longest} characters, more than the "
                    f"limit string_chars, {most}",
                )


@cache
def _strict_decoder() -> msgspec.msgpack.Decoder[Request[Any]]:
    """Return the decoder of the hot ops. Their structs forbid unknown fields, which may be others in another case."""
    hot = tuple(op.request for op in OPS.values() if op.hot)
    with building():
        return msgspec.msgpack.Decoder(Union[hot], dec_hook=_strict_array)  # noqa: UP007 - a union of a run-time list


def _strict_array(kind: type, value: object) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Decode an array; its elements must be numbers."""
    del kind
    return np.array(msgspec.convert(value, list[float]), dtype=np.float64)


def _names_collide(request: Struct) -> bool:
    """Return whether a map has keys that differ only in letter case, of which only the last one counts."""
    for value in astuple(request):  # no generators: each step takes this time
        if type(value) is dict and value:
            entries = cast("dict[str, object]", value)
            if len(entries) > 1 and len({*map(str.lower, entries)}) < len(entries):
                return True
            for item in entries.values():
                if isinstance(item, Struct) and _names_collide(item):
                    return True
    return False


def _longest_string(value: object) -> int:
    """Return the length of the longest string in a value of a request."""
    if isinstance(value, str):
        return len(value)
    if isinstance(value, (list, tuple)):
        inside = cast("list[object]", value)
    elif isinstance(value, dict):
        entries = cast("dict[object, object]", value)
        inside = [*entries, *entries.values()]
    elif isinstance(value, Struct):
        inside = [item for name in value.__struct_fields__ if (item := getattr(value, name)) is not None]
    else:
        return 0
    # Most values are numbers in long lists, and the set of their types is small.
    return 0 if _NUMBERS.issuperset(map(type, inside)) else max(map(_longest_string, inside))
