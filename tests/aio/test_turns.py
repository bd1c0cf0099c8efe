"""One client, many tasks: a request is built, sent, accounted for and taken over inside one turn.

The state machine at the end lets any ops of any tasks meet; the tests before it are the cases that went wrong.
"""

from __future__ import annotations

import asyncio
import warnings
from collections import Counter
from collections.abc import AsyncIterator, Coroutine, Iterator
from typing import Any

import anyio.to_thread
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from scripted import client_of
from waiting import DEADLINE_S, pass_time, until
from wire_log import WireLog

from urlab_client import SessionTakenOver, StepMode, URLabTimeoutError
from urlab_client.aio import URLabClient
from urlab_client.errors import NoSession, NotReady
from urlab_client.events import SessionOpened
from urlab_client.protocol.messages.runtime import ListKeyframes, SetMode
from urlab_client.protocol.messages.session import Forward, Hello
from urlab_client.server import Cut, Delay, Drop, Faults, Refuse, SimulatedServer

DT = 0.002


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[SimulatedServer, Faults]]:
    faults = Faults()
    with SimulatedServer("arm", play=True, faults=faults, shm_dir=tmp_path_factory.mktemp("shm")) as server:
        yield server, faults


@pytest.fixture
def faults(served: tuple[SimulatedServer, Faults]) -> Iterator[Faults]:
    yield served[1]
    served[1].reset()


@pytest.fixture
async def client(served: tuple[SimulatedServer, Faults]) -> AsyncIterator[URLabClient]:
    async with URLabClient(**served[0].client_options() | {"step_mode": "direct"}) as made:
        await made.discover()
        await made.reset()
        yield made


def tip(client: URLabClient) -> str:
    return list(client.articulations["arm"].bodies)[-1]


async def sent(client: URLabClient, op: str, call: Coroutine[Any, Any, Any], faults: Faults) -> asyncio.Task[Any]:
    """Start a call; return it when the server has its request, to which it will not reply."""
    lost = faults.add(Drop(op, times=1))
    task = asyncio.create_task(call)
    await until(lambda: lost.applied)
    return task


async def cancelled(task: asyncio.Task[Any]) -> None:
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


# Requests that carry state


async def test_a_wrench_travels_with_one_of_several_concurrent_steps(client: URLabClient) -> None:
    arm, log = client.articulations["arm"], WireLog(client)
    arm.apply_xfrc(tip(client), force=(0, 0, 5))
    await asyncio.gather(client.step(), client.step(), client.step())
    together = arm.qvel_array.copy()
    assert ["xfrc_applied" in step["per_articulation"]["arm"] for step in log.of("step")] == [True, False, False]
    await client.reset()
    arm.apply_xfrc(tip(client), force=(0, 0, 5))
    for _ in range(3):
        await client.step()
    assert together.tolist() == arm.qvel_array.tolist()


async def test_a_wrench_applied_while_a_step_waits_travels_once(client: URLabClient) -> None:
    arm, log = client.articulations["arm"], WireLog(client)
    steps = [asyncio.create_task(client.step()) for _ in range(3)]
    await until(lambda: log.requests, look=0)
    arm.apply_xfrc(tip(client), force=(0, 0, 5))
    await asyncio.gather(*steps)
    await client.step()
    assert ["xfrc_applied" in step["per_articulation"]["arm"] for step in log.of("step")] == [False, True, False, False]


async def test_a_wrench_is_kept_when_its_step_was_not_sent_or_refused(client: URLabClient, faults: Faults) -> None:
    arm, log = client.articulations["arm"], WireLog(client)
    arm.apply_xfrc(tip(client), force=(0, 0, 5))
    with pytest.raises(KeyError):
        await client.step(include_cameras={"nowhere": "latest"})
    arm.ctrl_array[0] = np.nan
    with pytest.raises(ValueError, match="nan"):
        await client.step()
    arm.ctrl_array[0] = 0.0
    holding = await sent(client, "list_actors", client.outliner.list_actors(), faults)
    await cancelled(asyncio.create_task(client.step()))
    await cancelled(holding)
    assert log.of("step") == []
    faults.add(Refuse("step", code="not_ready", times=1))
    with pytest.raises(NotReady):
        await client.step()
    await client.step()
    assert ["xfrc_applied" in step["per_articulation"]["arm"] for step in log.of("step")] == [True, True]
    assert arm.qvel_array.any()


async def test_an_editor_op_that_gives_up_its_turn_leaves_the_editor_to_the_next(
    client: URLabClient, faults: Faults
) -> None:
    holding = await sent(client, "list_keyframes", client.runtime.list_keyframes(), faults)
    with pytest.raises(URLabTimeoutError):
        await client.sim.start(timeout=0.05)
    with pytest.raises(URLabTimeoutError):
        await client.outliner.list_actors(timeout=0.05)
    await cancelled(holding)
    assert await client.outliner.list_actors(timeout=DEADLINE_S)


async def test_a_step_that_waits_for_a_mode_change_is_one_of_the_new_mode(client: URLabClient) -> None:
    await client.step(5)
    reply = (await asyncio.gather(client.runtime.set_mode("puppet"), client.step(10)))[1]
    assert client.step_mode is StepMode.PUPPET
    assert reply.time == client.data.time == pytest.approx(15 * DT)  # type: ignore[union-attr]  # there is a model
    await asyncio.gather(client.runtime.set_mode("direct"), client.step(10))
    assert client.sim_time == pytest.approx(25 * DT)


async def test_set_points_are_those_of_the_moment_in_which_a_step_is_sent(client: URLabClient, faults: Faults) -> None:
    arm, log = client.articulations["arm"], WireLog(client)
    holding = await sent(client, "list_actors", client.outliner.list_actors(), faults)
    step = asyncio.create_task(client.step())
    await asyncio.sleep(0)
    arm.ctrl_array[:] = 0.25
    await cancelled(holding)
    await step
    assert log.of("step")[0]["per_articulation"]["arm"]["ctrl"] == [0.25] * len(arm.actuators)


async def test_a_call_before_the_handshake_is_over_waits_for_it(served: tuple[SimulatedServer, Faults]) -> None:
    async with URLabClient(**served[0].client_options(), step_mode="direct") as client:
        await asyncio.gather(client.discover(), client.reset(), client.step(5), client.runtime.set_mode("live"))
        assert (client.step_count, client.step_mode) == (5, StepMode.LIVE)


async def test_concurrent_handshakes_follow_one_another(client: URLabClient) -> None:
    events, arm = client.events(), client.articulations["arm"]
    await asyncio.gather(client.discover(), client.discover(), client.step(2), client.discover())
    opened = [event for event in iter(events.receive_nowait, None) if isinstance(event, SessionOpened)]
    assert len(opened) == 3
    assert opened[-1].session_id == client.session_id
    assert client.articulations["arm"] is arm
    assert (await client.step(3)).step == client.step_count == 3


async def test_what_does_not_depend_on_the_state_passes_a_handshake_that_loads_its_model(
    client: URLabClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    loading, go_on = asyncio.Event(), asyncio.Event()
    run_sync = anyio.to_thread.run_sync

    async def slowly(*args: Any, **options: Any) -> Any:
        loading.set()
        await go_on.wait()
        return await run_sync(*args, **options)

    monkeypatch.setattr("anyio.to_thread.run_sync", slowly)
    discovering = asyncio.create_task(client.discover())
    await loading.wait()
    step = asyncio.create_task(client.step(4))
    await client.outliner.list_actors()
    assert not step.done()
    go_on.set()
    await asyncio.gather(discovering, step)
    assert client.step_count == 4


# Calls that were given up


@pytest.mark.parametrize("fresh", [True, False])
async def test_a_cancelled_handshake_is_not_somebody_else(
    client: URLabClient, served: tuple[SimulatedServer, Faults], faults: Faults, fresh: bool
) -> None:
    user = URLabClient(**served[0].client_options() | {"step_mode": "direct"}) if fresh else client
    late = faults.add(Delay("hello", seconds=0.1, times=1))
    events = user.events()
    discovering = asyncio.create_task(user.discover())
    await until(lambda: late.applied)
    await cancelled(discovering)
    if fresh:
        with pytest.raises(NoSession, match=r"^step: discover\(\) did not finish. .* Call discover\(\) first"):
            await user.step()
        assert await user.outliner.list_actors()
        await user.discover()
    assert (await user.step(3)).step == user.step_count == 3
    assert not [event for event in iter(events.receive_nowait, None) if type(event).__name__ == "SessionLost"]
    await user.close()


async def test_a_handshake_that_ran_into_its_deadline_is_not_somebody_else(client: URLabClient, faults: Faults) -> None:
    late = faults.add(Delay("hello", seconds=0.1, times=1))
    await client.step(2)
    with pytest.raises(URLabTimeoutError):
        await client.discover("full", timeout=0.05)
    assert late.applied
    await until(lambda: client.transport_stats.late)
    assert client.transport_stats.late == 1
    assert client.step_count == 0
    reply = await client.step(3)
    assert (reply.step, client.step_count) == (3, 3)
    assert reply.per_articulation["arm"].bodies is None, "at this client's level"


async def test_a_step_in_the_session_of_a_cancelled_handshake_shows_the_mode(
    client: URLabClient, served: tuple[SimulatedServer, Faults], faults: Faults
) -> None:
    assert client.step_mode == "direct"
    async with URLabClient(**served[0].client_options() | {"step_mode": "auto"}) as user:
        await user.discover()
        late = faults.add(Delay("hello", seconds=0.1, times=1))
        discovering = asyncio.create_task(user.discover())
        await until(lambda: late.applied)
        await cancelled(discovering)
        assert (await user.step(1)).step == 1
        assert user.step_mode == "direct"


async def test_a_handshake_lost_with_its_connection_is_named(client: URLabClient, faults: Faults) -> None:
    cut = faults.add(Cut("hello", times=1))
    discovering = asyncio.create_task(client.discover())
    await until(lambda: cut.applied)
    await until(lambda: not client.connected, look=0)
    await cancelled(discovering)
    with pytest.raises(SessionTakenOver, match=r"An abandoned handshake of this client .* Call discover\(\)"):
        await client.step()
    await client.discover()
    assert (await client.step(3)).step == 3


async def test_a_raw_handshake_is_the_clients_own(client: URLabClient) -> None:
    await client.call(Hello())
    assert (await client.step(3)).step == 3


@pytest.mark.parametrize("given_up", ["before", "after"])
async def test_a_step_after_a_cancelled_mode_change_is_one_of_that_mode(
    client: URLabClient, faults: Faults, given_up: str
) -> None:
    await client.step(5)
    if given_up == "after":
        await cancelled(await sent(client, "set_mode", client.runtime.set_mode("puppet"), faults))
    else:
        holding = await sent(client, "list_actors", client.outliner.list_actors(), faults)
        changing = asyncio.create_task(client.runtime.set_mode("puppet"))
        await asyncio.sleep(0)
        await cancelled(changing)
        await cancelled(holding)
    await client.step(10)
    assert client.step_mode == ("puppet" if given_up == "after" else "direct")
    assert client.sim_time == pytest.approx(15 * DT)


async def test_a_handshake_cancelled_at_its_last_request_is_made_up_for(
    served: tuple[SimulatedServer, Faults], client: URLabClient, faults: Faults
) -> None:
    await client.runtime.set_mode("live")
    async with URLabClient(**served[0].client_options() | {"step_mode": "direct"}) as user:
        await cancelled(await sent(user, "set_mode", user.discover(), faults))
        assert (await user.step(5)).step == user.step_count == 5
        assert user.step_mode is StepMode.DIRECT
    await client.call(Hello())
    assert (await client.call(SetMode(mode="live"))).previous_mode == "live", "close() has taken the mode back"


async def test_a_cancelled_start_is_told(faults: Faults, served: tuple[SimulatedServer, Faults]) -> None:
    async with URLabClient(**served[0].client_options() | {"step_mode": "direct"}) as client:
        await client.discover()
        await client.sim.stop()
        await cancelled(await sent(client, "begin_pie", client.sim.start(), faults))
        for call in (client.step(3), client.reset(), client.runtime.forward()):
            with pytest.raises(NoSession, match=r"sim.start\(\) was interrupted.*resync\(\)"):
                await call
        await client.sim.start()
        assert (await client.step(3)).step == client.step_count == 3
        await client.sim.stop()
        await cancelled(await sent(client, "begin_pie", client.sim.start(), faults))
        assert (await client.resync()).playing
        assert (await client.step(3)).step == client.step_count == 3


# Deadlines


async def test_a_call_waits_for_no_background_request_however_many_begin_at_once(scripted: Any) -> None:
    async with client_of(scripted, local_model=False) as client:
        await client.discover()
        probe = client._session.probe
        probes = [asyncio.create_task(probe(ListKeyframes(), timeout=DEADLINE_S)) for _ in range(2)]
        await until(scripted.held.qsize)
        assert await client.meta(timeout=5)
        assert await asyncio.gather(*probes) == [None, None]


async def test_a_step_that_waits_for_pictures_has_no_less_time_than_any_other(scripted: Any) -> None:
    options: dict[str, Any] = {"step_port": scripted.port, "rcv_timeout_ms": 60_000, "local_model": False}
    async with URLabClient("tcp://127.0.0.1", **options) as user:
        topic = {"mode": "real", "resolution": [2.0, 1.0], "fovy": 45.0, "zmq_endpoint": "tcp://*:9", "zmq_topic": "c"}
        hello = scripted.answers["hello"]({}) | {"manager_present": True, "global_cameras": {"c": topic}}
        scripted.on("hello", hello)
        scripted.on("set_mode", {"op": "set_mode_ok", "previous_mode": "live", "current_mode": "direct"})
        await user.discover()
        await user.runtime.set_mode("direct")
        before = user.transport_stats.sent
        step = asyncio.create_task(user.step(include_cameras={"c": "sync"}))
        await until(lambda: user.transport_stats.sent > before)
        pass_time(90)
        with pytest.raises(URLabTimeoutError, match=r"within (5999[0-9]|60000) ms"):
            await step


# Any ops of any tasks


OPS = ["step", "step", "step", "direct", "puppet", "live", "discover", "reset", "forward", "resync", "qpos"]
CALLS = st.one_of(
    st.tuples(st.sampled_from(OPS), st.integers(1, 4), st.none() | st.integers(0, 30)),
    # The server's options after a cancelled change are for the user to find out.
    st.tuples(st.just("options"), st.integers(1, 4), st.none()),
)
PUSHES = st.integers(0, 12)


class Tasks(RuleBasedStateMachine):
    """Batches of concurrent calls, some of which are cancelled, with wrenches applied at any moment between."""

    server: SimulatedServer
    transport: str

    def __init__(self) -> None:
        super().__init__()
        self.loop = asyncio.new_event_loop()
        self.applied = 0
        self.due: dict[float, int] = {}

    @initialize()
    def connect(self) -> None:
        self.loop.run_until_complete(self._connect())

    async def _connect(self) -> None:
        options = {"step_mode": "direct", "live_pictures": False, "transport": self.transport}
        self.client = URLabClient(**self.server.client_options() | options)
        await self.client.discover()
        await self.client.reset()
        self.log = WireLog(self.client)
        self.mode = "direct"

    @rule(calls=st.lists(CALLS, min_size=2, max_size=6), pushes=st.lists(PUSHES, max_size=2))
    def batch(self, calls: list[tuple[str, int, int | None]], pushes: list[int]) -> None:
        self.loop.run_until_complete(self._batch(calls, pushes))

    async def _batch(self, calls: list[tuple[str, int, int | None]], pushes: list[int]) -> None:
        tasks = [asyncio.create_task(self.call(op, count, cancel)) for op, count, cancel in calls]
        tasks += [asyncio.create_task(self.push(turns)) for turns in pushes]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # wrenches are inert in puppet mode
            await asyncio.gather(*tasks)
            await self.client.resync()
            self.check_requests()
            await self.check_agreement()

    async def call(self, op: str, count: int, cancel: int | None) -> None:
        client = self.client
        arm = client.articulations["arm"]
        run: Coroutine[Any, Any, Any] = {
            "step": lambda: client.step(count),
            "discover": client.discover,
            "reset": client.reset,
            "forward": client.runtime.forward,
            "resync": client.resync,
            "options": lambda: client.runtime.set_sim_options(density=float(count)),
            "qpos": lambda: client.runtime.set_qpos("arm", np.full(len(arm.qpos_array), 0.1 * count), by_name=True),
        }.get(op, lambda: client.runtime.set_mode(op))()
        task = asyncio.ensure_future(run)
        for _ in range(cancel or 0):
            await asyncio.sleep(0)
        if cancel is not None:
            task.cancel()
        try:
            await task
        except asyncio.CancelledError:
            assert cancel is not None

    async def push(self, turns: int) -> None:
        for _ in range(turns):
            await asyncio.sleep(0)
        self.applied += 1
        self.due[float(self.applied)] = len(self.log.requests)
        self.client.articulations["arm"].apply_xfrc(tip(self.client), force=(1e-3, 0, 0), torque=(0, 0, self.applied))

    def check_requests(self) -> None:
        """Each step fits the mode that the server was in, and carries a wrench that no other carries."""
        carried: Counter[float] = Counter()
        for request in self.log.requests:
            if request.get("reply", {}).get("op") == "error":
                continue  # not executed; it is sent again in the session that a cancelled handshake opened
            if request["op"] == "set_mode":
                self.mode = request["mode"]
            if request["op"] != "step":
                continue
            arms = request.get("per_articulation", {})
            assert ("qpos" in request) == ("time" in request) == (self.mode == "puppet"), (self.mode, request)
            carried.update(arm["xfrc_applied"][tip(self.client)][5] for arm in arms.values() if "xfrc_applied" in arm)
        assert all(count == 1 for count in carried.values()), carried
        missing = {push for push in self.due if push not in carried}
        buffered = {wrench[5] for wrench in self.client._state.objects.records["arm"].wrenches.values()}
        for push in missing - buffered:
            # A later one on the same body took its place, or a step took it that cannot carry any.
            later = push + 1 in self.due
            assert later or any(r["op"] == "step" for r in self.log.requests[self.due[push] :]), push
        self.due = dict.fromkeys(buffered, 0)
        self.log.requests.clear()

    async def check_agreement(self) -> None:
        """What the client believes is what the server says."""
        client = self.client
        assert client.step_mode == self.mode
        step = client.step_count
        told = await client.call(Forward())
        assert told.step == step, "and this client's session is the server's"
        if self.mode != "live":
            assert told.time == client.sim_time
            assert told.per_articulation["arm"].qpos.tolist() == client.articulations["arm"].qpos_array.tolist()
        assert client.model is not None
        believed = client.model.opt.density
        assert (await client.runtime.set_sim_options()).density == believed
        self.log.requests.clear()

    def teardown(self) -> None:
        self.loop.run_until_complete(self.client.close())
        self.loop.close()


@pytest.mark.parametrize("transport", ["zmq", "shm"])
def test_any_ops_of_any_tasks(served: tuple[SimulatedServer, Faults], transport: str) -> None:
    Tasks.server, Tasks.transport = served[0], transport
    machine = Tasks.TestCase()
    machine.settings = settings(max_examples=15, stateful_step_count=5, deadline=None)
    machine.runTest()
