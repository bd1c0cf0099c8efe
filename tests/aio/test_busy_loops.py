"""A program that computes for seconds on the event loop: nothing is lost by it, and nothing happens too late."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable, Coroutine
from threading import Event
from typing import Any

import pytest
from bare_loop import run_bare

from urlab_client import ServerUnreachable, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.aio.transport import connection
from urlab_client.events import ServerLost, ServerSilent

Main = Callable[[URLabClient], Coroutine[Any, Any, None]]


def compute(seconds: float) -> None:
    """Keep the thread for so long."""
    Event().wait(seconds)


LOOPS = ["selector", "bare", *(["uvloop"] if sys.platform != "win32" else [])]


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest, scripted: Any) -> Callable[[Main], None]:
    """Run something with a client of the scripted server, on a loop of each kind."""

    async def with_client(main: Main) -> None:
        async with URLabClient("tcp://127.0.0.1", step_port=scripted.port, local_model=False) as client:
            await main(client)

    def runner(main: Main) -> None:
        if request.param == "bare":
            run_bare(with_client(main))
        elif request.param == "selector":
            with asyncio.Runner(loop_factory=asyncio.SelectorEventLoop) as runner:
                runner.run(with_client(main))
        else:
            import uvloop

            uvloop.run(with_client(main))

    return runner


def test_a_reply_that_came_meanwhile_counts_although_its_deadline_has_passed(
    run: Callable[[Main], None], scripted: Any
) -> None:
    async def main(client: URLabClient) -> None:
        await client.meta()
        scripted.request()
        call = asyncio.create_task(client.meta(timeout=1))
        await asyncio.sleep(0)
        scripted.request()  # it is answered when this returns
        compute(1.2)
        assert await call
        assert client.transport_stats.late == 0

    run(main)


def test_a_request_is_not_sent_after_its_deadline(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        call = asyncio.create_task(client.reset(timeout=0.2))
        await asyncio.sleep(0)
        compute(0.5)  # the connection is made meanwhile
        with pytest.raises((URLabTimeoutError, ServerUnreachable), match="Nothing was sent"):
            await call
        assert await client.meta()
        assert scripted.request()["op"] == "meta"

    run(main)


def test_a_call_may_have_no_time_at_all(run: Callable[[Main], None], scripted: Any) -> None:
    async def main(client: URLabClient) -> None:
        await client.meta()
        scripted.request()
        with pytest.raises(URLabTimeoutError, match=r"Nothing was sent.*busy"):
            await client.reset(timeout=0)
        assert await client.meta()
        assert scripted.request()["op"] == "meta"

    run(main)


async def test_the_server_is_not_taken_for_lost(client: Any, scripted: Any) -> None:
    async with client.events() as events:
        await client.meta()
        scripted.request()
        call = asyncio.create_task(client.meta())
        await asyncio.sleep(0)
        scripted.request()
        compute((connection.HEARTBEAT_MS + connection.SILENCE_MS) / 1000 + 0.5)
        assert await call
        assert await client.meta()
        told = list(iter(events.receive_nowait, None))
    assert not [event for event in told if isinstance(event, (ServerLost, ServerSilent))]
    assert client.transport_stats.connects == 1
