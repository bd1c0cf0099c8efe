"""The blocking flavour of what follows a client for the length of a block."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

from urlab_client.protocol.errors import ClientClosed
from urlab_client.sync._portal import Portal

__all__ = ["BlockingTwin", "Following"]


class Following(Protocol):
    """Follows a client between `async with` and its end."""

    async def __aenter__(self) -> Any: ...

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None: ...

    def finish(self) -> None:
        """End when the client's loop is gone already. Blocks."""
        ...


F = TypeVar("F", bound=Following)


class BlockingTwin(Generic[F]):
    """Does between `with` and its end what its async twin does, on the loop of the client that it follows."""

    def __init__(self, aio: F, portal: Portal) -> None:
        self._aio = aio
        self._portal = portal

    @property
    def aio(self) -> F:
        """The async twin."""
        return self._aio

    def __enter__(self) -> Self:
        self._portal.call(self._aio.__aenter__)
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._portal.call(self._aio.__aexit__, exc_type, exc, traceback)
        except ClientClosed:
            self._aio.finish()
