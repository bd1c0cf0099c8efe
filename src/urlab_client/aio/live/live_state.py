"""Live mode in the background: keeps the client's state current while physics runs by itself."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from threading import Lock, RLock

from msgspec import Struct

from urlab_client.aio.live.camera_source import CameraSource
from urlab_client.aio.live.state_source import StateSource
from urlab_client.aio.transport.subscriber import MessageGone, MessageHandler
from urlab_client.protocol.errors import ProtocolError, URLabError
from urlab_client.protocol.layouts import BytesLike
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.pixels import Pixels

__all__ = ["LatestPicture", "LiveState", "LiveStats"]

log: logging.Logger = logging.getLogger("urlab_client.streams")

_RETRY_S = 0.002


class LiveStats(Struct):
    """Counters of the background reception.

    Attributes:
        received: Snapshots that arrived.
        absorbed: Snapshots taken over; the others were superseded before their turn.
        refused: Snapshots that could not be decoded or do not fit the model.
    """

    received: int = 0
    absorbed: int = 0
    refused: int = 0


class LiveState(MessageHandler):
    """Takes over the newest snapshot of each batch, right where it is received: no task, no thread, no queue.

    Args:
        source: The state socket.
        absorb: Takes a snapshot over, whole or not at all. May raise `ProtocolError`.
        lock: Guards the state. It is never waited for here: its holder may be waiting for a call on this loop.

    Attributes:
        stats: Counters since it was made.
    """

    def __init__(self, source: StateSource, absorb: Callable[[StateSnapshot], None], lock: RLock) -> None:
        self.stats: LiveStats = LiveStats()
        self._source = source
        self._absorb = absorb
        self._lock = lock
        self._payload: BytesLike | None = None
        self._snapshot: StateSnapshot | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._running = False
        self._warned = False

    @property
    def running(self) -> bool:
        """Whether it receives."""
        return self._running

    def start(self) -> None:
        """Receive from now on; from the event loop. Idempotent."""
        if not self._running:
            self._source.attach(self)
            self._running = True
            self._warned = False

    def stop(self) -> None:
        """Receive no longer; from the event loop. Idempotent."""
        self._running = False
        self._source.detach(self)
        self._forget()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        """Take one message."""
        self.stats.received += 1
        if self._source.wants(topic, payload):
            self._payload = payload

    def on_drained(self) -> None:
        """Take the newest one over."""
        try:
            if self._payload is not None:
                payload, self._payload = self._payload, None
                self._snapshot = StateSnapshot.decode(payload)
            if self._snapshot is not None:
                self._take_over(self._snapshot)
        except ProtocolError as error:
            self._snapshot = None
            self._refuse(str(error))

    def on_malformed(self, problem: str) -> None:
        """Take note of a malformed message."""
        self.stats.received += 1
        self._refuse(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Take note that the client was closed."""
        self._running = False
        self._forget()

    def _take_over(self, snapshot: StateSnapshot) -> None:
        if not self._free():
            if self._retry is None:
                self._retry = asyncio.get_running_loop().call_later(_RETRY_S, self._try_again)
            return
        try:
            self._snapshot = None
            self._absorb(snapshot)
        finally:
            self._lock.release()
        self.stats.absorbed += 1

    def _free(self) -> bool:
        """Acquire the lock, unless it is held, by this thread, too: a blocking call of its holder may run the loop."""
        owned: bool = self._lock._is_owned()  # type: ignore[attr-defined]  # noqa: SLF001 - as Condition does
        return not owned and self._lock.acquire(blocking=False)

    def _try_again(self) -> None:
        self._retry = None
        self.on_drained()

    def _refuse(self, problem: str) -> None:
        self.stats.refused += 1
        if not self._warned:
            self._warned = True
            log.warning("live state was not applied: %s More of these are only counted.", problem)

    def _forget(self) -> None:
        self._payload = self._snapshot = None
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None


class LatestPicture(MessageHandler):
    """The newest picture of a camera: from replies and, in live mode, by itself. Converted when somebody looks at it.

    Args:
        source: The camera.
    """

    def __init__(self, source: CameraSource) -> None:
        self._source = source
        self._lock = Lock()
        self._message: tuple[bytes, BytesLike] | None = None
        self._pixels: Pixels | None = None
        self._sim_time: float | None = None
        self._frame_id: int | None = None
        self._running = False
        self._warned = False

    def start(self) -> None:
        """Receive from now on; from the event loop. Idempotent."""
        if not self._running:
            try:
                self._source.attach(self)
            except (ProtocolError, ValueError) as error:  # the server says that they come from where nothing can
                log.warning("a camera's pictures are not received in the background: %s", error)
                return
            self._running = True

    def stop(self) -> None:
        """Receive no longer; from the event loop. Idempotent."""
        self._running = False
        self._source.detach(self)
        self.newest()  # what the camera is like now may not hold when somebody looks

    def deliver(self, pixels: Pixels, sim_time: float | None, frame_id: int | None = None) -> None:
        """Take over a picture that a reply carried."""
        with self._lock:
            self._message = None
            self._pixels, self._sim_time, self._frame_id = pixels, sim_time, frame_id

    @property
    def came(self) -> bool:
        """Whether there has been one."""
        return self._pixels is not None or self._message is not None

    def frame_id(self) -> int | None:
        """Return which snapshot of the state the newest picture shows, as far as it says so. From any thread."""
        self.newest()
        return self._frame_id

    def newest(self) -> tuple[Pixels | None, float | None]:
        """Return the newest picture and its simulation time, as far as there is one and it has one. From any thread."""
        with self._lock:
            if self._message is not None:
                (topic, payload), self._message = self._message, None
                try:
                    sample = self._source.decode(topic, payload)
                except MessageGone:
                    pass  # the one before it stays the newest
                except ProtocolError as error:
                    self._warn(str(error))
                else:
                    self._pixels, self._sim_time = sample.pixels, sample.sim_time
                    self._frame_id = sample.frame_id
            return self._pixels, self._sim_time

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        """Take one message."""
        if self._lock.acquire(blocking=False):  # held while converting: the next message will do as well
            self._message = topic, payload
            self._lock.release()

    def on_malformed(self, problem: str) -> None:
        """Take note of a malformed message."""
        self._warn(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Take note that the client was closed."""
        self._running = False

    def _warn(self, problem: str) -> None:
        if not self._warned:
            self._warned = True
            log.warning("skipped a malformed picture: %s More of them are skipped silently.", problem)
