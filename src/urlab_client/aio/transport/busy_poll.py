"""Looking for a reply again and again before the event loop goes to sleep for it.

A processor that has gone idle takes tens of microseconds to come back, as long as a server that answers at once takes
altogether. So the loop stays awake for replies that have come quickly before. All other tasks have their turns between
two looks.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from urlab_client._processors import crowded

__all__ = ["BusyPoll"]

_MISSES = 4
# One that looks keeps the loop awake for all; several would only keep each other busy.
_looking = False


class BusyPoll:
    """Knows by op how long replies take, and looks for them as long as that pays.

    Args:
        shortest: How long to look at least, seconds.
        longest: How long to look at most; whose replies take longer than this again and again is not looked for.
    """

    def __init__(self, shortest: float, longest: float) -> None:
        self._shortest = shortest
        self._longest = longest
        self._latency: dict[str, float] = {}
        self._missed: dict[str, int] = {}

    def pays(self, op: str) -> bool:
        """Whether to look for the reply to this op."""
        return not _looking and self._missed.get(op, 0) < _MISSES and not crowded()

    async def look(self, op: str, reply: asyncio.Future[Any], look: Callable[[], object]) -> None:
        """Call `look` until it completes `reply` or that has taken too long."""
        global _looking  # noqa: PLW0603  # about all loops of the process, as they share its interpreter
        now = time.perf_counter  # the loop's clock may tick 64 times a second
        give_up = now() + min(max(2 * self._latency.get(op, 0.0), self._shortest), self._longest)
        _looking = True
        try:
            while True:  # once at least: whoever is late to look first would find nobody left to wake it
                await asyncio.sleep(0)
                if reply.done():  # by whoever else had a turn, and took away where to look
                    break
                look()
                if reply.done() or now() >= give_up:
                    break
        finally:
            _looking = False

    def note(self, op: str, seconds: float) -> None:
        """Learn how long a reply has taken."""
        self._latency[op] = 0.9 * self._latency.get(op, seconds) + 0.1 * seconds
        self._missed[op] = self._missed.get(op, 0) + 1 if seconds > self._longest else 0
