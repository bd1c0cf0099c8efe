"""Whether processors are idle: if they are, busy polling is faster than sleeping and waking up."""

from __future__ import annotations

import os
import time

# With a higher load per processor, busy polling would take time from other programs.
_CROWDED_LOAD = 1.5
_KNOWN_S = 1.0

_known_until = 0.0
_answer = False


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
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return os.getloadavg()[0] > _CROWDED_LOAD * processors
