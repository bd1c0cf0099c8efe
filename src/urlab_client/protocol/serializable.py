"""Typed values as plain data: dictionaries, JSON, and fields of pydantic models. No I/O.

Plain data is what every JSON parser takes and gives back: numbers that are not finite are the strings `NaN`,
`Infinity` and `-Infinity`, arrays are lists, bytes are base64 text, enumerations their values. Names are those of the
attributes; a struct that is one of several kinds has its tag besides.
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

__all__ = ["ArrayForm", "Serializable", "plain"]

ArrayForm: TypeAlias = Literal["list", "base64"]
"""How plain data holds arrays: lists, nested by dimension, or `{"dtype": …, "shape": […], "base64": …}`."""


class Serializable:
    """Base of the structs that users get."""

    __slots__ = ()

    def to_dict(self, *, arrays: ArrayForm = "list") -> dict[str, Any]:
        """Return the fields as plain data, which any JSON encoder takes.

        Args:
            arrays: `list` makes nested lists of arrays. `base64` makes `{"dtype", "shape", "base64"}` of them, with
                the numbers little-endian, the last index running fastest: use it for pictures.

        Raises:
            ValueError: Unknown form of arrays.
        """
        if arrays not in {"list", "base64"}:
            raise ValueError(f"arrays={arrays!r} is unknown; it is 'list' or 'base64'")
        return plain(self, arrays)

    def to_json(self, *, arrays: ArrayForm = "list") -> str:
        """Return `to_dict()` as JSON text."""
        return msgspec.json.encode(self.to_dict(arrays=arrays)).decode()

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the value that plain data stand for: the way back from `to_dict()`, with arrays in either form.

        What has no type of its own comes back as it is; NaN and infinities in it stay strings. The base of several
        kinds, such as `ClientEvent`, finds the kind by its tag.

        Raises:
            ValueError: A field is missing, unknown or of another type; the text says which.
        """
        from urlab_client.protocol.plain_reading import read  # noqa: PLC0415  # which few programs need

        return cast("Self", read(cls, data, cls.__name__))

    @classmethod
    def from_json(cls, text: str | bytes) -> Self:
        """Return the value that JSON stands for: the way back from `to_json()`.

        Raises:
            ValueError: It is not JSON, or not that of such a value.
        """
        try:
            data = msgspec.json.decode(text)
        except msgspec.DecodeError as error:
            raise ValueError(f"{cls.__name__}: {error}") from None
        return cls.from_dict(data)

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which some fields have other values.

        Raises:
            TypeError: There is no field of that name.
        """
        return cast("Self", msgspec.structs.replace(cast("Struct", self), **changes))

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> dict[str, Any]:
        # Only pydantic calls this. What follows makes plain dictionaries and imports nothing of it.
        from urlab_client.protocol.pydantic_schema import core_schema  # noqa: PLC0415

        return core_schema(cast("type[Struct]", cls), handler)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: Any, handler: Any) -> dict[str, Any]:
        from urlab_client.protocol.pydantic_schema import json_schema  # noqa: PLC0415

        return json_schema(cast("type[Struct]", cls), schema, handler)


def plain(value: Any, arrays: ArrayForm | None) -> Any:  # noqa: PLR0911
    """Return a value as plain data.

    Args:
        value: Anything that a field of a struct may hold.
        arrays: Their form. None opens structs and containers only, and leaves what is in them as it is.

    Raises:
        TypeError: A value has no form in plain data.
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
            continue  # undecoded on purpose: it says nothing that another field does not
        if isinstance(value, dict) and value:
            # What the beta names otherwise is there under both names; data has it once, as from any generation.
            mapping: int = id(cast("object", value))
            if mapping in maps:
                value = None
            maps.add(mapping)
        data[name] = plain(value, arrays)
    return data


def _array(array: NDArray[Any], form: ArrayForm) -> Any:
    """Return an array in the form asked for."""
    if form == "list":
        listed = array.tolist()
        return listed if array.dtype.kind != "f" or np.isfinite(array).all() else plain(listed, form)
    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return {
        "dtype": array.dtype.name,
        "shape": list(array.shape),
        "base64": base64.b64encode(little.tobytes()).decode("ascii"),
    }
