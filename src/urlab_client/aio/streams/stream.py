"""Streams of published data, as asynchronous iterators that are also context managers."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Generic, Self, SupportsFloat, TypeVar

from urlab_client.aio.arguments import require
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.streams.buffer import StreamBuffer
from urlab_client.aio.streams.handler import Source, StreamHandler
from urlab_client.errors import URLabError
from urlab_client.protocol.messages.streams import StreamItem, StreamPolicy, StreamPolicyName, StreamStats
from urlab_client.values.names import Local

T = TypeVar("T", bound=StreamItem)

BUFFER_ITEMS = 1000
"""Default limit of a stream's buffer, items."""

BUFFER_BYTES = 64 * 1024 * 1024
"""Default limit of a stream's buffer, bytes."""


class LocalStream(Local, Generic[T]):
    """What both clients share of `Stream`: everything that does not wait."""

    __slots__ = ()

    _state: StreamHandler[T]

    @property
    def closed(self) -> bool:
        """Whether the reader closed the stream."""
        return self._state.closed

    @property
    def stats(self) -> StreamStats:
        """Counters up to now."""
        return self._state.stats()

    def latest(self) -> T | None:
        """Return the newest item without waiting and without removing it from the buffer; None before the first.

        The reader gets the same object.
        """
        return self._state.latest()

    def receive_nowait(self) -> T | None:
        """Return the next item if one is buffered, otherwise None.

        Returns None before the stream is opened and after it is closed.

        Raises:
            StreamOverflow: Items were lost; see the class.
            ConcurrentReadError: Another reader is waiting for the next item.
            ClientClosed: The client was closed and all items that had arrived have been read.
        """
        try:
            return self._state.receive_nowait()
        except StopAsyncIteration:
            return None

    def __repr__(self) -> str:
        return repr(self._state)


class Stream(LocalStream[T], Generic[T]):
    """Items that the server publishes, as they arrive.

    The stream opens on first use or on entering a `with` block, and reconnects automatically. Iteration ends when the
    stream is closed, and, after the items that had arrived, when the client is closed.

    The policy decides which items are kept for a busy reader. `latest` keeps the newest item. `latest_per_key` keeps
    the newest of each topic. `all` keeps everything up to a limit; beyond it the oldest items are lost and the next
    read raises `StreamOverflow` once. The stream continues after that, as after `URLabTimeoutError`.

    Each item has `seq`, `dropped` and `gap`, which show what the reader missed. Losses before an item reaches this
    process, in the queues of the server or the network, cannot be detected: messages on the wire are not numbered.

    Only one reader at a time may wait for items. `latest`, `stats` and `closed` may be used from anywhere. Items are
    decoded only when they are read.

    Example:
        async with client.state_stream() as states:
            async for state in states:
                print(state.time, state.per_articulation["arm"].qpos)
    """

    def __init__(
        self,
        source: Source[T],
        *,
        policy: StreamPolicy | StreamPolicyName,
        buffer: int = BUFFER_ITEMS,
        buffer_bytes: int = BUFFER_BYTES,
        timeout: Timeout = DEFAULT,
        default_timeout: float | None = None,
        max_rate: float | None = None,
        eager: bool = False,
        tolerant: bool = False,
    ) -> None:
        """Create a stream. It receives nothing before its first use.

        Args:
            source: Source of the messages.
            policy: Which items to keep for a busy reader.
            buffer: Maximum number of buffered items.
            buffer_bytes: Maximum number of buffered bytes.
            timeout: Seconds that iteration waits for an item; by default `default_timeout` for the first item and no
                limit after that.
            default_timeout: Seconds that `receive` waits by default; None waits without limit.
            max_rate: Maximum number of items per second, with policy `latest`; None for no limit.
            eager: Start receiving immediately. The source must allow that from any thread.
            tolerant: Report an overflow only in `dropped` of the next item.

        Raises:
            ValueError: The policy is unknown, a limit is below 1, or `max_rate` is not above 0 or used with another
                policy than `latest`.
        """
        kept = StreamBuffer(StreamPolicy(policy), buffer, buffer_bytes)
        if max_rate is not None and kept.policy is not StreamPolicy.LATEST:
            raise ValueError(f"max_rate requires policy 'latest', which skips items; {kept.policy.value!r} keeps them")
        if max_rate is not None:
            require("max_rate", max_rate, SupportsFloat, "a number above 0")
            if not 0 < float(max_rate) < math.inf:
                raise ValueError(f"max_rate must be a number above 0, got {max_rate}")
        super().__init__(
            StreamHandler(
                source, kept, tolerant=tolerant, timeout=timeout, default_timeout=default_timeout, max_rate=max_rate
            )
        )
        if eager:
            self._state.attach()

    async def receive(self, *, timeout: Timeout = DEFAULT) -> T:
        """Return the next item.

        Args:
            timeout: Seconds to wait; None waits without limit. The default is the client's `rcv_timeout_ms`; it is at
                least 30 s while a server in live mode may still be preparing its first picture.

        Raises:
            URLabTimeoutError: No item arrived in time; the message names the stage that failed and what to check.
            StreamOverflow: Items were lost; see the class.
            ConcurrentReadError: Another reader is waiting for the next item.
            ClientClosed: The client was closed and all items that had arrived have been read.
            URLabError: The stream was closed.
        """
        try:
            return await self._state.receive(timeout)
        except StopAsyncIteration:
            raise self._was_closed() from None

    async def aclose(self) -> None:
        """Stop receiving and discard buffered items. A running iteration ends. Idempotent."""
        self._state.close()

    async def __aenter__(self) -> Self:
        try:
            self._state.open()
        except StopAsyncIteration:
            raise self._was_closed() from None
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._state.close()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> T:
        """Return the next item; see `receive` for the errors. A closed client ends the iteration."""
        return await self._state.next()

    def __del__(self) -> None:
        handler: StreamHandler[T] | None = getattr(self, "_state", None)  # None if the constructor failed
        if handler is not None:
            handler.abandon()

    def _was_closed(self) -> URLabError:
        return URLabError("The stream was closed.", hint="Open a new one.")
