"""System calls that must not be interrupted by signals, because nobody repeats them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager

__all__ = ["uninterrupted"]


@contextmanager
def uninterrupted() -> Generator[None]:
    """Let other threads, or the end of the block, have the signals that come meanwhile.

    `zmq.Context.term` needs it: where a signal interrupts it, PyZMQ takes the context for closed, and its threads and
    descriptors are never released.
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
