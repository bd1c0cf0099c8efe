"""Connections of peers that stop in the middle of a request, to a page as the commands serve it."""

from __future__ import annotations

import asyncio
import contextlib
from argparse import Namespace
from collections.abc import AsyncGenerator
from typing import Any

import pytest
import websockets
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from urlab_client.cli import serve as serve_command
from urlab_client.cli._pages import bound, serve
from urlab_client.integrations import telemetry
from urlab_client.server import SimulatedServer

HEAD = b"GET /quick HTTP/1.1\r\nhost: localhost\r\n"
POST = b"POST /body HTTP/1.1\r\nhost: localhost\r\ncontent-length: 10\r\n\r\n"
SILENT = {
    "nothing": (b"", b""),
    "half a head": (b"", HEAD),
    "half a second head": (HEAD + b"\r\n", HEAD),
    "half a body": (b"", POST + b"abc"),
    "half a body that nobody reads": (POST.replace(b"/body", b"/quick") + b"abc", b"d"),
}
FOR_EVER = 3600.0


class Peer:
    """One connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    async def answer(self) -> bytes:
        """Return the status line of an answer, once all of it has come."""
        return (await self.reader.readuntil(b"done")).partition(b"\r\n")[0]

    async def rest(self) -> bytes:
        """Return what comes until the connection ends."""
        with contextlib.suppress(ConnectionResetError):
            return await self.reader.read()
        return b""


class Site:
    """What is served, and what its handlers wait for."""

    def __init__(self) -> None:
        self.port = 0
        self.entered = asyncio.Event()
        self.go_on = asyncio.Event()
        self.peers: list[Peer] = []

    async def open(self, sent: bytes = b"") -> Peer:
        peer = Peer(*await asyncio.open_connection("127.0.0.1", self.port))
        self.peers.append(peer)
        peer.writer.write(sent)
        return peer


@contextlib.asynccontextmanager
async def served(**limits: Any) -> AsyncGenerator[Site]:
    site, started, ended = Site(), asyncio.Event(), asyncio.Event()

    async def quick(_: Request) -> Response:
        return Response(b"done")

    async def slow(_: Request) -> Response:
        site.entered.set()
        await site.go_on.wait()
        return Response(b"done")

    async def body(request: Request) -> Response:
        await site.go_on.wait()
        await request.body()
        return Response(b"done")

    async def echo(socket: WebSocket) -> None:
        await socket.accept()
        async for text in socket.iter_text():
            await socket.send_text(text)

    methods = ["GET", "POST"]
    routes = [Route(f"/{handler.__name__}", handler, methods=methods) for handler in (quick, slow, body)]
    application = Starlette(routes=[*routes, WebSocketRoute("/echo", echo)])
    with bound("127.0.0.1", 0) as listener:
        site.port = listener.getsockname()[1]
        serving = asyncio.create_task(serve(application, listener, started.set, ended, **limits))
        await started.wait()
        try:
            yield site
        finally:
            ended.set()
            await serving
            for peer in site.peers:
                peer.writer.close()
                with contextlib.suppress(ConnectionError):
                    await peer.writer.wait_closed()


@pytest.mark.parametrize(("first", "then"), SILENT.values(), ids=SILENT)
async def test_a_peer_that_stops_in_the_middle_is_left(first: bytes, then: bytes) -> None:
    async with served(head_s=0.2, body_s=0.2) as site:
        site.go_on.set()
        peer = await site.open(first)
        if first:
            assert await peer.answer() == b"HTTP/1.1 200 OK"
        peer.writer.write(then)
        assert await peer.rest() == b""


async def test_bytes_that_trickle_give_a_head_no_more_time() -> None:
    async with served(head_s=0.5) as site:  # longer than a busy machine keeps the bytes from coming
        peer = await site.open(HEAD)
        ended = asyncio.create_task(peer.rest())
        for _ in range(500):  # a line of five seconds, if it is left alone
            if ended.done():
                break
            peer.writer.write(b"x")
            await asyncio.sleep(0.01)
        assert ended.done()
        assert await ended == b""


async def test_those_who_are_served_have_all_the_time_they_need() -> None:
    async with served(head_s=0.2, body_s=0.2) as site, websockets.connect(f"ws://127.0.0.1:{site.port}/echo") as live:
        slow = await site.open(HEAD.replace(b"quick", b"slow") + b"\r\n")
        # The application does not read this body yet, which is more than the console holds in memory.
        unread = await site.open(POST.replace(b" 10\r", b" 1000000\r") + bytes(1_000_000))
        for _ in range(2):  # their time is over twice
            silent = await site.open(HEAD)
            assert await silent.rest() == b""
        site.go_on.set()
        assert await slow.answer() == await unread.answer() == b"HTTP/1.1 200 OK"
        await live.send("still here")
        assert await live.recv() == "still here"


async def test_one_connection_too_many_ends_the_oldest_without_a_request() -> None:
    async with served(head_s=FOR_EVER, connections=3) as site:
        slow = await site.open(HEAD.replace(b"quick", b"slow") + b"\r\n")
        await site.entered.wait()
        silent = [await site.open(HEAD) for _ in range(2)]
        quick = await site.open(HEAD + b"\r\n")
        assert await quick.answer() == b"HTTP/1.1 200 OK"
        assert await silent[0].rest() == b""
        site.go_on.set()
        assert await slow.answer() == b"HTTP/1.1 200 OK"


async def test_the_metrics_of_a_server_wait_for_nobody_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telemetry, "PrometheusServerMetrics", lambda _: None)  # its registry is the process's
    monkeypatch.setattr(serve_command, "_SILENT_S", 0.2)
    arguments = Namespace(metrics_port=0)
    with serve_command._metrics(SimulatedServer(), arguments) as port:
        for sent in (b"", HEAD):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(sent)
            assert await Peer(reader, writer).rest() == b""
            writer.close()
            await writer.wait_closed()
