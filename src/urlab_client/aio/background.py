"""The event loop of a client, and its tasks and threads in the background, none of which ends unnoticed.

An unexpected end is logged, reported as an event, and passed on to whatever waits for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeAlias, TypeVarTuple

from urlab_client._platform.threads import daemon
from urlab_client.errors import URLabError
from urlab_client.events import ClientEvent, TaskFailed

log: logging.Logger = logging.getLogger("urlab_client.background")

Ts = TypeVarTuple("Ts")

_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 30.0

Tell: TypeAlias = Callable[[ClientEvent], object]
"""Publishes an event; called on the event loop."""


def background_task(
    name: str,
    work: Coroutine[Any, Any, None],
    *,
    tell: Tell | None = None,
    failed: Callable[[URLabError], object] = lambda _: None,
) -> asyncio.Task[None]:
    """Start a task that nobody awaits, or not at once. The caller must keep a reference to it.

    If it ends unexpectedly, `failed` is called on the event loop with the error, to fail what waits for the task, and
    `tell` publishes the event.
    """

    def note_end(task: asyncio.Task[None]) -> None:
        if task.cancelled() or (error := task.exception()) is None:
            return
        failed(_noted(name, error))
        if tell is not None:
            tell(TaskFailed(task=name, error=_said(error)))

    task = asyncio.create_task(work, name=name)
    task.add_done_callback(note_end)
    return task


def background_thread(
    name: str,
    run: Callable[[*Ts], object],
    *arguments: *Ts,
    tell: Tell | None = None,
    failed: Callable[[URLabError], object] = lambda _: None,
) -> threading.Thread:
    """Return a daemon thread, not started.

    If it ends unexpectedly, `failed` is called on the thread, and `tell` on the event loop that runs now.
    """
    loop = None if tell is None else asyncio.get_running_loop()

    def note_end(error: BaseException) -> None:
        failed(_noted(name, error))
        if loop is not None and tell is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(tell, TaskFailed(task=name, error=_said(error)))

    return daemon(name, run, *arguments, failed=note_end)


async def kept_running(name: str, work: Callable[[], Awaitable[None]], failed: Callable[[URLabError], object]) -> None:
    """Run something until it returns; whenever it fails, again after a pause, which grows to half a minute."""
    loop, pause = asyncio.get_running_loop(), _PAUSE_S
    while True:
        began = loop.time()
        try:
            return await work()
        except Exception as error:  # noqa: BLE001 - whatever it is, nobody else hears of it
            failed(_noted(name, error))
        if loop.time() - began > _LONGEST_PAUSE_S:
            pause = _PAUSE_S
        await asyncio.sleep(pause)
        pause = min(2 * pause, _LONGEST_PAUSE_S)


def _noted(name: str, error: BaseException) -> URLabError:
    """Log an unexpected end, and return the error for whatever waits."""
    log.error("%s ended unexpectedly", name, exc_info=error)
    failure = URLabError(f"{name} ended unexpectedly: {_said(error)}.", hint="The log has the details.")
    failure.__cause__ = error
    return failure


def _said(error: BaseException) -> str:
    text = str(error).rstrip(".")
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def running_loop(
    bound: asyncio.AbstractEventLoop | None = None, owner: str = "This client"
) -> asyncio.AbstractEventLoop:
    """Return the running event loop.

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
