"""The OpenAPI document of the HTTP API and the AsyncAPI document of the WebSockets, both made from the declarations."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import version
from typing import Any, cast, get_args, get_origin

import msgspec
from msgspec import Struct

from urlab_client.console.controls import SERVED
from urlab_client.console.messages import FromViewer, PictureHead, ToViewer, encode, tag_of
from urlab_client.protocol.base import Effect, Op
from urlab_client.protocol.messages.sim import BeginPieOk
from urlab_client.values.schemas import prose, schemas
from urlab_client.web.endpoints import BYTES, JSON, Endpoint
from urlab_client.web.live import SOCKETS, Socket

_SCHEMA = "#/components/schemas/{name}"
_TEXT: dict[str, Any] = {"type": "string"}
_FILE = _TEXT | {"format": "binary"}
_KEY_REQUIRED: list[dict[str, list[str]]] = [{"key": []}]
_SECURITY: dict[str, Any] = {"securitySchemes": {"key": {"type": "http", "scheme": "bearer"}}}


class ErrorDescription(Struct):
    """Why a request failed.

    Attributes:
        code: The server's code, or one of this application.
        message: What failed, and why.
        hint: What to do.
    """

    code: str
    message: str
    hint: str = ""


class Error(Struct):
    """The response of a request that failed."""

    error: ErrorDescription


# Without the handshake, which belongs to the application.
_STARTED = msgspec.defstruct(
    BeginPieOk.__name__,
    [(one.name, one.type) for one in msgspec.structs.fields(BeginPieOk) if one.name != "handshake_payload"],
    tag_field="op",
    tag=BeginPieOk.__struct_config__.tag,
)


@lru_cache(maxsize=8)
def openapi(endpoints: tuple[Endpoint, ...], root: str) -> bytes:
    """Return the OpenAPI 3.1 document.

    Args:
        endpoints: The endpoints besides the ops.
        root: Path under which the application is mounted or a proxy serves it.
    """
    ops = [*SERVED.values()]
    kinds = [kind for one in endpoints for kind in (one.result, one.parameters.get("body", (None, None))[0])]
    replies = [_STARTED if op.reply is BeginPieOk else op.reply for op in ops]
    components = schemas([*_structs(kinds), Error, *(op.request for op in ops), *replies], _SCHEMA)
    for op in ops:  # a request on the wire also says which op it is, and of which session
        request = components[op.request.__name__]
        for name in ("op", "session_id"):
            request["properties"].pop(name, None)
        request.pop("required", None)
        if op.required:
            request["required"] = list(op.required)
    paths: dict[str, dict[str, Any]] = {}
    for one in endpoints:
        paths.setdefault(_plain_path(one.path), {})[one.method.lower()] = _described_endpoint(one)
    return encode(
        {
            "openapi": "3.1.0",
            "info": {"title": "URLab console", "version": version("urlab-client")},
            "components": {"schemas": components, **_SECURITY},
            "servers": [{"url": root or "/"}],
            "security": _KEY_REQUIRED,
            "paths": paths | {f"/api/ops/{op.name}": {"post": _described_op(op)} for op in ops},
        }
    )


def _plain_path(path: str) -> str:
    """Return a path of Starlette's without the types of its parameters."""
    return re.sub(r":\w+\}", "}", path)


def _described_endpoint(endpoint: Endpoint) -> dict[str, Any]:
    doc = inspect.cleandoc(endpoint.function.__doc__ or "")
    if endpoint.media == JSON:
        reply = _schema(endpoint.result)
    else:
        reply = _TEXT if endpoint.media.startswith("text/") else _FILE
    found: dict[str, Any] = {
        "operationId": endpoint.function.__name__,
        "tags": ["console"],
        "summary": doc.partition("\n")[0] + (" Requires the controls." if endpoint.drives else ""),
        "responses": {"200": _content("Success.", reply, endpoint.media), "default": _error()},
    }
    if "\n" in doc:
        found["description"] = doc
    parameters = [
        _parameter(endpoint, name, kind, default)
        for name, (kind, default) in endpoint.parameters.items()
        if name != "body"
    ]
    if parameters:
        found["parameters"] = parameters
    if endpoint.upload:
        found["requestBody"] = {"required": True, "content": {BYTES: {"schema": _FILE}}}
    elif "body" in endpoint.parameters:
        kind, default = endpoint.parameters["body"]
        found["requestBody"] = {
            "required": default is inspect.Parameter.empty,
            "content": {JSON: {"schema": _schema(kind)}},
        }
    if endpoint.public:
        found["security"] = []
    return found


def _parameter(endpoint: Endpoint, name: str, kind: Any, default: Any) -> dict[str, Any]:
    in_path = name in endpoint.in_path
    schema = _schema(kind) | ({} if default is inspect.Parameter.empty else {"default": default})
    return {"name": name.rstrip("_"), "in": "path" if in_path else "query", "required": in_path, "schema": schema}


def _described_op(op: Op) -> dict[str, Any]:
    doc = (op.request.__doc__ or "").strip()
    drives = op.effect is not Effect.READ
    note = "\n\nRequires the controls: status 423 while another viewer has them." if drives else ""
    return {
        "operationId": op.name,
        "tags": [op.ns or "client"],
        "summary": doc.partition("\n")[0],
        "description": doc + note + (f"\n\nOwn error codes: {', '.join(op.errors)}." if op.errors else ""),
        "requestBody": {"content": {JSON: {"schema": _schema(op.request)}}},
        "responses": {"200": _content("Success.", _schema(op.reply)), "default": _error()},
    }


def _content(text: str, schema: dict[str, Any], media: str = JSON) -> dict[str, Any]:
    return {"description": text, "content": {media: {"schema": schema}}}


def _error() -> dict[str, Any]:
    return _content("The error.", _schema(Error))


def _schema(kind: Any) -> dict[str, Any]:
    """Return the schema of a type; a reference if it is a struct's."""
    if isinstance(kind, type) and issubclass(kind, Struct):
        return {"$ref": _SCHEMA.format(name=kind.__name__)}
    if get_origin(kind) is list:
        return {"type": "array", "items": _schema(get_args(kind)[0])}
    return {"type": "object"} if kind is None else msgspec.json.schema(kind)


def _structs(kinds: Iterable[Any]) -> list[type[Struct]]:
    """Return the structs among types and in the lists among them, each once."""
    found = (get_args(kind)[0] if get_origin(kind) is list else kind for kind in kinds)
    return [*dict.fromkeys(kind for kind in found if isinstance(kind, type) and issubclass(kind, Struct))]


# The WebSockets

_MESSAGES = cast("tuple[type[Struct], ...]", get_args(ToViewer | FromViewer))
_PICTURE = {
    "title": "picture",
    "summary": "The newest picture: length of the head (4 bytes, little-endian), the head as JSON, and a JPEG.",
    "contentType": BYTES,
    "payload": {"type": "string", "format": "binary", "x-head": _schema(PictureHead)},
}


@lru_cache(maxsize=8)
def asyncapi(host: str, root: str, protocol: str) -> bytes:
    """Return the AsyncAPI 3.0 document.

    Args:
        host: Under which the application was reached.
        root: The path under which it is mounted, or a proxy shows it.
        protocol: `ws` or `wss`.
    """
    return encode(
        {
            "asyncapi": "3.0.0",
            "info": {"title": "URLab console", "version": version("urlab-client")},
            "servers": {"console": {"host": host, "pathname": root or "/", "protocol": protocol,
                                    "security": [{"$ref": "#/components/securitySchemes/key"}]}},
            "channels": {one.name: _channel(one) for one in SOCKETS},
            "operations": {
                name: _operation(action, one, messages)
                for one in SOCKETS
                for action, (name, messages) in (("send", one.sends), ("receive", one.receives))
            },
            "components": {
                "messages": {tag_of(kind): _message(kind) for kind in _MESSAGES} | {"picture": _PICTURE},
                "schemas": schemas([*_MESSAGES, PictureHead], _SCHEMA),
                **_SECURITY,
            },
        }
    )  # fmt: skip


def _message(kind: type[Struct]) -> dict[str, Any]:
    return {
        "title": tag_of(kind),
        "summary": " ".join(prose(kind).split()),
        "contentType": JSON,
        "payload": _schema(kind),
    }


def _channel(socket: Socket) -> dict[str, Any]:
    messages = (*socket.sends[1], *socket.receives[1])
    found: dict[str, Any] = {
        "address": _plain_path(socket.path),
        "description": socket.description,
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in messages},
    }
    if socket.parameters:
        found["parameters"] = {name: {"description": text} for name, text in socket.parameters.items()}
    return found


def _operation(action: str, socket: Socket, messages: Iterable[str]) -> dict[str, Any]:
    channel = f"#/channels/{socket.name}"
    refs = [{"$ref": f"{channel}/messages/{name}"} for name in messages]
    return {"action": action, "channel": {"$ref": channel}, "messages": refs}
