"""What signals must not reach: child processes, and system calls that their callers do not repeat."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Final, TypedDict

SIGNALS: Final = sorted(int(number) for number in signal.valid_signals())
"""The numbers of all signals that a handler can be installed for."""

raw: Final[Any] = import_module("_signal")
"""The module behind `signal`, whose own functions convert all values to enumerations and take ten times as long."""


class _Options(TypedDict):
    start_new_session: bool
    creationflags: int


if sys.platform == "win32":
    _FLAGS = subprocess.CREATE_NEW_PROCESS_GROUP
else:
    _FLAGS = 0

APART: Final[_Options] = {"start_new_session": True, "creationflags": _FLAGS}  # each without effect on the other system
"""Options of `subprocess.Popen` for a child that exits when its input closes, not on signals that a terminal or a
notebook sends to the process group of its parent. Ctrl-C is for the parent, which may continue to use the child."""


def _set_mask(how: int, numbers: Iterable[int]) -> set[int]:
    """Do as `signal.pthread_sigmask`."""
    before: set[int] = raw.pthread_sigmask(how, numbers)
    return before


@contextmanager
def uninterrupted() -> Generator[None]:
    """Block signals in this thread; other threads receive them, or this thread after the block.

    Calls need it that PyZMQ does not repeat if a signal interrupts them: it then considers a context closed whose
    threads and descriptors `term` never released, and leaves sockets behind whose `monitor` or `disconnect` failed.
    """
    if sys.platform == "win32":
        yield
        return
    before = _set_mask(signal.SIG_BLOCK, ())
    try:
        _set_mask(signal.SIG_BLOCK, SIGNALS)
        yield
    finally:
        _set_mask(signal.SIG_SETMASK, before)
