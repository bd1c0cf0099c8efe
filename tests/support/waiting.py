"""Waiting, within bounds, for what nobody announces."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

DEADLINE_S = 30.0
"""Only there so that nothing hangs: a busy machine may need long for what an idle one does at once."""

LOOK_S = 0.002


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
