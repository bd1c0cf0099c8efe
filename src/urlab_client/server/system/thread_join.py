"""Waiting for threads to end, robust against pauses of the process."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Final

__all__ = ["ended", "within"]

SLICE_S: Final = 0.1


def within(timeout: float, attempt: Callable[[float], bool]) -> bool:
    """Try for `timeout` seconds, in at least two slices, and return whether it succeeded.

    After a process was stopped or got no processor time, its deadline may have passed although no other thread has run.
    With slices, such a pause uses up one of them, and another follows.

    Args:
        timeout: Seconds.
        attempt: Waits for up to the given seconds, and returns whether it succeeded.
    """
    return any(attempt(SLICE_S) for _ in range(max(2, math.ceil(timeout / SLICE_S))))


def ended(thread: threading.Thread, timeout: float) -> bool:
    """Wait until a thread has ended, for `timeout` seconds, and return whether it has."""

    def joined(seconds: float) -> bool:
        thread.join(seconds)
        return not thread.is_alive()

    return within(timeout, joined)
