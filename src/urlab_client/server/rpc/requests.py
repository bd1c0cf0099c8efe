"""From the bytes of a request to a typed struct.

For the dispatcher. msgspec decodes a `step` and a chunk of an upload directly to their structs, as our client sends
them: they come at kilohertz rates, or with megabytes. What this strict decoder refuses, and all other ops, is read
leniently, as the plugin does it. Both ways agree where the first one succeeds.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from functools import cache
from typing import Any, Final, TypeVar, Union, cast

import msgspec
import numpy as np
from msgspec import UNSET, Struct, inspect

from urlab_client.protocol.base import Op, Request
from urlab_client.protocol.codec import building
from urlab_client.protocol.registry import OPS
from urlab_client.server.dialects import ALPHA
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.lenient import ABSENT, as_text, bad_request, bare, fill, fold_keys, read_plain

_DEFAULT_LIMITS: Final = Limits()

_EXACT_NAMES: Final = frozenset({"hello", "meta"})
"""Ops that are recognised in lower case only."""

_NUMBERS: Final = frozenset({float, int})

T = TypeVar("T")


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
    """Return the value of a required field, or `otherwise` if the request has no usable value there."""
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
        """Decode one frame."""
        most = self._limits.request_bytes
        if len(frame) > most:
            raise bad_request(f"a request of {len(frame)} bytes exceeds the limit request_bytes, {most}")
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
                raise bad_request(
                    f"{op.name}: field '{sent_as}' holds a string of {longest} characters, more than the "
                    f"limit string_chars, {most}"
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


def _names_collide(value: object) -> bool:
    """Return whether a map has keys that differ only in case, of which only the last one counts."""
    if isinstance(value, dict):
        entries = cast("dict[str, object]", value)
        if len(entries) > 1 and len({*map(str.lower, entries)}) < len(entries):
            return True
        return any(map(_names_collide, entries.values()))
    if isinstance(value, Struct):
        for name in _maps_of(type(value)):
            inside = getattr(value, name)
            if inside and _names_collide(inside):
                return True
    return False


@cache
def _maps_of(struct: type[Struct]) -> tuple[str, ...]:
    """Return the names of the fields that can hold a map."""
    return tuple(
        field.name
        for field in msgspec.structs.fields(struct)
        if isinstance(kind := bare(inspect.type_info(field.type)), inspect.UnionType)
        and any(isinstance(member, inspect.DictType) for member in kind.types)
    )


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
