"""The AsyncAPI document of the two WebSockets, generated from the declarations of their messages."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version
from typing import Any

from msgspec import Struct

from urlab_client.console.messages import (
    Ack,
    Ctrl,
    Log,
    Name,
    PictureHead,
    Ping,
    Pong,
    Refused,
    State,
    Status,
    World,
    You,
)
from urlab_client.console.ops import encode
from urlab_client.values.schemas import prose, schemas

_TOLD: tuple[type[Struct], ...] = (You, World, State, Status, Log, Refused, Pong)
_SAID: tuple[type[Struct], ...] = (Ack, Ctrl, Ping, Name)
_PICTURE = {
    "title": "picture",
    "summary": "The newest picture: length of the head (4 bytes, little-endian), the head as JSON, and a JPEG.",
    "contentType": "application/octet-stream",
    "payload": {"type": "string", "format": "binary", "x-head": {"$ref": "#/components/schemas/PictureHead"}},
}


@lru_cache(maxsize=8)
def asyncapi(host: str, root: str, protocol: str) -> bytes:
    """Return the AsyncAPI 3.0 document.

    Args:
        host: Under which the application was reached.
        root: The path under which it is mounted, or a proxy shows it.
        protocol: `ws` or `wss`.
    """
    messages = {_tag(kind): _message(kind) for kind in (*_TOLD, *_SAID)} | {"picture": _PICTURE}
    live, pictures = [*map(_tag, _TOLD), *map(_tag, _SAID)], ["picture", _tag(Ack)]
    return encode(
        {
            "asyncapi": "3.0.0",
            "info": {"title": "URLab console", "version": version("urlab-client")},
            "servers": {"console": {"host": host, "pathname": root or "/", "protocol": protocol,
                                    "security": [{"$ref": "#/components/securitySchemes/key"}]}},
            "channels": {
                "live": _channel("/api/live", "State, status, world and log; what viewers say.", live),
                "pictures": {
                    **_channel("/api/cameras/{articulation}/{camera}/live", "Pictures of one camera.", pictures),
                    "parameters": {
                        "articulation": {"description": "Its articulation; `-` for cameras of the scene."},
                        "camera": {"description": "Its name."},
                    },
                },
            },
            "operations": {
                "tell": _operation("send", "live", map(_tag, _TOLD)),
                "hear": _operation("receive", "live", map(_tag, _SAID)),
                "show": _operation("send", "pictures", ["picture"]),
                "hearShown": _operation("receive", "pictures", [_tag(Ack)]),
            },
            "components": {
                "messages": messages,
                "schemas": schemas([*_TOLD, *_SAID, PictureHead], "#/components/schemas/{name}"),
                "securitySchemes": {"key": {"type": "http", "scheme": "bearer"}},
            },
        }
    )  # fmt: skip


def _tag(kind: type[Struct]) -> str:
    return str(kind.__struct_config__.tag)


def _message(kind: type[Struct]) -> dict[str, Any]:
    return {
        "title": _tag(kind),
        "summary": " ".join(prose(kind).split()),
        "contentType": "application/json",
        "payload": {"$ref": f"#/components/schemas/{kind.__name__}"},
    }


def _channel(address: str, description: str, messages: list[str]) -> dict[str, Any]:
    refs = {name: {"$ref": f"#/components/messages/{name}"} for name in messages}
    return {"address": address, "description": description, "messages": refs}


def _operation(action: str, channel: str, messages: Any) -> dict[str, Any]:
    return {
        "action": action,
        "channel": {"$ref": f"#/channels/{channel}"},
        "messages": [{"$ref": f"#/channels/{channel}/messages/{name}"} for name in messages],
    }
