"""Pictures of cameras: the newest one of each, and those of a given moment, for steps and captures.

A server numbers the snapshots of the state, and each picture carries the number of the snapshot that it shows. Servers
of the alpha do not number their pictures.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from threading import Lock
from typing import Final

from urlab_client.aio.streams.publishers import Publishers
from urlab_client.aio.streams.sources import Camera, CameraSource
from urlab_client.aio.transport.shm_regions import MessageGone
from urlab_client.aio.transport.subscriber import MessageHandler, client_closed
from urlab_client.enums import CameraMode
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.messages.session import CameraFrame
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import PictureStamp, Pixels, picture_stamp

log: logging.Logger = logging.getLogger("urlab_client.client")

_KEPT: Final = 8

Picture = tuple[PictureStamp | None, BytesLike]
"""A picture with its stamp, None without a number."""

_OPENING_S: Final = 2.0
"""Seconds that the first step waits for a camera to stream and its connection to open."""

_IDLE_S: Final = 5.0
"""Seconds that a stream stays open after the last step that requested its pictures."""


class LatestPicture(MessageHandler):
    """The newest picture of a camera, from replies and, in live mode, from its stream. Converted on first access.

    Attributes:
        camera: The camera.
        delivered: False if the last step that requested a picture got none.
    """

    def __init__(self, source: CameraSource) -> None:
        self.camera: Camera = source.camera
        self.delivered: bool = True
        self._source = source
        self._lock = Lock()
        self._message: tuple[bytes, BytesLike] | None = None
        self._pixels: Pixels | None = None
        self._sim_time: float | None = None
        self._frame_id: int | None = None
        self._running = False
        self._warned = False

    def start(self) -> None:
        """Start receiving. Call from the event loop. Idempotent."""
        if not self._running:
            try:
                self._source.attach(self)
            except (ProtocolError, ValueError) as error:  # the server announces an invalid endpoint
                log.warning("the pictures of a camera are not received in the background: %s", error)
                return
            self._running = True

    def stop(self) -> None:
        """Stop receiving. Call from the event loop. Idempotent."""
        self._running = False
        self._source.detach(self)
        self.newest()  # decode now: the camera may change before the next access

    def deliver(self, pixels: Pixels, sim_time: float | None, frame_id: int | None = None) -> None:
        with self._lock:
            self._message = None
            self._pixels, self._sim_time, self._frame_id = pixels, sim_time, frame_id

    @property
    def came(self) -> bool:
        return self._pixels is not None or self._message is not None

    def newest(self) -> tuple[Pixels | None, float | None, int | None]:
        """Return the newest picture, its simulation time and the number of its snapshot, each None if missing.

        Call from any thread.
        """
        with self._lock:
            if self._message is not None:
                (topic, payload), self._message = self._message, None
                try:
                    sample = self._source.decode(topic, payload)
                except MessageGone:
                    pass  # keep the previous picture
                except ProtocolError as error:
                    self._warn(str(error))
                else:
                    self._pixels, self._sim_time = sample.pixels, sample.sim_time
                    self._frame_id = sample.frame_id
            return self._pixels, self._sim_time, self._frame_id

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        if self._lock.acquire(blocking=False):  # held during conversion: skip this picture, the next one follows
            self._message = topic, payload
            self._lock.release()

    def on_malformed(self, problem: str) -> None:
        self._warn(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self._running = False

    def _warn(self, problem: str) -> None:
        if not self._warned:
            self._warned = True
            log.warning("skipped a malformed picture: %s Further ones are skipped without a warning.", problem)


class PictureListener(MessageHandler):
    """Keeps the latest pictures of one camera while it is attached to their source."""

    def __init__(self, source: CameraSource) -> None:
        self.source = source
        self.changed: asyncio.Event = asyncio.Event()
        self.numbered: bool = True  # as far as is known
        self.ended: Callable[[], URLabError] | None = None
        self._kept: deque[Picture | ProtocolError] = deque(maxlen=_KEPT)

    def forget(self) -> None:
        """Discard the pictures received so far."""
        self._kept.clear()

    async def next(self) -> Picture:
        """Return the next picture.

        Raises:
            ProtocolError: It is malformed.
            URLabError: The stream has ended.
        """
        while not self._kept:
            if self.ended is not None:
                raise self.ended()
            await self.change()
        found = self._kept.popleft()
        if isinstance(found, ProtocolError):
            raise found
        return found

    async def change(self) -> None:
        """Wait until a picture arrives or the connection changes."""
        self.changed.clear()
        await self.changed.wait()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        camera = self.source.camera
        try:
            stamp = picture_stamp(payload, *camera.info.resolution, where=camera.name)
        except ProtocolError as error:
            self._kept.append(error)
        else:
            self.numbered = stamp is not None
            self._kept.append((stamp, payload))
        self.changed.set()

    def on_malformed(self, problem: str) -> None:
        log.debug("skipped a malformed picture: %s", problem)

    def on_connection(self, connected: bool) -> None:
        self.changed.set()

    def on_gap(self, why: str) -> None:
        self.changed.set()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self.ended = error
        self.changed.set()


class StepStreams:
    """Camera streams that deliver the pictures of steps, for servers whose replies carry older pictures.

    Such a server renders on its own schedule. The picture of a step is the first one that is not older than the step's
    snapshot, so the client subscribes before the step. The streams stay open between steps and close after the last.

    Attributes:
        needed: Whether a reply has carried a picture older than its step.
    """

    def __init__(self, publishers: Publishers) -> None:
        self.needed = False
        self._publishers = publishers
        self._listeners: dict[str, PictureListener] = {}
        self._play: object = None
        self._closing: asyncio.TimerHandle | None = None

    def listen(self, cameras: Iterable[tuple[str, Camera]], play: object) -> bool:
        """Receive the pictures of cameras and discard those received so far.

        Returns:
            Whether new streams were added; `opened` waits for them.
        """
        if play is not self._play:
            self.close()
            self._play = play
        new = False
        for name, camera in cameras:
            known = self._listeners.get(name)
            if known is not None:
                known.forget()
                continue
            listener = PictureListener(self._publishers.camera(camera, StreamPolicy.ALL))
            try:
                listener.source.attach(listener)
            except (ProtocolError, ValueError) as error:  # the server announces an invalid endpoint
                log.warning("camera %s: the pictures of steps cannot be received: %s", name, error)
                continue
            self._listeners[name] = listener
            new = True
        if self._closing is not None:
            self._closing.cancel()
        self._closing = asyncio.get_running_loop().call_later(_IDLE_S, self.close)
        return new

    async def opened(self) -> None:
        try:
            async with asyncio.timeout(_OPENING_S):
                await self._publishers.camera_switch.settled()
                for listener in tuple(self._listeners.values()):
                    await _connected(listener, self._publishers)
        except TimeoutError:
            log.debug("the stream of a camera did not open within %g s", _OPENING_S)

    async def pictures(self, names: Iterable[str], frame_id: int, deadline: float) -> dict[str, CameraFrame]:
        """Return, for each camera, the first picture not older than a snapshot, if it arrives in time."""
        found: dict[str, CameraFrame] = {}
        try:
            async with asyncio.timeout_at(deadline):
                for name in names:
                    listener = self._listeners.get(name)
                    frame = None if listener is None else await _picture(listener, frame_id)
                    if frame is not None:
                        found[name] = frame
        except TimeoutError:
            log.debug("no picture of snapshot %d arrived in time", frame_id)
        return found

    def close(self) -> None:
        """Stop receiving. Call from the event loop. Idempotent."""
        if self._closing is not None:
            self._closing.cancel()
            self._closing = None
        for listener in self._listeners.values():
            listener.source.detach(listener)
            listener.on_end(client_closed)
        self._listeners.clear()


async def _connected(listener: PictureListener, publishers: Publishers) -> None:
    """Wait until the publisher is connected."""
    while listener.numbered and listener.ended is None:
        line = publishers.subscriptions.line(listener)
        if line is None or line.connected:
            return
        await listener.change()


async def _picture(listener: PictureListener, least: int) -> CameraFrame | None:
    """Return the first picture that is not older than a snapshot, or None if none can arrive."""
    while listener.numbered:  # otherwise no picture is known to be new enough
        try:
            stamp, payload = await listener.next()
        except ProtocolError as error:
            log.debug("skipped a malformed picture: %s", error)
            continue
        except URLabError:
            return None  # the client was closed
        if stamp is not None and stamp.frame_id >= least:
            return _frame(listener.source.camera, stamp, payload)
    return None


def _frame(camera: Camera, stamp: PictureStamp, payload: BytesLike) -> CameraFrame:
    width, height = camera.info.resolution
    return CameraFrame(
        width=width,
        height=height,
        frame_id=stamp.frame_id,
        sim_time=stamp.sim_time,
        dtype="float32" if camera.mode == CameraMode.DEPTH else "bgra8",
        data=bytes(memoryview(payload)[stamp.size :]),
    )
