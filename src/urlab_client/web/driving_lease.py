"""Who drives: one viewer at a time, for as long as they go on driving."""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["DrivingLease", "NotDriving", "Viewer"]


class Viewer:
    """Somebody who watches.

    Attributes:
        key: What proves who they are; known to nobody else.
        name: What the others see.
        yields: Whether anybody else may take the controls from them at once, as people may from an agent.
    """

    def __init__(self, key: str, name: str, *, yields: bool = False) -> None:
        self.key = key
        self.name = name
        self.yields = yields


class NotDriving(Exception):
    """Somebody else has the controls; the text says who, and for how long."""


class DrivingLease:
    """The controls. Whoever acts while nobody has them gets them; they are lost by not acting for a while.

    Args:
        seconds: How long they are kept without acting.
        clock: Monotonic time, seconds.
    """

    def __init__(self, seconds: float = 20.0, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock = clock
        self._holder: Viewer | None = None
        self._until = 0.0

    @property
    def holder(self) -> Viewer | None:
        """Who has the controls, or None."""
        return self._holder if self.left > 0 else None

    @property
    def left(self) -> float:
        """Seconds until they are free unless the holder acts."""
        return 0.0 if self._holder is None else max(0.0, self._until - self._clock())

    def use(self, viewer: Viewer) -> None:
        """Take the controls, or keep them.

        Raises:
            NotDriving: Somebody else has them.
        """
        holder = self.holder
        if holder is not None and holder.key != viewer.key and not holder.yields:
            raise NotDriving(f"{holder.name} has the controls for another {self.left:.0f} s, unless they act again")
        self._holder, self._until = viewer, self._clock() + self.seconds

    def interrupt(self, viewer: Viewer) -> None:
        """Take the controls from somebody who yields them; nothing happens to anybody else's."""
        if (holder := self.holder) is not None and holder.yields:
            self.use(viewer)

    def release(self, viewer: Viewer) -> None:
        """Give the controls back; nothing happens to somebody else's."""
        if self._holder is not None and self._holder.key == viewer.key:
            self._holder = None
