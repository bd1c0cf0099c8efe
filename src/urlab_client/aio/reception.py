"""Live mode in the background: keeps the client's state current while physics runs by itself."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from threading import RLock

from msgspec import Struct

from urlab_client.aio.sources import StateSource
from urlab_client.protocol.errors import ProtocolError, URLabError
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.protocol.rows import BytesLike

__all__ = ["LiveReception", "ReceptionStats"]

log = logging.getLogger("urlab_client.streams")

_RETRY_S = 0.002


class ReceptionStats(Struct):
    """Counters of the background reception.

    Attributes:
        received: Snapshots that arrived.
        absorbed: Snapshots taken over; the others were superseded before their turn.
        refused: Snapshots that could not be decoded or do not fit the model.
    """

    received: int = 0
    absorbed: int = 0
    refused: int = 0


class LiveReception:
    """Takes over the newest snapshot of each batch, right where it is received: no task, no thread, no queue.

    Args:
        source: The state socket.
        absorb: Takes a snapshot over, whole or not at all. May raise `ProtocolError`.
        lock: Guards the state. It is never waited for here: its holder may be waiting for a call on this loop.

    Attributes:
        stats: Counters since it was made.
    """

    def __init__(self, source: StateSource, absorb: Callable[[StateSnapshot], None], lock: RLock) -> None:
        self.stats = ReceptionStats()
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

    def on_message(self, topic: bytes, payload: BytesLike) -> None:  # noqa: D102  # see `Sink`
        self.stats.received += 1
        self._payload = payload

    def on_drained(self) -> None:  # noqa: D102
        try:
            if self._payload is not None:
                payload, self._payload = self._payload, None
                self._snapshot = StateSnapshot.decode(payload)
            if self._snapshot is not None:
                self._take_over(self._snapshot)
        except ProtocolError as error:
            self._snapshot = None
            self._refuse(str(error))

    def on_malformed(self, problem: str) -> None:  # noqa: D102
        self.stats.received += 1
        self._refuse(problem)

    def on_lost(self) -> None:  # noqa: D102
        pass

    def on_gap(self, why: str) -> None:  # noqa: D102
        pass

    def on_end(self, error: Callable[[], URLabError]) -> None:  # noqa: D102
        self._running = False
        self._forget()

    def _take_over(self, snapshot: StateSnapshot) -> None:
        if not self._lock.acquire(blocking=False):
            if self._retry is None:
                self._retry = asyncio.get_running_loop().call_later(_RETRY_S, self._try_again)
            return
        try:
            self._snapshot = None
            self._absorb(snapshot)
        finally:
            self._lock.release()
        self.stats.absorbed += 1

    def _try_again(self) -> None:
        self._retry = None
        self.on_drained()

    def _refuse(self, problem: str) -> None:
        self.stats.refused += 1
        if not self._warned:
            self._warned = True
            log.warning("live state is not taken over: %s More of these are only counted.", problem)

    def _forget(self) -> None:
        self._payload = self._snapshot = None
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
