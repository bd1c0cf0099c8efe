"""What the sources of published messages have in common: a socket, and a region of shared memory beside it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from urlab_client.aio.transport.regions import Place, Regions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.protocol.errors import ProtocolError
from urlab_client.protocol.layouts import BytesLike

__all__ = ["PublishedSource"]


class PublishedSource(ABC):
    """A `Source` of what a server publishes; see `urlab_client.aio.streams`.

    Args:
        subscriptions: The client's sockets.
        regions: Its shared memory, from which messages come whenever they can; None for sockets alone.

    Attributes:
        name: The call that made the stream, for messages.
        unreachable: What to look at when there is no connection.
        silent: What to look at when there is one and nothing comes.
    """

    name: str
    unreachable: str
    silent: str

    def __init__(self, subscriptions: Subscriptions, regions: Regions | None = None) -> None:
        self._subscriptions = subscriptions
        self._regions = regions

    @abstractmethod
    def subscription(self) -> Subscription:
        """Say what to receive, from where, as things stand."""

    def place(self) -> Place:
        """Say which region. Raises `ProtocolError` where there can be none."""
        raise ProtocolError(f"{self.name}: not in shared memory.")

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        if self._regions is None:
            self._subscriptions.attach(handler, self.subscription)
        else:
            self._regions.attach(handler, self.subscription, self.place)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        (self._regions or self._subscriptions).detach(handler)

    def region(self, handler: MessageHandler) -> Path | None:
        """Return the file of the region that feeds `handler`; None where a socket does, or nothing."""
        return None if self._regions is None else self._regions.path(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether a message is anything to the reader at all."""
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0: what is published comes at once."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why nothing came for so long, and what to do about it."""
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
        return f"connected to {line.endpoint}, but nothing came {within} on topics {topics}.", self.silent
