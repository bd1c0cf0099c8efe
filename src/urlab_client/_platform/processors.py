"""What depends on the processors: whether some are idle, so that busy polling is faster than sleeping and waking up,
and the memory barrier that both ends of shared memory need.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from functools import cache

# With a higher load per processor, busy polling would take time from other programs.
_CROWDED_LOAD = 1.5
_KNOWN_S = 1.0

_known_until = 0.0
_answer = False

_ORDERED = frozenset({"x86_64", "amd64", "i386", "i686", "x86"})
_SEQ_CST = 5


def crowded() -> bool:
    """Return whether programs wait for processors. Queries the system once a second at most."""
    global _answer, _known_until  # noqa: PLW0603  # a property of the machine
    now = time.monotonic()
    if now >= _known_until:
        _known_until = now + _KNOWN_S
        _answer = _ask()
    return _answer


def _ask() -> bool:
    if not hasattr(os, "getloadavg"):
        return False
    return os.getloadavg()[0] > _CROWDED_LOAD * processor_count()


def processor_count() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def no_fence() -> None:
    """Do nothing: the fence for processors that keep loads in order and stores in order, which is enough (x86)."""


@cache
def processor_fence() -> Callable[[], None]:
    """Return a full memory barrier, which CPython lacks, or `no_fence` where the processor needs none."""
    if platform.machine().lower() in _ORDERED:
        return no_fence
    try:
        if sys.platform == "darwin":
            return ctypes.CDLL("/usr/lib/libSystem.B.dylib").OSMemoryBarrier
        if sys.platform == "win32":
            return ctypes.WinDLL("kernel32").FlushProcessWriteBuffers
        barrier = ctypes.CDLL("libatomic.so.1").atomic_thread_fence
    except (OSError, AttributeError):
        lock = threading.Lock()

        def lock_and_unlock() -> None:  # not a formal barrier, as accesses may move inside; sufficient in practice
            with lock:
                pass

        return lock_and_unlock
    return lambda: barrier(_SEQ_CST)
