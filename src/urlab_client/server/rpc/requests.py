"""From the bytes of a request to a typed struct, by the plugin's rules of detection and coercion.

For the dispatcher. A request that means exactly what it says, which is every request of a sane client, is decoded by
msgspec in one go. Anything else is decoded to plain data and coerced field by field, as the plugin's engine does: names
and numbers in odd spellings are understood, unusable values count as absent. Both ways agree where the first succeeds.
"""

from __future__ import annotations

import base64
import math
import re
import types
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from functools import cache, cached_property
from typing import Annotated, Any, Final, TypeAlias, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import NODEFAULT, UNSET, Struct, inspect

from urlab_client.protocol.base import Op, Request
from urlab_client.protocol.codec import building
from urlab_client.protocol.dialects import ALPHA
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal

__all__ = ["Incoming", "RequestReader", "need", "usable"]

_DEFAULT_LIMITS: Final = Limits()

_BINARY_SUFFIX: Final = "__b64__"
"""Ends the key of what is binary, in JSON."""

INT32_MIN: Final = -(2**31)
INT32_MAX: Final = 2**31 - 1

T = TypeVar("T")
Plain: TypeAlias = Any
"""What a frame holds: None, bool, int, float, str, list, or dict with str keys."""


class Incoming(Struct, frozen=True):
    """One request as it was read.

    Attributes:
        name: The op as sent, or None when there is none that reads as a string.
        op: Its declaration, or None when no op has this name in any case.
        session_id: The session it claims; empty when it claims none.
        request: The typed request; None without a declaration. A required field whose value is missing or unusable
            holds `msgspec.UNSET`: read it through `need` or `usable`.
        missing: Declared required fields whose key is not there, in order of declaration. A key with a null or a value
            of the wrong type is there.
    """

    name: str | None
    op: Op | None = None
    session_id: str = ""
    request: Request[Any] | None = None
    missing: tuple[str, ...] = ()


def usable(value: T, otherwise: T) -> T:
    """Return the value of a required field, or `otherwise` when the request held nothing usable there."""
    return otherwise if value is UNSET else value


def need(request: Request[Any], value: T, field: str) -> T:
    """Return the value of a required field.

    Args:
        request: The request, named in the refusal.
        value: The field's value.
        field: Its name on the wire.

    Raises:
        Refusal: `missing_field` when the value is absent, of an unusable type, or an empty string.
    """
    if value is UNSET or (isinstance(value, str) and not value):
        op = request.__struct_config__.tag
        raise Refusal("missing_field", f"{op}: field '{field}' is missing, empty or of the wrong type")
    return value


class RequestReader:
    """Reads frames into requests. Has no state of its own, so any thread may use it."""

    def __init__(
        self,
        *,
        ops: Mapping[str, Op] = ALPHA.ops,
        structs: Mapping[str, type[Request[Any]]] = types.MappingProxyType({}),
        limits: Limits = _DEFAULT_LIMITS,
    ) -> None:
        """Prepare the decoders.

        Args:
            ops: The ops that there are, by name.
            structs: By op name, a struct that reads more than the declared one, which it must derive from.
            limits: What a request may be.
        """
        self._limits = limits
        self._exact: dict[type, Op] = {}
        self._loose: dict[str, _LooseOp] = {}
        strict: list[type[Request[Any]]] = []
        for op in ops.values():
            struct = structs.get(op.name, op.request)
            if not issubclass(struct, op.request):
                raise TypeError(f"{struct.__name__} does not derive from {op.request.__name__}")
            self._loose[op.name] = _LooseOp(op, struct)
            if not _holds_anything(_type_info(struct)):
                exact = cast("type[Request[Any]]", _strict_struct(struct))
                self._exact[exact] = op
                strict.append(exact)
        with building():
            self._decoder: msgspec.msgpack.Decoder[Request[Any]] = msgspec.msgpack.Decoder(
                Union[tuple(strict)],  # noqa: UP007 - a union of a run-time list
                dec_hook=_strict_array,
            )

    def read(self, frame: bytes) -> Incoming:
        """Read one frame.

        Raises:
            Refusal: `bad_request` when the frame is neither a msgpack map nor a JSON object, or exceeds a limit.
        """
        try:
            request = self._decoder.decode(frame)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return self._read_loosely(frame)
        kind = type(request)
        collides = _collision_test_of(kind)
        if len(frame) > self._limits.request_bytes or (collides is not None and collides(request)):
            return self._read_loosely(frame)
        op = self._exact[kind]
        self._check_strings(op, request, frame)
        return Incoming(op.name, op, request.session_id, request)

    def _check_strings(self, op: Op, request: Request[Any], frame: bytes) -> None:
        most = self._limits.string_chars
        if len(frame) <= most:  # which spares nearly every request the search
            return
        for field in msgspec.structs.fields(request):
            longest = _longest(getattr(request, field.name))
            if longest > most:
                raise _bad_request(
                    f"{op.name}: field '{field.encode_name}' holds a string of {longest} characters, more than the "
                    f"limit string_chars, {most}"
                )

    def _read_loosely(self, frame: bytes) -> Incoming:
        limits = self._limits
        if len(frame) > limits.request_bytes:
            raise _bad_request(
                f"a request of {len(frame)} bytes exceeds the limit request_bytes, {limits.request_bytes}"
            )
        fields = _fold(_decode(frame, limits.request_depth))
        name = _text(fields.get("op"))
        if name is _ABSENT:
            return Incoming(None)
        loose = self._loose.get(name.lower())
        if loose is None or (loose.exact and name != loose.op.name):
            return Incoming(name, session_id=_session_id(fields))
        missing = tuple(field for field in loose.declared if field.lower() not in fields)
        request = loose.convert(fields)
        self._check_strings(loose.op, request, frame)
        return Incoming(name, loose.op, _session_id(fields), request, missing)


def _longest(value: object) -> int:
    """Return the length of the longest string in a value of a request."""
    match value:
        case str():
            return len(value)
        case dict():
            items = cast("dict[object, object]", value)
            return max((max(_longest(key), _longest(item)) for key, item in items.items()), default=0)
        case list() | tuple():
            return max(map(_longest, cast("list[object]", value)), default=0)
        case Struct():
            return max((_longest(getattr(value, name)) for name in value.__struct_fields__), default=0)
        case _:
            return 0


def _session_id(fields: Mapping[str, Plain]) -> str:
    value = _text(fields.get("session_id"))
    return "" if value is _ABSENT else value


class _LooseOp:
    """What the field-by-field way needs to know of an op."""

    def __init__(self, op: Op, struct: type[Request[Any]]) -> None:
        self.op = op
        self.exact = op.name in ("hello", "meta")
        self._struct = struct

    # Computed on first use, so that a server starts sooner.

    @cached_property
    def declared(self) -> tuple[str, ...]:
        return self.op.declared_required

    @cached_property
    def convert(self) -> Callable[[dict[str, Plain]], Any]:
        return _struct_converter(self._struct)


# Bytes to plain data.

_JSON_FIRST = frozenset(b"{ \t\r\n")


def _decode(frame: bytes, depth: int) -> dict[str, Plain]:
    data: Plain = None
    if frame[:1] and frame[0] not in _JSON_FIRST:
        data = _decode_msgpack(frame)
    if not isinstance(data, dict):
        data = _decode_json(frame)
    if not isinstance(data, dict):
        raise _bad_request("the request is neither a msgpack map nor a JSON object")
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
    """Replace what the plugin's decoder would not deliver, all the way down."""
    if depth < 0:
        raise _bad_request(f"the request is nested deeper than {most} levels (limit request_depth)")
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
            # A byte string moves to another key, so the plain one is absent to whoever looks for it.
            name = f"{key}__b64__" if isinstance(item, bytes) else key
            folded = name.lower()
            if folded in seen:
                del tidy[seen[folded]]
            seen[folded] = name
            tidy[name] = _tidy(item, depth - 1, most)
    return tidy


def _fold(fields: dict[str, Plain]) -> dict[str, Plain]:
    return {key.lower(): value for key, value in fields.items()}


def _object_end(frame: bytes) -> int | None:
    """Return where the first msgpack object ends, or None when it is cut off: bytes after it are to be ignored."""
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
"""By first byte from 0xC0: bytes of the length field, bytes of content besides, items per unit of length."""


def _bad_request(why: str) -> Refusal:
    return Refusal("bad_request", why)


# The exact way: structs that refuse whatever the field-by-field way would have to interpret.


# Inspecting the types took most of a server's start, and gives the same for every server.
_type_info = cache(inspect.type_info)


def _strict_array(kind: type, value: object) -> np.ndarray[Any, np.dtype[np.float64]]:
    del kind
    return np.array(msgspec.convert(value, list[float]), dtype=np.float64)


@cache
def _strict_struct(struct: type[Struct]) -> type[Struct]:
    """Derive a struct that refuses unknown fields and integers beyond 32 bits, here and in the structs it holds."""
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
    if inspect.is_struct_type(annotation):
        return _strict_struct(annotation)
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


def _holds_anything(info: inspect.Type) -> bool:
    """Whether a field takes any plain value, which only `_tidy` can make the plugin's view of."""
    match info:
        case inspect.Metadata(type=inner) | inspect.ListType(item_type=inner) | inspect.DictType(value_type=inner):
            return _holds_anything(inner)
        case inspect.UnionType(types=members):
            return any(map(_holds_anything, members))
        case inspect.StructType(fields=fields):
            return any(_holds_anything(field.type) for field in fields)
        case _:
            return isinstance(info, inspect.AnyType)


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
def _collision_test_of(kind: type) -> Callable[[Any], bool] | None:
    return _collision_test(_type_info(kind))


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


# The loose way: a converter per field type, made once. Each returns `_ABSENT` for what it cannot use.


class _Absent(Enum):
    ABSENT = "absent"


_ABSENT: Any = _Absent.ABSENT

Converter: TypeAlias = Callable[[Plain], Any]

_DECIMAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d+", re.ASCII)


def _number(value: Plain) -> Any:
    if isinstance(value, str):
        return float(value) if _DECIMAL.fullmatch(value) else _ABSENT
    if not isinstance(value, (int, float)):
        return _ABSENT
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _whole(value: Plain) -> Any:
    number = _number(value)
    if number is _ABSENT or not math.isfinite(number):
        return _ABSENT
    rounded = math.trunc(number + math.copysign(0.5, number))
    return rounded if INT32_MIN <= rounded <= INT32_MAX else _ABSENT


def _flag(value: Plain) -> Any:
    if isinstance(value, str):
        return value.lower() in ("true", "yes", "on") or (
            _INTEGER.fullmatch(value) is not None and value.strip("+-0") != ""
        )
    return value != 0 if isinstance(value, (bool, int, float)) else _ABSENT


def _text(value: Plain) -> Any:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() else str(value)
    return str(float(value) if value.bit_length() > 1024 else value) if isinstance(value, int) else _ABSENT


def _array(value: Plain) -> Any:
    if not isinstance(value, list):
        return _ABSENT
    return np.array([_or_zero(_number(item)) for item in cast("list[Plain]", value)], dtype=np.float64)


def _or_zero(number: Any) -> Any:
    return 0.0 if number is _ABSENT else number


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
    """Return bytes; text, in which JSON carries them, is base64."""
    if isinstance(value, str):
        try:
            return base64.b64decode(value, validate=True)
        except ValueError:
            return _ABSENT
    return value if isinstance(value, bytes) else _ABSENT


def _same(value: Plain) -> Plain:
    return value


_SIMPLE: Final[Mapping[type[inspect.Type], Converter]] = {
    inspect.StrType: _text,
    inspect.BytesType: _binary,
    inspect.BoolType: _flag,
    inspect.IntType: _whole,
    inspect.FloatType: _number,
    inspect.CustomType: _array,
    inspect.AnyType: _same,
}


def _item_converter(info: inspect.Type) -> Converter:
    """Convert an element: numbers that are none read as 0, strings as empty, anything else unusable is left out."""
    convert = _converter(info)
    if convert is _number:
        return lambda value: _or_zero(convert(value))
    if inspect.StrType() in _members(info):
        return lambda value: "" if (text := convert(value)) is _ABSENT else text
    return convert


def _members(info: inspect.Type) -> Iterable[inspect.Type]:
    return info.types if isinstance(info, inspect.UnionType) else (info,)


def _choice_converter(choices: Iterable[Any]) -> Converter:
    folded = {str(choice).lower(): choice for choice in choices}

    def convert(value: Plain) -> Any:
        text = _text(value)
        return _ABSENT if text is _ABSENT else folded.get(text.lower(), _ABSENT)

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
            return None if optional else _ABSENT
        chosen = of_maps if isinstance(value, dict) else others
        return _ABSENT if chosen is None else chosen(value)

    return convert


def _tuple_converter(items: list[Converter]) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, list) or len(cast("list[Plain]", value)) != len(items):
            return _ABSENT
        return tuple(item(part) for item, part in zip(items, cast("list[Plain]", value), strict=True))

    return convert


def _list_converter(item: Converter) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, list):
            return _ABSENT
        converted = (item(part) for part in cast("list[Plain]", value))
        return [part for part in converted if part is not _ABSENT]

    return convert


def _map_converter(item: Converter) -> Converter:
    def convert(value: Plain) -> Any:
        if not isinstance(value, dict):
            return _ABSENT
        converted = ((key, item(part)) for key, part in cast("dict[str, Plain]", value).items())
        return {key: part for key, part in converted if part is not _ABSENT}

    return convert


def _nested_converter(struct: type[Struct]) -> Converter:
    of_fields = _struct_converter(struct)

    def convert(value: Plain) -> Any:
        if not isinstance(value, dict):
            return _ABSENT
        return of_fields(_fold(cast("dict[str, Plain]", value)))

    return convert


@cache
def _struct_converter(struct: type[Struct]) -> Callable[[dict[str, Plain]], Any]:
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
            value = of_field(fields[sent]) if sent in fields else _ABSENT
            values[name] = default() if value is _ABSENT else value
        return struct(**values)

    return convert


def _default(field: msgspec.structs.FieldInfo) -> Callable[[], Any]:
    if field.default_factory is not NODEFAULT:
        return field.default_factory
    value = UNSET if field.default is NODEFAULT else field.default
    return lambda: value
