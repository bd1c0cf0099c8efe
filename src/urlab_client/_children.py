"""Options for child processes of this package."""

from __future__ import annotations

import subprocess
import sys
from typing import Final, TypedDict

__all__ = ["APART", "why_it_failed"]


class _Options(TypedDict):
    start_new_session: bool
    creationflags: int


APART: Final[_Options] = {
    "start_new_session": True,  # without effect on Windows
    "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP if sys.platform == "win32" else 0,
}
"""Options of `subprocess.Popen` for a child that exits when its input closes, not on signals that a terminal or a
notebook sends to the process group of its parent. Ctrl-C is for the parent, which may continue to use the child."""


def why_it_failed(child: subprocess.CompletedProcess[bytes]) -> str:
    """Return the last line of what a Python program said before it exited with an error, or else its exit code.

    What a crash leaves last on standard error, such as a line of Python's fault handler, is no reason.
    """
    lines = child.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1].strip() if child.returncode == 1 and lines else f"it exited with code {child.returncode}"
