"""Typed values as plain data: dictionaries, JSON, and fields of pydantic models. No I/O.

Plain data survives a round trip through any JSON parser: numbers that are not finite become the strings `NaN`,
`Infinity` and `-Infinity`, arrays become lists, bytes base64 text, and enumerations their values. Keys are attribute
names; a struct that is one of several kinds also contains its tag.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypeAlias, cast

import msgspec
import numpy as np
from msgspec import Struct

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
        from urlab_client.values.plain_reading import read  # which few programs need

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

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        # Only pydantic calls this. The code below builds plain dictionaries and does not import pydantic.
        from urlab_client.values.pydantic_schema import core_schema

        return core_schema(cast("type[Struct]", cls), handler)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> dict[str, Any]:
        from urlab_client.values.pydantic_schema import json_schema

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


_ALREADY_PLAIN: Final[frozenset[type]] = frozenset({bool, int, str, type(None)})


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
