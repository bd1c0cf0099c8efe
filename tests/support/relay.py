"""A TCP relay between a client and a server whose faults a test dictates. On the test's own event loop."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Self


class Relay:
    """Forwards bytes to `127.0.0.1:target`.

    Attributes:
        port: Where clients connect.
        held: Bytes on their way to the client that are held back.
        swallowed: Bytes on their way to the server that are held back.
        refusing: Whether new connections are closed at once.
    """

    def __init__(self, target: int) -> None:
        self.port = 0
        self.held = 0
        self.swallowed = 0
        self.refusing = False
        self._target = target
        self._to_client = asyncio.Event()
        self._to_server = asyncio.Event()
        self._to_client.set()
        self._to_server.set()
        self._garble: bytes | None = None
        self._garble_from = 0
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._writers: set[asyncio.StreamWriter] = set()
        self._changed = asyncio.Event()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        self.cut()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    def hold_replies(self) -> None:
        """From now on nothing reaches the client; the server gets everything."""
        self._to_client.clear()

    def freeze(self) -> None:
        """Pull the cable: nothing gets through in either direction, and nobody is told."""
        self._to_client.clear()
        self._to_server.clear()

    def thaw(self) -> None:
        """Let everything through, what was held back first."""
        self._to_client.set()
        self._to_server.set()

    def garble(self, junk: bytes, *, at_least: int = 0) -> None:
        """Put `junk` in place of the next bytes to the client; of so many at least, where a heartbeat is not meant."""
        self._garble, self._garble_from = junk, at_least

    def cut(self) -> None:
        """Close every connection on both sides; what was held back is lost."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()
        self.held = 0

    async def until_held(self, size: int) -> None:
        """Wait until at least so many bytes to the client are held back."""
        while self.held < size:
            self._changed.clear()
            await self._changed.wait()

    async def until_swallowed(self, size: int) -> None:
        """Wait until at least so many bytes to the server are held back."""
        while self.swallowed < size:
            self._changed.clear()
            await self._changed.wait()

    async def pass_on(self, data: bytes, writer: asyncio.StreamWriter, *, up: bool) -> bool:
        """Write what arrived; return whether the connection goes on."""
        if not up and self._garble is not None and len(data) >= self._garble_from:
            data, self._garble = self._garble, None
        writer.write(data)
        await writer.drain()
        return True

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.refusing:
            writer.transport.abort()
            return
        try:
            onward, back = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, back}
        for pump in (self._pump(reader, back, up=True), self._pump(onward, writer, up=False)):
            task = asyncio.create_task(pump)
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, up: bool) -> None:
        gate = self._to_server if up else self._to_client
        pieces: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        receiving = asyncio.create_task(self._receive(reader, pieces, gate, up=up))
        try:
            with suppress(OSError):
                while (piece := await pieces.get())[0]:
                    data, counted = piece
                    if not gate.is_set():
                        if not counted:
                            self._count(len(data), up=up)
                        await gate.wait()
                    if writer.transport.is_closing():
                        break
                    if not await self.pass_on(data, writer, up=up):
                        break
        finally:
            receiving.cancel()
            writer.transport.abort()

    async def _receive(
        self,
        reader: asyncio.StreamReader,
        pieces: asyncio.Queue[tuple[bytes, bool]],
        gate: asyncio.Event,
        *,
        up: bool,
    ) -> None:
        """Go on receiving, and counting, while the gate is shut: what is held back first may be a heartbeat."""
        with suppress(OSError):
            while data := await reader.read(65536):
                if not gate.is_set():
                    self._count(len(data), up=up)
                pieces.put_nowait((data, not gate.is_set()))
        pieces.put_nowait((b"", False))

    def _count(self, size: int, *, up: bool) -> None:
        if up:
            self.swallowed += size
        else:
            self.held += size
        self._changed.set()
