"""When the loop stays awake for a reply, and what others get of it meanwhile."""

from __future__ import annotations

import asyncio
import itertools

import pytest

from urlab_client.aio.transport import waiting
from urlab_client.aio.transport.waiting import BusyPoll

SHORTEST, LONGEST = 0.001, 0.01


@pytest.fixture(autouse=True)
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processors to spare, whatever this machine does."""
    monkeypatch.setattr(waiting, "crowded", lambda: False)


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
        looks.note("reset", 2 * LONGEST, awake=True)
    assert not looks.pays("reset")
    assert looks.pays("step")
    looks.note("reset", LONGEST / 2, awake=False)
    assert looks.pays("reset")


@pytest.mark.parametrize(("awake_s", "asleep_s", "often"), [(100e-6, 150e-6, True), (60e-6, 55e-6, False)])
def test_the_loop_stays_awake_where_that_has_proved_quicker(awake_s: float, asleep_s: float, often: bool) -> None:
    looks = BusyPoll(SHORTEST, LONGEST)

    def ask() -> bool:
        awake = looks.pays("step")
        looks.note("step", awake_s if awake else asleep_s, awake=awake)
        return awake

    for _ in range(20):
        ask()
    chosen = [ask() for _ in range(10_000)]
    assert 0 < chosen.count(not often) < 50, "now and then it does the other thing, to find out"


def test_it_learns_that_waking_up_has_become_quick() -> None:
    looks, asleep_s = BusyPoll(SHORTEST, LONGEST), 150e-6
    for i in range(5000):
        awake = looks.pays("step")
        if i == 2500:
            assert awake
            asleep_s = 50e-6
        looks.note("step", 100e-6 if awake else asleep_s, awake=awake)
    assert not looks.pays("step")


def test_it_learns_that_waking_up_has_become_slow() -> None:
    looks, asleep_s, awake_s = BusyPoll(SHORTEST, LONGEST), 55e-6, 600e-6
    for i in range(5000):
        awake = looks.pays("step")
        if i == 2500:
            assert not awake
            asleep_s, awake_s = 150e-6, 100e-6
        looks.note("step", awake_s if awake else asleep_s, awake=awake)
    assert looks.pays("step")


async def test_finding_out_takes_no_longer_than_the_reply_would_take() -> None:
    looks, asleep_s = BusyPoll(30.0, 30.0), 0.001
    for _ in range(5000):
        if looks.pays("step"):
            break
        looks.note("step", asleep_s, awake=False)
    assert looks.pays("step")
    for _ in range(20):  # the first ones stay awake
        looks.note("step", 20 * asleep_s, awake=True)
        looks.note("step", asleep_s, awake=False)
    reply = asyncio.get_running_loop().create_future()
    async with asyncio.timeout(10):
        await looks.look("step", reply, lambda: None)
    assert not reply.done()


def test_nobody_looks_where_processors_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "crowded", lambda: True)
    assert not BusyPoll(SHORTEST, LONGEST).pays("step")
