"""Streams to browsers: by WebSocket or as server-sent events, until either side ends. Needs Starlette or FastAPI."""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from typing import Any, TypeAlias

import anyio
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from urlab_client.aio.streams.stream import Stream
from urlab_client.errors import URLabError
from urlab_client.events import ClientEvent
from urlab_client.protocol.messages.streams import StreamItem

__all__ = ["EventStream", "Items", "forward"]

log: logging.Logger = logging.getLogger("urlab_client.forwarding")

_ALIVE_S = 15.0
"""How long an event stream may be silent, seconds: proxies close connections that are silent for longer."""

_LOOK_S = 0.2
_REASON_BYTES = 120  # of the 123 that a WebSocket has

Items: TypeAlias = Stream[Any] | AsyncGenerator[StreamItem | str | bytes, None]
"""A client's stream, or an async generator of its items, texts or bytes."""


async def forward(items: Items, socket: WebSocket, *, ahead: int | None = None) -> None:
    """Send items to an accepted WebSocket until they end or the browser leaves; then close both.

    A stream's item is sent as its JSON, a text or bytes as they are. The next item is taken when the browser is ready
    for it, so that a slow browser gets the newest item of a stream with the policy `latest`. If the items end, the
    socket is closed with code 1000; if they fail with a `URLabError`, with 1011 and the error.

    Args:
        items: What to send. It is closed at the end.
        socket: The WebSocket of Starlette or FastAPI, on which `accept()` was called.
        ahead: Largest number of items that the browser has not acknowledged yet, by sending any text for each; None
            for what the network holds.
    """
    flow = Flow(ahead)

    async def send() -> None:
        await flow.until_free()
        async for item in items:
            flow.sent()
            if isinstance(item, bytes):
                await socket.send_bytes(item)
            else:
                await socket.send_text(item if isinstance(item, str) else item.to_json())
            await flow.until_free()

    async def listen() -> None:
        while True:
            await receive_text(socket)
            flow.acknowledge()

    async with contextlib.aclosing(items):
        await converse(socket, send, listen)


class EventStream(Response):
    """Response of server-sent events, which ends with its items, with the browser, and when uvicorn is told to end.

    A stream's item becomes an event whose data is its JSON; those of `client.events()` are called like their kind. A
    text becomes the data of an event; bytes are sent as they are. A comment every 15 s keeps the connection open.

    Args:
        items: What to send. It is closed at the end.
        headers: More headers of the response.
    """

    media_type = "text/event-stream"

    def __init__(self, items: Items, *, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(headers={"cache-control": "no-store", "x-accel-buffering": "no", **(headers or {})})
        del self.headers["content-length"]
        self._items = items

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the events."""

        async def send_part(part: bytes, *, more: bool = True) -> None:
            await send({"type": "http.response.body", "body": part, "more_body": more})

        async def tell() -> None:
            try:
                async for item in self._items:
                    await send_part(_event(item))
            except URLabError as error:
                log.warning("an event stream was closed: %s", error)

        async def stay_alive() -> None:
            while True:
                await anyio.sleep(_ALIVE_S)
                await send_part(b": nothing new\n\n")

        async def leaving() -> None:
            while (await receive())["type"] != "http.disconnect":
                pass

        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        async with contextlib.aclosing(self._items):
            await until_first(tell, stay_alive, leaving, _server_ending)
            await send_part(b"", more=False)


class Flow:
    """Counts what a browser has not acknowledged, and waits while it is too much."""

    def __init__(self, ahead: int | None) -> None:
        self._ahead = ahead
        self._on_the_way = 0
        self._acknowledged = anyio.Event()

    @property
    def free(self) -> bool:
        return self._ahead is None or self._on_the_way < self._ahead

    def sent(self) -> None:
        self._on_the_way += 1

    def acknowledge(self) -> None:
        self._on_the_way -= 1
        self._acknowledged.set()

    async def until_free(self) -> None:
        while not self.free:
            self._acknowledged = anyio.Event()
            await self._acknowledged.wait()


async def until_first(*jobs: Callable[[], Awaitable[None]]) -> None:
    """Run jobs until the first of them ends, and cancel the others."""
    async with anyio.create_task_group() as tasks:

        async def run(job: Callable[[], Awaitable[None]]) -> None:
            await job()
            tasks.cancel_scope.cancel()

        for job in jobs:
            tasks.start_soon(run, job)


class _NoText(Exception):
    """A browser sent bytes."""


async def converse(
    socket: WebSocket, send: Callable[[], Awaitable[None]], listen: Callable[[], Awaitable[None]]
) -> None:
    """Send and listen until either ends or the browser is gone, which each may find out first; then close the socket.

    Neither job may close it: the other one then fails, ends both, and the browser may never be told.
    """
    why: tuple[int, str | None] = (1000, None)

    def explained(job: Callable[[], Awaitable[None]]) -> Callable[[], Awaitable[None]]:
        async def run() -> None:
            nonlocal why
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone, perhaps during a reply
                try:
                    await job()
                except URLabError as error:
                    log.warning("a WebSocket was closed: %s", error)
                    why = (1011, str(error).encode()[:_REASON_BYTES].decode(errors="ignore"))
                except _NoText:
                    why = (1003, "this socket takes text")

        return run

    await until_first(explained(send), explained(listen))
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # gone
        await socket.close(*why)


async def receive_text(socket: WebSocket) -> str:
    """Return the next text that a browser sends."""
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message["code"], message.get("reason"))
    text: str | None = message.get("text")
    if text is None:
        raise _NoText
    return text


async def _server_ending() -> None:
    """Wait until uvicorn is told to end.

    It would wait for the response, tell it nothing, and log its cancellation as a failure. Its handler of signals is a
    method of the server, whose `should_exit` is public.
    """
    server: Any = getattr(signal.getsignal(signal.SIGTERM), "__self__", None)
    if not hasattr(server, "should_exit"):
        await anyio.sleep_forever()
    while not server.should_exit:  # noqa: ASYNC110 - uvicorn has no event to wait for
        await anyio.sleep(_LOOK_S)


def _event(item: StreamItem | str | bytes) -> bytes:
    if isinstance(item, bytes):
        return item
    name = f"event: {item.__struct_config__.tag}\n" if isinstance(item, ClientEvent) else ""
    text = item if isinstance(item, str) else item.to_json()
    return (name + "".join(f"data: {line}\n" for line in text.split("\n")) + "\n").encode()
