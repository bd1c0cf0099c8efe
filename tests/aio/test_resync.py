"""Lost replies: the client says what is in doubt, finds out, and goes on, without ever stepping twice."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from functools import partial
from typing import Any

import mujoco
import numpy as np
import pytest
from relay import Relay
from scripted import names
from scripted_beta import ScriptedBeta
from waiting import DEADLINE_S, gives_up, until

import urlab_client
from urlab_client import OutcomeUnknown, SessionTakenOver
from urlab_client.aio import URLabClient
from urlab_client.errors import StepTimeout
from urlab_client.protocol.messages.sim import BeginPie, StopPie
from urlab_client.server import Delay, Faults, SimulatedServer

MESSAGE = 60  # bytes: more than some heartbeats, less than any request or reply


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True, shm_dir=tmp_path_factory.mktemp("shm")) as made:
        yield made


@pytest.fixture
async def relay(server: SimulatedServer) -> AsyncIterator[Relay]:
    async with Relay(server.client_options()["step_port"]) as made:
        yield made


def options(server: SimulatedServer, relay: Relay) -> dict[str, Any]:
    return server.client_options() | {"step_mode": "direct", "step_port": relay.port}


@pytest.fixture
async def client(server: SimulatedServer, relay: Relay) -> AsyncIterator[URLabClient]:
    async with URLabClient(**options(server, relay)) as made:
        await made.discover()
        await made.reset()
        await made.step(5)
        yield made


async def lose_the_reply(relay: Relay, call: asyncio.Task[Any]) -> None:
    relay.hold_replies()
    await relay.until_held(MESSAGE)
    relay.cut()
    relay.thaw()
    with pytest.raises(OutcomeUnknown, match=r"resync\(\)"):
        await call


async def lose_the_request(relay: Relay, call: asyncio.Task[Any]) -> None:
    relay.freeze()
    await relay.until_swallowed(MESSAGE)
    relay.cut()
    relay.thaw()
    with pytest.raises(OutcomeUnknown):
        await call


async def test_a_step_whose_reply_was_lost_is_counted_and_not_repeated(client: URLabClient, relay: Relay) -> None:
    session = client.session_id
    await lose_the_reply(relay, asyncio.create_task(client.step(3)))
    found = await client.resync()
    assert (found.session_held, found.session_renewed, found.playing, found.settled) == (True, False, True, True)
    assert (found.steps_sent, found.steps_applied, found.step) == (3, 3, 8)
    assert found.time == client.sim_time == pytest.approx(0.016)
    assert client.session_id == session
    assert (await client.step()).step == client.step_count == 9


@pytest.mark.parametrize("transport", ["zmq", "shm"])
async def test_with_nothing_in_doubt_everything_stays(server: SimulatedServer, transport: str) -> None:
    async with URLabClient(**server.client_options() | {"step_mode": "direct", "transport": transport}) as client:
        await client.discover()
        for _ in range(2):
            await client.step(5)
            before, session = client.sim_time, client.session_id
            found = await client.resync()
            assert (found.session_held, found.session_renewed, found.playing, found.settled) == (
                True,
                False,
                True,
                True,
            )
            assert (found.steps_sent, found.steps_applied, found.reset_applied) == (0, 0, None)
            assert (found.step, found.time) == (client.step_count, before)
            assert client.session_id == session
        assert (await client.step()).step == client.step_count == 11


@pytest.mark.parametrize("fault", ["cancelled", "timed out"])
async def test_over_shared_memory_resync_does_not_overtake_an_abandoned_handshake(
    server: SimulatedServer, relay: Relay, fault: str
) -> None:
    async with URLabClient(**options(server, relay) | {"transport": "shm"}) as client:
        await client.discover()
        await client.step(5)
        swallowed, over_shm = relay.swallowed, client.transport_stats.over_shm
        relay.freeze()
        await gives_up(client.discover, lambda: relay.swallowed >= swallowed + MESSAGE, fault)
        resync = asyncio.create_task(client.resync())
        sent = client.transport_stats.sent
        await until(lambda: client.transport_stats.sent > sent)
        assert client.transport_stats.over_shm == over_shm
        relay.thaw()
        found = await resync
        assert (await client.step(2)).step == client.step_count == found.step + 2


async def test_a_reconnection_alone_leaves_no_doubt(client: URLabClient, relay: Relay) -> None:
    session = client.session_id
    relay.cut()
    await until(lambda: not client.connected)
    found = await client.resync()
    assert (found.session_held, found.session_renewed, found.steps_applied, found.step) == (True, False, 0, 5)
    assert client.session_id == session


async def test_a_step_that_never_arrived_is_shut_out_before_it_may_be_repeated(
    client: URLabClient, relay: Relay
) -> None:
    session, arm = client.session_id, client.articulations["arm"]
    await lose_the_request(relay, asyncio.create_task(client.step(3)))
    found = await client.resync()
    assert (found.session_held, found.session_renewed, found.settled) == (True, True, True)
    assert (found.steps_sent, found.steps_applied) == (3, 0)
    assert found.time == pytest.approx(0.01)
    assert client.session_id != session
    assert client.articulations["arm"] is arm
    await client.step(3)
    assert client.sim_time == pytest.approx(0.016)
    assert arm.qpos_array.tolist() == client.data.qpos.tolist()  # type: ignore[union-attr]  # there is a model


async def test_the_blocking_client_does_the_same(server: SimulatedServer, relay: Relay) -> None:
    def drive(lost: asyncio.Event, loop: asyncio.AbstractEventLoop) -> tuple[Any, float]:
        with urlab_client.URLabClient(**options(server, relay)) as client:
            client.discover()
            client.reset()
            loop.call_soon_threadsafe(lost.set)
            try:
                while True:
                    client.step(2)
            except OutcomeUnknown:
                return client.resync(), client.sim_time

    ready = asyncio.Event()
    blocking = asyncio.create_task(asyncio.to_thread(drive, ready, asyncio.get_running_loop()))
    await ready.wait()
    relay.hold_replies()
    await relay.until_held(MESSAGE)
    relay.cut()
    relay.thaw()
    found, time = await blocking
    assert (found.session_held, found.steps_sent, found.steps_applied) == (True, 2, 2)
    assert time == found.time == pytest.approx(found.step * 0.002)


async def test_a_timed_out_and_a_cancelled_step_are_counted_together(client: URLabClient, relay: Relay) -> None:
    relay.hold_replies()
    sent = client.transport_stats.sent
    await gives_up(partial(client.step, 2), lambda: client.transport_stats.sent == sent + 1, "timed out")
    await gives_up(partial(client.step, 4), lambda: client.transport_stats.sent == sent + 2, "cancelled")
    relay.thaw()
    found = await client.resync()
    assert (found.session_held, found.session_renewed) == (True, False), "the connection stood: nothing is on its way"
    assert (found.steps_sent, found.steps_applied, found.step) == (6, 6, 11)


async def test_a_refused_step_leaves_no_doubt(client: URLabClient) -> None:
    await client.sim.stop()
    with pytest.raises(urlab_client.NoActiveManager):
        await client.step(3)
    found = await client.resync()
    assert (found.playing, found.steps_sent, found.steps_applied, found.settled) == (False, 0, 0, True)
    await client.sim.start()
    await client.step(3)


async def test_steps_that_the_server_has_queued_stay_open(scripted: Any) -> None:
    """Beta statement 97."""
    clock = {"time": 0.0, "step": 4.0, "sim_time": {"sec": 0.0, "nsec": 0.0}, "wall_time": {"sec": 0.0, "nsec": 0.0}}
    scripted.on("step", {"op": "error", "code": "step_timeout", "message": "3 steps are queued"})
    scripted.on("forward", {"op": "forward_ok", **clock, "step": 0.0, "per_articulation": {}})
    hello = scripted.answers["hello"]({}) | {"manager_present": True, "entities": {}}
    scripted.on("hello", hello)
    scripted.on("set_mode", {"op": "set_mode_ok", "previous_mode": "direct", "current_mode": "direct"})
    async with URLabClient(f"tcp://127.0.0.1:{scripted.port}", step_mode="direct", local_model=False) as client:
        await client.discover()
        while not scripted.seen.empty():
            scripted.seen.get_nowait()
        with pytest.raises(StepTimeout):
            await client.step(3)
        found = await client.resync()
        sent = []
        while not scripted.seen.empty():
            sent.append(scripted.seen.get_nowait()["op"])
    assert (found.steps_sent, found.steps_applied, found.settled) == (3, 0, False)
    assert sent.count("step") == 1
    assert sent.index("step") < sent.index("forward")


async def test_a_cancelled_stop_is_completed(beta_client: URLabClient, beta: ScriptedBeta) -> None:
    """The plugin answers `stop_pie` when the end has been requested, not when play is over."""
    stop, status, left = beta.answers["stop_pie"], beta.answers["pie_status"], 3
    beta.on("stop_pie", {"op": "stop_pie_ok"})
    await gives_up(beta_client.sim.stop, lambda: "pie_status" in names(beta.arrived()), "cancelled")

    def winding_down(request: dict[str, Any]) -> Any:
        nonlocal left
        left -= 1
        if left == 0:
            stop(request)
        return status(request)

    beta.on("pie_status", winding_down)
    found = await beta_client.resync()
    assert (found.playing, beta_client.manager_present, left) == (False, False, 0)


async def test_a_cancelled_handshake_of_another_world_is_made_up_for() -> None:
    faults = Faults()
    async with (
        SimulatedServer("arm", play=True, faults=faults) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        await client.discover()
        await client.scene.duplicate_actor("arm", "second", by_name=True)
        await client.call(StopPie())  # as another program would: the client does not know
        await client.call(BeginPie())
        late = faults.add(Delay("hello", seconds=DEADLINE_S, times=1))
        await gives_up(client.discover, lambda: late.applied, "cancelled")
        late.remove()
        await client.resync()
        assert len(client.articulations) == 2
        assert (await client.step(2)).step == 2


@pytest.mark.parametrize("lose", [lose_the_reply, lose_the_request])
async def test_a_lost_reset_is_found_out(client: URLabClient, relay: Relay, lose: Any) -> None:
    await lose(relay, asyncio.create_task(client.reset(seed=7)))
    found = await client.resync()
    assert found.reset_applied is (lose is lose_the_reply)
    assert client.reset_seed == (7 if found.reset_applied else None)
    assert found.session_renewed is (lose is lose_the_request)
    assert found.time == client.sim_time == (0.0 if found.reset_applied else pytest.approx(0.01))


@pytest.mark.parametrize("lose", [lose_the_reply, lose_the_request])
async def test_a_lost_mode_change_is_made_certain(client: URLabClient, relay: Relay, lose: Any) -> None:
    await client.runtime.set_mode("live")
    await lose(relay, asyncio.create_task(client.runtime.set_mode("direct", timeout=DEADLINE_S)))
    assert client.step_mode == "live"
    await client.resync()
    assert client.step_mode == "direct"
    before = client.sim_time
    await client.step(4)
    assert client.sim_time == pytest.approx(before + 0.008)


async def test_a_lost_pause_is_made_certain(client: URLabClient, relay: Relay, server: SimulatedServer) -> None:
    session, play = client.session_id, server._running.core.play  # type: ignore[union-attr]
    await lose_the_request(relay, asyncio.create_task(client.runtime.set_paused(True)))
    await client.resync()
    assert client.session_id != session, "it may still be on its way, and must not arrive after another"
    assert play.running().engine.paused
    assert not await client.runtime.set_paused(False)
    await client.resync()
    assert not play.running().engine.paused


async def test_a_lost_push_is_found_out_and_the_local_state_stays(client: URLabClient, relay: Relay) -> None:
    await client.runtime.set_mode("puppet")
    await client.step(1)
    data = client.data
    assert data is not None
    pending = asyncio.create_task(client.step(10))
    await lose_the_request(relay, pending)
    local = data.time
    found = await client.resync()
    assert (found.steps_sent, found.steps_applied, found.session_renewed) == (1, 0, False)
    assert (client.data is data, data.time) == (True, local)
    await client.step(0)
    assert client.sim_time == local
    await client.runtime.set_mode("direct")


async def test_a_wrench_acts_once(client: URLabClient, relay: Relay) -> None:
    arm = client.articulations["arm"]
    link = list(arm.bodies)[-1]

    async def velocities(*, lost: bool) -> list[float]:
        await client.reset()
        arm.apply_xfrc(link, force=(0, 0, 5))
        if lost:
            await lose_the_reply(relay, asyncio.create_task(client.step()))
            assert (await client.resync()).steps_applied == 1
        else:
            await client.step()
        await client.step()
        return arm.qvel_array.tolist()

    assert await velocities(lost=True) == await velocities(lost=False)


async def test_a_wrench_whose_step_never_arrived_is_kept_for_the_next(client: URLabClient, relay: Relay) -> None:
    arm = client.articulations["arm"]

    async def velocities(*, lost: bool) -> list[float]:
        await client.reset()
        arm.apply_xfrc(list(arm.bodies)[-1], force=(0, 0, 5))
        if lost:
            await lose_the_request(relay, asyncio.create_task(client.step()))
            assert (await client.resync()).steps_applied == 0
        await client.step(2)
        return arm.qvel_array.tolist()

    assert await velocities(lost=True) == await velocities(lost=False)


async def test_another_client_took_over(client: URLabClient, server: SimulatedServer) -> None:
    async with URLabClient(**server.client_options()) as other:
        await other.discover()
        with pytest.raises(SessionTakenOver):
            await client.step(2)
        found = await client.resync()
    assert (found.session_held, found.session_renewed) == (False, True)
    await client.step()


async def test_resync_of_an_unreachable_server_keeps_the_doubt(client: URLabClient, relay: Relay) -> None:
    relay.refusing = True
    await lose_the_reply(relay, asyncio.create_task(client.step(3)))
    with pytest.raises(urlab_client.URLabConnectionError):
        await client.resync(timeout=0.2)
    relay.refusing = False
    found = await client.resync()
    assert (found.steps_sent, found.steps_applied) == (3, 3)


def test_forward_changes_no_trajectory() -> None:
    """What `resync` sends to learn the state must not disturb it."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
        <body pos="0 0 .3" euler="20 30 0"><freejoint/><geom type="box" size=".1 .1 .1"/>
        <body pos=".2 0 0"><joint axis="0 1 0"/><geom size=".05"/></body></body></worldbody></mujoco>"""
    )
    plain, disturbed = mujoco.MjData(model), mujoco.MjData(model)
    for _ in range(400):
        mujoco.mj_step(model, plain)
        mujoco.mj_step(model, disturbed)
        mujoco.mj_forward(model, disturbed)
    assert plain.ncon > 0
    assert np.array_equal(plain.qpos, disturbed.qpos)
    assert np.array_equal(plain.qvel, disturbed.qvel)
