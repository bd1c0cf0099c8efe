"""What a stream keeps between the wire and its reader. Plain data structures: no I/O, no clocks, no locks."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from urlab_client.aio.arguments import integer
from urlab_client.protocol.messages.streams import StreamPolicy

__all__ = ["BufferedMessage", "StreamBuffer"]


class BufferedMessage:
    """A message on its way to the reader.

    Attributes:
        topic: Its topic.
        payload: Its content, not decoded yet.
        size: Bytes of the content.
        seq: Its number among all messages pushed, from 1.
        dropped: Messages pushed before this one that it stands for: they will never be popped.
        gap: Why messages are missing before this one, or None.
        wall_ns: When it arrived, UTC, nanoseconds.
        item: What it was decoded to; for the reader's use.
        malformed: Whether decoding it failed; for the reader's use.
    """

    __slots__ = ("dropped", "gap", "item", "malformed", "payload", "seq", "size", "topic", "wall_ns")

    def __init__(self, topic: bytes, payload: Any, size: int, wall_ns: int, seq: int) -> None:
        self.topic: bytes = topic
        self.payload: Any = payload
        self.size: int = size
        self.wall_ns: int = wall_ns
        self.seq: int = seq
        self.dropped: int = 0
        self.gap: str | None = None
        self.item: Any = None
        self.malformed: bool = False


class StreamBuffer:
    """Messages that wait for one reader.

    Nothing is lost without a trace: what is dropped is counted on the entry that takes its place, else on the one
    popped next, which also takes over its `gap`. Under `latest_per_key` a topic keeps its place in the queue when a
    newer message takes over, so that a busy topic neither starves nor overtakes the others.

    When the limits are exceeded the oldest message gives way, so that a reader who falls behind misses as little as
    possible. `latest` has no limits: it keeps one message, however large.

    Args:
        policy: What to keep.
        max_items: Messages to keep at most.
        max_bytes: Bytes of content to keep at most; a larger message is never kept.

    Attributes:
        policy: As given.
        received: Messages pushed.
        received_bytes: Bytes of their content.
        dropped: Messages that will never be popped.
        size: Bytes of content now waiting.
        newest: The entry pushed last, popped or not; None before the first, and after one too large to keep.
    """

    def __init__(self, policy: StreamPolicy, max_items: int, max_bytes: int) -> None:
        max_items, max_bytes = integer("buffer", max_items), integer("buffer_bytes", max_bytes)
        if max_items < 1 or max_bytes < 1:
            raise ValueError(f"a buffer holds at least one item and one byte, not {max_items} and {max_bytes}")
        self.policy = policy
        self._max_items = max_items
        self._max_bytes = max_bytes
        self._waiting: OrderedDict[bytes | int, BufferedMessage] = OrderedDict()
        self._carried = 0
        self._carried_gap: str | None = None
        self._overflowed = 0
        self.received: int = 0
        self.received_bytes: int = 0
        self.dropped: int = 0
        self.size: int = 0
        self.newest: BufferedMessage | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, topic: bytes, payload: Any, size: int, wall_ns: int = 0) -> None:
        """Add a message, and drop what the policy and the limits say."""
        self.received += 1
        self.received_bytes += size
        entry = BufferedMessage(topic, payload, size, wall_ns, self.received)
        entry.dropped, self._carried = self._carried, 0
        entry.gap, self._carried_gap = self._carried_gap, None
        policy = self.policy
        key = topic if policy is StreamPolicy.LATEST_PER_KEY else self.received if policy is StreamPolicy.ALL else 0
        old = self._waiting.get(key)
        if old is not None:
            self.dropped += 1
            self.size -= old.size
            entry.dropped += old.dropped + 1
            entry.gap = entry.gap or old.gap
        self._waiting[key] = self.newest = entry
        self.size += size
        if policy is not StreamPolicy.LATEST:
            while len(self._waiting) > self._max_items or self.size > self._max_bytes:
                self._evict()

    def pop(self) -> BufferedMessage | None:
        """Take the next entry out; None if nothing waits."""
        if not self._waiting:
            return None
        entry = self._waiting.popitem(last=False)[1]
        self.size -= entry.size
        return entry

    def skip(self, entry: BufferedMessage) -> None:
        """Hand what a popped entry says about losses on to the next one: it turned out to be of no use."""
        self._hand_on(entry)

    def reject(self) -> None:
        """Count a message that is of no use from the start."""
        self.received += 1
        self._carried += 1

    def note_gap(self, why: str) -> None:
        """Say of the next message pushed that others are missing before it."""
        self._carried_gap = why

    def take_overflow(self) -> int:
        """Return how many messages gave way to the limits since this was asked last."""
        lost, self._overflowed = self._overflowed, 0
        return lost

    def clear(self) -> None:
        """Drop everything that waits."""
        self.dropped += len(self._waiting)
        self._waiting.clear()
        self.size = 0
        self.newest = None

    def _evict(self) -> None:
        entry = self._waiting.popitem(last=False)[1]
        self.size -= entry.size
        self.dropped += 1
        self._overflowed += 1
        if entry is self.newest:
            self.newest = None
        self._hand_on(entry)

    def _hand_on(self, entry: BufferedMessage) -> None:
        heir = next(iter(self._waiting.values()), None)
        if heir is None:
            self._carried += entry.dropped + 1
            self._carried_gap = self._carried_gap or entry.gap
        else:
            heir.dropped += entry.dropped + 1
            heir.gap = heir.gap or entry.gap
