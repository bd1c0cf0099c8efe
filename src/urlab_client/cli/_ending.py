"""Ending a command by a signal."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Generator
from types import FrameType

__all__ = ["in_background", "sigterm_interrupts"]


def in_background() -> bool:
    """Whether this command was started so that it ignores Ctrl-C, which is then for others; SIGTERM still ends it."""
    return signal.getsignal(signal.SIGINT) == signal.SIG_IGN


@contextlib.contextmanager
def sigterm_interrupts() -> Generator[None]:
    """Let SIGTERM end the block as SIGINT does, so that it cleans up."""

    def end(_number: int, _frame: FrameType | None) -> None:
        if in_background():
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
