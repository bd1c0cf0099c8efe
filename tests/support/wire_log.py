"""What a client's requests were, in the order in which they left."""

from __future__ import annotations

from typing import Any

import msgspec

from urlab_client.aio import URLabClient

__all__ = ["WireLog"]


class WireLog:
    """Notes every request of a client, with its reply once there is one.

    Attributes:
        requests: The decoded requests that left, each with the `reply` that came.
    """

    def __init__(self, client: URLabClient) -> None:
        self.requests: list[dict[str, Any]] = []
        transport: Any = client._transport
        way = transport.shared or transport
        send = way.request

        async def noted(frame: bytes, op: Any, deadlines: Any, **late: Any) -> bytes:
            entry = msgspec.msgpack.decode(frame)
            before = transport.stats.sent
            self.requests.append(entry)
            try:
                answer = await send(frame, op, deadlines, **late)
                entry["reply"] = msgspec.msgpack.decode(answer)
                return answer
            finally:
                if transport.stats.sent == before:
                    self.requests.remove(entry)

        way.request = noted

    def of(self, op: str) -> list[dict[str, Any]]:
        """Return the requests of one op."""
        return [request for request in self.requests if request["op"] == op]
