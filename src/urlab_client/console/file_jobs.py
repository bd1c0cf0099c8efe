"""Long work on files: jobs in threads that stop when cancelled, and files that arrive in pieces."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TypeAlias, TypeVar

import anyio.to_thread

Progress: TypeAlias = Callable[[int], None]

_T = TypeVar("_T")


async def run_job(job: Callable[[Progress], _T], progress: Progress = lambda _: None) -> _T:
    """Run a job in a thread. If cancelled, the job stops at its next progress report, and this waits for that.

    So the job's files can be removed afterwards.

    Args:
        job: Function that reports its progress often, through the callback that it is called with.
        progress: Callback invoked with the progress, in that thread.
    """
    stopped = threading.Event()

    def report(count: int) -> None:
        if stopped.is_set():
            raise _Stopped
        progress(count)

    running = asyncio.ensure_future(anyio.to_thread.run_sync(job, report))
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        stopped.set()
        running.add_done_callback(lambda done: done.cancelled() or done.exception())
        await asyncio.wait((running,))
        raise


class _Stopped(Exception):
    """Stops a cancelled job."""


async def write_chunks(file: Path, chunks: AsyncIterator[bytes], largest: int, what: str) -> None:
    """Write a new file that arrives in pieces.

    Raises:
        ValueError: It is larger than `largest` bytes.
    """
    size = 0
    with file.open("xb") as target:
        async for chunk in chunks:
            size += len(chunk)
            if size > largest:
                raise ValueError(f"{what} is at most {largest} bytes")
            await anyio.to_thread.run_sync(target.write, chunk)
