"""The pictures of one camera: from its socket or its region."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from urlab_client.aio.live.camera_switch import CameraSwitch
from urlab_client.aio.live.source import PublishedSource
from urlab_client.aio.transport.regions import Place, Regions, SharedPicture
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.protocol import doorbell
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.layouts import BytesLike
from urlab_client.protocol.messages.session import CameraInfo
from urlab_client.protocol.messages.streams import (
    CameraSample,
)
from urlab_client.protocol.picture_memory import PictureMemory
from urlab_client.protocol.pixels import decode_camera
from urlab_client.protocol.shm import camera_file
from urlab_client.protocol.topics import camera_filter, resolve_endpoint

__all__ = ["CameraSource", "HasCamera"]

FIRST_PICTURE_S = 30.0
"""How long a server may take for its first picture: it looks for OpenGL before."""


class HasCamera(Protocol):
    """A camera as the client knows it; what it says may change with each handshake.

    Attributes:
        memory: Where its pictures go.
    """

    memory: PictureMemory

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def info(self) -> CameraInfo:
        """The handshake's description."""
        ...

    @property
    def mode(self) -> CameraMode | str:
        """What its pixels mean."""
        ...


class CameraSource(PublishedSource):
    """The pictures of one camera, from its region or from its socket.

    A picture from the region is converted when somebody looks at it, straight into an array of the user's.

    Args:
        subscriptions: The client's.
        view: The camera.
        host: Tells under which name or address the server was reached.
        regions: As of the base class.
        live: Tells whether the server is in live mode, as far as is known.
        switch: Switches the camera on and off; None where it always streams.
        asked: Whether the user asked for these pictures, rather than having them received in the background.
    """

    name = "frames"
    unreachable = (
        "The port is open while play runs and the camera streams. A camera that found no free port reports one that "
        "it does not serve: the plugin serves nine."
    )
    silent = (
        "Older servers publish pictures in live mode only, and while the camera is switched on in the editor; newer "
        "ones in every mode, but only while the simulation moves. capture() takes one at any time. A server that "
        "cannot draw publishes none; before its first picture it looks for OpenGL, which takes seconds, and its log "
        "says what it found."
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
        """Begin to feed `handler`, from the event loop, and switch the camera on."""
        super().attach(handler)
        if self._switch is not None and handler not in self._users:
            self._users.add(handler)
            self._switch.use(self.view.info, asked=self._asked)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        super().detach(handler)
        if self._switch is not None and handler in self._users:
            self._users.discard(handler)
            self._switch.leave(self.view.info)

    def first_after(self, handler: MessageHandler) -> float:
        """Return how long a server may take until it can draw, where it is there and publishes; else 0.

        Sockets bring pictures in live mode only, regions in every mode.
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
        return Place(camera_file(articulation, camera), camera_filter(topic), doorbell.CAMERA)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Leave out a picture that was read already, in place of the one before it."""
        taken = self._taken
        return not (
            isinstance(payload, SharedPicture)
            and taken is not None
            and payload.reader is taken.reader
            and payload.sequence <= taken.sequence
        )

    def decode(self, topic: bytes, payload: BytesLike) -> CameraSample:
        """Read a picture. Raises `ProtocolError`."""
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
