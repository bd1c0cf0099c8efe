"""The buffer between the wire and the reader of a stream. Plain data structures: no I/O, no clocks, no locks."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

from urlab_client.aio.arguments import integer
from urlab_client.protocol.messages.streams import StreamPolicy


@dataclass(slots=True, eq=False)
class BufferedMessage:
    """A message on its way to the reader.

    Attributes:
        topic: Topic.
        payload: Content, not decoded yet.
        size: Size of the content, bytes.
        seq: Sequence number among all pushed messages, from 1.
        dropped: Number of messages dropped before this one and counted here.
        gap: Reason why messages are missing before this one, or None.
        wall_ns: Time of arrival, UTC, nanoseconds.
        item: Decoded item; for the reader's use.
        malformed: Whether decoding failed; for the reader's use.
    """

    topic: bytes
    payload: Any
    size: int
    wall_ns: int
    seq: int
    dropped: int = 0
    gap: str | None = None
    item: Any = None
    malformed: bool = False


class StreamBuffer:
    """Buffered messages for one reader.

    Every loss is counted: a dropped message counts on the entry that replaces it, otherwise on the entry popped next,
    which also inherits its `gap`. Under `latest_per_key` a topic keeps its place in the queue when a newer message
    replaces the old one, so a busy topic neither starves nor overtakes the others.

    Beyond the limits the oldest message is dropped, so that a slow reader misses as little as possible. `latest` has no
    limits: it keeps one message of any size.

    Attributes:
        policy: Policy, as given.
        received: Number of pushed messages.
        received_bytes: Number of bytes of their content.
        dropped: Number of messages that will never be popped.
        size: Bytes of buffered content.
        newest: The entry pushed last, popped or not; None before the first, and after one too large to keep.
    """

    def __init__(self, policy: StreamPolicy, max_items: int, max_bytes: int) -> None:
        max_items, max_bytes = integer("buffer", max_items), integer("buffer_bytes", max_bytes)
        if max_items < 1 or max_bytes < 1:
            raise ValueError(f"a buffer must hold at least one item and one byte, not {max_items} and {max_bytes}")
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
        """Add a message, and drop others as the policy and the limits require."""
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
        if not self._waiting:
            return None
        entry = self._waiting.popitem(last=False)[1]
        self.size -= entry.size
        return entry

    def reject(self) -> None:
        """Count a message that is malformed on arrival."""
        self.received += 1
        self._carried += 1

    def note_gap(self, why: str) -> None:
        """Mark the next pushed message: others are missing before it."""
        self._carried_gap = why

    def take_overflow(self) -> int:
        """Return the number of messages dropped because of the limits since the last call."""
        lost, self._overflowed = self._overflowed, 0
        return lost

    def clear(self) -> None:
        """Drop all buffered messages."""
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
        self.skip(entry)

    def skip(self, entry: BufferedMessage) -> None:
        """Let the next entry inherit the losses of one that was removed and cannot be read."""
        following = next(iter(self._waiting.values()), None)
        if following is None:
            self._carried += entry.dropped + 1
            self._carried_gap = self._carried_gap or entry.gap
        else:
            following.dropped += entry.dropped + 1
            following.gap = following.gap or entry.gap
