"""The pictures of one camera, from its socket or its shared memory region."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from urlab_client.aio.streams.camera_switch import CameraSwitch
from urlab_client.aio.streams.source import PublishedSource
from urlab_client.aio.transport.shm_streams import Place, Regions, SharedPicture
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.enums import CameraMode
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import (
    CameraSample,
)
from urlab_client.protocol.shm import Ring, camera_file
from urlab_client.protocol.topics import camera_filter, resolve_endpoint
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import PictureMemory, decode_camera

FIRST_PICTURE_S = 30.0
"""Seconds that a server may take for its first picture, because it initialises OpenGL first."""


class HasCamera(Protocol):
    """A camera as the client knows it. Its properties may change with each handshake.

    Attributes:
        memory: Memory that holds its decoded pictures.
    """

    memory: PictureMemory

    @property
    def name(self) -> str:
        """Name of the camera."""
        ...

    @property
    def info(self) -> CameraInfo:
        """Description from the handshake."""
        ...

    @property
    def mode(self) -> CameraMode | str:
        """Meaning of its pixels."""
        ...


class CameraSource(PublishedSource):
    """The pictures of one camera, from its region or from its socket.

    A picture from the region is converted on first access, directly into the user's array.

    Args:
        subscriptions: Subscriptions of the client.
        view: The camera.
        host: Callback that returns the host name or address of the server.
        regions: See the base class.
        live: Callback that returns whether the server is in live mode, as far as the client knows.
        switch: Switch that turns the camera on and off; None if it always streams.
        asked: True if the user requested these pictures; False if the client receives them in the background.
    """

    name = "frames"
    unreachable = (
        "The port is open while play runs and the camera streams. The plugin serves nine cameras; any further camera "
        "reports a port that it does not serve."
    )
    silent = (
        "Older servers publish pictures only in live mode and while the camera is switched on in the editor. Newer "
        "servers publish in every mode, but only while the simulation moves. capture() takes a picture at any time. "
        "A server that cannot render publishes no pictures. It initialises OpenGL before its first picture, which "
        "takes seconds; its log shows the result."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        view: HasCamera,
        host: Callable[[], str],
        *,
        regions: Regions | None = None,
        live: Callable[[], bool] = lambda: True,
        switch: CameraSwitch | None = None,
        asked: bool = True,
    ) -> None:
        super().__init__(subscriptions, regions)
        self.view = view
        self._host = host
        self._live = live
        self._switch = switch
        self._asked = asked
        self._users: set[MessageHandler] = set()
        self._taken: SharedPicture | None = None

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler` and switch the camera on. Call from the event loop."""
        super().attach(handler)
        if self._switch is not None and handler not in self._users:
            self._users.add(handler)
            self._switch.use(self.view.info, asked=self._asked)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Idempotent."""
        super().detach(handler)
        if self._switch is not None and handler in self._users:
            self._users.discard(handler)
            self._switch.leave(self.view.info)

    def first_after(self, handler: MessageHandler) -> float:
        """Return the seconds that a connected, publishing server may take until it can render; otherwise 0.

        Sockets deliver pictures only in live mode, regions in every mode.
        """
        if self.region(handler) is not None:
            return FIRST_PICTURE_S
        line = self._subscriptions.line(handler)
        return FIRST_PICTURE_S if line is not None and line.connected and self._live() else 0.0

    def subscription(self) -> Subscription:
        """See the base class."""
        info = self.view.info
        topic = camera_filter(info.zmq_topic)
        return Subscription(resolve_endpoint(info.zmq_endpoint, self._host()), (topic,), topic.__eq__, pictures=True)

    def place(self) -> Place:
        """See the base class."""
        topic = self.view.info.zmq_topic
        separator = "/camera/" if "/camera/" in topic else "/"
        articulation, _, camera = topic.strip().partition(separator)
        return Place(camera_file(articulation, camera), camera_filter(topic), Ring.CAMERA)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Skip a picture that was already read in place of its predecessor."""
        taken = self._taken
        return not (
            isinstance(payload, SharedPicture)
            and taken is not None
            and payload.reader is taken.reader
            and payload.sequence <= taken.sequence
        )

    def decode(self, topic: bytes, payload: BytesLike) -> CameraSample:
        """Decode a picture. Raises `ProtocolError`."""
        if not isinstance(payload, SharedPicture):
            return self._sample(topic, payload)
        found = payload.read(lambda slot: self._sample(topic, slot))
        self._taken = SharedPicture(payload.reader, found.sequence, len(payload))
        return found.payload

    def _sample(self, topic: bytes, payload: BytesLike) -> CameraSample:
        view = self.view
        width, height = view.info.resolution
        frame = decode_camera(
            payload, view.mode, width, height, memory=view.memory, where=topic.decode(errors="replace")
        )
        return CameraSample(
            camera=view.name,
            mode=view.mode,
            pixels=frame.pixels,
            frame_id=frame.frame_id,
            sim_time=frame.sim_time,
            capture_time=frame.capture_time,
        )
