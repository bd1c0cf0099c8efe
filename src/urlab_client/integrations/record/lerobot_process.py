"""The interpreter that has LeRobot, to which frames are handed over as they are read."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from urlab_client._children import APART
from urlab_client.aio.background import background_thread
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.protocol.errors import URLabError

__all__ = ["LeRobot", "last_line"]

_SCRIPT = Path(__file__).with_name("_lerobot_script.py")
_DEADLINE_S = 600.0
_FRAME_S = 2.0  # which may pass for each frame of an episode besides, while that is encoded
_LOOK_S = 0.5  # on Windows nothing interrupts a thread that waits
_ENDING_S = 10.0
_AHEAD = 2  # files that wait to be taken


class LeRobot:
    """Writes one dataset. Killed if the block ends before `finish`.

    Args:
        python: The interpreter.
        work: A folder with `plan.json`; see `_lerobot_script`.
    """

    def __init__(self, python: str, work: Path) -> None:
        self._work = work
        self._frames = self._files = 0
        self._waiting: deque[float] = deque()
        """Until when each file must be taken, seconds from when it is waited for."""
        self._replies: queue.SimpleQueue[str] = queue.SimpleQueue()
        with (work / "errors.txt").open("wb") as errors:
            self._process = subprocess.Popen(  # noqa: S603  # the user's own interpreter
                [python, "-P", str(_SCRIPT), str(work)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                encoding="utf-8",
                **APART,
            )
        self._failure: URLabError | None = None
        background_thread("urlab-lerobot", self._listen, failed=self._die).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._kill()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):  # what it did not read any more
                self._process.stdin.close()

    def add(self, arrays: Mapping[str, NDArray[Any]], *, ends_episode: bool) -> None:
        """Hand frames over, and wait while too many do.

        Raises:
            RecordingError: LeRobot failed, or takes too long.
        """
        while len(self._waiting) >= _AHEAD:
            self._wait()
        name = f"{self._files}.npz"
        np.savez(self._work / name, allow_pickle=False, **dict[str, Any](arrays))
        self._files += 1
        self._frames += len(arrays["state"])
        self._waiting.append(_DEADLINE_S + _FRAME_S * self._frames)
        try:
            if self._process.stdin is not None:
                self._process.stdin.write(json.dumps({"file": name, "ends_episode": ends_episode}) + "\n")
                self._process.stdin.flush()
        except OSError:
            raise self._broken_off() from None

    def finish(self) -> None:
        """Wait until the dataset is whole.

        Raises:
            RecordingError: LeRobot failed, or takes too long.
        """
        while self._waiting:
            self._wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._waiting.append(_DEADLINE_S + _FRAME_S * self._frames)
        try:
            failed = self._reply() or self._process.wait(_DEADLINE_S)
        except subprocess.TimeoutExpired:
            raise RecordingError(f"LeRobot did not end within {_DEADLINE_S:g} s.") from None
        if failed:
            raise self._broken_off()

    def _wait(self) -> None:
        if not self._reply():
            raise self._broken_off()

    def _reply(self) -> str:
        """Return the next reply, which is empty when there are no more."""
        allowed = self._waiting.popleft()
        until = time.monotonic() + allowed
        while True:
            try:
                return self._replies.get(timeout=_LOOK_S)
            except queue.Empty:
                if time.monotonic() > until:
                    raise RecordingError(f"LeRobot did not finish within {allowed:g} s.") from None

    def _listen(self) -> None:
        output = self._process.stdout
        if output is not None:
            with output:  # closed here and not by who waits: what encodes videos may outlive LeRobot and hold it open
                for line in output:
                    self._replies.put(line)
        self._replies.put("")

    def _die(self, error: URLabError) -> None:
        self._failure = error
        self._replies.put("")

    def _kill(self) -> None:
        if self._process.poll() is None:
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)  # with those that encode videos for it
            self._process.wait()

    def _broken_off(self) -> RecordingError:
        if self._failure is not None:
            failed = RecordingError(f"LeRobot's replies could not be read: {self._failure.__cause__!r}.")
            failed.__cause__ = self._failure.__cause__
            return failed
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDING_S)  # it says why when it ends
        self._kill()
        said = (self._work / "errors.txt").read_text(encoding="utf-8", errors="replace")
        return RecordingError(f"LeRobot failed: {last_line(said)}.")


def last_line(text: str) -> str:
    """Return the last line of what a program said."""
    lines = text.strip().splitlines()
    return lines[-1] if lines else "it said nothing"
