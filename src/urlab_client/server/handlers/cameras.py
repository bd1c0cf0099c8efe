"""Handlers of the ops that switch cameras."""

# ruff: noqa: D103 - what an op does stands once, on its request struct

from __future__ import annotations

from urlab_client.protocol.messages.cameras import (
    CameraStreaming,
    CameraTransports,
    SetCameraStreaming,
    SetCameraStreamingOk,
)
from urlab_client.server.core import ServerCore
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need


@handles(SetCameraStreaming)
def set_camera_streaming(server: ServerCore, request: SetCameraStreaming) -> SetCameraStreamingOk:
    running = server.play.running()
    asked = need(request, request.cameras, "cameras")
    if not asked:
        raise Refusal("bad_request", "set_camera_streaming: field 'cameras' is empty")
    known = {key.casefold(): key for key in running.cameras.keys}
    streaming: dict[str, CameraStreaming] = {}
    for name, wanted in asked.items():
        key = known.get(name.casefold())
        if key is None:
            continue
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


def _places(wanted: bool | CameraTransports) -> tuple[bool, bool]:
    if isinstance(wanted, bool):
        return wanted, wanted
    if wanted.zmq is None and wanted.shm is None:
        return True, True
    return bool(wanted.zmq), bool(wanted.shm)
