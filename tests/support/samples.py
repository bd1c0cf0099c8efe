"""A plausible value of every type that a request or a reply may hold."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np


def sample(kind: Any) -> Any:
    """A plausible plain value of a field type."""
    info = msgspec.inspect.type_info(kind) if not isinstance(kind, msgspec.inspect.Type) else kind
    match info:
        case msgspec.inspect.Metadata(type=inner):
            return sample(inner)
        case msgspec.inspect.UnionType(types=types):
            return sample(next(t for t in types if not isinstance(t, msgspec.inspect.NoneType)))
        case msgspec.inspect.StrType():
            return "text"
        case msgspec.inspect.LiteralType(values=values):
            return values[0]
        case msgspec.inspect.EnumType(cls=cls):
            return next(iter(cls))
        case msgspec.inspect.BoolType():
            return True
        case msgspec.inspect.IntType():
            return 3
        case msgspec.inspect.FloatType():
            return 0.5
        case msgspec.inspect.BytesType():
            return b"\x00\xffbytes"
        case msgspec.inspect.RawType():
            return msgspec.Raw(msgspec.msgpack.encode("text"))
        case msgspec.inspect.CustomType():
            return np.array([0.25, -1.0])
        case msgspec.inspect.TupleType(item_types=items):
            return tuple(sample(item) for item in items)
        case msgspec.inspect.ListType(item_type=item):
            return [sample(item)]
        case msgspec.inspect.DictType(value_type=item):
            return {"key": sample(item)}
        case msgspec.inspect.StructType(cls=cls):
            return filled(cls)
        case msgspec.inspect.AnyType():
            return {"nested": 1}
        case _:
            raise AssertionError(info)


def filled(cls: type[msgspec.Struct]) -> msgspec.Struct:
    fields = {f.name: f.type for f in msgspec.structs.fields(cls)}
    # A node of a tree has no children here, or it would never end.
    return cls(**{name: [] if name == "children" else sample(kind) for name, kind in fields.items()})
