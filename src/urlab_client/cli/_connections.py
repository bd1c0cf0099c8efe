"""HTTP connections that end when their peer stays silent, and not too many of them: uvicorn bounds neither."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol


def bounded_connections(head_s: float, body_s: float, most: int) -> type[H11Protocol]:
    """Return the protocol of the connections of one server.

    Args:
        head_s: Time for the whole head of a request, seconds.
        body_s: Time between two parts of a request's body, seconds.
        most: Number of connections. One more ends the oldest of those that have not sent a head yet.
    """
    without_head: dict[Connection, None] = {}

    class Connection(H11Protocol):
        """A connection with a clock that runs while the peer owes the rest of a head or of a body."""

        _clock: asyncio.TimerHandle | None = None

        def connection_made(  # pyright: ignore[reportIncompatibleMethodOverride]  # as in uvicorn
            self, transport: asyncio.Transport
        ) -> None:
            super().connection_made(transport)
            self._watch()
            if len(self.connections) > most:
                next(iter(without_head), self).end()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def on_response_complete(self) -> None:
            super().on_response_complete()
            self._stop()  # until the peer sends something, uvicorn's own clock for idle connections runs
            if not self._awaits_head:  # the next request had come already
                self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop()
            super().connection_lost(exc)

        @property
        def _awaits_head(self) -> bool:
            cycle: Any = self.cycle  # None before the first request
            return cycle is None or cycle.response_complete

        def _watch(self) -> None:
            ours = self in self.connections and not self.transport.is_closing()  # else it is a WebSocket, or ends
            if ours and self._awaits_head and self in without_head:
                return  # a head has the same time, however many bytes come
            self._stop()
            if ours and self._awaits_head:
                without_head[self] = None
                self._clock = self.loop.call_later(head_s, self.end)
            elif ours and self.cycle.more_body:
                self._clock = self.loop.call_later(body_s, self._end_unless_paused)

        def _stop(self) -> None:
            without_head.pop(self, None)
            if self._clock is not None:
                self._clock.cancel()
                self._clock = None

        def _end_unless_paused(self) -> None:
            if self.flow.read_paused:  # the application is slow, not the peer
                self._watch()
            else:
                self.end()

        def end(self) -> None:
            """Close the connection."""
            self._stop()
            self.transport.close()

    return Connection
