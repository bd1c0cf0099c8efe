"""Connections that lead nowhere: given up in seconds, and described for what they are."""

from __future__ import annotations

import asyncio
import socket
import sys
from contextlib import ExitStack
from typing import Any

import pytest
import zmq
from waiting import DEADLINE_S, eventually, until

from urlab_client import ServerUnreachable, SessionTakenOver
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import connection


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Attempts to connect are given up fifteen times as soon."""
    monkeypatch.setattr(connection, "_CONNECT_MS", 200)


async def test_what_accepts_and_says_nothing_is_tried_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        mute.settimeout(DEADLINE_S)
        port = mute.getsockname()[1]
        async with URLabClient("tcp://127.0.0.1", step_port=port, local_model=False) as client:
            call = asyncio.create_task(client.meta(timeout=None))
            for _ in range(2):
                accepted, _ = await asyncio.to_thread(mute.accept)
                with accepted:
                    accepted.settimeout(DEADLINE_S)
                    async with asyncio.timeout(DEADLINE_S):
                        while await asyncio.to_thread(accepted.recv, 65536):  # until the client gives it up
                            pass
            call.cancel()
            await asyncio.wait((call,))
            for _ in range(10):  # also between two attempts
                with pytest.raises(ServerUnreachable, match="does not speak ZeroMQ, or is suspended"):
                    await client.meta(timeout=0.03)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="how connections are dropped there")
async def test_a_host_that_drops_what_is_sent_is_not_said_to_refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        deaf = stack.enter_context(socket.socket())
        deaf.bind(("127.0.0.1", 0))
        deaf.listen(0)
        for _ in range(4):  # more than it has room for: the next one is dropped, as a firewall does
            filler = stack.enter_context(socket.socket())
            filler.setblocking(False)
            filler.connect_ex(deaf.getsockname())
        async with URLabClient("tcp://127.0.0.1", step_port=deaf.getsockname()[1], local_model=False) as client:
            tried, told = 0, connection.Attempts.obstacle

            def count(attempts: connection.Attempts, event: zmq.Event, value: int, now: float) -> str | None:
                nonlocal tried
                tried += event is zmq.Event.CONNECT_RETRIED
                return told(attempts, event, value, now)

            monkeypatch.setattr(connection.Attempts, "obstacle", count)
            call = asyncio.create_task(client.meta(timeout=None))
            # Where the loop was held up for longer than an attempt takes, only the next one shows what it is.
            await until(lambda: tried > 2 and client._transport._obstacle == connection.UNANSWERED)
            call.cancel()
            await asyncio.wait((call,))
            with pytest.raises(ServerUnreachable, match="the host does not answer"):
                await client.meta(timeout=0)


async def test_a_request_is_not_left_in_a_queue_for_a_later_server(client: Any, scripted: Any) -> None:
    await client.discover()
    while not scripted.seen.empty():
        scripted.request()
    scripted.close()
    # The connection is gone, and the client, whose loop did not run, does not know it yet.
    eventually(lambda: not client._transport._open.connection.socket.getsockopt(zmq.EVENTS) & zmq.POLLOUT)
    assert client.connected
    call = asyncio.create_task(client.reset(timeout=DEADLINE_S))
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
