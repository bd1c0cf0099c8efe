"""One call of a tool: its caller, session and limits."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

import anyio
from msgspec import Struct

from urlab_client.aio.background import background_task
from urlab_client.aio.explain import connection_problem
from urlab_client.console.lease import NotDriving, Viewer
from urlab_client.console.session import ConsoleSession
from urlab_client.enums import StepMode
from urlab_client.errors import OutcomeUnknown, URLabConnectionError, URLabError, URLabTimeoutError

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient

T = TypeVar("T")
Progress = Callable[[float, float | None, str | None], Awaitable[None]]
"""Progress callback: seconds passed, their limit if there is one, and what they pass with."""

TAKEN_OVER = "Another program has taken the server over. Ask a person to take it back in the console."

RESTARTED = "The server was started again, and its simulation has begun anew. Call look before going on."

_CONNECT_S = 10.0
_FIRST_S = 0.5
_PROBE_S = 0.4
_TOLD_S = 0.5
_REPORT_S = 0.1
_REST_S = 5.0
_THINKS_S = 60.0  # idle time after which an agent loses the controls; people can take them earlier


class Limits(Struct, frozen=True, kw_only=True):
    """Permissions and limits of an agent.

    Attributes:
        drive: Whether it may move robots, reset, pause and record.
        edit: Whether it may change the scene.
        sim_seconds: Simulation time that one call may take, seconds.
        wall_seconds: Wall time that one call may take, seconds.
    """

    drive: bool = False
    edit: bool = False
    sim_seconds: float = 10.0
    wall_seconds: float = 60.0


class Stopped(Exception):
    """A call was aborted; the message says why, and what to do."""


class Caller(Viewer):
    """An agent. People take the controls from it by acting; other agents wait until it is idle.

    Attributes:
        last_read: Number of the last log entry that it has read.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"agent:{secrets.token_urlsafe(16)}", name, yields=True, keeps=_THINKS_S)
        self.last_read = 0


class Call:
    """See the module."""

    def __init__(
        self,
        console: ConsoleSession,
        caller: Caller,
        limits: Limits,
        models: Mapping[str, Path],
        progress: Progress,
    ) -> None:
        self.console = console
        self.client: URLabClient = console.client
        self.caller = caller
        self.limits = limits
        self.models = models
        self._progress = progress
        self._seconds = 0.0
        self._rests = True

    def robot(self, name: str) -> URLabArticulation:
        """Return a robot."""
        return self.client.articulations[name]

    def within(self, seconds: float) -> float:
        """Return a duration of simulation time that the call may take."""
        if seconds > self.limits.sim_seconds:
            raise ValueError(
                f"A call may take up to {self.limits.sim_seconds:g} s of simulation time, got {seconds:g}. "
                "Call again to continue."
            )
        self._seconds = seconds
        return seconds

    async def connected(self) -> None:
        """Wait until the console's session is open, and report what the caller waits for.

        A simulated server that this program starts has as long as a call may take. One that should be running already
        is not waited for once an attempt has failed.
        """
        starts = self.client.address.startswith("sim://")
        waiting = background_task("urlab-mcp-connecting", self._report_connecting())
        try:
            await self._attempted(self.limits.wall_seconds if starts else _CONNECT_S)
        finally:
            waiting.cancel()
        if self.console.link.state != "connected":
            raise URLabConnectionError(await self.missing())

    async def _attempted(self, seconds: float) -> None:
        """Wait until the session is open, a first attempt has failed, or only a person can open it again."""
        with self.console.view.watch() as changed, anyio.move_on_after(seconds):
            while (link := self.console.link).state not in {"connected", "taken_over"}:
                if link.state == "connecting" and link.reason:
                    return
                changed.clear()
                await changed.wait()

    async def _report_connecting(self) -> None:
        began = time.monotonic()
        while True:
            await asyncio.sleep(_TOLD_S)
            await self._progress(time.monotonic() - began, None, self._connecting())

    def _connecting(self) -> str:
        doing = "The simulated server is starting" if self.client.address.startswith("sim://") else "Connecting"
        return f"{doing}: {self.client.address}."

    async def missing(self) -> str:
        """Return why there is no connection, as far as can be found out within a second; empty if there is one."""
        if self.console.link.state == "connecting":
            await self._attempted(_FIRST_S)
        link, address = self.console.link, self.client.address
        if link.state == "connected":
            return ""
        if link.state == "taken_over":
            return TAKEN_OVER
        if address.startswith("sim://") and not link.reason:
            return f"{self._connecting()} Call again in a few seconds."
        why = link.reason.rstrip(".?") or "a first attempt is under way"
        endpoint = urlsplit(address)
        if endpoint.scheme == "tcp":
            port = endpoint.port or self.client.config.step_port
            problem = await connection_problem(endpoint.hostname or "localhost", port, _PROBE_S)
            why = problem or f"{why}. The port accepts connections, so the server may be busy or starting"
        known = (
            f"There is no connection to {address}: {why.rstrip('.?')}. It is retried automatically: call again later."
        )
        if self.client.session_id:
            known += " If the server was started again, its simulation has begun anew: call look before going on."
        return known

    async def drive(self, work: Callable[[], Awaitable[T]]) -> T:
        """Do something that changes the simulation, through the console's controls."""
        began = False
        why = f"It took longer than {self.limits.wall_seconds:g} s on the wall."
        with anyio.move_on_after(self.limits.wall_seconds):
            try:
                async with self.console.lease.hold(self.caller):
                    began = True
                    return await self._reported(work)
            except NotDriving as refusal:
                why = str(refusal)
                if not began:
                    raise NotDriving(f"{why} Nothing was done. Call again later, or ask.") from None
        rests = "and the simulation is at rest" if self._rests else "but the simulation may still move"
        raise Stopped(f"{why} The call was aborted, {rests}. Call state before you continue.")

    async def _reported(self, work: Callable[[], Awaitable[T]]) -> T:
        """Do something, report its progress, and leave the simulation at rest if it is aborted."""
        reporting = background_task("urlab-mcp-progress", self._report())
        try:
            if self.console.controls.running:  # real-time stepping, started by a caller that has left
                await self.console.controls.run(self.caller, running=False)
            return await work()
        except (OutcomeUnknown, URLabTimeoutError):
            with contextlib.suppress(URLabError):
                await self.client.resync()
            raise
        except asyncio.CancelledError:  # also by the agent's host
            with anyio.CancelScope(shield=True):
                await self._rest()
            raise
        finally:
            reporting.cancel()
            self.console.view.notify()

    async def _report(self) -> None:
        start = self.client.sim_time
        while True:
            await asyncio.sleep(_REPORT_S)
            if self._seconds:
                passed = min(max(self.client.sim_time - start, 0.0), self._seconds)
                await self._progress(passed, self._seconds, None)

    async def _rest(self) -> None:
        """Leave the simulation at rest: no request in doubt, and paused in live mode."""
        self._rests = False
        with anyio.move_on_after(_REST_S), contextlib.suppress(URLabError):
            await self.client.resync()
            if self.client.step_mode is StepMode.LIVE:
                await self.client.runtime.set_paused(True)
            self._rests = True
