"""Single keys from the terminal, read as they are pressed and without waiting."""

from __future__ import annotations

import codecs
import contextlib
import importlib
import os
import select
import sys
from collections.abc import Callable, Generator
from typing import Any

from urlab_client.cli._common import CommandError

_MOST = 1024


@contextlib.contextmanager
def terminal_keys() -> Generator[Callable[[], str]]:
    """Yield a function that returns the characters typed since its last call; restore the terminal afterwards.

    Raises:
        CommandError: Standard input is not a terminal.
    """
    if not sys.stdin.isatty():
        raise CommandError("keys are read from a terminal, and standard input is not one")
    if os.name == "nt":
        console: Any = importlib.import_module("msvcrt")

        def typed() -> str:
            found = ""
            while console.kbhit() and len(found) < _MOST:
                found += console.getwch()
            return found

        yield typed
        return
    # By name: type checkers know these modules on one kind of system only.
    termios: Any = importlib.import_module("termios")
    tty: Any = importlib.import_module("tty")
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    decode = codecs.getincrementaldecoder("utf-8")(errors="replace").decode
    tty.setcbreak(descriptor)

    def read() -> str:
        if not select.select([descriptor], [], [], 0)[0]:
            return ""
        data = os.read(descriptor, _MOST)
        if not data:
            raise CommandError("the terminal is gone")
        return decode(data)

    try:
        yield read
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
