"""What else the machine does while a row is measured."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace

from benchmarks.harness import Pair, Row

__all__ = ["long", "warm", "warmth"]

_AWAKE = """
import os, sys, threading
threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(0)), daemon=True).start()
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [int(sys.argv[1])])
os.nice(19)
while True:
    pass
"""


@contextlib.contextmanager
def warmth() -> Iterator[None]:
    """Keep every core awake with a process at the lowest priority, as policies, renderers and the editor do."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    with contextlib.ExitStack() as stack:
        for core in cores:
            command = [sys.executable, "-c", _AWAKE, str(core)]
            process = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE))
            assert process.stdin is not None  # noqa: S101
            stack.callback(process.stdin.close)
        yield


def warm(row: Row, *, reach: float, p99: float | None = None, processor: float | None = None) -> Row:
    """Return a row that measures the same where every core is kept awake."""

    def within(prepare: Callable[[], AbstractContextManager[Pair]]) -> AbstractContextManager[Pair]:
        @contextlib.contextmanager
        def both() -> Iterator[Pair]:
            with prepare() as pair, warmth():
                yield pair

        return both()

    return replace(
        row,
        name=f"warm-{row.name}",
        what=f"{row.what}; every core kept awake",
        reach=reach,
        p99=p99,
        processor=processor,
        prepare=lambda: within(row.prepare),
    )


def long(row: Row) -> Row:
    """Return a row that measures the same in bursts of 1,000, as users step, instead of some hundredths of a second."""
    return replace(row, name=f"{row.name}-1000", what=f"{row.what}; in bursts of 1,000", count=1000)
