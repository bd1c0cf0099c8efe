"""MuJoCo's warnings, sent to the log while a simulation runs."""

from __future__ import annotations

import logging
import threading
from collections import Counter

import mujoco

__all__ = ["mujoco_warnings"]

logger: logging.Logger = logging.getLogger("urlab_client.server")


class _WarningLog:
    """Sends MuJoCo's warnings to the log while an engine runs.

    MuJoCo has one handler per process and by default appends to a file in the current folder. A handler that the
    application installed stays.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._counts: Counter[str] = Counter()

    def acquire(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1 and mujoco.get_mju_user_warning() is None:
                mujoco.set_mju_user_warning(self._log)

    def release(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and mujoco.get_mju_user_warning() == self._log:
                mujoco.set_mju_user_warning(None)
                self._counts.clear()

    def _log(self, text: str) -> None:
        kind = text[:32]  # the rest carries numbers that differ each time
        self._counts[kind] += 1
        count = self._counts[kind]
        if count & (count - 1) == 0:  # an unstable model repeats itself at every step
            logger.warning("MuJoCo: %s%s", text, f" ({count} times so far)" if count > 1 else "")


mujoco_warnings: _WarningLog = _WarningLog()
