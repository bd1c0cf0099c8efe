"""Detection of lost connections, lost sessions, and the start and end of play.

The wire announces none of these. When a connection breaks or the snapshots stop, the monitor sends a request without
side effects, and the reply shows the reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable

from urlab_client.aio.background import background_task
from urlab_client.aio.session.session import Session
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription
from urlab_client.errors import NoActiveManager, URLabError, URLabRPCError
from urlab_client.events import ClientEvent, PlayStarted, ServerLost, ServerReconnected
from urlab_client.protocol.messages.runtime import ListKeyframes
from urlab_client.protocol.topics import STATE_FULL
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.client")

_PROBE_S = 2.0
_SILENCE_S = 1.0  # while play runs, a snapshot arrives every 100 ms in every mode, even while paused
# The plugin closes the state socket before or after it ends the play session.
_PROBE_DELAYS_S = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)


class ConnectionMonitor:
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
        self._presence = _Presence(self._on_state_line, self._on_sign_of_play)
        self._present = False
        self._announced = False
        self._received = 0
        self._flowing = False
        self._closed = False
        state.publishers.events.on_listener = self._on_listener
        state.on_adopted = self._on_adopted

    def on_connection(self, event: ClientEvent) -> None:
        """Handle an event of the request connection and publish it."""
        publishers = self._state.publishers
        if isinstance(event, ServerLost):
            self._session.confirmed = False
            publishers.release_regions()  # the next server may reuse their files with another layout
        publishers.events.publish(event)
        if isinstance(event, ServerReconnected):
            self._session.was_down = self._session.was_down or event.refused
            publishers.resume_regions()
            self._look()

    async def aclose(self) -> None:
        """Stop watching. Idempotent."""
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
        """Handle a new handshake or the end of play."""
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
                subscriptions.attach(self._presence, self._wanted)
            except (URLabError, ValueError) as error:
                log.debug("the state socket cannot be watched: %s", error)
        subscriptions.refresh()

    def _wanted(self) -> Subscription:
        # While play runs, the open connection shows it. Afterwards only a snapshot does: the socket may stay open.
        subscription = self._state.publishers.state().subscription()
        filters = () if self._playing or self._announced else (STATE_FULL,)
        return Subscription(subscription.endpoint, filters, subscription.accepts)

    @property
    def _playing(self) -> bool:
        return self._state.playing

    def _on_state_line(self, connected: bool) -> None:
        if self._playing and not connected:
            self._look()

    def _on_sign_of_play(self) -> None:
        if not (self._playing or self._announced):
            self._look()

    def _tick(self) -> None:
        """Check whether live snapshots have stopped."""
        if self._closed or self._loop is None:
            return
        self._timer = self._loop.call_later(_SILENCE_S, self._tick)
        received = self._state.live_received
        flowing = received != self._received
        if self._flowing and not flowing and self._playing and self._state.live:
            self._look()
        self._received, self._flowing = received, flowing

    def _look(self) -> None:
        """Start to determine the reason, unless that is in progress or this client is starting or ending play."""
        if self._closed or self._state.switching_play or not self._session.session_id:
            return
        if self._task is None or self._task.done():
            self._task = background_task("urlab-watch", self._find_out(), tell=self._session.tell)

    async def _find_out(self) -> None:
        before = self._playing
        for pause in _PROBE_DELAYS_S:
            await asyncio.sleep(pause)
            if self._state.switching_play or before != self._playing or not self._session.transport.connected:
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


class _Presence(MessageHandler):
    """Watches the connection to the state socket."""

    def __init__(self, on_connection: Callable[[bool], None], on_sign: Callable[[], None]) -> None:
        self._on_line = on_connection
        self._on_sign = on_sign

    def on_connection(self, connected: bool) -> None:
        self._on_line(connected)

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        self._on_sign()

    def on_malformed(self, problem: str) -> None:
        self._on_sign()

    def on_end(self, error: Callable[[], URLabError]) -> None:
        """Do nothing: the client is being closed."""
