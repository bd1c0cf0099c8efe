"""From the bytes of a request to a typed struct, by the plugin's rules of detection and coercion.

For the dispatcher. A request is decoded to plain data and coerced field by field, as the plugin's engine does: unusual
spellings of names and numbers are accepted, and unusable values count as absent. A `step` of exactly the declared types
is decoded by msgspec directly, and so is a chunk of an upload. Both paths agree where the second one succeeds.

The direct path saves processor time: field by field, a bare `step` takes 6 us instead of 0.5, one with 12 set-points 18
instead of 1.2, and a chunk of an upload 4.5 ms per MiB instead of 0.1. The other ops are too rare to justify 0.8 ms
each at the server's start.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Final, TypeVar, Union

import msgspec
from msgspec import UNSET, Struct

from urlab_client.protocol.base import Op, Request
from urlab_client.protocol.codec import building
from urlab_client.protocol.dialects import ALPHA
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.coercion import ABSENT, as_text, struct_converter
from urlab_client.server.rpc.exact_structs import (
    collision_test_of,
    longest_string,
    strict_array,
    strict_struct,
    string_measures_of,
)
from urlab_client.server.rpc.plain_data import Plain, bad_request, decode_plain, fold_keys

__all__ = ["Incoming", "RequestReader", "need", "usable"]

_DEFAULT_LIMITS: Final = Limits()

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
    """Return the value of a required field.

    Args:
        request: The request, named in the refusal.
        value: The field's value.
        field: Name of the field on the wire.

    Raises:
        Refusal: `missing_field` if the value is absent, of an unusable type, or an empty string.
    """
    if value is UNSET or (isinstance(value, str) and not value):
        op = request.__struct_config__.tag
        raise Refusal("missing_field", f"{op}: field '{field}' is missing, empty or of the wrong type")
    return value


class _Nameless(Struct, tag_field="op", tag=""):
    """Second member of the decoder's union: a single struct would accept requests without an op."""


class RequestReader:
    """Decodes frames into requests. Stateless, so any thread may use it."""

    def __init__(
        self,
        *,
        ops: Mapping[str, Op] = ALPHA.ops,
        structs: Mapping[str, type[Request[Any]]] = types.MappingProxyType({}),
        limits: Limits = _DEFAULT_LIMITS,
    ) -> None:
        """Create the decoders.

        Args:
            ops: All ops by name.
            structs: Struct with more fields than the declared one, from which it must derive, by op name.
            limits: Limits on requests.
        """
        self._limits = limits
        self._exact: dict[type, Op] = {}
        self._loose: dict[str, _LooseOp] = {}
        strict: list[type[Struct]] = [_Nameless]
        for op in ops.values():
            struct = structs.get(op.name, op.request)
            if not issubclass(struct, op.request):
                raise TypeError(f"{struct.__name__} does not derive from {op.request.__name__}")
            self._loose[op.name] = _LooseOp(op, struct)
            if op.hot:
                exact = strict_struct(struct)
                self._exact[exact] = op
                strict.append(exact)
        with building():
            self._decoder: msgspec.msgpack.Decoder[Request[Any] | _Nameless] = msgspec.msgpack.Decoder(
                Union[tuple(strict)],  # noqa: UP007 - a union of a run-time list
                dec_hook=strict_array,
            )

    def read(self, frame: bytes) -> Incoming:
        """Decode one frame.

        Raises:
            Refusal: `bad_request` if the frame is neither a msgpack map nor a JSON object, or exceeds a limit.
        """
        try:
            request = self._decoder.decode(frame)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return self._read_loosely(frame)
        if isinstance(request, _Nameless):
            return self._read_loosely(frame)
        kind = type(request)
        collides = collision_test_of(kind)
        if len(frame) > self._limits.request_bytes or (collides is not None and collides(request)):
            return self._read_loosely(frame)
        op = self._exact[kind]
        self._check_strings(op, request, frame, exact=True)
        return Incoming(op.name, op, request.session_id, request)

    def _check_strings(self, op: Op, request: Request[Any], frame: bytes, *, exact: bool) -> None:
        most = self._limits.string_chars
        if len(frame) <= most:  # true for nearly every request, so that no search is needed
            return
        anything = ((name, longest_string) for name in request.__struct_fields__)
        for name, measure in string_measures_of(type(request)) if exact else anything:
            longest = measure(getattr(request, name))
            if longest > most:
                field = next(field for field in msgspec.structs.fields(request) if field.name == name)
                raise bad_request(
                    f"{op.name}: field '{field.encode_name}' holds a string of {longest} characters, more than the "
                    f"limit string_chars, {most}"
                )

    def _read_loosely(self, frame: bytes) -> Incoming:
        limits = self._limits
        if len(frame) > limits.request_bytes:
            raise bad_request(
                f"a request of {len(frame)} bytes exceeds the limit request_bytes, {limits.request_bytes}"
            )
        fields = fold_keys(decode_plain(frame, limits.request_depth))
        name = as_text(fields.get("op"))
        if name is ABSENT:
            return Incoming(None)
        loose = self._loose.get(name.lower())
        if loose is None or (loose.exact and name != loose.op.name):
            return Incoming(name, session_id=_session_id(fields))
        missing = tuple(field for field in loose.declared if field.lower() not in fields)
        request = loose.convert(fields)
        self._check_strings(loose.op, request, frame, exact=False)
        return Incoming(name, loose.op, _session_id(fields), request, missing)


def _session_id(fields: Mapping[str, Plain]) -> str:
    value = as_text(fields.get("session_id"))
    return "" if value is ABSENT else value


class _LooseOp:
    """What field-by-field decoding needs to know about an op."""

    def __init__(self, op: Op, struct: type[Request[Any]]) -> None:
        self.op = op
        self.exact = op.name in ("hello", "meta")
        self._struct = struct

    # Computed on first use, so that a server starts faster.

    @cached_property
    def declared(self) -> tuple[str, ...]:
        return self.op.declared_required

    @cached_property
    def convert(self) -> Callable[[dict[str, Plain]], Any]:
        return struct_converter(self._struct)
