"""Looking for a reply again and again before the event loop goes to sleep for it.

A processor that has gone idle takes tens of microseconds to come back, as long as a server that answers at once takes
altogether. One that something else keeps busy is back at once, and looking would only take its time. So the loop stays
awake where that has proved quicker than sleeping, by a margin; now and then it does the other thing, to find out. All
other tasks have their turns between two looks.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from urlab_client._processors import crowded

__all__ = ["BusyPoll"]

_MISSES = 4
_FIRST = 8  # requests of an op before sleeping is tried
_OFTEN, _RARELY = 64, 1024  # one of so many does the other thing: the more often it was no better, the more rarely
_MARGIN = 0.85  # waiting awake takes a processor: it has to be quicker by this
_WEIGHT = 0.2
# One that looks keeps the loop awake for all; several would only keep each other busy.
_looking = False


class _Replies:
    """How quickly the replies to one op come, in seconds, to a loop that stays awake and to one that sleeps."""

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
        """Whether staying awake has proved quicker."""
        return self.awake < _MARGIN * self.asleep

    def choose(self) -> bool:
        """Return whether to stay awake for the next one."""
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
        """Return how long to look for a reply, seconds: to find out whether that is better, no longer than it would."""
        usual = min(max(2 * self.awake, shortest), longest)
        return usual if self.awake_is_better or self.asleep == 0.0 else min(usual, self.asleep)

    def note(self, seconds: float, *, awake: bool) -> None:
        """Learn from a reply that did not take too long."""
        self.missed = 0
        before = self.awake if awake else self.asleep
        if before == 0.0:
            after = seconds
        else:
            if awake != self.awake_is_better:
                if (seconds < _MARGIN * self.asleep) if awake else (_MARGIN * seconds <= self.awake):
                    self.pause = _OFTEN  # perhaps things have changed: ask again soon
                else:
                    self.pause = min(2 * self.pause, _RARELY)
                self.trial = self.asked + self.pause
            # What took unusually long says more about the machine's other work than about the way of waiting.
            after = before + _WEIGHT * (min(seconds, 2 * before) - before)
        if awake:
            self.awake = after
        else:
            self.asleep = after


class BusyPoll:
    """Knows by op how long replies take, and looks for them as long as that pays.

    Args:
        shortest: How long to look at least, seconds.
        longest: How long to look at most; whose replies take longer than this again and again is not looked for.
    """

    def __init__(self, shortest: float, longest: float) -> None:
        self._shortest = shortest
        self._longest = longest
        self._ops: dict[str, _Replies] = {}

    def pays(self, op: str) -> bool:
        """Whether to look for the reply to this op."""
        if _looking or crowded():
            return False
        replies = self._ops.get(op)
        if replies is None:
            replies = self._ops[op] = _Replies()
        return replies.choose()

    async def look(self, op: str, reply: asyncio.Future[Any], look: Callable[[], object]) -> None:
        """Call `look` until it completes `reply` or that has taken too long."""
        global _looking  # noqa: PLW0603  # about all loops of the process, as they share its interpreter
        now = time.perf_counter  # the loop's clock may tick 64 times a second
        replies = self._ops.get(op)
        give_up = now() + (self._shortest if replies is None else replies.longest_look(self._shortest, self._longest))
        _looking = True
        try:
            while True:  # once at least: whoever is late to look first would find nobody left to wake it
                await asyncio.sleep(0)
                if reply.done():  # by whoever else had a turn, and took away where to look
                    break
                look()
                if reply.done() or now() >= give_up:
                    break
        finally:
            _looking = False

    def note(self, op: str, seconds: float, *, awake: bool) -> None:
        """Learn how long a reply has taken, to a loop that was looking for it or asleep."""
        replies = self._ops.get(op)
        if replies is None:
            return  # it has never been asked for
        if seconds > self._longest:
            replies.missed += 1
            return
        replies.note(seconds, awake=awake)
