"""Settings and diagnosis shared by all ZeroMQ connections of the client.

The client detects a silent peer (a pulled cable, a suspended machine, a stopped process) after at most
`HEARTBEAT_MS + SILENCE_MS`, and a peer whose system closes the connection immediately. The peer's I/O thread answers
heartbeats even while its worker is busy for minutes, so they detect a dead server but not a blocked one.
"""

from __future__ import annotations

import contextlib
import errno
from typing import Final

import zmq

HEARTBEAT_MS = 1000
SILENCE_MS = 3000
# The system's own limits are minutes, which would delay the detection of a restored cable as long.
_CONNECT_MS = 3000
_SILENT = 0.9  # of that time, and nothing refused the attempt
_RECONNECT_MS = 50
RECONNECT_MAX_MS = 1000

NOTICED_S: Final = (HEARTBEAT_MS + SILENCE_MS) / 1000
"""Seconds after which a connection to a silent peer is closed."""

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
"""Events that a connection's monitor must deliver."""

UNANSWERED: Final = "the host does not answer"

OBSTACLES: Final = {
    zmq.Event.CONNECT_RETRIED: "connection refused",
    zmq.Event.CONNECTED: "something accepts the connection but does not speak ZeroMQ, or is suspended",
    **dict.fromkeys(FAILED_HANDSHAKES, "the ZeroMQ handshake failed"),
}
"""Reasons for a missing connection, by event."""


RETRYING: Final = (zmq.Event.CONNECT_RETRIED, zmq.Event.CONNECTED, zmq.Event.HANDSHAKE_SUCCEEDED)
"""Events that show that ZeroMQ continues on its own."""

REVIVE_S: Final = 0.1
"""Seconds after a loss within which one of these events arrives, if any: ZeroMQ abandons a connection that delivered
invalid data."""

RETRY_S: Final = 2 * RECONNECT_MAX_MS / 1000
"""The same after a failed handshake, when ZeroMQ itself may wait before the next attempt."""


class Attempts:
    """Tracks the attempts of a connection to distinguish a refusing host from a silent one, as ZeroMQ does not.

    Args:
        now: Start time of the first attempt, seconds.
    """

    def __init__(self, now: float) -> None:
        self._began = now
        self._ended = False

    def obstacle(self, event: zmq.Event, value: int, now: float) -> str | None:
        """Return the obstacle that a monitor's event shows, or None if it shows none.

        Args:
            event: The event.
            value: Value of the event; for `CONNECT_RETRIED`, the milliseconds until the next attempt.
            now: Current time, seconds.
        """
        took, self._began = now - self._began, now
        ended, self._ended = self._ended, event is zmq.Event.DISCONNECTED
        if event is zmq.Event.CONNECT_RETRIED:
            self._began += value / 1000
            if ended or took < 0:
                # The event announces the next attempt and no failed one, or events were read too late to decide.
                return None
            if took >= _SILENT * _CONNECT_MS / 1000:
                return UNANSWERED
        if event is zmq.Event.HANDSHAKE_FAILED_NO_DETAIL and value == errno.EAGAIN:  # means a timeout
            event = zmq.Event.CONNECTED
        return OBSTACLES.get(event)


def reconnect(socket: zmq.Socket[bytes], endpoint: str) -> None:
    """Connect again."""
    with contextlib.suppress(zmq.ZMQError):  # ZeroMQ has already dropped the endpoint
        socket.disconnect(endpoint)
    socket.connect(endpoint)


def configure(socket: zmq.Socket[bytes]) -> None:
    """Configure `socket` to detect a dead peer and reconnect. Call before it connects."""
    socket.linger = 0
    socket.heartbeat_ivl = HEARTBEAT_MS
    socket.heartbeat_timeout = SILENCE_MS
    socket.heartbeat_ttl = SILENCE_MS
    socket.connect_timeout = _CONNECT_MS
    socket.handshake_ivl = _CONNECT_MS
    socket.reconnect_ivl = _RECONNECT_MS
    socket.reconnect_ivl_max = RECONNECT_MAX_MS
