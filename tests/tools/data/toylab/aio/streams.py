"""Asynchronous iterators that are context managers, too."""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Generic, Self, TypeVar

T = TypeVar("T")


class Stream(Generic[T]):
    """A stream.

    Example:
        async with robot.states() as states:
            async for state in states:
                await robot.controller.configure(kp=state)
    """

    closed: bool
    """Whether it was closed. Streams await their reader: prose stays."""

    def __init__(self, items: Iterable[T]) -> None:
        self._items = iter(items)
        self.closed = False

    async def __aenter__(self) -> Self:
        """Return itself."""
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close it."""
        await self.aclose()

    def __aiter__(self) -> Self:
        """Return itself."""
        return self

    def receive_nowait(self) -> T | None:
        """Return the next item if one waits."""
        return None

    async def __anext__(self) -> T:
        """Return the next item."""
        try:
            return next(self._items)
        except StopIteration:
            raise StopAsyncIteration from None

    async def aclose(self) -> None:
        """Close it, as `await stream.aclose()` or `async with` do."""
        self.closed = True
