"""Busy polling for a reply before the event loop sleeps.

An idle processor takes tens of microseconds to wake up, which is as long as a fast server takes for a whole reply. A
processor that other work keeps busy responds immediately, and polling would only waste its time. So the loop polls if
that has proved faster than sleeping by a margin. Occasionally it tries the alternative to measure it again. Other tasks
run between two polls.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from urlab_client._platform.processors import crowded

_MISSES = 4
_FIRST = 8  # requests of an op before the first trial of sleeping
_OFTEN, _RARELY = 64, 1024  # interval of trials of the alternative, which grows while the alternative is no better
_MARGIN = 0.85  # polling occupies a processor, so it must be faster by this factor
_WEIGHT = 0.2
# One poller keeps the loop awake for all requests; several would only delay each other.
_looking = False


class _Replies:
    """Reply times of one op in seconds, with a polling loop and with a sleeping loop."""

    __slots__ = ("asked", "asleep", "awake", "missed", "pause", "trial")

    def __init__(self) -> None:
        self.asked = 0
        self.missed = 0
        self.awake = 0.0
        self.asleep = 0.0
        self.pause = _OFTEN
        self.trial = _OFTEN

    @property
    def awake_is_better(self) -> bool:
        """Whether polling has proved faster."""
        return self.awake < _MARGIN * self.asleep

    def choose(self) -> bool:
        """Return whether to poll for the next reply."""
        self.asked += 1
        if self.missed >= _MISSES:
            return False
        if self.asleep == 0.0:
            return self.asked <= _FIRST
        if self.asked < self.trial:
            return self.awake_is_better
        self.trial = self.asked + self.pause
        return not self.awake_is_better

    def longest_look(self, shortest: float, longest: float) -> float:
        """Return the seconds to poll for a reply; a trial is no longer than sleeping takes."""
        usual = min(max(2 * self.awake, shortest), longest)
        return usual if self.awake_is_better or self.asleep == 0.0 else min(usual, self.asleep)

    def note(self, seconds: float, *, awake: bool) -> None:
        """Record the time of a reply that did not exceed the limit."""
        self.missed = 0
        before = self.awake if awake else self.asleep
        if before == 0.0:
            after = seconds
        else:
            if awake != self.awake_is_better:
                if (seconds < _MARGIN * self.asleep) if awake else (_MARGIN * seconds <= self.awake):
                    self.pause = _OFTEN  # conditions may have changed: try again soon
                else:
                    self.pause = min(2 * self.pause, _RARELY)
                self.trial = self.asked + self.pause
            # An unusually long time reflects the machine's other load rather than the way of waiting.
            after = before + _WEIGHT * (min(seconds, 2 * before) - before)
        if awake:
            self.awake = after
        else:
            self.asleep = after


class BusyPoll:
    """Learns the reply time of each op and polls while that pays off.

    Args:
        shortest: Minimum polling time, seconds.
        longest: Maximum polling time, seconds. Ops whose replies repeatedly take longer are not polled.
    """

    def __init__(self, shortest: float, longest: float) -> None:
        self._shortest = shortest
        self._longest = longest
        self._ops: dict[str, _Replies] = {}

    def pays(self, op: str) -> bool:
        """Return whether to poll for the reply to this op."""
        if _looking or crowded():
            return False
        replies = self._ops.get(op)
        if replies is None:
            replies = self._ops[op] = _Replies()
        return replies.choose()

    async def look(self, op: str, reply: asyncio.Future[Any], look: Callable[[], object]) -> None:
        """Call `look` until it completes `reply` or the time limit is reached."""
        global _looking  # noqa: PLW0603  # shared by all loops of the process, which share one interpreter
        now = time.perf_counter  # the loop's clock may tick 64 times a second
        replies = self._ops.get(op)
        give_up = now() + (self._shortest if replies is None else replies.longest_look(self._shortest, self._longest))
        _looking = True
        try:
            while True:  # at least once: otherwise nothing would wake a task that is late for its first poll
                await asyncio.sleep(0)
                if reply.done():  # another task may have completed it and closed the socket
                    break
                look()
                if reply.done() or now() >= give_up:
                    break
        finally:
            _looking = False

    def note(self, op: str, seconds: float, *, awake: bool) -> None:
        """Record the time of a reply, with a polling or a sleeping loop."""
        replies = self._ops.get(op)
        if replies is None:
            return  # `pays` was never called for it
        if seconds > self._longest:
            replies.missed += 1
            return
        replies.note(seconds, awake=awake)
