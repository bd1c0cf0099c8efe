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
from urlab_client.protocol.messages.sim import StopPie
from urlab_client.protocol.messages.streams import PlayEnded
from urlab_client.server import Drop, Faults, SimulatedServer


@pytest.mark.parametrize("play", [True, False])
async def test_closing_while_the_model_loads(monkeypatch: pytest.MonkeyPatch, play: bool) -> None:
    loading, go_on = asyncio.Event(), threading.Event()
    loop, load = asyncio.get_running_loop(), Mirror.load

    def slowly(*args: Any, **options: Any) -> Any:
        loop.call_soon_threadsafe(loading.set)
        assert go_on.wait(DEADLINE_S)
        return load(*args, **options)

    monkeypatch.setattr(Mirror, "load", staticmethod(slowly))
    async with SimulatedServer("ball", play=play) as server:
        client = URLabClient(**server.client_options())
        call = asyncio.create_task(client.discover())
        await loading.wait()
        await client.close()
        go_on.set()
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
