"""Keeping a session open: `keep_session=True`.

After a restart of the server and with each new play session, the client discovers again automatically. It never takes a
session back: the server has a single session, the last client that sent `hello` holds it, and no request shows which
client that is. The client can only detect that the server was down. So it reopens only a session that was lost with the
connection, if nothing listened at the address meanwhile and the simulation has not continued.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from urlab_client.aio.background import background_task
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.discovery import Discovery
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.streams.stream import Stream
from urlab_client.errors import ClientClosed, URLabConnectionError, URLabError, URLabTimeoutError
from urlab_client.events import ClientEvent, PlayStarted, ServerLost, SessionLost
from urlab_client.protocol.messages.runtime import ListKeyframes
from urlab_client.protocol.messages.session import Hello
from urlab_client.protocol.messages.streams import StreamPolicy

log: logging.Logger = logging.getLogger("urlab_client.client")

_LOOK_S: Final = 5.0  # interval between checks that this client still holds the session
_PROBE_S: Final = 2.0
_WORLD_S: Final = 0.5  # a running simulation that publishes does so ten times a second
_PAUSES_S: Final = (0.0, 0.2, 0.5, 1.0, 2.0)  # between attempts; the last one repeats


class SessionKeeper:
    """Keeps the session of one client open, in one task."""

    def __init__(self, session: Session, state: SimState, discovery: Discovery) -> None:
        self._session = session
        self._state = state
        self._discovery = discovery
        self._task: asyncio.Task[None] | None = None
        self._time = 0.0  # simulation time when the connection was lost
        self._given_up = ""  # id of a session that another client has taken over

    def start(self) -> None:
        """Keep the current session and its successors open. Call from the event loop. Idempotent.

        If it fails, calls name the reason until this is called again.
        """
        if self._task is None or self._task.done():
            kinds = (ServerLost, SessionLost, PlayStarted)
            events = self._state.publishers.events.stream(kinds, 100)
            session = self._session
            session.unkept = None
            self._task = background_task("urlab-keeper", self._run(events), tell=session.tell, failed=self._die)

    async def aclose(self) -> None:
        """Stop keeping the session. Idempotent."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))

    def _die(self, error: URLabError) -> None:
        self._session.unkept = error

    async def _run(self, events: Stream[ClientEvent]) -> None:
        while True:
            try:
                await self._act_on(await events.receive(timeout=_LOOK_S))
            except URLabTimeoutError:
                await self._look()
            except ClientClosed:
                return
            except URLabError as error:
                log.warning("the session could not be checked: %s", error)

    async def _act_on(self, event: ClientEvent) -> None:
        match event:
            case ServerLost():
                self._time = self._state.clocks.sim_time
            case SessionLost():
                if event.session_id == self._session.session_id:
                    await self._on_lost(event.session_id)
            case PlayStarted(articulations=[]):
                await self._open("another client or the editor has started play")
            case _:
                pass

    async def _look(self) -> None:
        """Detect a takeover of the session early, before a restart of the server could be mistaken for the cause."""
        session = self._session
        if session.session_id not in ("", self._given_up) and session.transport.connected:
            try:
                await session.probe(ListKeyframes(), timeout=_PROBE_S)
            except URLabError as error:  # the events report its meaning
                log.debug("the session probe failed: %s", error)

    async def _on_lost(self, session_id: str) -> None:
        if session_id == self._given_up:
            return
        if not self._session.was_down or await self._simulation_continues():
            self._given_up = session_id
            log.warning("another client has taken over the session; this client does not take it back")
            return
        await self._open("the server has been restarted")

    async def _simulation_continues(self) -> bool:
        """Return whether the simulation is at or past the last known time, so that no server was restarted."""
        if self._time <= 0.0:
            return False
        snapshots = Stream(self._state.publishers.state(), policy=StreamPolicy.LATEST)
        try:
            async with snapshots:
                return (await snapshots.receive(timeout=_WORLD_S)).time >= self._time
        except URLabTimeoutError:
            return False

    async def _open(self, why: str) -> None:
        """Open a session as soon as the server permits, unless the user opens one or outcomes are pending."""
        session, state = self._session, self._state
        lost = session.session_id
        attempt = 0
        while session.session_id == lost and not state.pending:
            await asyncio.sleep(_PAUSES_S[min(attempt, len(_PAUSES_S) - 1)])
            attempt += 1
            try:
                async with session.turn(Hello) as turn:
                    if session.session_id == lost:
                        log.info("discovering again, because %s", why)
                        await self._discovery.open(turn, state.level.of_session)
            except (URLabConnectionError, URLabTimeoutError) as error:
                if isinstance(error, ClientClosed):
                    raise
                log.info("the session cannot be opened yet: %s", error)
            except URLabError as error:
                log.warning("the session could not be opened again: %s", error)
                return
