"""Streams that hand out at most so many items per second."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from urlab_client.aio.streams import handler
from urlab_client.aio.streams.handler import Source
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.errors import URLabTimeoutError
from urlab_client.events import ServerLost
from urlab_client.values.layouts import BytesLike


class Numbers(Source[ServerLost]):
    """A source of numbered items."""

    name = "numbers"
    handler: MessageHandler

    def attach(self, handler: MessageHandler) -> None:
        self.handler = handler

    def detach(self, handler: MessageHandler) -> None:
        pass

    def push(self, number: int) -> None:
        self.handler.on_message(b"", str(number).encode())
        self.handler.on_drained()

    def decode(self, topic: bytes, payload: BytesLike) -> ServerLost:
        return ServerLost(endpoint=bytes(payload).decode())

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        return "nothing.", ""


class Clock:
    """The clock of streams, which a test sets."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now

    def time_ns(self) -> int:
        return round(self.now * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(handler, "time", clock)
    return clock


def late(number: int) -> float:
    """How late a reader comes, seconds: never twice the same, up to nearly a period."""
    return number * 7 % 15 / 1000


@pytest.mark.parametrize("lateness", [lambda _: 0.0, late], ids=["prompt", "late"])
async def test_the_rate_holds_however_late_a_reader_comes(clock: Clock, lateness: Callable[[int], float]) -> None:
    source = Numbers()
    stream: Stream[Any] = Stream(source, policy="latest", max_rate=60)
    taken: list[Any] = []
    async with stream:
        looks_at = clock.now
        for millisecond in range(2000):
            clock.now = 100.0 + millisecond / 1000
            source.push(millisecond)
            if clock.now >= looks_at:
                item = stream.receive_nowait()
                if item is not None:
                    assert item.endpoint == str(millisecond), "the newest"
                    taken.append(item)
                    looks_at = clock.now + lateness(len(taken))
    assert len(taken) in range(119, 122)
    assert sum(item.dropped for item in taken) + len(taken) == taken[-1].seq


async def test_a_reader_who_stayed_away_is_not_overwhelmed_afterwards(clock: Clock) -> None:
    source = Numbers()
    stream: Stream[Any] = Stream(source, policy="latest", max_rate=10)
    async with stream:
        source.push(0)
        assert stream.receive_nowait() is not None
        clock.now += 60.0
        taken = 0
        for number in range(1, 101):
            clock.now += 0.001
            source.push(number)
            taken += stream.receive_nowait() is not None
    assert taken == 1


async def test_what_is_waited_for_is_the_newest_once_it_is_due() -> None:
    source = Numbers()
    stream: Stream[Any] = Stream(source, policy="latest", max_rate=20)
    async with stream:
        source.push(1)
        assert (await stream.receive()).endpoint == "1"
        source.push(2)
        waiting = asyncio.create_task(stream.receive())
        await asyncio.sleep(0)
        source.push(3)
        assert (await waiting).endpoint == "3"
        with pytest.raises(URLabTimeoutError):
            await stream.receive(timeout=0)
        source.push(4)
        source.handler.on_end(lambda: URLabTimeoutError("the end"))
        assert (await stream.receive()).endpoint == "4", "nothing delays the end"


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf")])
def test_nonsense_is_refused(rate: float) -> None:
    with pytest.raises(ValueError, match="above 0"):
        Stream(Numbers(), policy="latest", max_rate=rate)


@pytest.mark.parametrize("rate", ["60", [60]])
def test_what_is_no_number_is_refused(rate: Any) -> None:
    with pytest.raises(TypeError, match="max_rate takes a number above 0"):
        Stream(Numbers(), policy="latest", max_rate=rate)


def test_all_items_and_a_rate_contradict_each_other() -> None:
    with pytest.raises(ValueError, match="'latest'"):
        Stream(Numbers(), policy="all", max_rate=60)


async def test_a_stream_says_what_it_is() -> None:
    source = Numbers()
    stream: Stream[Any] = Stream(source, policy="latest", max_rate=60)
    assert "numbers latest at most 60 per s, idle" in repr(stream)
    async with stream:
        source.push(1)
        source.push(2)
        await stream.receive()
        assert repr(stream).endswith("open: 1 delivered, 1 dropped, 0 waiting>")
    assert "closed" in repr(stream)
