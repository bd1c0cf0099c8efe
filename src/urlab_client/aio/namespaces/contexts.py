"""Context managers for play, and for scene edits that end with one restart of play."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from types import TracebackType

import anyio

from urlab_client.enums import PIEState
from urlab_client.errors import URLabError
from urlab_client.values.types import PIEStartResult, PIEStatus

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


class SceneEdit:
    """Edits of the level, after which play is restarted once; see `client.scene.edit()`."""

    def __init__(self, begin: Callable[[], None], end: Callable[[bool], Awaitable[None]]) -> None:
        """Create the context manager. Nothing is sent before its end.

        Args:
            begin: Callback invoked when the block is entered.
            end: Callback invoked when the block is left, with True unless it raised.
        """
        self._begin = begin
        self._end = end

    async def __aenter__(self) -> None:
        self._begin()

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if isinstance(exc, Exception):
            exc.add_note("scene.edit(): the edits made before this error stay in the level; play was not restarted.")
        await self._end(exc is None)
