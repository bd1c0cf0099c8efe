"""What integrations offer for clients of either flavour: blocks, and functions that make them or run to their end."""

from __future__ import annotations

import asyncio
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, Protocol, Self, TypeVar, cast, overload

import anyio.to_thread

from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import ClientClosed
from urlab_client.sync._facade import aio_of, portal_of
from urlab_client.sync._portal import Portal
from urlab_client.sync.client import URLabClient

P = ParamSpec("P")
T = TypeVar("T")
A = TypeVar("A", bound="AsyncBlock")
B = TypeVar("B", bound="BlockingBlock")
A_co = TypeVar("A_co", bound="AsyncBlock", covariant=True)
B_co = TypeVar("B_co", bound="BlockingBlock", covariant=True)


class Block(ABC):
    """Follows a client for the duration of a block, in one of two flavours."""

    @abstractmethod
    async def _begin(self) -> None:
        """Begin, on the client's loop."""

    @abstractmethod
    async def _end(self, error: BaseException | None) -> None:
        """End, on the client's loop; `error` is the exception that ends the block."""

    @abstractmethod
    def _finish(self) -> None:
        """End if the client's loop has already ended. Blocks."""


class AsyncBlock(Block):
    """The flavour for `async with`."""

    async def __aenter__(self) -> Self:
        await self._begin()
        return self

    async def __aexit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._end(exc)


class BlockingBlock(Block):
    """The flavour for `with`, which runs on the loop of the followed client."""

    portal: Portal

    def __enter__(self) -> Self:
        self.portal.call(self._begin)
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self.portal.call(self._end, exc)
        except ClientClosed:
            self._finish()


async def opened(open_it: Callable[[], T], close: Callable[[T], object]) -> T:
    """Open something in a worker thread and return it; it is closed if the caller is cancelled meanwhile."""
    made = Future[T]()
    try:
        await anyio.to_thread.run_sync(lambda: made.set_result(open_it()))
    except asyncio.CancelledError:
        made.add_done_callback(lambda made: close(made.result()))
        raise
    return made.result()


class Flavoured(Protocol[P, A_co, B_co]):
    """A function that returns a block of the client's flavour."""

    @overload
    def __call__(self, client: AsyncClient, /, *args: P.args, **kwargs: P.kwargs) -> A_co: ...
    @overload
    def __call__(self, client: URLabClient, /, *args: P.args, **kwargs: P.kwargs) -> B_co: ...


def flavoured(
    aio: type[A_co], blocking: type[B_co]
) -> Callable[[Callable[Concatenate[Any, P], A_co | B_co]], Flavoured[P, A_co, B_co]]:
    """Declare which flavour a function returns for which client."""
    del aio, blocking
    return lambda function: cast("Flavoured[P, A_co, B_co]", function)


def in_flavour(
    client: AsyncClient | URLabClient,
    aio: Callable[Concatenate[AsyncClient, P], A],
    blocking: Callable[Concatenate[AsyncClient, P], B],
    *args: P.args,
    **kwargs: P.kwargs,
) -> A | B:
    """Return a block of the client's flavour."""
    if not isinstance(client, URLabClient):
        return aio(client, *args, **kwargs)
    made = blocking(aio_of(client), *args, **kwargs)
    made.portal = portal_of(client)
    return made


def blocking(
    function: Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[URLabClient, P], T]:
    """Return the flavour of a coroutine function for a blocking client."""

    @functools.wraps(function)
    def call(client: URLabClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return portal_of(client).call(function, aio_of(client), *args, **kwargs)

    return call
