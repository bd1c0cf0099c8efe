"""The streams in which the pictures of steps are looked for, on servers whose replies bring older ones.

Such a server draws on its own schedule and numbers the snapshots of the state: the first picture that is not older than
a step's snapshot is that of the step. Whoever wants it has to receive the stream before the step is taken.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from urlab_client.aio.live.camera_source import CameraSource, HasCamera
from urlab_client.aio.live.publishers import Publishers
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.protocol.enums import CameraMode
from urlab_client.protocol.errors import ProtocolError, URLabError
from urlab_client.protocol.layouts import BytesLike
from urlab_client.protocol.messages.session import CameraFrame
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.protocol.pixels import PictureStamp, picture_stamp

__all__ = ["StepStreams"]

log: logging.Logger = logging.getLogger("urlab_client.client")

_OPENING_S: Final = 2.0
"""How long the first step waits until a camera streams and the connection to it stands."""

_IDLE_S: Final = 5.0
"""How long a stream stays open after the last step that asked for its pictures."""

_KEPT: Final = 8


class StepStreams:
    """The streams of one client's steps. They stay open from step to step, and are closed when no more step comes.

    Args:
        publishers: Where pictures come from.

    Attributes:
        needed: Whether a reply has brought an older picture than that of its step.
    """

    def __init__(self, publishers: Publishers) -> None:
        self.needed = False
        self._publishers = publishers
        self._listeners: dict[str, _Listener] = {}
        self._play: object = None
        self._closing: asyncio.TimerHandle | None = None

    def listen(self, cameras: Iterable[tuple[str, HasCamera]], play: object) -> bool:
        """Receive the pictures of cameras, and forget those received so far.

        Args:
            cameras: Name and view of each.
            play: What is another object in another play session, where snapshots are numbered anew.

        Returns:
            Whether there are new ones, for which `opened` waits.
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
            except (ProtocolError, ValueError) as error:  # the server says that they come from where nothing can
                log.warning("camera %s: the pictures of steps cannot be received: %s", name, error)
                continue
            self._listeners[name] = listener
            new = True
        if self._closing is not None:
            self._closing.cancel()
        self._closing = asyncio.get_running_loop().call_later(_IDLE_S, self.close)
        return new

    async def opened(self) -> None:
        """Wait until the cameras stream and the connections to them stand, or that has taken too long."""
        try:
            async with asyncio.timeout(_OPENING_S):
                switch = self._publishers.camera_switch
                if switch is not None:
                    await switch.settled()
                for listener in tuple(self._listeners.values()):
                    await listener.connection(self._publishers)
        except TimeoutError:
            log.debug("a camera's stream has not opened within %g s", _OPENING_S)

    async def pictures(self, names: Iterable[str], frame_id: int, deadline: float) -> dict[str, CameraFrame]:
        """Return the first picture of each camera that is not older than a snapshot, as far as they come in time.

        Args:
            names: Cameras that `listen` was told of.
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
            log.debug("no picture of snapshot %d came in time", frame_id)
        return found

    def close(self) -> None:
        """Stop receiving, from the event loop. Idempotent."""
        if self._closing is not None:
            self._closing.cancel()
            self._closing = None
        for listener in self._listeners.values():
            listener.source.detach(listener)
            listener.end()
        self._listeners.clear()


class _Listener(MessageHandler):
    """Keeps the latest pictures of one camera, each with its number."""

    def __init__(self, source: CameraSource) -> None:
        self.source = source
        self._kept: deque[tuple[PictureStamp, BytesLike]] = deque(maxlen=_KEPT)
        self._news = asyncio.Event()
        self._over = False  # nothing that could be told apart will come

    async def connection(self, publishers: Publishers) -> None:
        """Wait until the publisher is on the line."""
        while not self._over:
            line = publishers.subscriptions.line(self)
            if line is None or line.connected:
                return
            await self._next()

    async def picture(self, least: int) -> CameraFrame | None:
        """Return the first picture that is not older than a snapshot; None where none can come."""
        while True:
            while self._kept:
                stamp, payload = self._kept.popleft()
                if stamp.frame_id >= least:
                    return self._frame(stamp, payload)
            if self._over:
                return None
            await self._next()

    def forget(self) -> None:
        """Drop what has been received."""
        self._kept.clear()

    def end(self) -> None:
        """Let nobody wait any longer."""
        self._over = True
        self._news.set()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        """Take one message."""
        width, height = self.source.view.info.resolution
        try:
            stamp = picture_stamp(payload, width, height, where=self.source.view.name)
        except ProtocolError as error:
            self.on_malformed(str(error))
            return
        if stamp is None:
            self.end()  # without numbers, none of them is known to be new enough
        else:
            self._kept.append((stamp, payload))
            self._news.set()

    def on_malformed(self, problem: str) -> None:
        """Take note of a malformed message."""
        log.debug("skipped a malformed picture: %s", problem)

    def on_connection(self, connected: bool) -> None:
        """Take note that the connection was made or lost."""
        self._news.set()

    def on_gap(self, why: str) -> None:
        """Take note that the stream comes from elsewhere."""
        self._news.set()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Take note that the client was closed."""
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
