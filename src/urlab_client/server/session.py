"""The one session of a server: its id, the encoding of replies and the observation level.

For the dispatcher and the handlers. It survives play sessions and level changes, and ends with the server or the next
`hello`. It does not time out.
"""

from __future__ import annotations

import uuid

from urlab_client.protocol.enums import ObservationLevel

__all__ = ["ServerSession"]


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
