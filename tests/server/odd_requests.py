"""Hypothesis strategies: requests that fit the declarations, and requests that almost do."""

from __future__ import annotations

import datetime as dt
from typing import Any

import msgspec
from hypothesis import strategies as st

from urlab_client.server.dialects import BETA

every_kind = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=40)
    | st.binary(max_size=40)
    | st.builds(msgspec.msgpack.Ext, st.integers(0, 127), st.binary(max_size=40))
    | st.datetimes(timezones=st.just(dt.UTC)),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=40), inner, max_size=20),
    max_leaves=12,
)


names = st.sampled_from(["a", "A", "b", "op", "n_steps", "ß", "SS"]) | st.text(max_size=3)
numbers = st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.integers(-5, 5)


def plausible(annotation: msgspec.inspect.Type) -> st.SearchStrategy[Any]:
    """Values that often fit a field's type."""
    match annotation:
        case msgspec.inspect.Metadata(type=inner):
            return plausible(inner)
        case msgspec.inspect.StrType():
            return st.text(max_size=5)
        case msgspec.inspect.BoolType():
            return st.booleans()
        case msgspec.inspect.IntType():
            return st.integers(-3, 9) | numbers
        case msgspec.inspect.FloatType():
            return numbers
        case msgspec.inspect.NoneType():
            return st.none()
        case msgspec.inspect.CustomType():
            return st.lists(numbers, max_size=4)
        case msgspec.inspect.LiteralType(values=values):
            return st.sampled_from(values)
        case msgspec.inspect.UnionType(types=types):
            return st.one_of(map(plausible, types))
        case msgspec.inspect.TupleType(item_types=items):
            return st.lists(numbers, min_size=len(items), max_size=len(items))
        case msgspec.inspect.ListType(item_type=item):
            return st.lists(plausible(item), max_size=4)
        case msgspec.inspect.DictType(value_type=item):
            return st.dictionaries(names, plausible(item), max_size=3)
        case msgspec.inspect.StructType(fields=struct_fields):
            return st.fixed_dictionaries({}, optional={f.encode_name: plausible(f.type) for f in struct_fields})
        case _:
            return every_kind


def plain_request(name: str) -> st.SearchStrategy[dict[str, Any]]:
    op = BETA.ops[name]
    info = {f.encode_name: plausible(msgspec.inspect.type_info(f.type)) for f in msgspec.structs.fields(op.request)}
    required = {field: info.pop(field) for field in op.required}
    return st.fixed_dictionaries({"op": st.just(name), **required}, optional=info)


def mangle(request: dict[str, Any], key: str, value: object, where: int) -> dict[str, Any]:
    """Put `value` at `key`, or over one of the request's own fields."""
    keys = [*request, key]
    return {**request, keys[where % len(keys)]: value}


def mangled(requests: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    """Requests in which one value is another one, or in another place."""
    return st.builds(mangle, requests, names, every_kind, st.integers(0, 9))
