"""Waiting for threads to end, for a time in which they have a chance to."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Final

__all__ = ["ended", "within"]

SLICE_S: Final = 0.1


def within(timeout: float, attempt: Callable[[float], bool]) -> bool:
    """Try for `timeout` seconds, two slices of it at least, and return whether it worked.

    A process that is stopped, or gets no processor, finds its deadline over when it goes on, and no other thread has
    had a turn. In slices that costs one of them, and after it comes another.

    Args:
        timeout: Seconds.
        attempt: Waits for up to so many seconds, and returns whether it worked.
    """
    return any(attempt(SLICE_S) for _ in range(max(2, math.ceil(timeout / SLICE_S))))


def ended(thread: threading.Thread, timeout: float) -> bool:
    """Wait until a thread has ended, for `timeout` seconds, and return whether it has."""

    def joined(seconds: float) -> bool:
        thread.join(seconds)
        return not thread.is_alive()

    return within(timeout, joined)
