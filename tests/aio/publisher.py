"""A publisher whose every message a test dictates, on a real socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import zmq
from ports import free_port
from waiting import DEADLINE_S


class Publisher:
    """Publishes as the plugin's PUB sockets do, and knows which subscriptions have reached it.

    Attributes:
        port: Where it listens.
        filters: Subscriptions in force, by its only subscriber.
    """

    def __init__(self, port: int = 0) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.linger = 1000
        self._socket.rcvtimeo = round(1e3 * DEADLINE_S)
        self.port = port or free_port()
        self._socket.bind(f"tcp://127.0.0.1:{self.port}")
        self.filters: set[bytes] = set()

    @property
    def endpoint(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    async def subscribed(self, *filters: bytes) -> None:
        """Wait until these subscriptions, and no others, are in force."""
        await self.until(lambda: self.filters == set(filters))

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait until the subscriptions fulfil a condition."""
        while not condition():
            change = await asyncio.to_thread(self._socket.recv)
            (self.filters.add if change[0] else self.filters.discard)(change[1:])

    def send(self, topic: bytes, *frames: bytes) -> None:
        self._socket.send_multipart((topic, *frames))

    def close(self) -> None:
        """Vanish, as at the end of a play session."""
        self._socket.close(0)
        self._context.term()
