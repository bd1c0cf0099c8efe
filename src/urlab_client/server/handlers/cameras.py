"""Handlers of the ops that switch and delay cameras."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any, TypeVar

from urlab_client.protocol.base import Request
from urlab_client.protocol.messages.cameras import (
    CameraDelay,
    CameraDelayInForce,
    CameraStreaming,
    CameraTransports,
    SetCameraDelay,
    SetCameraDelayOk,
    SetCameraStreaming,
    SetCameraStreamingOk,
)
from urlab_client.server.core import ServerCore
from urlab_client.server.physics.play import Running
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need
from urlab_client.simulation.controllers import float32

T = TypeVar("T")


@handles(SetCameraStreaming)
def set_camera_streaming(server: ServerCore, request: SetCameraStreaming) -> SetCameraStreamingOk:
    running = server.play.running()
    streaming: dict[str, CameraStreaming] = {}
    for key, wanted in _known(running, request, request.cameras).items():
        zmq, shm = _places(wanted)
        server.switch_camera(key, zmq=zmq, shm=shm)
        robot, _, part = key.partition("/")
        streaming[key] = CameraStreaming(
            streaming=zmq or shm,
            zmq=zmq,
            shm=shm,
            zmq_endpoint=server.camera_endpoint(robot, part) if zmq else None,
            zmq_topic=server.dialect.camera_topic(robot, part) if zmq else None,
        )
    return SetCameraStreamingOk(cameras=streaming)


@handles(SetCameraDelay)
def set_camera_delay(server: ServerCore, request: SetCameraDelay) -> SetCameraDelayOk:
    running = server.play.running()
    wanted: dict[str, tuple[CameraDelayInForce, int]] = {}
    for key, asked in _known(running, request, request.cameras).items():
        delay = asked if isinstance(asked, CameraDelay) else CameraDelay(delay_s=asked)
        wanted[key] = (_latency(key, delay, running.cameras.latency(key)), delay.seed or zlib.crc32(key.encode()))
    running.delay_cameras(wanted)
    return SetCameraDelayOk(cameras={key: _rounded(latency) for key, (latency, _) in wanted.items()})


def _known(running: Running, request: Request[Any], cameras: Mapping[str, T]) -> dict[str, T]:
    """Return a request's entries for existing cameras, by camera key, ignoring case.

    Raises:
        Refusal: `missing_field`; `bad_request` if it contains no camera.
    """
    asked = need(request, cameras, "cameras")
    if not asked:
        raise Refusal("bad_request", f"{request.__struct_config__.tag}: field 'cameras' is empty")
    keys = {key.casefold(): key for key in running.cameras.keys}
    return {keys[name.casefold()]: wanted for name, wanted in asked.items() if name.casefold() in keys}


def _places(wanted: bool | CameraTransports) -> tuple[bool, bool]:
    if isinstance(wanted, bool):
        return wanted, wanted
    if wanted.zmq is None and wanted.shm is None:
        return True, True
    return bool(wanted.zmq), bool(wanted.shm)


def _latency(key: str, asked: CameraDelay, before: CameraDelayInForce | None) -> CameraDelayInForce:
    """Return the requested latency.

    Raises:
        Refusal: `bad_request` for a clock that does not exist, and for a number that single precision cannot hold.
    """
    clock = asked.clock.lower()
    if clock not in ("sim", "wall"):
        raise Refusal("bad_request", f"set_camera_delay: clock of '{key}' is '{asked.clock}', not 'sim' or 'wall'")
    numbers = {"delay_s": asked.delay_s, "jitter_s": asked.jitter_s, "max_fps": asked.max_fps or 0.0}
    for field, number in numbers.items():
        if not math.isfinite(float32(number)):
            raise Refusal("bad_request", f"set_camera_delay: {field} of '{key}' is {number}, not a finite number")
    keeps = before is not None and asked.on_state_change is None and asked.max_fps is None
    return CameraDelayInForce(
        delay_s=max(0.0, asked.delay_s),
        jitter_s=max(0.0, asked.jitter_s),
        clock=clock,
        on_state_change=before.on_state_change if before is not None and keeps else asked.on_state_change is not False,
        max_fps=before.max_fps if before is not None and keeps else max(0.0, numbers["max_fps"]),
    )


def _rounded(latency: CameraDelayInForce) -> CameraDelayInForce:
    return CameraDelayInForce(
        delay_s=float32(latency.delay_s),
        jitter_s=float32(latency.jitter_s),
        clock=latency.clock,
        on_state_change=latency.on_state_change,
        max_fps=float32(latency.max_fps),
    )
