"""The agent at the controls: one call at a time, within limits, and a person can take over at any moment."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Awaitable, Callable
from typing import TypeVar

import anyio
from msgspec import Struct

from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import OutcomeUnknown, URLabError, URLabTimeoutError
from urlab_client.web.console_session import ConsoleSession
from urlab_client.web.driving_lease import NotDriving, Viewer

__all__ = ["Driving", "Limits", "Progress", "Stopped"]

T = TypeVar("T")
Progress = Callable[[float, float], Awaitable[None]]
"""Told how much simulation time has passed, and how much may pass."""

_LOOK_S = 0.1
_REST_S = 5.0


class Limits(Struct, frozen=True, kw_only=True):
    """What an agent may do.

    Attributes:
        drive: Whether it may move robots, reset, pause and record.
        edit: Whether it may change the scene.
        sim_seconds: Simulation time that one call may take, seconds.
        wall_seconds: Time on the wall that one call may take, seconds.
    """

    drive: bool = False
    edit: bool = False
    sim_seconds: float = 10.0
    wall_seconds: float = 60.0


class Stopped(Exception):
    """A call was broken off; the text says why, and what to do."""


class Driving:
    """Lets one call at a time drive, through the console's lease.

    Args:
        console: The session that the console's viewers share.
        limits: What one call may take.

    Attributes:
        viewer: What the agent is called in the console. Everybody else's action takes the controls from it.
    """

    def __init__(self, console: ConsoleSession, limits: Limits) -> None:
        self.viewer: Viewer = Viewer(f"agent:{secrets.token_urlsafe(16)}", "the agent", yields=True)
        self._console = console
        self._limits = limits
        self._one = anyio.Lock()

    @property
    def idle(self) -> bool:
        """Whether no call drives at the moment."""
        return not self._one.locked()

    def seconds(self, seconds: float) -> float:
        """Return a duration of simulation time that a call may take.

        Raises:
            ValueError: It is not above 0, or above the limit.
        """
        if not 0 < seconds <= self._limits.sim_seconds:
            raise ValueError(
                f"A call may take up to {self._limits.sim_seconds:g} s of simulation time, and more than 0; "
                f"got {seconds:g}. Call again to go on."
            )
        return seconds

    async def drive(self, work: Callable[[], Awaitable[T]], progress: Progress, seconds: float = 0.0) -> T:
        """Do something that changes the simulation.

        Args:
            work: What to do.
            progress: Told how far it is.
            seconds: Simulation time that it may take; 0 if none.

        Raises:
            NotDriving: Somebody else has the controls; nothing was done.
            Stopped: Somebody took the controls meanwhile, or it took too long; physics is paused.
        """
        why = f"It took longer than {self._limits.wall_seconds:g} s on the wall."
        with anyio.move_on_after(self._limits.wall_seconds) as scope:
            async with self._one:
                self._console.lease.use(self.viewer)
                if self._console.controls.running:  # stepped along with the clock, for somebody who has left
                    await self._console.controls.run(self.viewer, running=False)
                watch = asyncio.create_task(self._watch(scope, progress, seconds))
                try:
                    return await work()
                except (OutcomeUnknown, URLabTimeoutError):
                    with contextlib.suppress(URLabError):
                        await self._console.client.resync()
                    raise
                except asyncio.CancelledError:  # by the agent's host, too
                    with anyio.CancelScope(shield=True):
                        await self._rest()
                    raise
                finally:
                    watch.cancel()
                    self._console.tell()
        holder = self._console.lease.holder
        if holder is not None and holder is not self.viewer:
            why = f"{holder.name} took the controls. Wait until they are free again, or ask."
        raise Stopped(f"{why} The call was broken off, and the simulation is at rest. Call state before going on.")

    async def _watch(self, scope: anyio.CancelScope, progress: Progress, seconds: float) -> None:
        """Keep the controls while a call goes on, and break it off when somebody takes them."""
        start = self._console.client.sim_time
        while True:
            await asyncio.sleep(_LOOK_S)
            try:
                self._console.lease.use(self.viewer)
            except NotDriving:
                scope.cancel()
                return
            if seconds:
                await progress(min(max(self._console.client.sim_time - start, 0.0), seconds), seconds)

    async def _rest(self) -> None:
        """Leave the simulation at rest: nothing in doubt, and paused where time passes by itself."""
        client = self._console.client
        with anyio.move_on_after(_REST_S), contextlib.suppress(URLabError):
            await client.resync()
            if client.step_mode is StepMode.LIVE:
                await client.runtime.set_paused(True)
