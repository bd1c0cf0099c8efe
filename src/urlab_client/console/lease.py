"""The controls: one viewer drives at a time, for as long as they keep acting."""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass

import anyio

from urlab_client.aio.background import background_task

_LOOK_S = 0.1


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
        return 0.0 if self._holder is None else max(0.0, self._until - self._clock())

    def use(self, viewer: Viewer) -> None:
        """Take or keep the controls."""
        holder = self.holder
        if holder is not None and holder.key != viewer.key and not _gives_way(holder, viewer):
            raise NotDriving(f"{holder.name} has the controls for another {self.left:.0f} s, unless they act again.")
        kept = self.seconds if viewer.keeps is None else viewer.keeps
        self._holder, self._until = viewer, self._clock() + kept

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
            body = anyio.CancelScope()
            keeping = background_task("urlab-web-lease", self._keep(viewer, body), failed=lambda _: body.cancel())
            with body:
                try:
                    yield
                finally:
                    keeping.cancel()
            if body.cancelled_caught and keeping.done():
                keeping.result()  # raises what ended it
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
        """Release the controls if this viewer has them."""
        if self._holder is not None and self._holder.key == viewer.key:
            self._holder = None


def _gives_way(holder: Viewer, viewer: Viewer) -> bool:
    return holder.yields and not viewer.yields
