"""A lock between the tasks of one event loop that costs next to nothing while it is free."""

from __future__ import annotations

import asyncio
from collections import deque

__all__ = ["Mutex"]


class Mutex:
    """Mutual exclusion of tasks, first come, first served.

    Unlike `asyncio.Lock` it can be taken without a coroutine, and it is handed on: whoever is woken has it.
    """

    __slots__ = ("_held", "_waiting")

    def __init__(self) -> None:
        self._held = False
        self._waiting: deque[asyncio.Future[None]] = deque()

    def locked(self) -> bool:
        """Whether somebody has it."""
        return self._held

    def acquire_nowait(self) -> bool:
        """Take it if it is free, and return whether it was."""
        if self._held:
            return False
        self._held = True
        return True

    async def acquire(self) -> None:
        """Wait for it."""
        if not self._held:
            self._held = True
            return
        handed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(handed)
        try:
            await handed
        except asyncio.CancelledError:
            if handed.cancelled():
                self._waiting.remove(handed)
            else:  # it came in the turn of the loop in which the caller was cancelled
                self.release()
            raise

    def release(self) -> None:
        """Hand it to whoever has waited longest, or let it go."""
        for handed in self._waiting:
            if not handed.done():
                self._waiting.remove(handed)
                handed.set_result(None)
                return
        self._held = False
