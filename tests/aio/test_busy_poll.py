"""When the loop stays awake for a reply, and what others get of it meanwhile."""

from __future__ import annotations

import asyncio
import itertools

import pytest

from urlab_client.aio.transport import busy_poll
from urlab_client.aio.transport.busy_poll import BusyPoll

SHORTEST, LONGEST = 0.001, 0.01


@pytest.fixture(autouse=True)
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processors to spare, whatever this machine does."""
    monkeypatch.setattr(busy_poll, "crowded", lambda: False)


async def test_a_look_is_taken_even_where_time_is_up() -> None:
    reply = asyncio.get_running_loop().create_future()
    await BusyPoll(0.0, 0.0).look("meta", reply, lambda: reply.set_result("there"))
    assert reply.result() == "there"


async def test_looking_ends_when_nothing_comes() -> None:
    reply = asyncio.get_running_loop().create_future()
    async with asyncio.timeout(10):
        await BusyPoll(SHORTEST, LONGEST).look("meta", reply, lambda: None)
    assert not reply.done()
    assert BusyPoll(SHORTEST, LONGEST).pays("meta"), "somebody else may look now"


async def test_between_two_looks_other_tasks_have_their_turns() -> None:
    reply, turns, seen = asyncio.get_running_loop().create_future(), 0, list[int]()

    async def others() -> None:
        nonlocal turns
        while not reply.done():
            turns += 1
            await asyncio.sleep(0)

    def look() -> None:
        seen.append(turns)
        if len(seen) == 5:
            reply.set_result(None)

    other = asyncio.create_task(others())
    await BusyPoll(30.0, 30.0).look("meta", reply, look)
    await other
    assert all(later > earlier for earlier, later in itertools.pairwise(seen))


async def test_one_looks_at_a_time() -> None:
    reply, paid = asyncio.get_running_loop().create_future(), list[bool]()

    def look() -> None:
        paid.append(BusyPoll(SHORTEST, LONGEST).pays("meta"))
        reply.set_result(None)

    await BusyPoll(SHORTEST, LONGEST).look("meta", reply, look)
    assert paid == [False]


def test_ops_that_take_long_are_not_looked_for_until_one_is_quick_again() -> None:
    looks = BusyPoll(SHORTEST, LONGEST)
    for _ in range(4):
        assert looks.pays("reset")
        looks.note("reset", 2 * LONGEST)
    assert not looks.pays("reset")
    assert looks.pays("step")
    looks.note("reset", LONGEST / 2)
    assert looks.pays("reset")


def test_nobody_looks_where_processors_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(busy_poll, "crowded", lambda: True)
    assert not BusyPoll(SHORTEST, LONGEST).pays("step")
