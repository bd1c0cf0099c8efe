"""What a client takes from a server that means it no good, below the level of replies."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
from waiting import DEADLINE_S, pass_time, until

from urlab_client import ConnectionLost
from urlab_client.aio import URLabClient
from urlab_client.protocol.codec import MAX_REPLY_BYTES

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x06ROUTER"
MORE, LARGE, COMMAND = 1, 2, 4


async def announce(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Speak ZeroMQ up to the first request, and begin a reply that is said to be too long."""
    writer.write(GREETING + bytes([COMMAND, len(READY)]) + READY)
    await reader.readuntil(b"list_actors")
    writer.write(bytes([MORE, 8]) + (1).to_bytes(8, "big") + bytes([MORE, 0]))
    writer.write(bytes([LARGE]) + (MAX_REPLY_BYTES + 1).to_bytes(8, "big") + bytes(1000))
    await reader.read()
    writer.close()


@pytest.fixture
async def port() -> AsyncIterator[int]:
    async def once(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        server.close()  # or the client would ask again and again, and its time would be up somewhere in that
        await announce(reader, writer)

    server = await asyncio.start_server(once, "127.0.0.1", 0)
    async with server:
        yield server.sockets[0].getsockname()[1]


async def test_a_reply_that_is_too_long_is_not_even_received(port: int) -> None:
    async with URLabClient("tcp://127.0.0.1", step_port=port, local_model=False) as client:
        call = asyncio.create_task(client.outliner.list_actors(timeout=DEADLINE_S))
        await until(lambda: client.transport_stats.connects and not client.connected)
        pass_time(DEADLINE_S)
        with pytest.raises(ConnectionLost):
            await call
