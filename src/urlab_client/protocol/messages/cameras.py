"""Ops that switch the streams of cameras and delay what they show."""

from __future__ import annotations

from typing import Annotated, Final

from msgspec import Struct

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc
from urlab_client.protocol.serializable import Serializable

__all__ = [
    "OPS",
    "CameraDelay",
    "CameraDelayInForce",
    "CameraStreaming",
    "CameraTransports",
    "SetCameraDelay",
    "SetCameraDelayOk",
    "SetCameraStreaming",
    "SetCameraStreamingOk",
]


class CameraTransports(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Where a camera is to stream: what is not mentioned is switched off, unless nothing is mentioned."""

    zmq: Annotated[bool | None, doc("On its socket.")] = None
    shm: Annotated[bool | None, doc("In shared memory.")] = None


class CameraStreaming(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Where a camera streams."""

    streaming: Annotated[bool, doc("Whether it streams at all.")]
    zmq: Annotated[bool, doc("Whether on its socket.")]
    shm: Annotated[bool, doc("Whether in shared memory.")]
    zmq_endpoint: Annotated[str | None, doc("Publisher endpoint as bound: the host may be 0.0.0.0.")] = None
    zmq_topic: Annotated[str | None, doc("Topic without the trailing space that messages carry.")] = None


class SetCameraStreamingOk(Reply, tag="set_camera_streaming_ok", kw_only=True):
    """Where the cameras stream now."""

    cameras: Annotated[dict[str, CameraStreaming], doc("By the server's name of the camera; unknown ones are missing.")]


class SetCameraStreaming(Request[SetCameraStreamingOk], tag="set_camera_streaming", kw_only=True):
    """Switch the streams of cameras, for every client alike; the last call wins."""

    cameras: Annotated[dict[str, bool | CameraTransports], doc("Camera to on or off, or to where it is to stream.")]


class CameraDelay(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Latency that a camera is to have."""

    delay_s: Annotated[float, doc("Seconds between a picture and its release.")] = 0.0
    jitter_s: Annotated[float, doc("Largest random deviation from that, seconds.")] = 0.0
    clock: Annotated[str, doc("`sim` or `wall`.")] = "sim"
    seed: Annotated[int, doc("Seed of the deviation; 0 derives one from the name.")] = 0
    on_state_change: Annotated[bool | None, doc("Take pictures only when the state has changed; None keeps it.")] = None
    max_fps: Annotated[float | None, doc("Pictures per second at most, 0 for no limit; None keeps it.")] = None


class CameraDelayInForce(Serializable, Struct, kw_only=True):
    """Latency that a camera has."""

    delay_s: Annotated[float, doc("Seconds between a picture and its release.")]
    jitter_s: Annotated[float, doc("Largest random deviation from that, seconds.")]
    clock: Annotated[str, doc("`sim` or `wall`.")]
    on_state_change: Annotated[bool, doc("Whether pictures are taken only when the state has changed.")]
    max_fps: Annotated[float, doc("Pictures per second at most; 0 for no limit.")]


class SetCameraDelayOk(Reply, tag="set_camera_delay_ok", kw_only=True):
    """The latencies now."""

    cameras: Annotated[
        dict[str, CameraDelayInForce], doc("By the server's name of the camera; unknown ones are missing.")
    ]


class SetCameraDelay(Request[SetCameraDelayOk], tag="set_camera_delay", kw_only=True):
    """Let cameras show what they saw some time ago, as slow ones do."""

    cameras: Annotated[dict[str, float | CameraDelay], doc("Camera to seconds, or to a latency.")]


OPS: Final = (
    Op(
        request=SetCameraStreaming,
        ns="runtime",
        needs=Needs.MANAGER,
        timeout=6.5,
        errors=("missing_field", "not_ready", "bad_request", "timeout"),
        dialects=("beta",),
    ),
    Op(
        request=SetCameraDelay,
        ns="runtime",
        needs=Needs.MANAGER,
        timeout=6.5,
        errors=("missing_field", "not_ready", "bad_request", "timeout"),
        dialects=("beta",),
    ),
)
