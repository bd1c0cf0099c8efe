"""Progress of operations that read a recording several times."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

__all__ = ["Progress", "phases"]

Progress: TypeAlias = Callable[[int], None]


def phases(size: int, progress: Progress | None, count: int) -> list[Progress]:
    """Return a progress callback for each phase, which report the total to `progress`.

    Args:
        size: Size of the recording, bytes, which is the end of each phase and of the total.
        progress: Callback for the total; None for none.
        count: Number of phases.
    """

    def phase(number: int) -> Progress:
        def tell(done: int) -> None:
            if progress is not None:
                progress((number * size + min(done, size)) // count)

        return tell

    return [phase(number) for number in range(count)]
