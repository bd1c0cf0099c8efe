"""Long jobs in a thread that stop when cancelled, and before their output is removed."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import anyio.to_thread

Progress: TypeAlias = Callable[[int], None]

_T = TypeVar("_T")


async def stoppable(job: Callable[[Progress], _T], progress: Progress = lambda _: None) -> _T:
    """Run a job in a thread. If cancelled, the job stops at its next progress report, and this waits for that.

    Args:
        job: Function that reports its progress often, through the callback that it is called with.
        progress: Callback invoked with the progress, in that thread.
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
    """Stops a cancelled job."""
