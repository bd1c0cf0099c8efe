"""`client.sim`: the life cycle of a play session."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from types import TracebackType

import anyio
import msgspec

from urlab_client.aio.background import running_loop
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.namespaces._base import Namespace, fill
from urlab_client.aio.session.session import STOP, Session, leaves_open
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.discovery import Discovery
from urlab_client.aio.state.sim_state import SimState
from urlab_client.enums import PIEState
from urlab_client.errors import URLabError, URLabPIEError, URLabTimeoutError
from urlab_client.protocol.messages.sim import BeginPie, BeginPieOk, PieStatus, StopPie
from urlab_client.values.types import PIEStartResult, PIEStatus

_POLL_S = 0.25
_SLICE_S = 2.0
_STOP_POLL_S = 0.05
_WIND_DOWN_S = 10.0
_SLACK_S = 15.0  # the server may need 10 s to reach its game thread before its own timeout starts


log: logging.Logger = logging.getLogger("urlab_client.client")


class Playing:
    """Play for the duration of a block; see `client.sim.playing()`."""

    def __init__(
        self,
        start: Callable[[], Awaitable[PIEStartResult]],
        stop: Callable[[], Awaitable[None]],
        status: Callable[[], Awaitable[PIEStatus]],
    ) -> None:
        """Create the context manager. Nothing is sent before it is entered.

        Args:
            start: Starts play.
            stop: Stops play.
            status: Returns the state of play.
        """
        self._start = start
        self._stop = stop
        self._status = status
        self._ours = False

    async def __aenter__(self) -> PIEStartResult:
        self._ours = (await self._status()).state is PIEState.OFF
        try:
            return await self._start()
        except BaseException as error:
            await self._end(error)
            raise

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._end(exc)

    async def _end(self, error: BaseException | None) -> None:
        if not self._ours:
            return
        try:
            with anyio.CancelScope(shield=True):  # bounded, because its requests have deadlines
                await self._stop()
        except URLabError as failed:
            if error is None:
                raise
            log.warning("play could not be stopped after %r: %s", error, failed)  # the first error is raised


class SimNamespace(Namespace):
    """Starting and stopping play."""

    def __init__(self, session: Session, state: SimState, discovery: Discovery) -> None:
        super().__init__(session)
        self._state = state
        self._discovery = discovery

    async def start(
        self,
        level_path: str | None = None,
        *,
        timeout_s: float = 30.0,
        raise_on_failure: bool = True,
        on_progress: Callable[[PIEStatus], object] | None = None,
        timeout: Timeout = DEFAULT,
    ) -> PIEStartResult:
        """Start play, wait until the model is compiled, and adopt the handshake of the new play world.

        Without `level_path`, a healthy play session continues and does not restart. Afterwards the client's own step
        mode is in force again; in live mode physics starts paused.

        Args:
            level_path: Level to open first, a full `/Game/` path: `/Game/Levels/lab` or `/Game/Levels/lab.lab`.
            timeout_s: Seconds to wait for the compile.
            raise_on_failure: Raise unless play is ready; otherwise return the result in any state.
            on_progress: Callback invoked with the state of play about every 0.25 s while the model compiles.
            timeout: Seconds to wait for each reply of the server; None waits without limit.

        Raises:
            URLabPIEError: Play did not become ready; the message contains the compile log.
        """
        async with self._session.turn(BeginPie, timeout=timeout, each=True) as turn:
            self._state.switching_play = True
            try:
                reply = await self._play(turn, level_path, timeout_s, on_progress)
                state = reply.state
                payload = reply.handshake_payload
                result = PIEStartResult(state=state, compile_error=reply.compile_error)
                if payload is not None:
                    await self._discovery.adopt(turn, payload)
                    self._session.unsettled.pop(STOP, None)  # what was stopped before does not matter any more
                    result.handshake_payload = msgspec.to_builtins(payload)
            finally:
                self._state.switching_play = False
        if raise_on_failure and not result.is_ready:
            explanation = reply.compile_error or (
                f"no compiled model within {timeout_s:g} s; does the level have a manager (scene.ensure_manager())?"
            )
            raise URLabPIEError(code=str(state), message=explanation, state=state)
        return result

    async def _play(
        self, turn: Turn, level_path: str | None, timeout_s: float, on_progress: Callable[[PIEStatus], object] | None
    ) -> BeginPieOk:
        """Begin play and wait until its model has compiled or failed to compile, or the time is up."""
        loop = running_loop()
        deadline = loop.time() + timeout_s
        # In slices: while the server waits for the compile it answers no client, including this one.
        reply = await self._begin(turn, level_path, min(timeout_s, _SLICE_S))
        while reply.state == PIEState.TIMEOUT and not reply.compile_error and loop.time() < deadline:
            status = fill(PIEStatus, await turn.call(PieStatus()))
            if on_progress is not None:
                on_progress(status)
            if status.state is PIEState.COMPILING:
                await turn.aside(asyncio.sleep(min(_POLL_S, max(0.0, deadline - loop.time()))))
            elif status.state is PIEState.OFF:
                break
            else:
                reply = await self._begin(turn, None, min(max(0.0, deadline - loop.time()), _SLICE_S))
        return reply

    async def _begin(self, turn: Turn, level_path: str | None, timeout_s: float) -> BeginPieOk:
        pending = self._state.pending
        try:
            reply = await turn.call(BeginPie(level_path=level_path, timeout_s=timeout_s), takes=timeout_s + _SLACK_S)
        except BaseException as error:
            pending.play = pending.play or (turn.sent and leaves_open(error))
            raise
        # Until the handshake has been adopted, or is known not to come.
        pending.play = reply.state in (PIEState.READY, PIEState.TIMEOUT)
        return reply

    async def stop(self, *, timeout: Timeout = DEFAULT) -> None:
        """Stop play and wait until it has ended; return immediately if play is off. The session continues.

        Args:
            timeout: Seconds to wait for each reply of the server; None waits without limit.

        Raises:
            GameThreadTimeout: The editor did not react, often because a modal dialog is open.
            URLabTimeoutError: The editor accepted the request, but play did not end within 10 s.
        """
        async with self._session.turn(StopPie, timeout=timeout, each=True) as turn:
            await self._stop(turn)

    async def _stop(self, turn: Turn) -> None:
        state, loop = self._state, running_loop()
        state.switching_play = True
        # On Windows the server could neither remove nor recreate regions that this client has mapped.
        state.publishers.release_regions()
        try:
            with self._session.settling(STOP, self._stop):
                await turn.call(StopPie())
            # The plugin replies as soon as the end has been requested.
            self._session.unsettled[STOP] = self._stop
            deadline = loop.time() + _WIND_DOWN_S
            while fill(PIEStatus, await turn.call(PieStatus())).state is not PIEState.OFF:
                if loop.time() > deadline:
                    raise URLabTimeoutError(f"stop_pie: play did not end within {_WIND_DOWN_S:g} s.", op="stop_pie")
                await turn.aside(asyncio.sleep(_STOP_POLL_S))
        finally:
            state.switching_play = False
        state.on_play_ended("stopped by this client")

    def playing(self, level_path: str | None = None, *, timeout_s: float = 30.0) -> Playing:
        """Play for the duration of a `with` block: start on entering, and stop on leaving, also after an exception.

        If play is already running, the block joins it as `start()` does, and play continues after the block.

        Args:
            level_path: Level to open first, a full `/Game/` path; None for the open one.
            timeout_s: Seconds to wait for the compile.

        Raises:
            URLabPIEError: On entering, play did not become ready. It is stopped again.

        Example:
            async with client.sim.playing():
                await client.step(100)
        """
        return Playing(lambda: self.start(level_path, timeout_s=timeout_s), self.stop, self.status)

    async def status(self, *, timeout: Timeout = DEFAULT) -> PIEStatus:
        """Read the state of play."""
        return fill(PIEStatus, await self._call(PieStatus(), timeout))
