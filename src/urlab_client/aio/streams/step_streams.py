"""Camera streams that deliver the pictures of steps, for servers whose replies carry older pictures.

Such a server renders on its own schedule and numbers the snapshots of the state. The picture of a step is the first one
that is not older than the step's snapshot. The client must subscribe to the stream before the step.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from urlab_client.aio.streams.camera_source import CameraSource, HasCamera
from urlab_client.aio.streams.publishers import Publishers
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.enums import CameraMode
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.messages.session import CameraFrame
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.values.layouts import BytesLike
from urlab_client.values.pictures import PictureStamp, picture_stamp

log: logging.Logger = logging.getLogger("urlab_client.client")

_OPENING_S: Final = 2.0
"""Seconds that the first step waits for a camera to stream and its connection to open."""

_IDLE_S: Final = 5.0
"""Seconds that a stream stays open after the last step that requested its pictures."""

_KEPT: Final = 8


class StepStreams:
    """The camera streams of one client's steps. They stay open between steps and close after the last step.

    Args:
        publishers: Publishers that deliver the pictures.

    Attributes:
        needed: Whether a reply has carried a picture older than its step.
    """

    def __init__(self, publishers: Publishers) -> None:
        self.needed = False
        self._publishers = publishers
        self._listeners: dict[str, _Listener] = {}
        self._play: object = None
        self._closing: asyncio.TimerHandle | None = None

    def listen(self, cameras: Iterable[tuple[str, HasCamera]], play: object) -> bool:
        """Receive the pictures of cameras and discard those received so far.

        Args:
            cameras: Name and view of each camera.
            play: Object that identifies the play session; each session numbers its snapshots anew.

        Returns:
            Whether new streams were added; `opened` waits for them.
        """
        if play is not self._play:
            self.close()
            self._play = play
        new = False
        for name, view in cameras:
            known = self._listeners.get(name)
            if known is not None:
                known.forget()
                continue
            listener = _Listener(self._publishers.camera(view, StreamPolicy.ALL))
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
        """Wait until the cameras stream and their connections are open, or until the time limit."""
        try:
            async with asyncio.timeout(_OPENING_S):
                switch = self._publishers.camera_switch
                if switch is not None:
                    await switch.settled()
                for listener in tuple(self._listeners.values()):
                    await listener.connection(self._publishers)
        except TimeoutError:
            log.debug("the stream of a camera did not open within %g s", _OPENING_S)

    async def pictures(self, names: Iterable[str], frame_id: int, deadline: float) -> dict[str, CameraFrame]:
        """Return, for each camera, the first picture not older than a snapshot, if it arrives in time.

        Args:
            names: Cameras passed to `listen`.
            frame_id: Number of the snapshot.
            deadline: Loop time until which to wait.
        """
        found: dict[str, CameraFrame] = {}
        try:
            async with asyncio.timeout_at(deadline):
                for name in names:
                    listener = self._listeners.get(name)
                    frame = None if listener is None else await listener.picture(frame_id)
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
            listener.end()
        self._listeners.clear()


class _Listener(MessageHandler):
    """Buffers the latest pictures of one camera, each with its number."""

    def __init__(self, source: CameraSource) -> None:
        self.source = source
        self._kept: deque[tuple[PictureStamp, BytesLike]] = deque(maxlen=_KEPT)
        self._news = asyncio.Event()
        self._over = False  # no picture with a number will arrive

    async def connection(self, publishers: Publishers) -> None:
        """Wait until the publisher is connected."""
        while not self._over:
            line = publishers.subscriptions.line(self)
            if line is None or line.connected:
                return
            await self._next()

    async def picture(self, least: int) -> CameraFrame | None:
        """Return the first picture that is not older than a snapshot, or None if none can arrive."""
        while True:
            while self._kept:
                stamp, payload = self._kept.popleft()
                if stamp.frame_id >= least:
                    return self._frame(stamp, payload)
            if self._over:
                return None
            await self._next()

    def forget(self) -> None:
        """Discard the buffered pictures."""
        self._kept.clear()

    def end(self) -> None:
        """Wake all waiters and end the reception."""
        self._over = True
        self._news.set()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        """Process one message."""
        width, height = self.source.view.info.resolution
        try:
            stamp = picture_stamp(payload, width, height, where=self.source.view.name)
        except ProtocolError as error:
            self.on_malformed(str(error))
            return
        if stamp is None:
            self.end()  # without numbers, no picture is known to be new enough
        else:
            self._kept.append((stamp, payload))
            self._news.set()

    def on_malformed(self, problem: str) -> None:
        """Log a malformed message."""
        log.debug("skipped a malformed picture: %s", problem)

    def on_connection(self, connected: bool) -> None:
        """Wake the waiters because the connection was opened or lost."""
        self._news.set()

    def on_gap(self, why: str) -> None:
        """Wake the waiters because the source of the stream changed."""
        self._news.set()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """End the reception because the client was closed."""
        self.end()

    async def _next(self) -> None:
        self._news.clear()
        await self._news.wait()

    def _frame(self, stamp: PictureStamp, payload: BytesLike) -> CameraFrame:
        width, height = self.source.view.info.resolution
        return CameraFrame(
            width=width,
            height=height,
            frame_id=stamp.frame_id,
            sim_time=stamp.sim_time,
            dtype="float32" if self.source.view.mode == CameraMode.DEPTH else "bgra8",
            data=bytes(memoryview(payload)[stamp.size :]),
        )
