"""Base class of the sources of published messages: a socket and, optionally, a region of shared memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from urlab_client.aio.transport.shm_streams import Place, Regions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.errors import ProtocolError
from urlab_client.values.layouts import BytesLike


class PublishedSource(ABC):
    """A `Source` of published messages; see `urlab_client.aio.streams.stream`.

    Args:
        subscriptions: Sockets of the client.
        regions: Shared memory of the client, preferred whenever available; None to use only sockets.

    Attributes:
        name: Name of the call that created the stream, for messages.
        unreachable: Hint if there is no connection.
        silent: Hint if there is a connection but no message arrives.
    """

    name: str
    unreachable: str
    silent: str

    def __init__(self, subscriptions: Subscriptions, regions: Regions | None = None) -> None:
        self._subscriptions = subscriptions
        self._regions = regions

    @abstractmethod
    def subscription(self) -> Subscription:
        """Return the current subscription."""

    def place(self) -> Place:
        """Return the place of the region. Raises `ProtocolError` if there can be none."""
        raise ProtocolError(f"{self.name} is not available in shared memory.")

    def attach(self, handler: MessageHandler) -> None:
        """Start delivering to `handler`. Call from the event loop."""
        if self._regions is None:
            self._subscriptions.attach(handler, self.subscription)
        else:
            self._regions.attach(handler, self.subscription, self.place)

    def detach(self, handler: MessageHandler) -> None:
        """Stop delivering to `handler`. Idempotent."""
        (self._regions or self._subscriptions).detach(handler)

    def region(self, handler: MessageHandler) -> Path | None:
        """Return the file of the region that feeds `handler`, or None if no region does."""
        return None if self._regions is None else self._regions.path(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether a message is relevant to the reader."""
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0: published messages arrive without delay."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why no message arrived in that time, and what to do about it."""
        region = self.region(handler)
        if region is not None:
            return f"nothing new in {region} within {seconds * 1000:.0f} ms.", self.silent
        within = f"within {seconds * 1000:.0f} ms"
        line = self._subscriptions.line(handler)
        if line is None:
            return f"nothing {within}.", ""
        if not line.connected:
            return f"no connection to {line.endpoint} {within}: {line.obstacle}.", self.unreachable
        filters = [repr(prefix.decode()) for prefix in self.subscription().filters]
        topics = ", ".join(filters[:3]) + (f" and {len(filters) - 3} more" if len(filters) > 3 else "")
        return f"connected to {line.endpoint}, but nothing arrived {within} on topics {topics}.", self.silent
