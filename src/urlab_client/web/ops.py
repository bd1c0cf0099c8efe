"""The registry's ops over HTTP: requests from JSON, and the OpenAPI document that describes them."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from urlab_client.protocol.base import Effect, Op, Request
from urlab_client.protocol.codec import from_wire_array
from urlab_client.protocol.messages.cameras import (
    SetCameraDelay,
    SetCameraDelayOk,
    SetCameraStreaming,
    SetCameraStreamingOk,
)
from urlab_client.protocol.messages.runtime import (
    ConfigureController,
    ConfigureControllerOk,
    SetMode,
    SetModeOk,
    SetSimOptions,
    SetSimOptionsOk,
)
from urlab_client.protocol.messages.session import Forward, Hello, Reset
from urlab_client.protocol.messages.sim import BeginPie, BeginPieOk, StopPie, StopPieOk
from urlab_client.protocol.registry import OPS
from urlab_client.values.schemas import schemas

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient, URLabController

_UNSERVED = frozenset({Hello})  # the application holds the session

# Without the handshake, which belongs to the application as well.
_STARTED = msgspec.defstruct(
    BeginPieOk.__name__,
    [(one.name, one.type) for one in msgspec.structs.fields(BeginPieOk) if one.name != "handshake_payload"],
    tag_field="op",
    tag=BeginPieOk.__struct_config__.tag,
)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return cast("np.ndarray[Any, Any]", value).tolist()
    if isinstance(value, np.generic):
        return cast("np.generic[Any]", value).item()
    raise TypeError(f"{type(value).__name__} has no JSON form")


_encoder = msgspec.json.Encoder(enc_hook=_plain)


def encode(value: object) -> bytes:
    """Return JSON; arrays become lists, and binary values base64 text."""
    return _encoder.encode(value)


def served(name: str) -> Op | None:
    """Return the op of this name, or None if it is not served."""
    op = OPS.get(name)
    return None if op is None or op.request in _UNSERVED else op


def parse(op: Op, body: bytes) -> Request[Any]:
    """Decode a request from JSON.

    Raises:
        ValueError: The JSON does not match the op's declaration.
    """
    try:
        request = msgspec.json.decode(body or b"{}", type=op.request, dec_hook=from_wire_array)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{op.name}: {error}") from None
    request.session_id = ""
    return request


async def perform(client: URLabClient, request: Request[Any]) -> object:
    """Send a request, through the client's own method if that also updates state from the reply."""
    reply: object
    match request:
        case SetMode(mode=mode):
            previous = client.step_mode
            reply = SetModeOk(previous_mode=previous, current_mode=await client.runtime.set_mode(mode))
        case SetCameraStreaming(cameras=wanted):
            reply = SetCameraStreamingOk(cameras=await client.runtime.set_camera_streaming(wanted))
        case SetCameraDelay(cameras=delays):
            reply = SetCameraDelayOk(cameras=await client.runtime.set_camera_delay(delays))
        case BeginPie(level_path=level, timeout_s=limit):
            result = await client.sim.start(level, timeout_s=limit, raise_on_failure=False)
            reply = BeginPieOk(state=result.state, compile_error=result.compile_error)
        case StopPie():
            await client.sim.stop()
            reply = StopPieOk()
        case ConfigureController(articulation=key, params=params) if controller := _controller(client, key):
            reply = ConfigureControllerOk(articulation=key, params=await controller.configure(**params))
        case SetSimOptions(options=options):
            given = msgspec.to_builtins(options)
            reply = SetSimOptionsOk(options=await client.runtime.set_sim_options(**given))
        case Reset(keyframe_name=name, seed=seed, per_articulation_qpos=overrides):
            reply = await client.reset(name, seed, overrides)
        case Forward():
            reply = await client.runtime.forward()
        case _:
            reply = await client.call(request)
    return reply


def _controller(client: URLabClient, key: str) -> URLabController | None:
    art = client.articulations.get(key)
    return None if art is None else art.controller


@lru_cache(maxsize=8)
def openapi(root: str = "", *, metrics: bool = False) -> bytes:
    """Return the OpenAPI 3.1 document of the whole HTTP API.

    Args:
        root: Path under which the application is mounted or a proxy serves it.
        metrics: Whether the application serves `/metrics`.
    """
    ops = [op for op in OPS.values() if op.request not in _UNSERVED]
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
