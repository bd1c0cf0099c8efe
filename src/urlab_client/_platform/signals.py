"""System calls that signals must not interrupt, because their callers do not repeat them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def uninterrupted() -> Generator[None]:
    """Block signals in this thread; other threads receive them, or this thread after the block.

    `zmq.Context.term` needs it: if a signal interrupts that call, PyZMQ considers the context closed, and its threads
    and descriptors are never released.
    """
    if sys.platform == "win32":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
