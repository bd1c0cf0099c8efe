"""Waiting, within bounds, for what nobody announces."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any, TypeVar

import pytest

from urlab_client import URLabTimeoutError

T = TypeVar("T")

DEADLINE_S = 60.0
"""Only there so that nothing hangs: a busy machine may need long for what an idle one does at once."""

LOOK_S = 0.002

SLACK_S = 1.0
"""How long after its deadline a call may end."""

_BEAT_S = 0.05


async def until(condition: Callable[[], object], *, look: float = LOOK_S) -> None:
    """Let the loop run until something is so.

    Args:
        condition: Whether it is.
        look: Seconds between two looks; 0 to look at each turn of the loop, and so to be there at once.
    """
    async with asyncio.timeout(DEADLINE_S):
        while not condition():  # noqa: ASYNC110 - there is no event to wait for
            await asyncio.sleep(look)


def attempts(otherwise: str = "it did not happen") -> Iterator[None]:
    """Yield until the caller has seen enough; fail when that takes too long.

    Args:
        otherwise: What to complain of.
    """
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        yield
    raise AssertionError(f"{otherwise} within {DEADLINE_S:g} s")


def eventually(condition: Callable[[], T], otherwise: str = "it did not happen", *, look: float = LOOK_S) -> T:
    """Block until something is so; return what the condition then gives.

    Args:
        condition: Whether it is.
        otherwise: What to complain of.
        look: Seconds between two looks; 0 where the condition itself waits, as for a message.
    """
    nothing = threading.Event()
    for _ in attempts(otherwise):
        if found := condition():
            return found
        nothing.wait(look)
    raise AssertionError


async def in_time(deadline: float, call: Awaitable[T]) -> T:
    """Fail when a call outlives its deadline by more than a second, not counting what the loop itself was held up.

    Each beat is waited for anew, so that a pause of the whole process, after which all deadlines have passed at once,
    costs one of them.
    """
    task = asyncio.ensure_future(call)
    for _ in range(round((deadline + SLACK_S) / _BEAT_S)):
        done, _ = await asyncio.wait((task,), timeout=_BEAT_S)
        if done:
            return task.result()
    task.cancel()
    await asyncio.wait((task,))
    raise AssertionError(f"a call outlives its deadline of {deadline} s: {task}")


def pass_time(seconds: float) -> None:
    """Let the running loop, which is asyncio's own, believe that so much time has passed: what is due by then is done.

    A test that sees to it that something has happened, and lets the deadline pass then, depends on no real time.
    """
    loop = asyncio.get_running_loop()
    now = loop.time
    loop.time = lambda: now() + seconds  # type: ignore[method-assign]


async def gives_up(call: Callable[..., Awaitable[Any]], arrived: Callable[[], object], fault: str) -> None:
    """Abandon a call once the server has it: cancel it, or let its deadline pass.

    Args:
        call: What makes the call, given its `timeout`.
        arrived: Whether the server has it.
        fault: `cancelled` or `timed out`.
    """
    abandoned = asyncio.ensure_future(call(timeout=DEADLINE_S))
    await until(lambda: arrived() or abandoned.done())
    if fault == "cancelled":
        abandoned.cancel()
    else:
        pass_time(DEADLINE_S)
    with pytest.raises(asyncio.CancelledError if fault == "cancelled" else URLabTimeoutError):
        await abandoned
