"""Importing the package, in a fresh interpreter each time."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator

from benchmarks.harness import Pair, Row

__all__ = ["ROWS"]


def _importing(modules: str) -> Callable[[int], list[float]]:
    script = f"import time; t = time.perf_counter(); import {modules}; print(time.perf_counter() - t)"

    def burst(count: int) -> list[float]:
        command = [sys.executable, "-c", script]
        return [float(subprocess.run(command, check=True, capture_output=True).stdout) for _ in range(count)]

    return burst


@contextlib.contextmanager
def _imports() -> Iterator[Pair]:
    yield Pair(ours=_importing("urlab_client"), floor=_importing("numpy, zmq, msgspec"))


ROWS = (
    Row(
        name="import",
        what="import urlab_client",
        floor="import numpy, zmq, msgspec",
        reach=1.3,
        prepare=_imports,
        count=1,
    ),
)
