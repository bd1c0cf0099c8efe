"""Processes that tests start: they end with the test, whatever becomes of it."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Generator
from pathlib import Path
from typing import Any

DEADLINE_S = 240.0

_MARK = "URLAB_TEST_PROCESS"
_numbers = itertools.count()


@contextlib.contextmanager
def child(*command: str | Path, **options: Any) -> Generator[subprocess.Popen[str]]:
    """Run a Python program with pipes; it is killed when it outlives the deadline or the block.

    Args:
        command: Arguments of the interpreter.
        options: Options of `Popen`, in place of pipes for all three streams.
    """
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    process = subprocess.Popen([sys.executable, *map(str, command)], text=True, **{**pipes, **options})
    watchdog = threading.Timer(DEADLINE_S, process.kill)
    watchdog.start()
    with process:
        try:
            yield process
        finally:
            watchdog.cancel()
            process.kill()


@contextlib.contextmanager
def in_background() -> Generator[None]:
    """Ignore Ctrl-C, as programs that are started meanwhile then do: a script's job in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def signals_kept() -> Generator[None]:
    """Put back what `urlab serve` does to the process that it owns."""
    numbers = [number for number in signal.Signals if number.name in {"SIGINT", "SIGTERM", "SIGHUP"}]
    before = [signal.getsignal(number) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextlib.contextmanager
def ended_with_a_failure() -> Generator[None]:
    """Kill all that a block has started when it fails: children's children and orphans, too, where `/proc` tells."""
    mark = os.environ[_MARK] = f"{os.getpid()}-{next(_numbers)}"
    try:
        yield
    except BaseException:
        for process in _marked(f"{_MARK}={mark}".encode()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        raise
    finally:
        del os.environ[_MARK]


def _marked(entry: bytes) -> list[int]:
    """Return the processes that were started with an entry in their environment."""
    found: list[int] = []
    for file in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # another user's, or it has just ended
            if entry in file.read_bytes().split(b"\0"):
                found.append(int(file.parent.name))
    return found
