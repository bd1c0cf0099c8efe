"""Where a stream"s messages come from: a subscription of a socket, or a region of shared memory beside one."""

from __future__ import annotations

from abc import ABC, abstractmethod

from urlab_client.aio.transport.regions import Place, Regions
from urlab_client.aio.transport.subscriber import MessageHandler, Subscription, Subscriptions
from urlab_client.protocol.layouts import BytesLike

__all__ = ["SharedMemorySource", "SocketSource"]


class SocketSource(ABC):
    """What a subscription brings.

    Attributes:
        name: The call that made the stream, for messages.
        unreachable: What to look at when there is no connection.
        silent: What to look at when there is one and nothing comes.
    """

    name: str
    unreachable: str
    silent: str

    def __init__(self, subscriptions: Subscriptions) -> None:
        self._subscriptions = subscriptions

    @abstractmethod
    def subscription(self) -> Subscription:
        """Say what to receive, from where, as things stand."""

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        self._subscriptions.attach(handler, self.subscription)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        self._subscriptions.detach(handler)

    def wants(self, topic: bytes, payload: BytesLike) -> bool:
        """Return whether a message is anything to the reader at all."""
        return True

    def first_after(self, handler: MessageHandler) -> float:
        """Return 0: what is published comes at once."""
        return 0.0

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why nothing came for so long, and what to do about it."""
        within = f"within {seconds * 1000:.0f} ms"
        line = self._subscriptions.line(handler)
        if line is None:
            return f"nothing {within}.", ""
        if not line.connected:
            return f"no connection to {line.endpoint} {within}: {line.obstacle}.", self.unreachable
        filters = [repr(prefix.decode()) for prefix in self.subscription().filters]
        topics = ", ".join(filters[:3]) + (f" and {len(filters) - 3} more" if len(filters) > 3 else "")
        return f"connected to {line.endpoint}, but nothing came {within} on topics {topics}.", self.silent


class SharedMemorySource(SocketSource):
    """A source whose publications are in shared memory, too, and come from there whenever they can."""

    regions: Regions

    @abstractmethod
    def place(self) -> Place:
        """Say which region. Raises `ProtocolError` where there can be none."""

    def attach(self, handler: MessageHandler) -> None:
        """Begin to feed `handler`, from the event loop."""
        self.regions.attach(handler, self)

    def detach(self, handler: MessageHandler) -> None:
        """Stop feeding `handler`. Idempotent."""
        self.regions.detach(handler)

    def silence(self, handler: MessageHandler, seconds: float) -> tuple[str, str]:
        """Return why nothing came for so long, and what to do about it."""
        path = self.regions.path(handler)
        if path is None:
            return super().silence(handler, seconds)
        return f"nothing new in {path} within {seconds * 1000:.0f} ms.", self.silent
