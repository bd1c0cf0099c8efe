"""Long work in a thread that ends when nobody wants it any more, and before what it writes to is removed."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import anyio.to_thread

__all__ = ["Progress", "stoppable"]

Progress: TypeAlias = Callable[[int], None]

_T = TypeVar("_T")


async def stoppable(job: Callable[[Progress], _T], progress: Progress = lambda _: None) -> _T:
    """Run a job in a thread. Cancelled, it ends when it next says how far it is, and this does not end before it.

    Args:
        job: Says how far it is, often.
        progress: Told of it, in that thread.
    """
    stopped = threading.Event()

    def told(count: int) -> None:
        if stopped.is_set():
            raise _Stopped
        progress(count)

    running = asyncio.ensure_future(anyio.to_thread.run_sync(job, told))
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        stopped.set()
        running.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait((running,))
        raise


class _Stopped(Exception):
    """A job was told to stop."""
