"""The OpenAPI document of the HTTP API."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version
from typing import Any

import msgspec

from urlab_client.console.ops import SERVED, encode
from urlab_client.protocol.base import Effect, Op
from urlab_client.protocol.messages.sim import BeginPieOk
from urlab_client.values.schemas import schemas

# Without the handshake, which belongs to the application as well.
_STARTED = msgspec.defstruct(
    BeginPieOk.__name__,
    [(one.name, one.type) for one in msgspec.structs.fields(BeginPieOk) if one.name != "handshake_payload"],
    tag_field="op",
    tag=BeginPieOk.__struct_config__.tag,
)


@lru_cache(maxsize=8)
def openapi(root: str = "", *, metrics: bool = False) -> bytes:
    """Return the OpenAPI 3.1 document of the whole HTTP API.

    Args:
        root: Path under which the application is mounted or a proxy serves it.
        metrics: Whether the application serves `/metrics`.
    """
    ops = [*SERVED.values()]
    replies = [_STARTED if op.reply is BeginPieOk else op.reply for op in ops]
    structs = [*(op.request for op in ops), *replies]
    components = schemas(structs, "#/components/schemas/{name}")
    for op in ops:
        properties = components[op.request.__name__]["properties"]
        for name in ("op", "session_id"):
            properties.pop(name, None)
        components[op.request.__name__].pop("required", None)
        if op.required:
            components[op.request.__name__]["required"] = list(op.required)
    components["Error"] = _ERROR
    security: list[dict[str, list[str]]] = [{"key": []}]
    return encode(
        {
            "openapi": "3.1.0",
            "info": {"title": "URLab console", "version": version("urlab-client")},
            "components": {
                "schemas": components,
                "securitySchemes": {"key": {"type": "http", "scheme": "bearer"}},
            },
            "servers": [{"url": root or "/"}],
            "security": security,
            "paths": {
                **_PATHS,
                **(_METRICS if metrics else {}),
                **{f"/api/ops/{op.name}": {"post": _operation(op)} for op in ops},
            },
        }
    )


def _operation(op: Op) -> dict[str, Any]:
    doc = (op.request.__doc__ or "").strip()
    drives = op.effect is not Effect.READ
    note = "\n\nRequires the controls: status 423 while another viewer has them." if drives else ""
    return {
        "operationId": op.name,
        "tags": [op.ns or "client"],
        "summary": doc.partition("\n")[0],
        "description": doc + note + (f"\n\nOwn error codes: {', '.join(op.errors)}." if op.errors else ""),
        "requestBody": {"content": {"application/json": {"schema": _ref(op.request.__name__)}}},
        "responses": {"200": _answer(op.reply.__name__, "Success."), "default": _answer("Error", "The error.")},
    }


def _ref(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}


def _answer(schema: str, text: str) -> dict[str, Any]:
    return {"description": text, "content": {"application/json": {"schema": _ref(schema)}}}


_ERROR = {
    "type": "object",
    "properties": {
        "error": {
            "type": "object",
            "properties": {
                "code": {"type": "string", "description": "The server's code, or one of this application."},
                "message": {"type": "string"},
                "hint": {"type": "string"},
            },
            "required": ["code", "message"],
        }
    },
    "required": ["error"],
}


def _path(method: str, name: str, summary: str, **more: Any) -> dict[str, Any]:
    return {
        method: {
            "operationId": name,
            "tags": ["console"],
            "summary": summary,
            "responses": {"200": {"description": "Success."}, "default": _answer("Error", "The error.")},
            **more,
        }
    }


_METRICS: dict[str, Any] = {
    "/metrics": _path(
        "get",
        "metrics",
        "Metrics of the client's requests, in Prometheus' text format.",
        responses={
            "200": {"description": "Success.", "content": {"text/plain": {"schema": {"type": "string"}}}},
            "default": _answer("Error", "The error."),
        },
    )
}

_PATHS: dict[str, Any] = {
    "/api/world": _path("get", "world", "Articulations, joints with ranges, actuators, sensors, cameras."),
    "/api/status": _path("get", "status", "Connection, play, modes and driver."),
    "/api/handshake": _path(
        "get", "handshake", "The bytes that a client with `read_only=True` passes to `discover()`."
    ),
    "/api/state": _path("get", "state", "The newest state."),
    "/api/log": _path("get", "log", "The latest calls, errors and events."),
    "/api/events": _path(
        "get", "events", "Server-sent events `log`, `world` and `status`; `Last-Event-ID` resumes the log."
    ),
    "/api/asyncapi.json": _path("get", "asyncapi", "The WebSockets, described as AsyncAPI 3.0."),
    "/api/explain": _path("get", "explain", "Why does a robot not move? The client's diagnosis, in sentences."),
    "/api/ctrl": _path("post", "ctrl", "Set set-points: `{articulation: {actuator: value}}`. Requires the controls."),
    "/api/run": _path("post", "run", "Run or stop physics: `{running: bool}`. Anyone may stop it."),
    "/api/step": _path("post", "step_many", "Step in direct mode: `{n_steps: int}`. Requires the controls."),
    "/api/models/{name}": _path(
        "put",
        "import_model",
        "Import a model: the bytes of an .xml or .zip file. `?replace=NAME` allows it to replace that blueprint. "
        "Requires the controls.",
    ),
    "/api/recording": {
        **_path("post", "record", "Record to an MCAP file: `{cameras: bool}`. Requires the controls."),
        **_path("delete", "stop_recording", "Stop the recording and describe it. Requires the controls."),
    },
    "/api/recording/outcome": _path(
        "post", "mark_episode", "Mark the episode: `{outcome}` success, failure or discarded. Requires the controls."
    ),
    "/api/recordings": _path("get", "recordings", "The recordings, newest first."),
    "/api/recordings/{name}": {
        **_path(
            "get", "download", "A recording; `?as=csv`, `npz` or `mp4&camera=…` converts it, `?as=about` describes it."
        ),
        **_path("put", "upload", "Add a recording that was made elsewhere: its bytes. Requires the controls."),
        **_path("delete", "remove_recording", "Delete a recording. Requires the controls."),
    },
    "/api/replay": {
        **_path(
            "post",
            "replay",
            "Start a replay with `{name, placing}`, or change it with `{time, playing, rate}`, seconds.",
        ),
        **_path("delete", "end_replay", "End the replay and show the server's state again. Requires the controls."),
    },
    "/api/replay/states": _path("get", "replayed", "States of the last `?seconds` before the replay's position."),
    "/api/lease": {
        **_path("post", "take_controls", "Take or keep the controls."),
        **_path("delete", "release_controls", "Release the controls."),
    },
    "/api/connection": _path("post", "connect", "Open a new session after another program has taken the server over."),
    "/api/invitations": _path("post", "invite", "Make a token for one more browser or program."),
    "/api/session": _path("post", "enter", "Exchange a token for a key: `{token: str}`.", security=[]),
    "/api/cameras/{articulation}/{camera}.jpg": _path("get", "picture", "The newest picture of a camera."),
    "/api/cameras/{articulation}/{camera}.png": _path("get", "png", "A lossless picture, captured now, in any mode."),
}
