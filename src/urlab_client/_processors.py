"""Whether processors are idle: where they are, waiting awake is quicker than sleeping and waking up."""

from __future__ import annotations

import os
import time

__all__ = ["crowded"]

# Where more than so many wait for each processor, the time spent awake is somebody else's.
_CROWD = 1.5
_KNOWN_S = 1.0

_known_until = 0.0
_answer = False


def crowded() -> bool:
    """Whether programs wait for processors; asks the system once a second."""
    global _answer, _known_until  # noqa: PLW0603  # about the machine
    now = time.monotonic()
    if now >= _known_until:
        _known_until = now + _KNOWN_S
        _answer = _ask()
    return _answer


def _ask() -> bool:
    if not hasattr(os, "getloadavg"):
        return False
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return os.getloadavg()[0] > _CROWD * processors
