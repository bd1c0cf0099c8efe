"""The registry's ops for viewers: requests from JSON, and what the client does for each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from urlab_client.protocol.base import Op, Request
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

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient, URLabController

SERVED: dict[str, Op] = {name: op for name, op in OPS.items() if op.request is not Hello}
"""The ops that viewers may perform, by name; the console itself holds the session."""


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
