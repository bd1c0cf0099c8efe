"""`keep_session=True`: what is opened again by itself, and what is left to whoever has it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any, TypeVar

import pytest
from behind_its_back import behind_its_back
from ports import free_port
from relay import Relay
from waiting import DEADLINE_S
from waiting import until as wait_until

from urlab_client.aio import Stream, URLabClient
from urlab_client.aio.state import connection_monitor
from urlab_client.errors import ServerRestarted, SessionTakenOver
from urlab_client.events import ClientEvent, PlayEnded, ServerLost, ServerReconnected, SessionLost, SessionOpened
from urlab_client.server import SimulatedServer

E = TypeVar("E", bound=ClientEvent)


async def until(events: Stream[ClientEvent], kind: type[E]) -> E:
    """Read events up to the first of a kind."""
    async with asyncio.timeout(DEADLINE_S):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError(kind)


@pytest.fixture
def ports() -> dict[str, int]:
    return {f"{name}_port": free_port() for name in ("step", "state", "ctrl", "info", "camera")}


@pytest.fixture
async def server(ports: dict[str, int]) -> AsyncIterator[SimulatedServer]:
    async with SimulatedServer("arm", play=True, **ports) as made:
        yield made


def keeping(server: SimulatedServer, **options: Any) -> URLabClient:
    return URLabClient(**(server.client_options() | {"step_mode": "direct", "keep_session": True} | options))


async def is_gone(client: URLabClient, events: Stream[ClientEvent]) -> None:
    """Wait until the client has found nobody at the address."""
    await until(events, ServerLost)
    await wait_until(lambda: client._transport.refused)  # type: ignore[union-attr]


async def test_a_restarted_server_is_discovered_again(ports: dict[str, int]) -> None:
    async with SimulatedServer("arm", play=True, **ports) as first:
        client = keeping(first)
        await client.discover()
        arm, events = client.articulations["arm"], client.events()
        await client.step(50)
    await is_gone(client, events)
    async with SimulatedServer("arm", play=True, **ports), client:
        assert (await until(events, ServerReconnected)).refused
        lost, opened = await until(events, SessionLost), await until(events, SessionOpened)
        assert lost.session_id != opened.session_id
        await wait_until(lambda: client.step_count == 0)
        assert client.articulations["arm"] is arm
        assert (await client.step(3)).step == 3


@pytest.mark.parametrize(("mode", "keep"), [("direct", True), ("direct", False), ("live", False)])
async def test_waiting_across_a_restart_says_that_the_server_was_started_again(
    mode: str, keep: bool, ports: dict[str, int]
) -> None:
    async with SimulatedServer("arm", play=True, unpaused=True, **ports) as first:
        client = keeping(first, step_mode=mode, keep_session=keep)
        await client.discover()
        events = client.events()
        if mode == "live":
            waiting = asyncio.create_task(client.wait_until(lambda: False, timeout=5.0))
            await wait_until(lambda: client.sim_time > 0.1)
    await is_gone(client, events)
    if mode == "direct":
        waiting = asyncio.create_task(client.wait_until(lambda: False, timeout=5.0))
    async with SimulatedServer("arm", play=True, unpaused=True, **ports), client:
        with pytest.raises(ServerRestarted, match=r"has restarted.* Call discover\(\)") as info:
            await waiting
        assert "another" not in str(info.value)
        assert "takes the server over" not in str(info.value)
        await client.discover()
        await client.run_for(0.01)


async def test_a_session_that_was_taken_over_is_not_taken_back(ports: dict[str, int]) -> None:
    async with SimulatedServer("arm", play=True, **ports) as first:
        client, other = keeping(first), URLabClient(**first.client_options(), step_mode="direct")
        await client.discover()
        events = client.events()
        await other.discover()
        with pytest.raises(SessionTakenOver):
            await client.step()
        await until(events, SessionLost)
        assert (await other.step()).step == 1
    await is_gone(client, events)
    async with SimulatedServer("arm", play=True, **ports), client, other:
        await other.discover()
        await until(events, SessionLost)
        assert (await other.step()).step == 1, "nor after a restart, which was the other one's"


async def test_a_takeover_is_noticed_without_a_call(server: SimulatedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_monitor, "_PROBE_INTERVAL_S", 0.02)
    async with keeping(server) as client, URLabClient(**server.client_options()) as other:
        await client.discover()
        events = client.events()
        await other.discover()
        assert (await until(events, SessionLost)).session_id == client.session_id
        await other.runtime.list_keyframes()


async def test_a_takeover_behind_a_broken_line_is_none_of_a_restart(server: SimulatedServer) -> None:
    async with (
        Relay(server.client_options()["step_port"]) as relay,
        keeping(server, step_port=relay.port) as client,
        URLabClient(**server.client_options()) as other,
    ):
        await client.discover()
        await client.step(50)
        events = client.events()
        relay.refusing = True
        relay.cut()
        await is_gone(client, events)
        await other.discover()
        relay.refusing = False
        await until(events, SessionLost)
        await wait_until(lambda: client._keeper._taken_over == client.session_id)
        await other.runtime.list_keyframes()


async def test_play_that_somebody_else_starts_is_discovered(
    server: SimulatedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_monitor, "_PROBE_INTERVAL_S", 0.1)
    async with keeping(server) as client:
        await client.discover()
        arm, events = client.articulations["arm"], client.events()
        await client.step(5)
        await behind_its_back(server, client, "stop_pie")
        await until(events, PlayEnded)
        await behind_its_back(server, client, "begin_pie")
        await until(events, SessionOpened)
        await wait_until(lambda: client.manager_present)
        assert client.articulations["arm"] is arm
        assert (await client.step(2)).step == 2
