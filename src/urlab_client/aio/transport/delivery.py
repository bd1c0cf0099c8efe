"""Giving a reply to the task that awaits it in the very callback that receives it."""

from __future__ import annotations

import asyncio
from typing import Any, TypeVar

__all__ = ["deliver"]

T = TypeVar("T")


def deliver(reply: asyncio.Future[T], result: T) -> None:
    """Set the result of a future and let the task that awaits it go on, before this returns.

    `set_result` alone has the task go on in the loop's next turn, which looks at all sockets and timers before: a tenth
    of what a step takes the client.

    Only for callbacks of the loop, as the last thing they do: a task cannot run within another one, and what the
    callback was about to look at may have changed when this returns.
    """
    # Of asyncio's own futures, not public: unchanged from Python 3.11 to 3.14. Without it the loop wakes the task.
    callbacks: Any = getattr(reply, "_callbacks", None)
    if not callbacks or len(callbacks) > 1:
        reply.set_result(result)
        return
    woken, context = callbacks[0]
    reply.remove_done_callback(woken)
    reply.set_result(result)
    context.run(woken, reply)
