"""Who drives: one viewer at a time, for as long as they go on driving."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, Callable

import anyio

__all__ = ["DrivingLease", "NotDriving", "Viewer"]

_LOOK_S = 0.1


class Viewer:
    """Somebody who watches.

    Attributes:
        key: What proves who they are; known to nobody else.
        name: What the others see.
        yields: Whether those who do not yield may take the controls from them at once, as people may from an agent.
        keeps: Seconds for which they keep the controls without acting; None: as the lease says.
    """

    def __init__(self, key: str, name: str, *, yields: bool = False, keeps: float | None = None) -> None:
        self.key = key
        self.name = name
        self.yields = yields
        self.keeps = keeps


class NotDriving(Exception):
    """Somebody else has the controls, or took them; the text says who."""


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
        self._one = anyio.Lock()

    @property
    def holder(self) -> Viewer | None:
        """Who has the controls, or None."""
        return self._holder if self.left > 0 else None

    @property
    def held(self) -> bool:
        """Whether a body of `hold()` runs, or winds up."""
        return self._one.locked()

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
        if holder is not None and holder.key != viewer.key and not _gives_way(holder, viewer):
            raise NotDriving(f"{holder.name} has the controls for another {self.left:.0f} s, unless they act again.")
        kept = self.seconds if viewer.keeps is None else viewer.keeps
        self._holder, self._until = viewer, self._clock() + kept

    def interrupt(self, viewer: Viewer) -> None:
        """Take the controls from somebody who yields them; nothing happens to anybody else's."""
        if (holder := self.holder) is not None and _gives_way(holder, viewer):
            self.use(viewer)

    @contextlib.asynccontextmanager
    async def hold(self, viewer: Viewer) -> AsyncGenerator[None]:
        """Keep the controls as long as the body runs, which is cancelled when somebody takes them.

        One body runs at a time: it begins when an earlier one, whosever it was, has wound up.

        Raises:
            NotDriving: Somebody else has the controls, and the body did not run; or they took them meanwhile.
        """
        self.use(viewer)
        async with self._one:
            self.use(viewer)
            with anyio.CancelScope() as body:
                keeping = asyncio.create_task(self._keep(viewer, body))
                try:
                    yield
                finally:
                    keeping.cancel()
            if body.cancelled_caught and (holder := self.holder) is not None:
                raise NotDriving(f"{holder.name} took the controls.")

    async def _keep(self, viewer: Viewer, body: anyio.CancelScope) -> None:
        while True:
            try:
                self.use(viewer)
            except NotDriving:
                body.cancel()
                return
            await anyio.sleep(_LOOK_S)

    def release(self, viewer: Viewer) -> None:
        """Give the controls back; nothing happens to somebody else's."""
        if self._holder is not None and self._holder.key == viewer.key:
            self._holder = None


def _gives_way(holder: Viewer, viewer: Viewer) -> bool:
    return holder.yields and not viewer.yields
