"""Detection of lost connections, lost sessions, and the start and end of play; keeping a session open.

The wire announces none of these. When a connection breaks or the snapshots stop, the monitor sends a request without
side effects, and the reply shows the reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from typing import Final

from urlab_client.aio.background import background_task
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.discovery import Discovery
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.streams.stream import Stream
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription
from urlab_client.errors import (
    ClientClosed,
    NoActiveManager,
    URLabConnectionError,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)
from urlab_client.events import ClientEvent, PlayStarted, ServerLost, ServerReconnected, SessionLost
from urlab_client.protocol.messages.runtime import ListKeyframes
from urlab_client.protocol.messages.session import Hello
from urlab_client.protocol.messages.streams import StreamPolicy
from urlab_client.protocol.topics import STATE_FULL
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.client")

_PROBE_S = 2.0
_SILENCE_S = 1.0  # while play runs, a snapshot arrives every 100 ms in every mode, even while paused
# The plugin closes the state socket before or after it ends the play session.
_PROBE_DELAYS_S = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)


class ConnectionMonitor(MessageHandler):
    """Monitors one client in a task that runs only while there is something to find out.

    In live mode it always watches the state. In the other modes, where the client does not otherwise use the state
    socket, it watches only while the events have listeners.
    """

    def __init__(self, session: Session, state: SimState) -> None:
        self._session = session
        self._state = state
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._present = False
        self._announced = False
        self._received = 0
        self._flowing = False
        self._closed = False
        state.publishers.events.on_listener = self._on_listener
        state.on_adopted = self._on_adopted

    def on_transport(self, event: ClientEvent) -> None:
        publishers = self._state.publishers
        if isinstance(event, ServerLost):
            self._session.confirmed = False
            publishers.release_regions()  # the next server may reuse their files with another layout
        publishers.events.publish(event)
        if isinstance(event, ServerReconnected):
            self._session.was_down = self._session.was_down or event.refused
            publishers.refresh()
            self._investigate()

    async def aclose(self) -> None:
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))

    def _on_listener(self) -> None:
        """Start watching the state socket. Call from any thread."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._attend)

    def _on_adopted(self) -> None:
        self._announced = False
        self._loop = asyncio.get_running_loop()
        if self._timer is None:
            self._timer = self._loop.call_later(_SILENCE_S, self._tick)
        self._attend()

    def _attend(self) -> None:
        if self._closed or not self._state.publishers.events.heard:
            return
        subscriptions = self._state.publishers.subscriptions
        if not self._present:
            self._present = True
            try:
                subscriptions.attach(self, self._wanted)
            except (URLabError, ValueError) as error:
                log.debug("the state socket cannot be watched: %s", error)
        subscriptions.refresh()

    def _wanted(self) -> Subscription:
        # While play runs, the open connection shows it. Afterwards only a snapshot does: the socket may stay open.
        subscription = self._state.publishers.state().subscription()
        filters = () if self._state.playing or self._announced else (STATE_FULL,)
        return Subscription(subscription.endpoint, filters, subscription.accepts)

    # Called for the state socket

    def on_connection(self, connected: bool) -> None:
        if self._state.playing and not connected:
            self._investigate()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        if not (self._state.playing or self._announced):
            self._investigate()

    def on_malformed(self, problem: str) -> None:
        self.on_message(b"", b"")  # a sign of play, too

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Do nothing: the client is being closed."""

    def _tick(self) -> None:
        if self._closed or self._loop is None:
            return
        self._timer = self._loop.call_later(_SILENCE_S, self._tick)
        received = self._state.live_received
        flowing = received != self._received
        if self._flowing and not flowing and self._state.playing and self._state.live:
            self._investigate()
        self._received, self._flowing = received, flowing

    def _investigate(self) -> None:
        """Start to determine the reason, unless that is in progress or this client is starting or ending play."""
        if self._closed or self._state.switching_play or not self._session.session_id:
            return
        if self._task is None or self._task.done():
            self._task = background_task("urlab-watch", self._find_out(), tell=self._session.tell)

    async def _find_out(self) -> None:
        before = self._state.playing
        for pause in _PROBE_DELAYS_S:
            await asyncio.sleep(pause)
            if self._state.switching_play or before != self._state.playing or not self._session.transport.connected:
                return
            try:
                reply = await self._session.probe(ListKeyframes(), timeout=_PROBE_S)
            except NoActiveManager:
                return  # the state already reflects it
            except URLabRPCError as refusal:
                log.debug("the server refused the session probe: %s", refusal)
                return
            except URLabError as error:
                log.debug("the session probe failed: %s", error)
                continue
            if reply is not None and not before:
                self._announced = True
                self._state.publishers.events.publish(PlayStarted())
                self._attend()
                return


_PROBE_INTERVAL_S: Final = 5.0  # interval between checks that this client still holds the session
_SNAPSHOT_S: Final = 0.5  # a running simulation that publishes does so ten times a second
_PAUSES_S: Final = (0.0, 0.2, 0.5, 1.0, 2.0)  # between attempts; the last one repeats


class SessionKeeper:
    """Keeps the session of one client open, in one task: `keep_session=True`.

    After a restart of the server and with each new play session, the client discovers again automatically. It never
    takes a session back: the server has a single session, the last client that sent `hello` holds it, and no request
    shows which client that is. The client can only detect that the server was down. So it reopens only a session that
    was lost with the connection, if nothing listened at the address meanwhile and the simulation has not continued.
    """

    def __init__(self, session: Session, state: SimState, discovery: Discovery) -> None:
        self._session = session
        self._state = state
        self._discovery = discovery
        self._task: asyncio.Task[None] | None = None
        self._time = 0.0  # simulation time when the connection was lost
        self._taken_over = ""  # id of a session that another client has taken over

    def start(self) -> None:
        """Keep the current session and its successors open. Call from the event loop. Idempotent.

        If it fails, calls name the reason until this is called again.
        """
        if self._task is None or self._task.done():
            kinds = (ServerLost, SessionLost, PlayStarted)
            events = self._state.publishers.events.stream(kinds, 100)
            session = self._session
            session.unkept = None
            self._task = background_task(
                "urlab-keeper", self._run(events), tell=session.tell, failed=self._note_failure
            )

    async def aclose(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))

    def _note_failure(self, error: URLabError) -> None:
        self._session.unkept = error

    async def _run(self, events: Stream[ClientEvent]) -> None:
        while True:
            try:
                await self._act_on(await events.receive(timeout=_PROBE_INTERVAL_S))
            except URLabTimeoutError:
                await self._probe()
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

    async def _probe(self) -> None:
        """Detect a takeover of the session early, before a restart of the server could be mistaken for the cause."""
        session = self._session
        if session.session_id not in ("", self._taken_over) and session.transport.connected:
            try:
                await session.probe(ListKeyframes(), timeout=_PROBE_S)
            except URLabError as error:  # the events report its meaning
                log.debug("the session probe failed: %s", error)

    async def _on_lost(self, session_id: str) -> None:
        if session_id == self._taken_over:
            return
        if not self._session.was_down or await self._simulation_continues():
            self._taken_over = session_id
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
                return (await snapshots.receive(timeout=_SNAPSHOT_S)).time >= self._time
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
                        await self._discovery.open(turn, state.level)
            except (URLabConnectionError, URLabTimeoutError) as error:
                if isinstance(error, ClientClosed):
                    raise
                log.info("the session cannot be opened yet: %s", error)
            except URLabError as error:
                log.warning("the session could not be opened again: %s", error)
                return
