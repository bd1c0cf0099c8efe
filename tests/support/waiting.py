"""Waiting, within bounds, for what nobody announces."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

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


def eventually(condition: Callable[[], T], otherwise: str = "it did not happen") -> T:
    """Block until something is so; return what the condition then gives.

    Args:
        condition: Whether it is.
        otherwise: What to complain of.
    """
    deadline, nothing = time.monotonic() + DEADLINE_S, threading.Event()
    while not (found := condition()):
        assert time.monotonic() < deadline, f"{otherwise} within {DEADLINE_S:g} s"
        nothing.wait(LOOK_S)
    return found


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
