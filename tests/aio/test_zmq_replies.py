"""Replies over ZeroMQ that come twice, or to handshakes that were given up."""

from __future__ import annotations

import asyncio

import msgspec
import pytest
import zmq
from waiting import DEADLINE_S

from urlab_client.aio.transport import waiting
from urlab_client.aio.transport.base import Deadlines
from urlab_client.aio.transport.zmq import ZmqTransport
from urlab_client.protocol.registry import OPS


async def test_replies_that_come_twice_keep_no_later_one_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second is still unread when the next request goes out: the descriptor says nothing of the next reply."""
    monkeypatch.setattr(waiting, "crowded", lambda: True)  # who looks by itself would find it
    op = OPS["forward"]
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        port = router.bind_to_random_port("tcp://127.0.0.1")

        def answer() -> None:
            envelope = router.recv_multipart()
            for _ in range(3):
                router.send_multipart(envelope)

        transport = ZmqTransport(f"tcp://127.0.0.1:{port}")
        try:
            async with asyncio.timeout(DEADLINE_S):
                for number in range(20):
                    frame = msgspec.msgpack.encode(number)
                    answered = asyncio.create_task(asyncio.to_thread(answer))
                    assert await transport.request(frame, op, Deadlines(None, None)) == frame
                    await answered
        finally:
            await transport.aclose()
        assert transport.stats.received == 20


async def test_of_handshakes_that_are_given_up_the_last_alone_is_awaited() -> None:
    """Until a later request is answered, and with it all that went before, in the order of a connection."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        port = router.bind_to_random_port("tcp://127.0.0.1")
        transport = ZmqTransport(f"tcp://127.0.0.1:{port}")
        abandoned = list[asyncio.Future[bytes]]()

        async def abandon() -> list[bytes]:
            asking = asyncio.ensure_future(
                transport.request(b"", OPS["hello"], Deadlines(None, None), late=abandoned.append)
            )
            arrived = await asyncio.to_thread(router.recv_multipart)
            asking.cancel()
            await asyncio.wait((asking,))
            return arrived

        try:
            async with asyncio.timeout(DEADLINE_S):
                envelopes = [await abandon() for _ in range(3)]
                assert [reply.done() for reply in abandoned] == [True, True, False]
                for envelope in envelopes:
                    router.send_multipart(envelope)
                assert await abandoned[2] == b""
                await abandon()  # and is never answered
                asking = asyncio.create_task(transport.request(b"", OPS["meta"], Deadlines(None, None)))
                router.send_multipart(await asyncio.to_thread(router.recv_multipart))
                await asking
                assert abandoned[3].cancelled()
        finally:
            await transport.aclose()
