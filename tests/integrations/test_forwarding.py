"""Streams forwarded to browsers, over real sockets: slow browsers, browsers that leave, and either end that ends."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import re
import signal
import subprocess
import sys
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest
from http_served import served
from starlette.applications import Starlette
from starlette.routing import Route, WebSocketRoute
from starlette.types import Message, Receive, Scope, Send
from starlette.websockets import WebSocket
from waiting import DEADLINE_S, eventually, until
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from urlab_client.aio import URLabClient
from urlab_client.integrations.forwarding import EventStream, Items, forward
from urlab_client.server import SimulatedServer

EXAMPLES = Path(__file__).parents[2] / "examples"


class Backend:
    """An application that forwards what `items` gives, and counts the browsers that it serves."""

    def __init__(self, items: Callable[[], Items], **options: Any) -> None:
        async def states(socket: WebSocket) -> None:
            await socket.accept()
            await forward(items(), socket, **options)

        async def events(_: object) -> EventStream:
            return EventStream(items())

        self.serving = 0
        self._application = Starlette(routes=[WebSocketRoute("/states", states), Route("/events", events)])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.serving += 1
        try:
            await self._application(scope, receive, send)
        finally:
            self.serving -= 1


@contextlib.asynccontextmanager
async def browser(http: httpx2.AsyncClient) -> AsyncGenerator[ClientConnection]:
    url = str(http.base_url).replace("http", "ws", 1).rstrip("/")
    async with connect(f"{url}/states", max_size=None, close_timeout=0.1) as socket:
        yield socket


async def test_handlers_of_browsers_that_left_end_though_the_server_is_dead() -> None:
    with SimulatedServer("arm", play=True) as server:
        async with URLabClient(**server.client_options()) as client:
            await client.discover()
            backend = Backend(lambda: client.state_stream("latest", timeout=None))
            kept: list[AsyncIterator[bytes]] = []
            async with served(backend, lifespan=False) as http, contextlib.AsyncExitStack() as browsers:
                for _ in range(10):
                    socket = await browsers.enter_async_context(browser(http))
                    await socket.recv()
                    response = await browsers.enter_async_context(http.stream("GET", "/events"))
                    kept.append(response.aiter_bytes())
                    await anext(kept[-1])
                await asyncio.to_thread(server.close)
                assert backend.serving == 20
                await browsers.aclose()
                await until(lambda: backend.serving == 0)


async def test_browsers_hear_the_end_of_a_client_that_closes(caplog: pytest.LogCaptureFixture) -> None:
    with SimulatedServer("arm", play=True) as server:
        client = URLabClient(**server.client_options())
        await client.discover()
        async with (
            served(Backend(lambda: client.state_stream("latest")), lifespan=False) as http,
            browser(http) as socket,
            http.stream("GET", "/events") as response,
        ):
            chunks = response.aiter_bytes()
            first = await anext(chunks)
            assert first.startswith(b'data: {"')
            await client.close()
            async with asyncio.timeout(DEADLINE_S):
                await socket.wait_closed()
            assert socket.close_code == 1000
            async with asyncio.timeout(DEADLINE_S):
                assert b"".join([chunk async for chunk in chunks]).endswith((b"\n\n", b""))
    assert "forwarding" not in caplog.text
    assert "uvicorn" not in caplog.text


async def test_browsers_hear_why_a_stream_failed(caplog: pytest.LogCaptureFixture) -> None:
    with SimulatedServer("arm", play=True) as server:
        options = server.client_options()
    async with URLabClient(**options) as client:
        backend = Backend(lambda: client.state_stream("latest", timeout=0.05))
        async with served(backend, lifespan=False) as http, browser(http) as socket:
            with pytest.raises(ConnectionClosed) as closed:
                await socket.recv()
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1011
            assert "state_stream: no connection" in closed.value.rcvd.reason
            assert (await http.get("/events")).content == b""
    assert "Traceback" not in caplog.text


async def test_a_browser_is_told_why_it_is_closed_while_items_are_sent() -> None:
    told: list[Message] = []

    async def send(message: Message) -> None:
        await asyncio.sleep(0)
        await asyncio.sleep(0)  # as long as an item takes, and more
        told.append(message)

    async def numbers() -> AsyncGenerator[str]:
        for number in itertools.count():
            yield str(number)
            await asyncio.sleep(0)

    said: list[Message] = [{"type": "websocket.connect"}, {"type": "websocket.receive", "bytes": b"\0"}]

    async def receive() -> Message:
        await until(lambda: len(said) == 2 or len(told) > 10)
        return said.pop(0)

    socket = WebSocket({"type": "websocket"}, receive, send)
    await socket.accept()
    await forward(numbers(), socket)
    assert told[-1] == {"type": "websocket.close", "code": 1003, "reason": "this socket takes text"}


async def test_a_browser_that_acknowledges_nothing_waits_for_the_newest_state() -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        async with URLabClient(**server.client_options()) as client:
            await client.discover()
            backend = Backend(lambda: client.state_stream("latest"), ahead=1)
            async with served(backend, lifespan=False) as http, browser(http) as slow:
                first = json.loads(await slow.recv())
                async with client.state_stream("latest") as states:
                    passed = await anext(state async for state in states if state.time > first["time"] + 0.2)
                await slow.send("shown")
                assert json.loads(await slow.recv())["time"] >= passed.time


def test_ctrl_c_ends_a_backend_with_an_event_stream_without_a_traceback(tmp_path: Path) -> None:
    log = tmp_path / "log"
    command = [sys.executable, "-m", "uvicorn", "fastapi_backend:app", "--app-dir", str(EXAMPLES), "--port", "0"]
    with log.open("wb") as output:
        program = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        found = eventually(lambda: re.search(r"running on (http://\S+)", log.read_text()))
        with httpx2.stream("GET", f"{found[1]}/events", timeout=DEADLINE_S) as response:
            assert response.status_code == 200
            program.send_signal(signal.SIGINT)
            assert list(response.iter_bytes()) == []
        assert program.wait(DEADLINE_S) in {0, -signal.SIGINT}
    finally:
        program.kill()
        program.wait()
    assert "Application shutdown complete" in log.read_text()
    assert "Traceback" not in log.read_text()
    assert "ERROR" not in log.read_text()
