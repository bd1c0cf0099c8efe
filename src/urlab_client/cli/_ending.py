"""Ending a command by a signal."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Generator

__all__ = ["sigterm_interrupts"]


@contextlib.contextmanager
def sigterm_interrupts() -> Generator[None]:
    """Let SIGTERM end the block as SIGINT does, so that it cleans up."""
    before = signal.signal(signal.SIGTERM, lambda _number, _frame: signal.raise_signal(signal.SIGINT))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
