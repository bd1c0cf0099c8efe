"""An event loop that is cheap to run for the duration of one call.

`run_forever` polls all sockets before every round of callbacks. A call consists of one callback that sends, one wait,
and one callback that takes the reply. The other polls find nothing, and take as long as the call's own code.
"""

from __future__ import annotations

import asyncio
import select
import selectors
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

# Consecutive rounds of callbacks after which sockets are polled even if more callbacks are ready.
_ROUNDS = 4

_READABLE = getattr(select, "EPOLLIN", None)

# Attributes of asyncio's own loop, some of them private, unchanged from Python 3.11 to 3.14. If one is missing,
# `run_forever` is used.
_NEEDED = (
    "_asyncgen_finalizer_hook",
    "_asyncgen_firstiter_hook",
    "_process_events",
    "_ready",
    "_run_once",
    "_scheduled",
    "_selector",
    "_stopping",
    "_thread_id",
)


class CallerLoop(asyncio.SelectorEventLoop):
    """A selector loop with a faster way to run until `stop`. Everything else is asyncio's own."""

    _asyncgen_finalizer_hook: Any
    _asyncgen_firstiter_hook: Any
    _process_events: Any
    _ready: deque[Any]
    _run_once: Any
    _scheduled: list[Any]
    _selector: Any
    _stopping: bool
    _thread_id: int | None

    def __init__(self) -> None:
        super().__init__()
        self._as_known = all(hasattr(self, name) for name in _NEEDED)
        nothing: Mapping[int, Any] = {}
        self._poll, self._keys = _parts(self._selector) if self._as_known else (None, nothing)

    def run_until_stopped(self) -> None:
        """Do the same as `run_forever`, for a caller that stops the loop soon."""
        if not self._as_known or self.get_debug():  # debug mode times callbacks
            self.run_forever()
            return
        hooks = sys.get_asyncgen_hooks()
        sys.set_asyncgen_hooks(self._asyncgen_firstiter_hook, self._asyncgen_finalizer_hook)
        asyncio._set_running_loop(self)  # noqa: SLF001  # as every loop does
        self._thread_id = threading.get_ident()
        try:
            self._run_rounds()
        finally:
            self._stopping = False
            self._thread_id = None
            asyncio._set_running_loop(None)  # noqa: SLF001
            sys.set_asyncgen_hooks(*hooks)

    def _run_rounds(self) -> None:
        ready = self._ready
        rounds = 0
        while not self._stopping:
            rounds += 1
            if ready and rounds < _ROUNDS:
                # Only those that are ready now, as asyncio does: callbacks that they add wait for the next round.
                for _ in range(len(ready)):
                    handle = ready.popleft()
                    if not handle._cancelled:  # noqa: SLF001
                        handle._run()  # noqa: SLF001
                continue
            rounds = 0
            # A cancelled timer counts as well: it only ends the wait early, and `_run_once` removes it.
            scheduled = self._scheduled
            left = scheduled[0]._when - time.monotonic() if scheduled else None  # noqa: SLF001  # the loop's own clock
            if ready or (left is not None and left <= 0):
                self._run_once()  # handles timers
            else:
                self._wait(left)

    def _wait(self, left: float | None) -> None:
        """Wait for sockets, at most `left` seconds; run the callback of a single event, or queue those of several."""
        poll = self._poll
        if poll is None:
            self._process_events(self._selector.select(left))
            return
        events = poll(left)
        # A call waits for one reply, so almost always one socket is readable. Selecting, queueing its callback and
        # running another round would take longer than the callback itself.
        if len(events) == 1:
            fd, mask = events[0]
            key = self._keys.get(fd)
            if mask == _READABLE and key is not None:
                handle = key.data[0]
                if handle is not None and not handle._cancelled:  # noqa: SLF001
                    handle._run()  # noqa: SLF001  # nothing else is ready, so nothing is overtaken
                    return
        if events:  # they stay ready until they are handled
            self._process_events(self._selector.select(0))


def _parts(selector: Any) -> tuple[Callable[[float | None], list[tuple[int, int]]] | None, Mapping[int, Any]]:
    """Return the poll function and the keys by descriptor of an epoll selector, whose own `select` is slower.

    The function is None for another selector, or one without the attributes of Python 3.11 to 3.14.
    """
    poll, keys = getattr(selector, "_selector", None), getattr(selector, "_fd_to_key", None)
    if not isinstance(selector, getattr(selectors, "EpollSelector", ())) or poll is None or keys is None:
        return None, {}
    return poll.poll, keys
