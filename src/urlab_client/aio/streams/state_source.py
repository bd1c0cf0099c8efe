"""Snapshots of the simulation, from the state socket, the state region or the client's own steps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from urlab_client.aio.streams.source import PublishedSource
from urlab_client.aio.transport.shm_streams import Place, Regions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.protocol.messages.session import StateReply
from urlab_client.protocol.messages.streams import (
    StateSnapshot,
)
from urlab_client.protocol.shm import STATE_FILE, Ring
from urlab_client.protocol.topics import STATE_FULL
from urlab_client.values.layouts import BytesLike

_ONLY_OWN = (
    "This server publishes state only in live mode: call client.runtime.set_mode('live'). In the other modes, "
    "snapshots come only from this client's own steps."
)


class OwnSteps:
    """Delivers the states in replies to receivers of snapshots if the server publishes only in live mode."""

    def __init__(self) -> None:
        self._handlers: dict[MessageHandler, None] = {}

    def __bool__(self) -> bool:
        return bool(self._handlers)

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from the event loop."""
        self._handlers[handler] = None

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Idempotent."""
        self._handlers.pop(handler, None)

    def publish(self, reply: StateReply) -> None:
        """Deliver a state to all handlers."""
        payload = StateSnapshot.of(reply).encode()
        for handler in tuple(self._handlers):
            handler.take(STATE_FULL, payload)
            handler.drain()


class StateSource(PublishedSource):
    """The snapshots of the state region or the state socket.

    Args:
        subscriptions: Subscriptions of the client.
        endpoint: Callback that returns the address of the state socket.
        regions: See the base class.
        own: Delivers the states of the client's own steps if the server does not publish them.
        only_own: Callback that returns whether snapshots currently come only from the client's own steps.

    Attributes:
        subscriptions: The argument of that name.
        endpoint: The argument of that name.
    """

    name = "state_stream"
    unreachable = (
        "The port is open only while play runs: call client.sim.start(). Check that it is the server's state port."
    )
    silent = (
        "While play runs, the server publishes a snapshot at least every 100 ms in every mode, even while paused. "
        "Check that this is the server's state port."
    )

    def __init__(
        self,
        subscriptions: Subscriptions,
        endpoint: Callable[[], str],
        own: OwnSteps | None = None,
        *,
        regions: Regions | None = None,
        only_own: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(subscriptions, regions)
        self.subscriptions = subscriptions
        self.endpoint = endpoint
        self._own = OwnSteps() if own is None else own
        self._only_own = only_own
        # The socket may be one snapshot ahead of the region. Each contains its build time, so no two are equal.
        self._came = deque[BytesLike](maxlen=2)

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from the event loop."""
        super().attach(handler)
        self._own.attach(handler)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Idempotent."""
        super().detach(handler)
        self._own.detach(handler)

    def subscription(self) -> Subscription:
        """See the base class."""
        return Subscription(self.endpoint(), (STATE_FULL,), STATE_FULL.__eq__)

    def place(self) -> Place:
        """See the base class."""
        return Place(STATE_FILE, STATE_FULL, Ring.STATE)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Skip snapshots that already arrived: both deliver them when the region takes over from the socket."""
        if self._regions is None:
            return True
        if payload in self._came:
            return False
        self._came.append(payload)
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return the seconds to wait for the first snapshot; infinite if snapshots come only from steps."""
        return math.inf if self._only_own() else super().first_after(handler)

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """See the base class."""
        problem, advice = super().silence(handler, seconds)
        return problem, _ONLY_OWN if self._only_own() else advice

    def decode(self, topic: bytes, payload: BytesLike) -> StateSnapshot:
        """Decode a snapshot. Raises `ProtocolError`."""
        return StateSnapshot.decode(payload, topic.decode())
