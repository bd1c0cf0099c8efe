"""Background reception in live mode: keeps the client's state current while physics runs on its own."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from threading import RLock

from msgspec import Struct

from urlab_client.aio.streams.sources import StateSource
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.errors import ProtocolError, URLabError
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.streams")

_RETRY_S = 0.002


class LiveStats(Struct):
    """Counters of the background reception.

    Attributes:
        received: Snapshots that arrived.
        absorbed: Snapshots applied; the others were superseded first.
        refused: Snapshots that could not be decoded or did not fit the model.
    """

    received: int = 0
    absorbed: int = 0
    refused: int = 0


class LiveState(MessageHandler):
    """Applies the newest snapshot of each batch in the receiving callback, without a task, thread or queue.

    Attributes:
        stats: Counters since construction.
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
        return self._running

    def start(self) -> None:
        """Start receiving. Call from the event loop. Idempotent."""
        if not self._running:
            self._source.attach(self)
            self._running = True
            self._warned = False

    def stop(self) -> None:
        """Stop receiving. Call from the event loop. Idempotent."""
        self._running = False
        self._source.detach(self)
        self._forget()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        self.stats.received += 1
        if self._source.wants(topic, payload):
            self._payload = payload

    def on_drained(self) -> None:
        try:
            if self._payload is not None:
                payload, self._payload = self._payload, None
                self._snapshot = StateSnapshot.decode(payload)
            if self._snapshot is not None:
                self._apply(self._snapshot)
        except ProtocolError as error:
            self._snapshot = None
            self._refuse(str(error))

    def on_malformed(self, problem: str) -> None:
        self.stats.received += 1
        self._refuse(problem)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self._running = False
        self._forget()

    def _apply(self, snapshot: StateSnapshot) -> None:
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
        """Try to acquire the lock. Fails if this thread owns it: a blocking call of its holder may run the loop."""
        owned: bool = self._lock._is_owned()  # type: ignore[attr-defined]  # noqa: SLF001 - as Condition does
        return not owned and self._lock.acquire(blocking=False)

    def _try_again(self) -> None:
        self._retry = None
        self.drain()

    def _refuse(self, problem: str) -> None:
        self.stats.refused += 1
        if not self._warned:
            self._warned = True
            log.warning("live state was not applied: %s Further failures are only counted.", problem)

    def _forget(self) -> None:
        self._payload = self._snapshot = None
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
