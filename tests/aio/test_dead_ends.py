"""Connections that lead nowhere: given up in seconds, and described for what they are."""

from __future__ import annotations

import asyncio
import select
import socket
import sys
from contextlib import ExitStack
from typing import Any

import pytest

from urlab_client import ServerUnreachable, SessionTakenOver
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import line


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts to connect are given up fifteen times as soon."""
    monkeypatch.setattr(line, "_CONNECT_MS", 200)


async def test_what_accepts_and_says_nothing_is_tried_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        mute.settimeout(10)
        port = mute.getsockname()[1]
        async with URLabClient("tcp://127.0.0.1", step_port=port, local_model=False) as client:
            call = asyncio.create_task(client.meta(timeout=15))
            for _ in range(2):
                connection, _ = await asyncio.to_thread(mute.accept)
                with connection:
                    connection.settimeout(10)
                    while await asyncio.to_thread(connection.recv, 65536):  # until the client gives it up
                        pass
            call.cancel()
            with pytest.raises(ServerUnreachable, match="does not speak ZeroMQ, or is suspended"):
                await client.meta(timeout=0.1)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="how connections are dropped there")
async def test_a_host_that_drops_what_is_sent_is_not_said_to_refuse() -> None:
    with ExitStack() as stack:
        deaf = stack.enter_context(socket.socket())
        deaf.bind(("127.0.0.1", 0))
        deaf.listen(0)
        for _ in range(4):  # more than it has room for: the next one is dropped, as a firewall does
            filler = stack.enter_context(socket.socket())
            filler.setblocking(False)
            filler.connect_ex(deaf.getsockname())
        async with URLabClient("tcp://127.0.0.1", step_port=deaf.getsockname()[1], local_model=False) as client:
            with pytest.raises(ServerUnreachable, match="the host does not answer"):
                await client.meta(timeout=1)


async def test_a_request_is_not_left_in_a_queue_for_a_later_server(client: Any, scripted: Any) -> None:
    await client.discover()
    while not scripted.seen.empty():
        scripted.request()
    scripted.close()
    # The connection is gone, and the client, whose loop did not run, does not know it yet.
    assert select.select([client._transport._monitor], [], [], 5)[0]
    call = asyncio.create_task(client.reset(timeout=5))
    await asyncio.sleep(0)
    reborn = type(scripted)(scripted.port)
    reborn.on("reset", {"op": "error", "code": "session_expired", "message": "who is that?"})
    try:
        with pytest.raises(SessionTakenOver, match="who is that"):
            await call
        assert reborn.request()["op"] == "reset"
        assert reborn.seen.empty()
    finally:
        await asyncio.to_thread(reborn.close)
