"""The controls: one viewer drives at a time, for as long as they keep acting."""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass

import anyio


@dataclass(eq=False)
class Viewer:
    """A viewer: a person with a browser, or a program.

    Attributes:
        key: Secret that identifies the viewer.
        name: Name that other viewers see.
        yields: Whether viewers that do not yield may take the controls immediately, as people may from an agent.
        keeps: Seconds for which the viewer keeps the controls without acting; None for the lease's default.
    """

    key: str
    name: str
    yields: bool = False
    keeps: float | None = None


class NotDriving(Exception):
    """Another viewer has or took the controls; the text names the viewer."""


class DrivingLease:
    """The controls. Whoever acts first while they are free gets them, and loses them after `seconds` without an act."""

    def __init__(self, seconds: float = 20.0, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock = clock
        self._holder: Viewer | None = None
        self._until = 0.0
        self._block: anyio.CancelScope | None = None  # of the holder, who keeps the controls while it runs
        self._one = anyio.Lock()

    @property
    def holder(self) -> Viewer | None:
        """The viewer who has the controls, or None."""
        return self._holder if self.left > 0 else None

    @property
    def held(self) -> bool:
        """Whether a block of `hold()` is running or cleaning up."""
        return self._one.locked()

    @property
    def left(self) -> float:
        """Seconds until the controls are free unless the holder acts."""
        if self._holder is None:
            return 0.0
        return self._kept_by(self._holder) if self._block is not None else max(0.0, self._until - self._clock())

    def use(self, viewer: Viewer) -> None:
        """Take or keep the controls."""
        holder = self.holder
        if holder is not None and holder.key != viewer.key:
            if not _gives_way(holder, viewer):
                raise NotDriving(
                    f"{holder.name} has the controls for another {self.left:.0f} s, unless they act again."
                )
            if self._block is not None:
                self._block.cancel()
                self._block = None
        self._holder, self._until = viewer, self._clock() + self._kept_by(viewer)

    def _kept_by(self, viewer: Viewer) -> float:
        return self.seconds if viewer.keeps is None else viewer.keeps

    def interrupt(self, viewer: Viewer) -> None:
        """Take the controls from a holder that yields; otherwise do nothing."""
        if (holder := self.holder) is not None and _gives_way(holder, viewer):
            self.use(viewer)

    @contextlib.asynccontextmanager
    async def hold(self, viewer: Viewer) -> AsyncGenerator[None]:
        """Keep the controls while the block runs, and cancel it if another viewer takes them.

        One block runs at a time: it starts after an earlier one, of any viewer, has finished. Raises `NotDriving` if
        another viewer has the controls, and the block did not run, or if another took them meanwhile.
        """
        self.use(viewer)
        async with self._one:
            self.use(viewer)
            with anyio.CancelScope() as block:
                self._block = block
                try:
                    yield
                finally:
                    if self._block is block:
                        self._block = None
                        self.use(viewer)
            if block.cancelled_caught:
                raise NotDriving(f"{self._holder.name if self._holder else 'Another viewer'} took the controls.")

    def release(self, viewer: Viewer) -> None:
        """Release the controls if this viewer has them, and no block needs them."""
        if self._holder is not None and self._holder.key == viewer.key and self._block is None:
            self._holder = None


def _gives_way(holder: Viewer, viewer: Viewer) -> bool:
    return holder.yields and not viewer.yields
