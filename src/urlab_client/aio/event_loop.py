"""Checks that an asynchronous object runs on asyncio, and always on the same event loop."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from urlab_client.errors import URLabError


def running_loop(
    bound: asyncio.AbstractEventLoop | None = None, owner: str = "This client"
) -> asyncio.AbstractEventLoop:
    """Return the running event loop.

    Args:
        bound: The loop that the caller has been used on; None before its first use.
        owner: Name of the caller for the error message.

    Raises:
        URLabError: No asyncio event loop is running, or another one than `bound`.
    """
    loop = asyncio._get_running_loop()  # noqa: SLF001  # unlike get_running_loop, never raises
    if loop is None:
        here = "this code runs on trio" if _on_trio() else "no event loop is running"
        raise URLabError(
            f"The async client runs on asyncio's event loop, but {here}.",
            hint="Run it with asyncio.run() or anyio's asyncio backend. Elsewhere use the blocking client: under trio, "
            "with trio.to_thread.run_sync().",
        )
    if bound is not None and bound is not loop:
        raise URLabError(
            f"{owner} belongs to another event loop.", hint="Create one per loop, or use the blocking client."
        )
    return loop


def _on_trio() -> bool:
    trio: Any = sys.modules.get("trio")
    return trio is not None and trio.lowlevel.in_trio_run()
