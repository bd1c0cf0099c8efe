"""How this package starts processes that belong to it."""

from __future__ import annotations

import subprocess
import sys
from typing import Final, TypedDict

__all__ = ["APART"]


class _Options(TypedDict):
    start_new_session: bool
    creationflags: int


APART: Final[_Options] = {
    "start_new_session": True,  # without effect on Windows
    "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP if sys.platform == "win32" else 0,
}
"""Options of `subprocess.Popen` for a child that ends with its input, and not with what a terminal or a notebook sends
to the whole process group of its parent: Ctrl-C is for the program, which may go on with the child after it."""
