"""A program in the foreground of a terminal, where Ctrl-C can be pressed."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import textwrap
import threading
from types import TracebackType
from typing import Self

from waiting import DEADLINE_S

# The leader of a session without a terminal gets the first one that it opens, and is in its foreground.
_PRELUDE = """
import os, sys
os.close(os.open(sys.argv[1], os.O_RDWR))
"""


class Terminal:
    """Runs a Python program whose processes get what is typed.

    Args:
        program: Source text.
    """

    def __init__(self, program: str) -> None:
        self._keyboard, self._screen = pty.openpty()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PRELUDE + textwrap.dedent(program), os.ttyname(self._screen)],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._watchdog = threading.Timer(2 * DEADLINE_S, self._process.kill)

    def __enter__(self) -> Self:
        self._watchdog.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._watchdog.cancel()
        self._process.kill()
        self._process.communicate()
        os.close(self._keyboard)
        os.close(self._screen)

    def line(self) -> str:
        """Return the next line that the program prints; at its end, what it complained of."""
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        return self._process.stdout.readline().rstrip("\n") or self._process.stderr.read()

    def type(self, text: str) -> None:
        """Type on the keyboard."""
        os.write(self._keyboard, text.encode())

    def press_ctrl_c(self) -> None:
        """Interrupt all processes in the foreground."""
        os.write(self._keyboard, b"\x03")

    def end(self) -> tuple[int, str, str]:
        """Wait for the end; return exit code and the rest of what was printed."""
        out, err = self._process.communicate()
        return self._process.returncode, out, err
