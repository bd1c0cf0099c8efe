"""Delivering a reply to the waiting task within the callback that receives it."""

from __future__ import annotations

import asyncio
from typing import Any, TypeVar

T = TypeVar("T")


def deliver(reply: asyncio.Future[T], result: T) -> None:
    """Set the result of a future and resume the task that awaits it before returning.

    With `set_result` alone, the task resumes in the loop's next iteration, which first polls all sockets and timers.
    That costs a tenth of the client's time for a step.

    Call only as the last statement of a loop callback: a task cannot run within another one, and any state may have
    changed when this returns.
    """
    # A private attribute of asyncio's futures, unchanged from Python 3.11 to 3.14. Without it, the loop wakes the task.
    callbacks: Any = getattr(reply, "_callbacks", None)
    if not callbacks or len(callbacks) > 1:
        reply.set_result(result)
        return
    woken, context = callbacks[0]
    reply.remove_done_callback(woken)
    reply.set_result(result)
    context.run(woken, reply)
