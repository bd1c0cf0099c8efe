"""The blocking flavour of a follower."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

from urlab_client.protocol.errors import ClientClosed
from urlab_client.sync._portal import Portal

__all__ = ["BlockingTwin", "Following"]


class Following(Protocol):
    """Follows a client for the duration of an `async with` block."""

    async def __aenter__(self) -> Any: ...

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None: ...

    def finish(self) -> None:
        """End if the client's loop has already ended. Blocks."""
        ...


F = TypeVar("F", bound=Following)


class BlockingTwin(Generic[F]):
    """Runs its async counterpart for the duration of a `with` block, on the loop of the followed client."""

    def __init__(self, aio: F, portal: Portal) -> None:
        self._aio = aio
        self._portal = portal

    @property
    def aio(self) -> F:
        """The async counterpart."""
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
