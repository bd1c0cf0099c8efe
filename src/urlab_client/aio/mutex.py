"""A lock between the tasks of one event loop that is cheap to take while it is free."""

from __future__ import annotations

import asyncio
from collections import deque


class Mutex:
    """Mutual exclusion of tasks, first come, first served.

    Unlike `asyncio.Lock` it can be taken without a coroutine, and it is handed over: a task that is woken holds it.
    """

    __slots__ = ("_held", "_waiting")

    def __init__(self) -> None:
        self._held = False
        self._waiting: deque[asyncio.Future[None]] = deque()

    def locked(self) -> bool:
        """Return whether the lock is held."""
        return self._held

    def acquire_nowait(self) -> bool:
        """Take the lock if it is free, and return whether it was."""
        if self._held:
            return False
        self._held = True
        return True

    async def acquire(self) -> None:
        """Wait for the lock and take it."""
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
            else:  # the lock was handed over in the same loop iteration in which the caller was cancelled
                self.release()
            raise

    def release(self) -> None:
        """Hand the lock to the task that has waited longest, or free it."""
        for handed in self._waiting:
            if not handed.done():
                self._waiting.remove(handed)
                handed.set_result(None)
                return
        self._held = False
