"""Typed values as plain data: dictionaries, JSON, and fields of pydantic models. No I/O.

Plain data survives a round trip through any JSON parser: numbers that are not finite become the strings `NaN`,
`Infinity` and `-Infinity`, arrays become lists, bytes base64 text, and enumerations their values. Keys are attribute
names; a struct that is one of several kinds also contains its tag.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self, TypeAlias, Union, cast, get_args, get_origin

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client.values import html
from urlab_client.values.names import did_you_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

ArrayForm: TypeAlias = Literal["list", "base64"]
"""Form of arrays in plain data: lists, nested by dimension, or `{"dtype": …, "shape": […], "base64": …}`."""


class Serializable:
    """Base class of the structs that calls return."""

    __slots__ = ()

    def to_dict(self, *, arrays: ArrayForm = "list") -> dict[str, Any]:
        """Return the fields as plain data for any JSON encoder.

        Args:
            arrays: `list` converts arrays to nested lists. `base64` converts them to `{"dtype", "shape", "base64"}`,
                with little-endian numbers in C order; use it for pictures.

        Raises:
            ValueError: The form of arrays is unknown.
        """
        if arrays not in {"list", "base64"}:
            raise ValueError(f"arrays={arrays!r} is unknown; it is 'list' or 'base64'")
        return plain(self, arrays)

    def to_json(self, *, arrays: ArrayForm = "list") -> str:
        """Return `to_dict()` as JSON text."""
        return msgspec.json.encode(self.to_dict(arrays=arrays)).decode()

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Create a value from plain data, the inverse of `to_dict()`, with arrays in either form.

        Untyped parts are returned unchanged; NaN and infinities in them stay strings. A base class of several kinds,
        such as `ClientEvent`, selects the kind by its tag.

        Raises:
            ValueError: A field is missing, unknown or of the wrong type; the message names it.
        """
        return cast("Self", read(cls, data, cls.__name__))

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """Create a value from JSON text, the inverse of `to_json()`.

        Raises:
            ValueError: The text is not JSON, or not that of such a value.
        """
        try:
            data = msgspec.json.decode(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{cls.__name__}: {error}") from None
        return cls.from_dict(data)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced.

        Raises:
            TypeError: There is no field with this name.
        """
        return cast("Self", msgspec.structs.replace(cast("Struct", self), **changes))

    def _repr_html_(self) -> str | None:
        return html.fields(type(self).__name__, self._shown())

    def _shown(self) -> dict[str, Any]:
        """Return what a notebook shows, by field."""
        struct = cast("Struct", self)
        return {name: one for name, one in _fields(struct, None).items() if name in struct.__struct_fields__}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        # Only pydantic calls this. The code below builds plain dictionaries and does not import pydantic.
        from urlab_client.values.schemas import core_schema

        return core_schema(cast("type[Struct]", cls), handler)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> dict[str, Any]:
        from urlab_client.values.schemas import json_schema

        return json_schema(cast("type[Struct]", cls), schema, handler)


def plain(value: Any, arrays: ArrayForm | None) -> Any:  # noqa: PLR0911
    """Return a value as plain data.

    Args:
        value: Any value that a field of a struct may have.
        arrays: Form of arrays. None converts only structs and containers, and leaves their contents unchanged.

    Raises:
        TypeError: A value cannot be represented as plain data.
    """
    kind: type = type(cast("object", value))
    if kind in _ALREADY_PLAIN:
        return value
    match value:
        case Struct():
            return _fields(value, arrays)
        case Mapping():
            items = cast("Mapping[Any, Any]", value).items()
            return {plain(key, "list"): plain(item, arrays) for key, item in items}
        case list() | tuple():
            return [plain(item, arrays) for item in cast("list[Any]", value)]
        case set() | frozenset():
            return sorted(plain(item, arrays) for item in cast("set[Any]", value))
        case _ if arrays is None:
            return value
        case float():
            return float(value) if math.isfinite(value) else _name_of(value)
        case Enum():
            return value.value
        case np.ndarray():
            return _array(cast("NDArray[Any]", value), arrays)
        case np.generic():
            return plain(cast("np.generic[Any]", value).item(), arrays)
        case bytes():
            return base64.b64encode(value).decode("ascii")
        case _:
            raise TypeError(f"{kind.__name__} has no form in plain data")


_ALREADY_PLAIN: Final[frozenset[type]] = frozenset({bool, int, str, NoneType})


def _name_of(value: float) -> str:
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _fields(struct: Struct, arrays: ArrayForm | None) -> dict[str, Any]:
    config = struct.__struct_config__
    data: dict[str, Any] = {} if config.tag_field is None else {config.tag_field: config.tag}
    maps: set[int] = set()
    for name in struct.__struct_fields__:
        value = getattr(struct, name)
        if isinstance(value, msgspec.Raw):
            continue  # deliberately not decoded: another field has the same information
        if isinstance(value, dict) and value:
            # Fields that the beta renames exist under both names; plain data has them once, as for every dialect.
            mapping: int = id(cast("object", value))
            if mapping in maps:
                value = None
            maps.add(mapping)
        data[name] = plain(value, arrays)
    return data


def _array(array: NDArray[Any], form: ArrayForm) -> Any:
    """Return an array in the given form."""
    if form == "list":
        listed = array.tolist()
        return listed if array.dtype.kind != "f" or np.isfinite(array).all() else plain(listed, form)
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return {
        "dtype": array.dtype.name,
        "shape": list(array.shape),
        "base64": base64.b64encode(little.tobytes()).decode("ascii"),
    }


def read(kind: Any, data: Any, where: str) -> Any:  # noqa: PLR0911 - one for each kind of type
    """Create a value of a type from plain data.

    Args:
        kind: The type, as a field of a struct is annotated.
        data: Result of `plain`, or of a JSON parser on it.
        where: Location of the data, for errors.

    Raises:
        ValueError: The data do not match the type; the message says where.
    """
    origin: Any = get_origin(kind)
    arguments = get_args(kind)
    if origin is Annotated:
        return read(arguments[0], data, where)
    if origin in {Union, UnionType}:
        return _read_one_of(arguments, data, where)
    if origin is Literal and data in arguments:
        return data
    if origin is np.ndarray:
        return _said(where, lambda: read_array(data, np.dtype(get_args(arguments[1])[0])))
    if origin is dict and isinstance(data, Mapping):
        items = cast("Mapping[Any, Any]", data).items()
        return {_key(arguments[0], key): read(arguments[1], value, f"{where}[{key!r}]") for key, value in items}
    if origin in {list, tuple, frozenset, Sequence} and isinstance(data, list | tuple):
        return _read_items(origin, arguments, list(cast("Sequence[Any]", data)), where)
    if isinstance(kind, type) and issubclass(kind, Struct):
        return _read_struct(kind, data, where)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _said(where, lambda: kind(data))
    if kind is bytes:
        return _said(where, lambda: read_bytes(data))
    if kind is float and isinstance(data, str) and data in _NAMES:
        return _NAMES[data]
    if kind is float and type(data) in {int, float}:
        return _said(where, lambda: float(data))
    if kind is Any or (type(data) is kind and kind in _ALREADY_PLAIN):
        return data
    raise ValueError(f"{where}: {data!r:.80} does not fit {_named(kind)}")


_NAMES: Final[Mapping[Any, float]] = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def _said(where: str, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{where}: {error}") from None


def _named(kind: Any) -> str:
    return kind.__name__ if isinstance(kind, type) and not get_args(kind) else str(kind)


def _key(kind: Any, key: Any) -> Any:
    return int(key) if kind is int else key  # JSON keys are strings


def _read_one_of(kinds: tuple[Any, ...], data: Any, where: str) -> Any:
    """Read a value of one of several types; of several structs, the one with these fields."""
    problems: list[str] = []
    for kind in sorted(kinds, key=lambda one: not _has_fields_of(one, data)):
        try:
            return read(NoneType if kind is None else kind, data, where)
        except ValueError as error:
            problems.append(str(error))
    raise ValueError(problems[0] if isinstance(data, Mapping) else f"{where}: {data!r:.80} fits none of its types")


def _has_fields_of(kind: Any, data: Any) -> bool:
    known = _fields_by_name(kind) if isinstance(kind, type) and issubclass(kind, Struct) else {}
    return isinstance(data, Mapping) and known.keys() == cast("Mapping[str, Any]", data).keys()


def _read_items(origin: Any, kinds: tuple[Any, ...], data: list[Any], where: str) -> Any:
    fixed = origin is tuple and kinds[-1] is not ...
    if fixed and len(data) != len(kinds):
        raise ValueError(f"{where}: {len(data)} values, but it takes {len(kinds)}")
    each = kinds if fixed else kinds[:1] * len(data)
    read_all = [read(kind, one, f"{where}[{at}]") for at, (kind, one) in enumerate(zip(each, data, strict=True))]
    return tuple(read_all) if origin is tuple else frozenset(read_all) if origin is frozenset else read_all


@cache
def _fields_by_name(struct: type[Struct]) -> dict[str, msgspec.structs.FieldInfo]:
    return {field.name: field for field in msgspec.structs.fields(struct)}


def _read_struct(struct: type[Struct], data: Any, where: str) -> Struct:
    if not isinstance(data, Mapping):
        raise ValueError(f"{where}: {data!r:.80} is not a mapping of fields")  # noqa: TRY004 - the one error of reading
    given = dict(cast("Mapping[str, Any]", data))
    if kinds := kinds_of(struct):
        tag = given.get(str(next(iter(kinds.values())).__struct_config__.tag_field))
        if not isinstance(tag, str) or tag not in kinds:
            raise ValueError(f"{where}: {tag!r} is none of {', '.join(sorted(kinds))}.{did_you_mean(str(tag), kinds)}")
        return _read_struct(kinds[tag], data, where)
    config, known = struct.__struct_config__, _fields_by_name(struct)
    if config.tag_field is not None and given.pop(config.tag_field, config.tag) != config.tag:
        raise ValueError(f"{where}: {config.tag_field} is {data[config.tag_field]!r}, not {config.tag!r}")
    for name in given:
        if name not in known:
            raise ValueError(f"{where}: there is no field {name!r}.{did_you_mean(str(name), known)}")
    missing = [name for name, field in known.items() if field.required and name not in given]
    if missing:
        raise ValueError(f"{where}: the field {missing[0]!r} is missing")
    return struct(**{name: read(known[name].type, one, f"{where}.{name}") for name, one in given.items()})


def kinds_of(struct: type[Struct]) -> dict[str, type[Struct]]:
    """Return the structs of a base class by tag; empty if it is not a base class."""
    config = struct.__struct_config__
    if config.tag_field is None or config.tag != struct.__name__:  # the default tag
        return {}
    kinds: dict[str, type[Struct]] = {}
    for child in struct.__subclasses__():
        kinds |= kinds_of(child) or {str(child.__struct_config__.tag): child}
    return kinds


def read_bytes(data: Any) -> bytes:
    """Read bytes from base64 text, or return bytes unchanged.

    Raises:
        ValueError: The data are neither.
    """
    if isinstance(data, bytes):
        return data
    if not isinstance(data, str):
        raise ValueError(f"{type(data).__name__} is not base64 text")  # noqa: TRY004  # the one error of reading
    return base64.b64decode(data, validate=True)


def read_array(data: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Read an array from either form, or return an array unchanged.

    Raises:
        ValueError: The data are neither, or the numbers do not fit the type.
    """
    try:
        match data:
            case np.ndarray():
                array = cast("NDArray[Any]", data)
            case {"dtype": str(name), "shape": shape, "base64": numbers}:
                stored = np.dtype(name).newbyteorder("<")
                array = np.frombuffer(read_bytes(numbers), stored).reshape(shape).astype(stored.newbyteorder("="))
            case list():
                array = np.array(data, dtype if dtype.kind == "f" or not data else None)
            case _:
                raise ValueError("an array is a list of numbers, or has dtype, shape and base64")
    except TypeError as error:  # not numbers
        raise ValueError(str(error)) from None
    with np.errstate(invalid="ignore"):
        exact = array.astype(dtype, copy=False)
    # Floating-point numbers are depths, even if they are whole, because colours are bytes.
    if not np.can_cast(array.dtype, dtype, "same_kind") and (array.dtype.kind == "f" or (array != exact).any()):
        raise ValueError(f"the numbers are not {dtype.name}")
    return exact
