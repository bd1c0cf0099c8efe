"""Ops that switch the streams of cameras and delay their pictures."""

from __future__ import annotations

from typing import Annotated, Final

from msgspec import Struct

from urlab_client.protocol.base import Needs, Op, Reply, Request, doc
from urlab_client.values.plain import Serializable


class CameraTransports(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Transports that a camera should use. Those not mentioned are switched off, unless none is mentioned."""

    zmq: Annotated[bool | None, doc("On its socket.")] = None
    shm: Annotated[bool | None, doc("In shared memory.")] = None


class CameraStreaming(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Streaming state of a camera."""

    streaming: Annotated[bool, doc("Whether it streams at all.")]
    zmq: Annotated[bool, doc("Whether it streams on its socket.")]
    shm: Annotated[bool, doc("Whether it streams in shared memory.")]
    zmq_endpoint: Annotated[str | None, doc("Publisher endpoint as bound: the host may be 0.0.0.0.")] = None
    zmq_topic: Annotated[str | None, doc("Topic without the trailing space that messages carry.")] = None


class SetCameraStreamingOk(Reply, tag="set_camera_streaming_ok", kw_only=True):
    """Streaming state of the cameras."""

    cameras: Annotated[dict[str, CameraStreaming], doc("State by the server's camera name; unknown ones are missing.")]


class SetCameraStreaming(Request[SetCameraStreamingOk], tag="set_camera_streaming", kw_only=True):
    """Switch the streams of cameras, for all clients. The last call wins."""

    cameras: Annotated[dict[str, bool | CameraTransports], doc("Camera to on or off, or to the transports to use.")]


class CameraDelay(Serializable, Struct, kw_only=True, omit_defaults=True):
    """Requested latency of a camera."""

    delay_s: Annotated[float, doc("Seconds between a picture and its release.")] = 0.0
    jitter_s: Annotated[float, doc("Largest random deviation from that, seconds.")] = 0.0
    clock: Annotated[str, doc("`sim` or `wall`.")] = "sim"
    seed: Annotated[int, doc("Seed of the deviation; 0 derives one from the name.")] = 0
    on_state_change: Annotated[bool | None, doc("Take pictures only when the state has changed; None keeps it.")] = None
    max_fps: Annotated[float | None, doc("Maximum pictures per second, 0 for no limit; None keeps it.")] = None


class CameraDelayInForce(Serializable, Struct, kw_only=True):
    """Latency of a camera in force."""

    delay_s: Annotated[float, doc("Seconds between a picture and its release.")]
    jitter_s: Annotated[float, doc("Largest random deviation from that, seconds.")]
    clock: Annotated[str, doc("`sim` or `wall`.")]
    on_state_change: Annotated[bool, doc("Whether pictures are taken only when the state has changed.")]
    max_fps: Annotated[float, doc("Maximum pictures per second; 0 for no limit.")]


class SetCameraDelayOk(Reply, tag="set_camera_delay_ok", kw_only=True):
    """The latencies in force."""

    cameras: Annotated[
        dict[str, CameraDelayInForce], doc("Latency by the server's camera name; unknown ones are missing.")
    ]


class SetCameraDelay(Request[SetCameraDelayOk], tag="set_camera_delay", kw_only=True):
    """Delay the pictures of cameras, as real cameras do."""

    cameras: Annotated[dict[str, float | CameraDelay], doc("Camera to seconds, or to a latency.")]


OPS: Final = (
    Op(
        request=SetCameraStreaming,
        ns="runtime",
        needs=Needs.MANAGER,
        timeout=6.5,
        errors=("timeout",),
        dialects=("beta",),
    ),
    Op(request=SetCameraDelay, ns="runtime", needs=Needs.MANAGER, timeout=6.5, errors=("timeout",), dialects=("beta",)),
)
