"""The progress of work that goes through a recording more than once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

__all__ = ["Progress", "phases"]

Progress: TypeAlias = Callable[[int], None]


def phases(size: int, progress: Progress | None, count: int) -> list[Progress]:
    """Return what is told, in each of some phases, how far that phase is; `progress` is told how far all are.

    Args:
        size: How far each phase goes, and all together: the size of the recording, bytes.
        progress: Told of it; None if nobody is.
        count: How many phases there are.
    """

    def phase(number: int) -> Progress:
        def tell(done: int) -> None:
            if progress is not None:
                progress((number * size + min(done, size)) // count)

        return tell

    return [phase(number) for number in range(count)]
