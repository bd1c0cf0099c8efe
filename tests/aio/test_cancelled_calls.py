"""A handshake that is broken off, by closing the client or by a deadline, leaves a client that says what is true."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
from waiting import DEADLINE_S, pass_time, until

from urlab_client import ClientClosed, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.aio.model.mirror import Mirror
from urlab_client.events import PlayEnded
from urlab_client.protocol.messages.sim import StopPie
from urlab_client.server import Drop, Faults, SimulatedServer


class SlowLoading:
    """Models take until `go_on` to load."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun, self.go_on = asyncio.Event(), threading.Event()
        loop, load = asyncio.get_running_loop(), Mirror.load

        def slowly(*args: Any, **options: Any) -> Any:
            loop.call_soon_threadsafe(self.begun.set)
            assert self.go_on.wait(DEADLINE_S)
            return load(*args, **options)

        monkeypatch.setattr(Mirror, "load", staticmethod(slowly))


async def test_loading_the_model_counts_for_no_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    async with SimulatedServer("ball", play=True) as server, URLabClient(**server.client_options()) as client:
        loading = SlowLoading(monkeypatch)
        call = asyncio.create_task(client.discover(timeout=DEADLINE_S))
        await loading.begun.wait()
        pass_time(DEADLINE_S - 1)
        loading.go_on.set()
        await call
        assert client.model is not None


async def test_a_handshake_that_is_cancelled_leaves_model_and_wrappers_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with (
        SimulatedServer("ball", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        await client.discover()
        model, data, ball = client.model, client.data, client.articulations["ball"]
        with monkeypatch.context() as patch:
            loading = SlowLoading(patch)
            call = asyncio.create_task(client.discover())
            await loading.begun.wait()
            call.cancel()
            await asyncio.wait((call,))  # it does not wait for the thread
            assert (client.model, client.data, client.articulations["ball"]) == (model, data, ball)
            loading.go_on.set()
        await client.discover()
        assert client.articulations["ball"] is ball
        assert (await client.step()).step == 1


@pytest.mark.parametrize("play", [True, False])
async def test_closing_while_the_model_loads(monkeypatch: pytest.MonkeyPatch, play: bool) -> None:
    loading = SlowLoading(monkeypatch)
    async with SimulatedServer("ball", play=play) as server:
        client = URLabClient(**server.client_options())
        call = asyncio.create_task(client.discover())
        await loading.begun.wait()
        await client.close()
        loading.go_on.set()
        with pytest.raises(ClientClosed):
            await call
        assert client.model is None
        assert not client.articulations


async def test_the_end_of_play_is_noticed_after_a_handshake_whose_last_reply_was_lost() -> None:
    faults = Faults()
    lost = faults.add(Drop("set_mode", times=1))
    async with (
        SimulatedServer("ball", play=True, faults=faults) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        events = client.events()
        call = asyncio.create_task(client.discover(timeout=DEADLINE_S))
        await until(lambda: lost.applied)
        pass_time(DEADLINE_S)
        with pytest.raises(URLabTimeoutError):
            await call
        await client.resync()
        assert client.step_mode == "direct"
        await client.runtime.set_mode("live")
        await client.state_stream().receive()
        async with asyncio.timeout(DEADLINE_S):
            await client.call(StopPie())  # as somebody at the editor: the client takes nothing over
            async for event in events:
                if isinstance(event, PlayEnded):
                    break
        assert not client.manager_present
