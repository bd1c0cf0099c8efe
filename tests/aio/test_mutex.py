"""The lock that requests and turns wait for: fair, and never lost with a task that is cancelled."""

from __future__ import annotations

import asyncio

import pytest

from urlab_client.aio.session.turn import Mutex


async def waiting(mutex: Mutex, order: list[str], name: str) -> asyncio.Task[None]:
    async def take() -> None:
        await mutex.acquire()
        order.append(name)
        mutex.release()

    task = asyncio.create_task(take())
    await asyncio.sleep(0)
    return task


async def test_it_is_handed_on_in_the_order_of_asking() -> None:
    mutex, order = Mutex(), list[str]()
    assert mutex.acquire_nowait()
    tasks = [await waiting(mutex, order, name) for name in ("first", "second", "third")]
    mutex.release()
    assert not mutex.acquire_nowait(), "nobody overtakes those who wait"
    await asyncio.gather(*tasks)
    assert order == ["first", "second", "third"]
    assert not mutex.locked()


async def test_who_gives_up_waiting_is_passed_over() -> None:
    mutex, order = Mutex(), list[str]()
    await mutex.acquire()
    given_up, other = await waiting(mutex, order, "given up"), await waiting(mutex, order, "other")
    given_up.cancel()
    mutex.release()
    await other
    with pytest.raises(asyncio.CancelledError):
        await given_up
    assert order == ["other"]
    assert not mutex.locked()


async def test_it_is_not_lost_with_a_task_that_is_cancelled_as_it_gets_it() -> None:
    mutex, order = Mutex(), list[str]()
    await mutex.acquire()
    unlucky, other = await waiting(mutex, order, "unlucky"), await waiting(mutex, order, "other")
    mutex.release()  # to `unlucky`, which has not run yet
    unlucky.cancel()
    await asyncio.wait((unlucky, other))
    assert order == ["other"]
    assert not mutex.locked()
