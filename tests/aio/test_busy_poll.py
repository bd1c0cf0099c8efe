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


class Machine:
    """Answers steps by a clock of its own: each takes what the way of waiting takes at that time."""

    def __init__(self, looks: BusyPoll, awake_s: float, asleep_s: float) -> None:
        self.looks, self.awake_s, self.asleep_s = looks, awake_s, asleep_s

    def steps(self, count: int) -> list[bool]:
        """Return whether the loop stayed awake for each of so many steps."""
        awake: list[bool] = []
        for _ in range(count):
            awake.append(self.looks.pays("step"))
            self.looks.note("step", self.awake_s if awake[-1] else self.asleep_s, awake=awake[-1])
        return awake


@pytest.mark.parametrize(
    ("awake_s", "asleep_s", "often", "trials"), [(100e-6, 150e-6, True, 50), (60e-6, 55e-6, False, 500)]
)
def test_the_loop_stays_awake_where_that_has_proved_quicker(
    awake_s: float, asleep_s: float, often: bool, trials: int
) -> None:
    machine = Machine(BusyPoll(SHORTEST, LONGEST), awake_s, asleep_s)
    machine.steps(20)
    assert 0 < machine.steps(10_000).count(not often) < trials, "now and then it does the other thing, to find out"


def test_it_learns_that_waking_up_has_become_quick() -> None:
    machine = Machine(BusyPoll(SHORTEST, LONGEST), 100e-6, 150e-6)
    assert machine.steps(2500)[-1]
    machine.asleep_s = 50e-6
    assert not machine.steps(2500)[-1]


def test_it_learns_that_waking_up_has_become_slow() -> None:
    machine = Machine(BusyPoll(SHORTEST, LONGEST), 600e-6, 55e-6)
    assert not machine.steps(2500)[-1]
    machine.awake_s, machine.asleep_s = 100e-6, 150e-6
    assert machine.steps(2500)[-1]


@pytest.mark.parametrize("disturbed_steps", [1, 5, 40, 300, 5000])
@pytest.mark.parametrize("slower", [(30, 1), (30, 30), (5, 2), (200, 1), (200, 200)])
def test_after_a_disturbance_it_stays_awake_again_within_a_hundred_steps(
    disturbed_steps: int, slower: tuple[float, float]
) -> None:
    machine = Machine(BusyPoll(SHORTEST, LONGEST), 100e-6, 150e-6)
    machine.steps(2000)
    machine.awake_s, machine.asleep_s = 100e-6 * slower[0], 150e-6 * slower[1]
    machine.steps(disturbed_steps)
    machine.awake_s, machine.asleep_s = 100e-6, 150e-6
    machine.steps(100)
    assert machine.steps(100).count(True) > 90


async def test_finding_out_takes_no_longer_than_the_reply_would_take() -> None:
    looks, asleep_s = BusyPoll(30.0, 30.0), 0.001
    machine = Machine(looks, 20 * asleep_s, asleep_s)
    assert not machine.steps(20)[-1]
    while not looks.pays("step"):
        machine.steps(1)
    reply = asyncio.get_running_loop().create_future()
    async with asyncio.timeout(10):
        await looks.look("step", reply, lambda: None)
    assert not reply.done()


def test_nobody_looks_where_processors_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "crowded", lambda: True)
    assert not BusyPoll(SHORTEST, LONGEST).pays("step")
