"""What all ZeroMQ connections of the client have in common: how they notice a dead peer, and what stands in their way.

A peer that is gone silently (a pulled cable, a suspended machine, a stopped process) is noticed after
`HEARTBEAT_MS + SILENCE_MS` at the latest, one whose system closes the connection at once. Heartbeats are answered by
the peer's I/O thread, also while its worker is busy for minutes: they tell a dead server, not a wedged one.
"""

from __future__ import annotations

import contextlib
import errno
from typing import Final

import zmq

__all__ = [
    "FAILED_HANDSHAKES",
    "NOTICED_S",
    "OBSTACLES",
    "RETRYING",
    "RETRY_S",
    "REVIVE_S",
    "UNANSWERED",
    "WATCHED",
    "Attempts",
    "configure",
    "reconnect",
]

HEARTBEAT_MS = 1000
SILENCE_MS = 3000
# The system's own limits are minutes: with them a cable plugged in again would be noticed as late.
_CONNECT_MS = 3000
_SILENT = 0.9  # of that time, and nothing refused the attempt
_RECONNECT_MS = 50
RECONNECT_MAX_MS = 1000

NOTICED_S: Final = (HEARTBEAT_MS + SILENCE_MS) / 1000
"""Seconds after which a connection to a silent peer is given up."""

FAILED_HANDSHAKES: Final = (
    zmq.Event.HANDSHAKE_FAILED_AUTH,
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL,
    zmq.Event.HANDSHAKE_FAILED_PROTOCOL,
)

WATCHED: Final = (
    zmq.Event.CONNECTED
    | zmq.Event.CONNECT_RETRIED
    | zmq.Event.DISCONNECTED
    | zmq.Event.HANDSHAKE_SUCCEEDED
    | zmq.Event.HANDSHAKE_FAILED_AUTH
    | zmq.Event.HANDSHAKE_FAILED_NO_DETAIL
    | zmq.Event.HANDSHAKE_FAILED_PROTOCOL
)
"""Events that a monitor of a connection must bring."""

UNANSWERED: Final = "the host does not answer"

OBSTACLES: Final = {
    zmq.Event.CONNECT_RETRIED: "connection refused",
    zmq.Event.CONNECTED: "something accepts the connection but does not speak ZeroMQ, or is suspended",
    **dict.fromkeys(FAILED_HANDSHAKES, "the ZeroMQ handshake failed"),
}
"""What an event says about why there is no connection."""


RETRYING: Final = (zmq.Event.CONNECT_RETRIED, zmq.Event.CONNECTED, zmq.Event.HANDSHAKE_SUCCEEDED)
"""Events that show that ZeroMQ goes on by itself."""

REVIVE_S: Final = 0.1
"""Seconds after a loss by which one of those has come, or never will: ZeroMQ gives up a connection over which garbage
came."""

RETRY_S: Final = 2 * RECONNECT_MAX_MS / 1000
"""The same after a handshake that failed, where ZeroMQ itself may be waiting before it tries again."""


class Attempts:
    """Follows a connection's attempts, to tell a host that refuses from one that says nothing: ZeroMQ does not.

    Args:
        now: When the first attempt begins, seconds.
    """

    def __init__(self, now: float) -> None:
        self._began = now
        self._ended = False

    def obstacle(self, event: zmq.Event, value: int, now: float) -> str | None:
        """Return what stands in the way after a monitor's event, None if the event does not say.

        Args:
            event: The event.
            value: Its value; of `CONNECT_RETRIED` the milliseconds until the next attempt.
            now: The time, seconds.
        """
        took, self._began = now - self._began, now
        ended, self._ended = self._ended, event is zmq.Event.DISCONNECTED
        if event is zmq.Event.CONNECT_RETRIED:
            self._began += value / 1000
            if ended or took < 0:
                # It tells when the next attempt begins, and of none that failed; or events were read too late to tell.
                return None
            if took >= _SILENT * _CONNECT_MS / 1000:
                return UNANSWERED
        if event is zmq.Event.HANDSHAKE_FAILED_NO_DETAIL and value == errno.EAGAIN:  # which says that time was up
            event = zmq.Event.CONNECTED
        return OBSTACLES.get(event)


def reconnect(socket: zmq.Socket[bytes], endpoint: str) -> None:
    """Connect afresh."""
    with contextlib.suppress(zmq.ZMQError):  # which says that ZeroMQ has forgotten the endpoint
        socket.disconnect(endpoint)
    socket.connect(endpoint)


def configure(socket: zmq.Socket[bytes]) -> None:
    """Set what makes `socket` notice a dead peer and come back; before it connects."""
    socket.linger = 0
    socket.heartbeat_ivl = HEARTBEAT_MS
    socket.heartbeat_timeout = SILENCE_MS
    socket.heartbeat_ttl = SILENCE_MS
    socket.connect_timeout = _CONNECT_MS
    socket.handshake_ivl = _CONNECT_MS
    socket.reconnect_ivl = _RECONNECT_MS
    socket.reconnect_ivl_max = RECONNECT_MAX_MS
