"""What a console does that ends, or whose browser leaves, while it converts, takes in and hands out files."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import tempfile
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path

import pytest
from children import in_background
from made_recordings import Robot, write_recording
from starlette.applications import Starlette
from waiting import until

from urlab_client.aio import URLabClient
from urlab_client.cli._pages import bound, graceful_exit, serve
from urlab_client.console import model_import
from urlab_client.integrations.record import Run, export
from urlab_client.server import SimulatedServer
from urlab_client.web import Access, app

LONG = "long.mcap"


@contextlib.asynccontextmanager
async def console(folder: Path, ended: asyncio.Event) -> AsyncGenerator[tuple[int, str]]:
    """Serve a console as `urlab console` does, and give its port and a key; wait until it has ended."""
    access, started = Access(), asyncio.Event()
    with SimulatedServer("arm", play=True) as server, bound("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        async with URLabClient(**server.client_options()) as client:
            site = app(client, access=access, recordings=folder)
            serving = asyncio.create_task(serve(site, listener, started.set, ended))
            await started.wait()
            key = access.admit(access.invite())
            assert key is not None
            yield port, key
            await serving


Ask = Callable[..., Awaitable[tuple[asyncio.StreamReader, asyncio.StreamWriter]]]


@pytest.fixture
async def ask() -> AsyncGenerator[Ask]:
    """Begin requests, whose connections are closed after the test."""
    async with contextlib.AsyncExitStack() as stack:

        async def begin(
            port: int, key: str, head: str, body: bytes = b""
        ) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
            reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1024)
            stack.callback(writer.close)
            writer.write(f"{head} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {key}\r\n".encode())
            writer.write(f"content-length: {1000 if body else 0}\r\n\r\n".encode() + body)
            await writer.drain()
            return reader, writer

        yield begin


def test_in_the_background_sigterm_ends_it_and_ctrl_c_is_ignored() -> None:
    handlers: list[object] = []

    def started() -> None:
        handlers.append(signal.getsignal(signal.SIGINT))
        signal.raise_signal(signal.SIGTERM)

    with in_background(), bound("127.0.0.1", 0) as listener, graceful_exit():
        asyncio.run(serve(Starlette(), listener, started))
    assert handlers == [signal.SIG_IGN]


def test_a_second_ctrl_c_does_not_break_off_its_end() -> None:
    steps: list[str] = []

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        yield
        steps.append("cleaned up")

    def started() -> None:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)

    with bound("127.0.0.1", 0) as listener, graceful_exit():
        asyncio.run(serve(Starlette(lifespan=lifespan), listener, started))
    assert steps == ["cleaned up"]


@pytest.fixture
def converting(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A conversion that writes half a file, says so, and goes on until its progress breaks it off."""
    begun = threading.Event()

    def write(_run: Run, path: Path, progress: Callable[[int], None]) -> int:
        path.write_text("half", encoding="utf-8")
        begun.set()
        while True:
            progress(0)

    monkeypatch.setattr(export, "write_csv", write)
    return begun


@pytest.fixture
def compiling(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A model's archive that takes as long to compile; return the folder for temporary files."""

    def flatten(file: Path, progress: Callable[[int], object]) -> None:
        while True:
            progress(0)
            file.with_name("part").touch()

    monkeypatch.setattr(model_import, "flatten_confined", flatten)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path.parent / f"{tmp_path.name}-temporary"))
    Path(tempfile.gettempdir()).mkdir()
    return Path(tempfile.gettempdir())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording, and a file too large for what sockets hold."""
    write_recording(tmp_path / "short.mcap", [({"arm": Robot([0.0])}, {})])
    (tmp_path / LONG).touch()
    os.truncate(tmp_path / LONG, 100_000_000)
    return tmp_path


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return what the console logged; the server may have to tell of a machine that is busy or cannot draw."""
    return [record.getMessage() for record in caplog.records if record.name == "urlab_client.web"]


async def test_ending_breaks_off_what_takes_long_without_a_trace(
    folder: Path, converting: threading.Event, compiling: Path, ask: Ask, caplog: pytest.LogCaptureFixture
) -> None:
    ended = asyncio.Event()
    with caplog.at_level(logging.WARNING):
        async with console(folder, ended) as (port, key):
            importing = await ask(port, key, "PUT /api/models/robot.zip", b"P" * 1000)
            uploading = await ask(port, key, "PUT /api/recordings/other.mcap", b"some")
            again = await ask(port, key, "PUT /api/recordings/other.mcap", b"more")
            conversion = await ask(port, key, "GET /api/recordings/short.mcap?as=csv")
            download = await ask(port, key, f"GET /api/recordings/{LONG}")
            assert await download[0].readline() == b"HTTP/1.1 200 OK\r\n"
            await until(lambda: converting.is_set() and len(os.listdir(folder)) == 5 and any(compiling.rglob("part")))
            ended.set()
            for reader, _ in (conversion, uploading, again, importing):
                assert await reader.readline() == b"HTTP/1.1 503 Service Unavailable\r\n"
                assert b"The console ended before the request was complete." in await reader.read()
    assert sorted(messages(caplog)) == [
        "the conversion of short.mcap to csv was broken off",
        f"the download of {LONG} was broken off",
        "the import of robot.zip was broken off",
        *["the upload of other.mcap was broken off"] * 2,
    ]
    assert sorted(os.listdir(folder)) == [LONG, "short.mcap"]
    assert [name for name in os.listdir(compiling) if name.startswith("urlab-model-")] == []


async def test_a_browser_that_leaves_ends_what_was_made_for_it(
    folder: Path, converting: threading.Event, ask: Ask, caplog: pytest.LogCaptureFixture
) -> None:
    ended = asyncio.Event()
    with caplog.at_level(logging.WARNING):
        async with console(folder, ended) as (port, key):
            for head, body in (("GET /api/recordings/short.mcap?as=csv", b""), ("PUT /api/recordings/a.mcap", b"some")):
                _, writer = await ask(port, key, head, body)
                await until(lambda: len(os.listdir(folder)) == 3)
                writer.close()
                await until(lambda: len(os.listdir(folder)) == 2)
            assert converting.is_set()
            ended.set()
    assert messages(caplog) == []
