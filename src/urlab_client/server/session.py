"""The one session of a server, and the lease by which clients announce that the server is in use.

For the dispatcher and the handlers. The session survives play sessions and level changes, and ends with the server or
the next `hello`. It does not time out. The lease is advisory.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable

from urlab_client.enums import ObservationLevel
from urlab_client.server.refusal import Refusal


class ServerSession:
    """State that the server keeps between requests, apart from the world.

    Attributes:
        id: Active session id, a lower-case GUID; empty before the first `hello`.
        json: Whether replies are JSON instead of msgpack, for all clients.
        level: Observation level of replies that carry state.
    """

    __slots__ = ("id", "json", "level")

    def __init__(self) -> None:
        self.id: str = ""
        self.json: bool = False
        self.level: ObservationLevel = ObservationLevel.STANDARD

    def open(self, *, observations: str | None, encoding: str | None) -> str:
        """Start a new session, which ends the previous one, and return its id.

        Args:
            observations: Level name, case-insensitive; an unknown name means standard, None keeps the level.
            encoding: `json`, case-insensitive, for JSON replies; anything else means msgpack.
        """
        self.id = str(uuid.uuid4())
        self.json = encoding is not None and encoding.lower() == "json"
        if observations is not None:
            self.level = _level(observations) or ObservationLevel.STANDARD
        return self.id

    def accepts(self, session_id: str) -> bool:
        """Whether a request with this id belongs to the active session."""
        return session_id != "" and session_id == self.id

    def level_of(self, observations: str | None) -> ObservationLevel:
        """Return the level that a step requests; the session's, if it requests none or an unknown one."""
        return self.level if observations is None else _level(observations) or self.level


def _level(name: str) -> ObservationLevel | None:
    try:
        return ObservationLevel(name.lower())
    except ValueError:
        return None


class DriverLease:
    """One lease at a time, which expires after some time without requests.

    Args:
        clock: Returns the time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._id = ""
        self._ttl_s = 0.0
        self._touched = 0.0

    @property
    def held(self) -> bool:
        """Whether it is held."""
        with self._lock:
            return self._holds()

    def acquire(self, ttl_s: float) -> str:
        """Take it and return its id."""
        with self._lock:
            if self._holds():
                # As the plugin does, although with the id anybody can release the lease. No message and no log has it.
                raise Refusal("busy", "another client holds the driver lease", lease_id=self._id)
            self._id, self._ttl_s, self._touched = str(uuid.uuid4()).upper(), ttl_s, self._clock()
            return self._id

    def release(self, lease_id: str) -> None:
        """Give it back."""
        with self._lock:
            if not self._holds() or lease_id != self._id:
                raise Refusal("bad_request", "lease_id is not the id of the lease that is held")
            self._id = ""

    def touch(self) -> None:
        """Renew the lease: the server is in use."""
        if self._id:
            with self._lock:
                if self._holds():
                    self._touched = self._clock()

    def _holds(self) -> bool:
        return bool(self._id) and self._clock() - self._touched <= self._ttl_s and self._ttl_s > 0
