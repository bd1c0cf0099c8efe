"""The reader's end of a stream: its source, its buffer, its waiting reader and its end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from urlab_client.aio.background import running_loop
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.streams.buffer import BufferedMessage, StreamBuffer
from urlab_client.aio.transport.shm_regions import MessageGone
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.errors import (
    ClientClosed,
    ConcurrentReadError,
    ProtocolError,
    StreamOverflow,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.protocol.messages.streams import StreamItem, StreamStats
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.streams")

T = TypeVar("T", bound=StreamItem)
T_co = TypeVar("T_co", bound=StreamItem, covariant=True)


class Source(ABC, Generic[T_co]):
    """Origin of a stream's messages, which also decodes them."""

    name: str
    """Name of the call that created the stream, for messages."""

    @abstractmethod
    def attach(self, handler: StreamHandler[Any]) -> None:
        """Start passing messages to `handler`, from the event loop."""

    @abstractmethod
    def detach(self, handler: StreamHandler[Any]) -> None:
        """Stop passing messages to `handler`. Idempotent."""

    @abstractmethod
    def decode(self, topic: bytes, payload: Any) -> T_co:
        """Decode what was passed into an item. Raises `ProtocolError` if it is malformed."""

    @abstractmethod
    def silence(self, handler: StreamHandler[Any], seconds: float) -> tuple[str, str]:
        """Return why no message arrived for `seconds`, and what to do about it."""

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether a message is relevant to the reader."""
        return True

    def parts(self, topic: bytes, payload: BytesLike) -> Iterable[tuple[bytes, BytesLike]]:
        """Return what the reader wants of a message, each with its topic. Raises `ProtocolError` if it is malformed."""
        return ((topic, payload),) if self.wants(topic, payload) else ()

    def first_after(self, handler: StreamHandler[Any]) -> float:
        """Return the seconds that the first item may take to arrive; 0 if no delay is expected."""
        return 0.0


class StreamHandler(MessageHandler, Generic[T]):
    """Buffer, reader and end of one stream.

    The receiver holds a reference to this object, which holds none to the stream. A stream that is dropped without
    being closed can therefore be garbage-collected, and stops receiving then.

    Messages are pushed on the event loop. The façade calls methods that do not wait from any thread, so a lock guards
    the buffer and the counters. It is never held while decoding.
    """

    def __init__(
        self,
        source: Source[T],
        buffer: StreamBuffer,
        *,
        tolerant: bool,
        timeout: Timeout,
        default_timeout: float | None,
        max_rate: float | None,
    ) -> None:
        self.closed: bool = False
        self._source = source
        self._buffer = buffer
        self._tolerant = tolerant
        self._timeout = timeout
        self._default_timeout = default_timeout
        self._period = 0.0 if max_rate is None else 1.0 / max_rate
        self._due = -math.inf  # monotonic time at which the next item may be delivered
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._attached = False
        self._reading = self._expired = self._warned = False
        self._waiter: asyncio.Future[None] | None = None
        self._end: Callable[[], URLabError] | None = None
        self._last: T | None = None
        self._arrived: float | None = None
        self._delivered = self._malformed = self._gaps = 0

    # Called by the source

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        try:
            for name, part in self._source.parts(topic, payload):
                self.push(name, part, len(part))
        except ProtocolError as error:
            self.on_malformed(str(error))

    def push(self, topic: bytes, payload: object, size: int) -> None:
        """Keep what the source will decode, as the policy says."""
        now, wall_ns = time.monotonic(), time.time_ns()
        with self._lock:
            self._arrived = now
            self._buffer.push(topic, payload, size, wall_ns)

    def on_malformed(self, problem: str) -> None:
        with self._lock:
            self._buffer.reject()
            self._malformed += 1
        self._warn(problem)

    def on_drained(self) -> None:
        if self._early_by() <= 0.0:
            self._wake()

    def on_gap(self, why: str) -> None:
        with self._lock:
            self._gaps += 1
            self._buffer.note_gap(why)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self._end = error
        self._wake()

    # Called by the reader

    def open(self) -> None:
        if self.closed:
            raise StopAsyncIteration
        self._loop = running_loop(self._loop, f"{self._source.name}: this stream")
        self.attach()

    def attach(self) -> None:
        if not self._attached and self._end is None:
            self._source.attach(self)
            self._attached = True

    async def next(self) -> T:
        try:
            return await self.receive(None if self._timeout is DEFAULT and self._delivered else self._timeout)
        except ClientClosed:
            raise StopAsyncIteration from None

    async def receive(self, timeout: Timeout) -> T:
        """Return the next item within `timeout` seconds."""
        self._refuse_second_reader()
        self._reading = True
        try:
            self.open()
            item = self._take()
            return await self._wait(timeout) if item is None else item
        finally:
            self._reading = False

    def receive_nowait(self) -> T | None:
        self._refuse_second_reader()
        return self._take()

    def latest(self) -> T | None:
        """Return the newest item without removing it from the buffer."""
        with self._lock:
            entry = self._buffer.newest
            last = self._last
        if entry is None:
            return last
        item = self._decoded(entry)
        return last if item is None else item

    def stats(self) -> StreamStats:
        with self._lock:
            buffer = self._buffer
            return StreamStats(
                received=buffer.received,
                delivered=self._delivered,
                dropped=buffer.dropped,
                malformed=self._malformed,
                waiting=len(buffer),
                gaps=self._gaps,
                received_bytes=buffer.received_bytes,
                last_age_s=None if self._arrived is None else time.monotonic() - self._arrived,
            )

    def close(self) -> None:
        """Stop receiving. Call it on the event loop."""
        if self.closed:
            return
        self.closed = True
        self._source.detach(self)
        with self._lock:
            self._buffer.clear()
        self._wake()

    def abandon(self) -> None:
        """Stop receiving. May be called from any thread, by the garbage collector."""
        if self.closed or not self._attached:
            return
        if self._loop is None:
            self._source.detach(self)
        else:
            with contextlib.suppress(RuntimeError):  # the loop is closed, so nothing receives
                self._loop.call_soon_threadsafe(self._source.detach, self)

    def __repr__(self) -> str:
        stats = self.stats()
        state = "closed" if self.closed else "ended" if self._end is not None else "open" if self._attached else "idle"
        counts = f"{stats.delivered} delivered, {stats.dropped} dropped, {stats.waiting} waiting"
        rate = f" at most {1.0 / self._period:g} per s" if self._period else ""
        return f"<Stream {self._source.name} {self._buffer.policy}{rate}, {state}: {counts}>"

    def _early_by(self) -> float:
        """Return the seconds left until the next item may be delivered."""
        return self._due - time.monotonic() if self._period and self._end is None else 0.0

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)

    def _refuse_second_reader(self) -> None:
        if self._reading:
            raise ConcurrentReadError(
                f"{self._source.name}: another reader is already waiting for the next item of this stream.",
                hint="Open a stream for each reader; all streams share one connection.",
            )

    def _take(self) -> T | None:
        """Return the next item, or None if there is none yet; raise the error that ended the stream."""
        while True:
            if self.closed:
                raise StopAsyncIteration
            early = self._early_by() > 0.0
            with self._lock:
                lost = self._buffer.take_overflow()
                entry = None if early or (lost and not self._tolerant) else self._buffer.pop()
                waiting = len(self._buffer)
            if lost and not self._tolerant:
                raise StreamOverflow(
                    f"{self._source.name}: the reader fell behind: {lost} messages were lost, {waiting} are buffered.",
                    lost=lost,
                    hint="Reading continues with the oldest buffered item. Read faster, or pass a larger buffer=….",
                )
            if entry is None:
                if self._end is not None:
                    raise self._end()
                return None
            item = self._decoded(entry)
            with self._lock:
                if item is None:
                    self._malformed += 1
                    self._buffer.skip(entry)
                    continue
                self._delivered += 1
            if self._period:
                # Counted from the due time, not from the read: otherwise each late wake-up would lower the rate.
                now = time.monotonic()
                self._due = (self._due if now - self._due < self._period else now) + self._period
            # Messages before it may have been lost since `latest` decoded it.
            item.dropped, item.gap = entry.dropped, entry.gap
            return item

    def _decoded(self, entry: BufferedMessage) -> T | None:
        """Return the item of a message, or None if it is malformed."""
        with self._lock:
            if entry.item is not None or entry.malformed:
                return entry.item
            payload = entry.payload
        try:
            item = self._source.decode(entry.topic, payload)
        except ProtocolError as error:
            entry.malformed = True
            if not isinstance(error, MessageGone):
                self._warn(str(error))
            return None
        item.seq, item.dropped, item.gap, item.recv_wall_time_ns = entry.seq, entry.dropped, entry.gap, entry.wall_ns
        with self._lock:
            if entry.item is None:
                entry.item, entry.payload = item, None
                if self._last is None or self._last.seq < item.seq:
                    self._last = item
            return entry.item

    async def _wait(self, timeout: Timeout) -> T:
        loop = asyncio.get_running_loop()
        seconds = self._default_timeout if timeout is DEFAULT else timeout
        self._expired = False
        timer = None if seconds is None else loop.call_later(seconds, self._expire)
        pace: asyncio.TimerHandle | None = None
        try:
            while True:
                self._waiter = loop.create_future()
                if (early := self._early_by()) > 0.0:
                    pace = loop.call_later(early, self._wake)
                await self._waiter
                item = self._take()
                if item is not None:
                    return item
                if self._expired and seconds is not None:
                    more = self._source.first_after(self) - seconds
                    if timeout is DEFAULT and self._arrived is None and more > 0.0:
                        self._expired = False
                        seconds += more
                        timer = None if math.isinf(more) else loop.call_later(more, self._expire)
                        continue
                    problem, advice = self._source.silence(self, seconds)
                    raise URLabTimeoutError(f"{self._source.name}: {problem}", hint=advice)
        finally:
            self._waiter = None
            for pending in (timer, pace):
                if pending is not None:
                    pending.cancel()

    def _expire(self) -> None:
        self._expired = True
        self._wake()

    def _warn(self, problem: str) -> None:
        if not self._warned:
            self._warned = True
            log.warning("%s: skipped a malformed message: %s Later ones are only counted.", self._source.name, problem)
