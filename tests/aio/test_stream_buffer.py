"""What waits for a reader: bounded, in order, and no loss without a trace."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from urlab_client.aio.streams.buffer import BufferedMessage, StreamBuffer
from urlab_client.protocol.messages.streams import StreamPolicy

TOPICS = [b"a", b"b", b"c"]


class Buffers(RuleBasedStateMachine):
    """Any order of arrivals and reads."""

    @initialize(policy=st.sampled_from(StreamPolicy), max_items=st.integers(1, 4), max_bytes=st.integers(1, 24))
    def make(self, policy: StreamPolicy, max_items: int, max_bytes: int) -> None:
        self.policy, self.max_items, self.max_bytes = policy, max_items, max_bytes
        self.buffer = StreamBuffer(policy, max_items, max_bytes)
        self.waiting: list[tuple[bytes, int, int]] = []  # topic, number, size: what a careful reader would expect
        self.received = self.useless = self.delivered = self.lost = self.overflow = 0
        self.last_seq = 0
        self.gaps: list[int] = []  # numbers of the messages that have one before them

    def expected_after(self, topic: bytes, size: int) -> None:
        message = (topic, self.received, size)
        if self.policy is StreamPolicy.LATEST:
            self.waiting = [message]
            return
        places = [i for i, (other, _, _) in enumerate(self.waiting) if other == topic]
        if self.policy is StreamPolicy.LATEST_PER_KEY and places:
            self.waiting[places[0]] = message
        else:
            self.waiting.append(message)
        while len(self.waiting) > self.max_items or sum(size for _, _, size in self.waiting) > self.max_bytes:
            del self.waiting[0]
            self.overflow += 1

    @rule(topic=st.sampled_from(TOPICS), size=st.integers(0, 12))
    def push(self, topic: bytes, size: int) -> None:
        self.received += 1
        if self.gaps and self.gaps[-1] == 0:
            self.gaps[-1] = self.received
        self.expected_after(topic, size)
        self.buffer.push(topic, b"payload", size)

    @rule()
    def reject(self) -> None:
        self.received += 1
        self.useless += 1
        self.buffer.reject()

    @rule()
    def gap(self) -> None:
        if not self.gaps or self.gaps[-1]:
            self.gaps.append(0)
        self.buffer.note_gap("reconnected")

    @rule()
    def pop(self) -> None:
        entry = self.take()
        if entry is not None:
            self.check_delivered(entry)

    @rule()
    def pop_something_useless(self) -> None:
        entry = self.take()
        if entry is not None:
            self.useless += 1
            self.buffer.skip(entry)

    @rule()
    def notice_overflow(self) -> None:
        assert self.buffer.take_overflow() == self.overflow
        self.overflow = 0

    def take(self) -> BufferedMessage | None:
        entry = self.buffer.pop()
        expected = self.waiting.pop(0) if self.waiting else None
        assert (None if entry is None else (entry.topic, entry.seq, entry.size)) == expected
        return entry

    def check_delivered(self, entry: BufferedMessage) -> None:
        self.delivered += 1
        self.lost += entry.dropped
        if self.policy is not StreamPolicy.LATEST_PER_KEY:
            assert entry.dropped == entry.seq - self.last_seq - 1
            crossed = [seq for seq in self.gaps if self.last_seq < seq <= entry.seq]
            assert bool(crossed) == (entry.gap is not None)
        self.last_seq = entry.seq

    @precondition(lambda self: hasattr(self, "buffer"))
    @invariant()
    def bounded_and_accounted_for(self) -> None:
        buffer = self.buffer
        assert buffer.received == self.received
        assert len(buffer) == len(self.waiting)
        assert buffer.size == sum(size for _, _, size in self.waiting)
        if self.policy is not StreamPolicy.LATEST:
            assert len(buffer) <= self.max_items
            assert buffer.size <= self.max_bytes
        assert buffer.received == self.delivered + self.useless + buffer.dropped + len(buffer)

    def teardown(self) -> None:
        """What was delivered says, all in all, how much was not."""
        if not hasattr(self, "buffer"):
            return
        while (entry := self.take()) is not None:
            self.check_delivered(entry)
        self.push(b"last", 1)
        self.check_delivered(self.take() or BufferedMessage(b"", b"", 0, 0, 0))
        assert self.delivered + self.lost == self.received


TestBuffers = Buffers.TestCase
TestBuffers.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_a_topic_keeps_its_place_when_a_newer_message_takes_over() -> None:
    buffer = StreamBuffer(StreamPolicy.LATEST_PER_KEY, 10, 1000)
    for topic in b"a", b"b", b"a", b"c", b"a":
        buffer.push(topic, b"", 0)
    entries = [buffer.pop() for _ in range(3)]
    assert [(e.topic, e.seq, e.dropped) for e in entries if e] == [(b"a", 5, 2), (b"b", 2, 0), (b"c", 4, 0)]


def test_a_message_larger_than_the_buffer_is_lost_with_what_it_pushed_out() -> None:
    buffer = StreamBuffer(StreamPolicy.ALL, 10, 100)
    buffer.push(b"a", b"", 60)
    buffer.push(b"a", b"", 101)
    assert (len(buffer), buffer.take_overflow(), buffer.take_overflow()) == (0, 2, 0)
    buffer.push(b"a", b"", 100)
    entry = buffer.pop()
    assert entry is not None
    assert (entry.seq, entry.dropped) == (3, 2)


def test_latest_keeps_one_message_however_large() -> None:
    buffer = StreamBuffer(StreamPolicy.LATEST, 1, 1)
    buffer.push(b"a", b"", 1000)
    assert len(buffer) == 1


@pytest.mark.parametrize("policy", [StreamPolicy.LATEST, StreamPolicy.LATEST_PER_KEY])
def test_a_gap_is_told_with_what_took_over(policy: StreamPolicy) -> None:
    buffer = StreamBuffer(policy, 10, 1000)
    buffer.note_gap("reconnected")
    for _ in range(3):
        buffer.push(b"a", b"", 0)
    buffer.push(b"a", b"", 0)
    entry = buffer.pop()
    assert entry is not None
    assert (entry.seq, entry.dropped, entry.gap) == (4, 3, "reconnected")
    buffer.push(b"a", b"", 0)
    entry = buffer.pop()
    assert entry is not None
    assert entry.gap is None


@pytest.mark.parametrize("policy", [StreamPolicy.LATEST, StreamPolicy.LATEST_PER_KEY])
@pytest.mark.parametrize("before", [None, "moved"])
def test_a_gap_right_before_what_took_over_is_told(policy: StreamPolicy, before: str | None) -> None:
    buffer = StreamBuffer(policy, 10, 1000)
    if before:
        buffer.note_gap(before)
    buffer.push(b"a", b"", 0)
    buffer.note_gap("reconnected")
    buffer.push(b"a", b"", 0)
    entry = buffer.pop()
    assert entry is not None
    assert (entry.seq, entry.dropped, entry.gap) == (2, 1, "reconnected"), "the latest gap is told"


@pytest.mark.parametrize("limits", [(0, 1), (1, 0)])
def test_a_buffer_without_room_is_refused(limits: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="at least one item and one byte"):
        StreamBuffer(StreamPolicy.ALL, *limits)
