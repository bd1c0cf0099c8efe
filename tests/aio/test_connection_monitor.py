"""What the client notices without being asked, and what it does not take over from a server it does not know."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator
from typing import Any, TypeVar

import pytest
from behind_its_back import behind_its_back
from relay import Relay
from waiting import DEADLINE_S, pass_time
from waiting import until as wait_until

from urlab_client.aio import Stream, URLabClient
from urlab_client.aio.state import connection_monitor
from urlab_client.aio.transport import connection
from urlab_client.aio.transport.subscriber import Subscription, Subscriptions
from urlab_client.errors import ConnectionLost, OutcomeUnknown, URLabConnectionError, URLabTimeoutError
from urlab_client.events import (
    ClientEvent,
    PlayEnded,
    PlayStarted,
    ServerAnswers,
    ServerLost,
    ServerReconnected,
    ServerSilent,
    SessionLost,
    SessionOpened,
)
from urlab_client.server import SimulatedServer

E = TypeVar("E", bound=ClientEvent)
REPLY = 60  # bytes: more than a heartbeat, less than any reply
LEVEL = {"op": "current_level_ok", "level_path": "/Game/Levels/lab"}


async def until(events: Stream[ClientEvent], kind: type[E]) -> E:
    """Read events up to the first of a kind."""
    async with asyncio.timeout(DEADLINE_S):
        async for event in events:
            if isinstance(event, kind):
                return event
    raise AssertionError(kind)


@pytest.fixture
async def server() -> AsyncIterator[SimulatedServer]:
    async with SimulatedServer("arm", play=True) as made:
        yield made


async def test_play_that_is_stopped_in_the_editor_is_noticed_and_so_is_the_next(server: SimulatedServer) -> None:
    async with URLabClient(**server.client_options(), step_mode="live") as client:
        await client.discover()
        arm, events = client.articulations["arm"], client.events()
        await client.state_stream().receive()
        await behind_its_back(server, client, "stop_pie")
        assert (await until(events, PlayEnded)).reason
        assert not client.manager_present
        await behind_its_back(server, client, "begin_pie")
        assert (await until(events, PlayStarted)).articulations == []
        await client.discover()
        assert client.articulations["arm"] is arm
        await client.runtime.set_mode("direct")
        await client.step(5)
        assert client.sim_time > 0
        assert arm.qpos_array.tolist() == client.data.qpos.tolist()  # type: ignore[union-attr]  # there is a model


async def test_a_lost_session_is_noticed_as_soon_as_the_server_is_back(server: SimulatedServer) -> None:
    async with Relay(server.client_options()["step_port"]) as relay:
        options = server.client_options() | {"step_port": relay.port}
        async with URLabClient(**options) as client, URLabClient(**server.client_options()) as thief:
            await client.discover()
            arm, events, session = client.articulations["arm"], client.events(), client.session_id
            relay.refusing = True
            relay.cut()
            await until(events, ServerLost)
            await thief.discover()
            relay.refusing = False
            assert (await until(events, ServerReconnected)).down_s > 0
            assert (await until(events, SessionLost)).session_id == session
            await client.discover()
            await until(events, SessionOpened)
            assert client.articulations["arm"] is arm


async def test_live_state_waits_until_the_session_is_known_to_live(server: SimulatedServer) -> None:
    async with Relay(server.client_options()["step_port"]) as relay:
        options = server.client_options() | {"step_port": relay.port}
        async with URLabClient(**options, step_mode="live") as client:
            await client.discover()
            await client.runtime.set_paused(False)
            events = client.events()
            states = client.state_stream()
            await states.receive()
            relay.refusing = True
            relay.cut()
            await until(events, ServerLost)
            frozen = client.sim_time
            times = [(await states.receive()).time for _ in range(20)]
            assert times[0] >= frozen  # the first may be the one that was taken over last
            assert times[-1] > times[0]
            assert client.sim_time == frozen
            relay.refusing = False
            await until(events, ServerReconnected)
            await wait_until(lambda: client.sim_time > frozen)
            await client.runtime.set_paused(True)


async def test_a_pulled_cable_is_noticed_by_heartbeats(server: SimulatedServer) -> None:
    async with Relay(server.client_options()["step_port"]) as relay:
        options = server.client_options() | {"step_port": relay.port, "step_mode": "direct"}
        async with URLabClient(**options) as client:
            await client.discover()
            await client.step()
            events = client.events()
            relay.freeze()
            with pytest.raises(OutcomeUnknown):
                await client.step(3, timeout=None)
            await until(events, ServerLost)
            relay.cut()
            relay.thaw()
            await until(events, ServerReconnected)
            found = await client.resync()
            assert (found.steps_sent, found.steps_applied, found.session_renewed) == (3, 0, True)


async def test_a_stuck_worker_behind_a_live_connection_is_told_from_a_dead_server(client: Any, scripted: Any) -> None:
    await client.discover()
    events = client.events()
    scripted.on("current_level", None)
    loop = asyncio.get_running_loop()
    asked = loop.time()
    call = asyncio.create_task(client.scene.current_level(timeout=5))
    await wait_until(scripted.held.qsize)
    pass_time(5)
    with pytest.raises(URLabTimeoutError, match="busy or blocked"):
        await call
    gave_up = loop.time()
    silent = await until(events, ServerSilent)
    assert (silent.op, client.connected) == ("current_level", True)
    released = loop.time()
    scripted.release(LEVEL)
    answers = await until(events, ServerAnswers)
    # Since the request, that is, and not since the call gave up.
    assert silent.waited_s + (released - gave_up) <= answers.silent_s < loop.time() - asked


async def test_a_read_is_asked_again_on_the_next_connection(client: Any, scripted: Any) -> None:
    await client.discover()
    scripted.on("current_level", None)
    pending = asyncio.create_task(client.scene.current_level(timeout=DEADLINE_S))
    await asyncio.to_thread(scripted.request, "current_level")
    await asyncio.to_thread(scripted.close)
    reborn = type(scripted)(scripted.port)
    reborn.on("current_level", LEVEL)
    try:
        assert await pending == "/Game/Levels/lab"
        assert client.transport_stats.connects == 2
    finally:
        await asyncio.to_thread(reborn.close)


async def test_a_read_whose_server_stays_away_says_that_it_was_lost(client: Any, scripted: Any) -> None:
    await client.discover()
    pending = asyncio.create_task(client.scene.current_level(timeout=DEADLINE_S))
    await asyncio.to_thread(scripted.request, "current_level")
    await asyncio.to_thread(scripted.close)
    await wait_until(lambda: not client.connected)
    pass_time(DEADLINE_S)
    with pytest.raises(ConnectionLost):
        await pending


@pytest.mark.parametrize(
    "junk",
    [b"HTTP/1.1 400 Bad Request\r\n\r\n", bytes(64), b"\x04\x7f", b"\xff" * 4096],
    ids=["text", "0", "cut", "ff"],
)
async def test_garbage_on_the_line_is_a_typed_error_and_the_next_call_works(
    server: SimulatedServer, junk: bytes
) -> None:
    options = server.client_options() | {"step_mode": "direct"}
    async with Relay(options["step_port"]) as relay, URLabClient(**(options | {"step_port": relay.port})) as client:
        await client.discover()
        relay.garble(junk, at_least=REPLY)
        with pytest.raises((URLabConnectionError, URLabTimeoutError)):
            await client.step(timeout=0.5)
        if client.connected:
            relay.cut()  # the stream of frames is out of step for good, as heartbeats find out in time
        found = await client.resync()
        assert found.steps_applied in (0, 1)
        await client.step()


async def test_garbage_in_the_handshake_of_a_reconnection_does_not_end_it_for_good(
    server: SimulatedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_RETRY_S", 0.2)
    options = server.client_options() | {"step_mode": "direct"}
    async with Relay(options["step_port"]) as relay, URLabClient(**(options | {"step_port": relay.port})) as client:
        await client.discover()
        events = client.events()
        relay.garble(b"\xff" * 4096)
        relay.cut()
        await until(events, ServerLost)
        await until(events, ServerReconnected)
        await client.step()


async def test_a_probe_gives_way_to_a_call(client: Any, scripted: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that leaves the client's own question unanswered must not delay the user's."""
    monkeypatch.setattr(connection_monitor, "_PROBE_S", 10 * DEADLINE_S)
    scripted.on("hello", scripted.answers["hello"]({}) | {"manager_present": True, "entities": {}})
    await client.discover()
    events = client.events()
    port = scripted.port
    await asyncio.to_thread(scripted.close)
    await until(events, ServerLost)
    reborn = type(scripted)(port)
    reborn.on("current_level", LEVEL)
    try:
        await asyncio.to_thread(reborn.request, "list_keyframes")
        assert await client.scene.current_level(timeout=DEADLINE_S) == "/Game/Levels/lab"
    finally:
        await asyncio.to_thread(reborn.close)


@pytest.mark.parametrize("flavour", ["URLabClient", "aio.URLabClient"])
def test_an_abandoned_client_keeps_no_interpreter(flavour: str) -> None:
    script = f"""
import asyncio, urlab_client, urlab_client.aio
from urlab_client.server import SimulatedServer

async def use(client):
    await client.discover()
    client.events()
    await client.state_stream().receive()

with SimulatedServer("arm", play=True) as server:
    client = urlab_client.{flavour}(**server.client_options(), step_mode="live")
    if "{flavour}".startswith("aio"):
        asyncio.run(use(client))
    else:
        client.discover()
        client.events()
        client.state_stream().receive()
    print("done", flush=True)
"""
    command = [sys.executable, "-W", "ignore::ResourceWarning", "-c", script]  # which development mode shows
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


async def test_a_socket_whose_making_was_interrupted_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    made, nobody = Subscriptions(), Subscription("tcp://127.0.0.1:1", (b"",), lambda _: True)
    handler: Any = None
    monkeypatch.setattr(connection.Connection, "watch", interrupted)
    with pytest.raises(KeyboardInterrupt) as kept:  # and with it the socket
        made.attach(handler, lambda: nobody)
    async with asyncio.timeout(DEADLINE_S):
        await asyncio.to_thread(made.close)
    assert kept.value
