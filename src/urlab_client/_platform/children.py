"""Options for child processes of this package."""

from __future__ import annotations

import subprocess
import sys
from typing import Final, TypedDict


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
