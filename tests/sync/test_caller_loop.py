"""The loop under the blocking client: quicker to run for a call, and otherwise asyncio's own."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncGenerator, Iterator

import pytest

from urlab_client.sync import _caller_loop
from urlab_client.sync._caller_loop import CallerLoop


@pytest.fixture(params=["as known", "of another asyncio"])
def loop(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[CallerLoop]:
    if request.param == "of another asyncio":
        monkeypatch.setattr(_caller_loop, "_NEEDED", ("_something_it_does_not_have",))
    loop = CallerLoop()
    yield loop
    loop.close()


def test_callbacks_that_never_rest_keep_neither_timers_nor_sockets_waiting(loop: CallerLoop) -> None:
    near, far = socket.socketpair()
    come: set[str] = set()
    loop.add_reader(near, lambda: come.add("socket"))
    loop.call_later(0.01, come.add, "timer")
    left = iter(range(200_000))  # rounds: far more than fit into the time of the timer

    def again() -> None:
        if come == {"socket", "timer"} or next(left, None) is None:
            loop.stop()
        else:
            loop.call_soon(again)

    far.send(b"x")
    loop.call_soon(again)
    loop.run_until_stopped()
    loop.remove_reader(near)
    near.close()
    far.close()
    assert come == {"socket", "timer"}


def test_it_can_be_stopped_and_run_again(loop: CallerLoop) -> None:
    order: list[int] = []
    for i in range(3):
        loop.call_soon(order.append, i)
        loop.call_soon(loop.stop)
        loop.run_until_stopped()
        assert not loop.is_running()
    assert order == [0, 1, 2]


def test_cancelled_callbacks_and_timers_do_not_run(loop: CallerLoop) -> None:
    ran: list[str] = []
    loop.call_soon(ran.append, "callback").cancel()
    loop.call_later(0.001, ran.append, "timer").cancel()
    loop.call_later(0.01, loop.stop)
    loop.run_until_stopped()
    assert ran == []


def test_generators_that_were_left_half_read_are_known_to_the_loop(loop: CallerLoop) -> None:
    closed: list[bool] = []

    async def numbers() -> AsyncGenerator[int]:
        try:
            yield 1
        finally:
            closed.append(True)

    left = numbers()

    async def read() -> None:
        await anext(left)
        loop.stop()

    task = loop.create_task(read())
    loop.run_until_stopped()
    assert task.done()
    loop.run_until_complete(loop.shutdown_asyncgens())
    assert closed == [True]


def test_what_a_task_raises_to_end_the_program_comes_out(loop: CallerLoop) -> None:
    async def leave() -> None:
        raise KeyboardInterrupt

    task = loop.create_task(leave())
    with pytest.raises(KeyboardInterrupt):
        loop.run_until_stopped()
    assert isinstance(task.exception(), KeyboardInterrupt)
    assert asyncio._get_running_loop() is None
    assert not loop.is_running()
