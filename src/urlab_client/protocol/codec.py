"""Bytes to structs and back, with the plugin's conventions. No I/O.

The plugin emits every number as a float64 and accepts any number; arrays of numbers are NumPy arrays in structs.
Replies are msgpack unless the session requested JSON, in which case binary values travel as base64 text under their
key plus `__b64__`. Unknown fields are ignored, so that an old client can talk to a newer server.
"""

from __future__ import annotations

import base64
import math
import re
from _thread import allocate_lock
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from urlab_client.errors import ProtocolError, rpc_error
from urlab_client.protocol.base import Needs, Op, Reply, Request
from urlab_client.protocol.messages.jobs import OpStarted, OpStatusOk
from urlab_client.protocol.messages.session import ErrorReply
from urlab_client.protocol.registry import OPS

MAX_REQUEST_BYTES = 64 * 1024 * 1024
MAX_REPLY_BYTES = 2 * 1024 * 1024 * 1024

_BINARY_SUFFIX = "__b64__"
_COPY_SUFFIX = "_base64"  # a second copy of a binary field; see `HelloOk.mjb_base64`

R = TypeVar("R", bound=Reply)
Buffer = bytes | bytearray | memoryview

# `_thread` instead of `threading`: this module starts no threads, but is called from several.
_BUILDING = allocate_lock()
_BUILD_S = 1.0

_OP_BY_REQUEST = {op.request: op for op in OPS.values()}


@contextmanager
def building() -> Generator[None]:
    """Hold while msgspec first inspects a struct, to build a decoder or to convert.

    msgspec 0.22 publishes the description of a struct before it is complete, and another thread that uses it crashes
    the process. Two clients that connect at the same time from two threads are enough.
    """
    # No build takes this long: the lock was held in the parent when this process was forked.
    held = _BUILDING.acquire(timeout=_BUILD_S)
    try:
        yield
    finally:
        if held:
            _BUILDING.release()


def op_of(request: Request[Any] | type[Request[Any]]) -> Op:
    """Return the declaration of a request's op."""
    return _OP_BY_REQUEST[request if isinstance(request, type) else type(request)]


def from_wire_array(kind: type, value: Any) -> Any:
    """Decoding hook: a list of numbers becomes a float64 array of shape (n,)."""
    try:
        array = np.array(value, float)
    except OverflowError as error:  # integers have no limit in JSON; msgspec expects ValueError
        raise ValueError(str(error)) from None
    if array.ndim != 1:
        raise ValueError(f"expected a flat array of numbers, got {array.ndim} dimensions")
    return array


def _to_wire(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return cast("np.ndarray[Any, Any]", value).tolist()
    if isinstance(value, np.generic):
        return cast("np.generic[Any]", value).item()
    raise TypeError(f"a value of type {type(value).__name__} cannot be sent")


_encoder = msgspec.msgpack.Encoder(enc_hook=_to_wire)
_json_encoder = msgspec.json.Encoder(enc_hook=_to_wire)


def encode_message(message: Struct) -> bytes:
    """Return a published message in msgpack, with unchanged numbers."""
    return _encoder.encode(message)


def encode_request(request: Request[Any], session_id: str, *, json: bool = False) -> bytes:
    """Return the bytes of `request` with this `session_id`.

    Raises:
        TypeError: A field contains a value that cannot be sent.
        ValueError: The request is larger than `MAX_REQUEST_BYTES`.
    """
    if request.session_id != session_id:
        request = replace(request, session_id=session_id)
    try:
        frame = _json_ascii(request) if json else _encoder.encode(request)
    except TypeError as error:
        raise TypeError(f"{op_of(request).name}: {_unsendable(request)}: {error}") from None
    if len(frame) > MAX_REQUEST_BYTES:
        raise ValueError(
            f"{op_of(request).name}: a request of {len(frame)} bytes exceeds the limit {MAX_REQUEST_BYTES}"
        )
    return frame


def _unsendable(request: Request[Any]) -> str:
    """Return the name of the first field that cannot be encoded."""
    for name in request.__struct_fields__:
        try:
            _encoder.encode(getattr(request, name))
        except TypeError:
            return name
    return "request"


def _json_ascii(request: Request[Any]) -> bytes:
    # The plugin truncates JSON by byte count after decoding, so non-ASCII text makes it read past the frame.
    text = _json_encoder.encode(request).decode()
    return re.sub(r"[^\x00-\x7f]", _escape, text).encode("ascii")


def _escape(match: re.Match[str]) -> str:
    units = match[0].encode("utf-16-be")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


@cache
def _request_decoder(kind: type[Request[Any]]) -> msgspec.msgpack.Decoder[Request[Any]]:
    with building():
        return msgspec.msgpack.Decoder(kind, dec_hook=from_wire_array)


def check_request(request: Request[Any], frame: bytes) -> None:
    """Check an encoded msgpack request against its own declaration.

    msgspec validates only on decoding, so this decodes the encoded request.

    Raises:
        TypeError: A field has the wrong type.
        ValueError: A field has the right type but a wrong length or choice.
    """
    try:
        _request_decoder(type(request)).decode(frame)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        where = path.strip("`").removeprefix("$.") or "request"
        kind = ValueError if "length" in problem or "enum" in problem else TypeError
        raise kind(f"{op_of(request).name}: {where}: {problem[:1].lower()}{problem[1:]}") from None


def check_finite(request: Request[Any]) -> None:
    """Check the numbers of a request: NaN and infinities pass all other checks, and JSON cannot represent them.

    Raises:
        ValueError: A number is not finite, and the op does not accept infinities there. The message names it.
    """
    op = op_of(request)
    for name in request.__struct_fields__:
        found = None if name in op.infinite else _not_finite(getattr(request, name), name)
        if found is not None:
            raise ValueError(f"{op.name}: {found}; it takes finite numbers. Nothing was sent.")


def _not_finite(value: Any, path: str) -> str | None:
    match value:
        case float():
            return None if math.isfinite(value) else f"{path} is {value}"
        case np.ndarray():
            inside: Any = ((item, f"{path}[{i}]") for i, item in enumerate(cast("list[Any]", value.tolist())))
        case Struct():
            inside = ((getattr(value, name), f"{path}.{name}") for name in value.__struct_fields__)
        case dict():
            inside = ((item, f"{path}.{key}") for key, item in cast("dict[str, Any]", value).items())
        case list() | tuple():
            inside = ((item, f"{path}[{i}]") for i, item in enumerate(cast("list[Any]", value)))
        case _:
            return None
    return next(filter(None, (_not_finite(item, where) for item, where in inside)), None)


# Only the answer shows whether an editor op is a job. The answer of `op_status` is never another job.
_MAY_START = frozenset(op.reply for op in OPS.values() if op.needs is Needs.EDITOR) - {OpStatusOk}


@cache
def _answers(reply: type[Reply]) -> Any:
    """Return the union of possible answers other than the reply."""
    return reply | ErrorReply | OpStarted if reply in _MAY_START else reply | ErrorReply


@cache
def _reply_decoder(reply: type[Reply]) -> msgspec.msgpack.Decoder[Reply]:
    # Not strict: the plugin sends integers as floats.
    with building():
        return msgspec.msgpack.Decoder(_answers(reply), strict=False, dec_hook=from_wire_array)


def decode_answer(op: Op, reply: type[R], frame: Buffer) -> R | OpStarted:
    """Decode the server's answer to `op`; the first byte shows whether it is msgpack or JSON.

    Returns:
        The reply, or the start of the job that will deliver it; `decode_job` then decodes the reply.

    Raises:
        URLabRPCError: The server refused the request.
        ProtocolError: The frame is not an answer to `op`.
    """
    if len(frame) > MAX_REPLY_BYTES:
        raise ProtocolError(f"{op.name}: a reply of {len(frame)} bytes exceeds the limit {MAX_REPLY_BYTES}", op=op.name)
    answer: Any
    try:
        if frame[:1] == b"{":
            answer = _converted(reply, _restore_binary(msgspec.json.decode(frame)))
        else:
            answer = _reply_decoder(reply).decode(frame)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise _not_an_answer(op, error, bytes(frame[:256])) from error
    if isinstance(answer, ErrorReply):
        raise _refusal(op, answer, _plain(frame))
    return answer


def decode_reply(op: Op, reply: type[R], frame: Buffer) -> R:
    """Decode the server's reply to `op` like `decode_answer`, if no job is expected.

    Raises:
        URLabRPCError: The server refused the request.
        ProtocolError: The frame is not the reply to `op`.
    """
    answer = decode_answer(op, reply, frame)
    if isinstance(answer, OpStarted):
        raise ProtocolError(f"{op.name}: the server has started {answer.job_id} instead of answering.", op=op.name)
    return answer


def decode_job(op: Op, reply: type[R], result: dict[str, Any]) -> R:
    """Decode the result of a job from `op_status` as the answer to `op`.

    Raises:
        URLabRPCError: The server refused the request.
        ProtocolError: The result is not an answer to `op`.
    """
    try:
        answer = _converted(reply, result)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise _not_an_answer(op, error, b"") from error
    if isinstance(answer, ErrorReply):
        raise _refusal(op, answer, result)
    if isinstance(answer, OpStarted):
        raise ProtocolError(f"{op.name}: the job's result is another job, {answer.job_id}.", op=op.name)
    return cast("R", answer)


def _converted(reply: type[Reply], plain: Any) -> Reply:
    _reply_decoder(reply)  # so that the structs are inspected before `convert`
    return msgspec.convert(plain, _answers(reply), strict=False, dec_hook=from_wire_array)


def _not_an_answer(op: Op, error: Exception, raw: bytes) -> ProtocolError:
    return ProtocolError(
        f"{op.name}: the server's answer is not a valid {op.reply_name}: {error}.", op=op.name, raw=raw
    )


def _plain(frame: Buffer) -> dict[str, Any]:
    return _restore_binary(msgspec.json.decode(frame)) if frame[:1] == b"{" else msgspec.msgpack.decode(frame)


def _refusal(op: Op, answer: ErrorReply, fields: Mapping[str, Any]) -> Exception:
    message = answer.message
    if not message and answer.absolute_path is not None:
        message = f"nothing to save, or {answer.absolute_path} cannot be written"
    details = {name: value for name, value in fields.items() if name not in {"op", "code", "message"}}
    return rpc_error(answer.code, message, op=op.name, details=details)


def _restore_binary(value: Any) -> Any:
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return {
            key.removesuffix(_BINARY_SUFFIX): base64.b64decode(item)
            if key.endswith(_BINARY_SUFFIX) and isinstance(item, str)
            else _restore_binary(item)
            for key, item in items
            if not (key.endswith(_COPY_SUFFIX) and key.removesuffix(_COPY_SUFFIX) + _BINARY_SUFFIX in value)
        }
    if isinstance(value, list):
        return [_restore_binary(item) for item in cast("list[Any]", value)]
    return value


def encode_reply(reply: Struct, *, json: bool = False) -> bytes:
    """Return the bytes of a reply as the plugin sends it: structs declare counters as `int`, the wire has float64."""
    plain = msgspec.to_builtins(reply, builtin_types=(bytes, msgspec.Raw), enc_hook=_packed)
    return msgspec.json.encode(_spelled(plain)) if json else _encoder.encode(_widened(plain))


def _packed(value: Any) -> msgspec.Raw:
    """Return an array in msgpack, so that nothing looks at each of its numbers again."""
    return msgspec.Raw(_encoder.encode(np.asarray(value, dtype=np.float64).tolist()))


def _widened(value: Any) -> Any:
    # No call for what nearly all values are: floats.
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return {key: item if type(item) is float else _widened(item) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [item if type(item) is float else _widened(item) for item in cast("list[Any]", value)]
    return float(value) if type(value) is int else value


def _spelled(value: Any) -> Any:
    """Return a reply as the plugin encodes it in JSON: bytes as base64 under a separate key, numbers as `%.17g`."""
    if isinstance(value, msgspec.Raw):
        value = msgspec.msgpack.decode(value)
    match value:
        case dict():
            items = cast("dict[str, Any]", value).items()
            return {f"{key}{_BINARY_SUFFIX}" if isinstance(item, bytes) else key: _spelled(item) for key, item in items}
        case list() | tuple():
            return [_spelled(item) for item in cast("list[Any]", value)]
        case bytes():
            return base64.b64encode(value).decode("ascii")
        case int() | float() if math.isfinite(value) and not isinstance(value, bool):
            return msgspec.Raw(b"%.17g" % value)
        case _:
            return value  # numbers that are not finite become null; the plugin's JSON would be invalid
