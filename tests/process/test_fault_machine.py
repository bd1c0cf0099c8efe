"""Client, server and everything that can happen between them, in any order.

`URLAB_LONG_TESTS=1` takes hundreds of long histories in place of a few short ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import sys
import threading
from collections import Counter
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import mujoco
import pytest
from fault_proxy import Delay, Fault, FaultProxy, Garbage, Throttle, Truncate
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from waiting import eventually, in_time

from urlab_client.aio import Stream, URLabClient
from urlab_client.aio.transport import connection
from urlab_client.errors import (
    NoActiveManager,
    NotReady,
    ProtocolError,
    ServerUnreachable,
    SessionTakenOver,
    ShuttingDown,
    StepTimeout,
    StreamOverflow,
    URLabConnectionError,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.server import SimulatedServer
from urlab_client.server.physics.engine import Engine

LONG = bool(os.environ.get("URLAB_LONG_TESTS"))
TIMEOUT_S = 0.3
# A request or none: what these say about a step is that it was not executed.
REFUSED = (ServerUnreachable, SessionTakenOver, NoActiveManager, NotReady)
UNDECIDED = (URLabConnectionError, URLabTimeoutError, ProtocolError, StepTimeout, ShuttingDown)

faults: st.SearchStrategy[Fault] = st.one_of(
    st.builds(Delay, st.sampled_from([0.01, 0.1, 0.5])),
    st.builds(Truncate, st.integers(0, 40)),
    st.builds(Garbage, st.sampled_from([b"\xff", bytes(9), b"\x04\x7f", b"GET / HTTP/1.1\r\n\r\n"])),
    st.builds(Throttle, st.integers(1, 50)),
)


class Steps:
    """Steps of `mj_step` on request, counted where they are made; live mode has its own."""

    def __init__(self) -> None:
        self.taken = 0
        self._real = mujoco.mj_step

    def __call__(self, model: Any, data: Any, nstep: int = 1) -> None:
        self._real(model, data, nstep)
        if sys._getframe(1).f_code is Engine._advance.__code__:
            self.taken += nstep


class Machine(RuleBasedStateMachine):
    """Rules are what a user, a second user, the network and the server's machine do."""

    steps: Steps

    def __init__(self) -> None:
        super().__init__()
        self.before = self.held()
        self.loop = asyncio.new_event_loop()
        self.began = self.steps.taken
        # How many steps the server must have taken, and how many more it may have.
        self.sure = self.unsure = 0
        self.calls: list[asyncio.Task[Any]] = []
        self.states: Stream[Any] | None = None

    def held(self) -> tuple[list[str], int]:
        gc.collect()
        ours = sorted(t.name for t in threading.enumerate() if t.name.startswith("urlab"))
        return ours, len(list(Path("/proc/self/fd").iterdir()))

    def run(self, coro: Coroutine[Any, Any, Any], deadline: float) -> Any:
        """Do something within a deadline and a second; return its result, or the error that the user would see."""

        async def bounded() -> Any:
            call = asyncio.ensure_future(coro)
            self.calls.append(call)
            try:
                return await in_time(deadline, call)
            except URLabError as error:
                return error

        return self.loop.run_until_complete(bounded())

    @initialize()
    def connect(self) -> None:
        async def make() -> None:
            self.server = await SimulatedServer("ball", play=True).__aenter__()
            self.ports = {
                f"{name}_port": getattr(self.server, f"{name}_port") for name in ("step", "state", "ctrl", "info")
            }
            self.proxy = await FaultProxy(self.ports["step_port"]).__aenter__()
            options = {**self.server.client_options(), "step_mode": "direct", "rcv_timeout_ms": 1000}
            self.client = URLabClient(**(options | {"step_port": self.proxy.port}))
            self.other = URLabClient(**options)

        self.loop.run_until_complete(make())
        self.discover()

    # The user

    def note(self, outcome: Any, count: int) -> None:
        """Take note of what the user knows about steps."""
        if isinstance(outcome, REFUSED):
            return
        if isinstance(outcome, UNDECIDED):
            self.unsure += count
            return
        assert not isinstance(outcome, URLabError), outcome
        self.sure += count

    @rule()
    def discover(self) -> None:
        self.run(self.client.discover(timeout=TIMEOUT_S), TIMEOUT_S)

    @rule(count=st.integers(1, 20))
    def step(self, count: int) -> None:
        self.note(self.run(self.client.step(count, timeout=TIMEOUT_S), TIMEOUT_S), count)

    @rule(count=st.integers(1, 20), turns=st.integers(0, 5))
    def cancelled_step(self, count: int, turns: int) -> None:
        async def cancel() -> Any:
            call = asyncio.ensure_future(self.client.step(count, timeout=TIMEOUT_S))
            for _ in range(turns):
                await asyncio.sleep(0)
            call.cancel()
            try:
                return await call
            except asyncio.CancelledError:
                self.unsure += count
                return ServerUnreachable("counted")

        self.note(self.run(cancel(), TIMEOUT_S), count)

    @rule(count=st.integers(2_000, 4_000))
    def step_that_times_out(self, count: int) -> None:
        self.note(self.run(self.client.step(count, timeout=0.001), 0.001), count)

    @rule()
    def reset(self) -> None:
        self.run(self.client.reset(timeout=TIMEOUT_S), TIMEOUT_S)

    @rule()
    def read(self) -> None:
        self.run(self.client.scene.current_level(timeout=TIMEOUT_S), TIMEOUT_S)

    @rule()
    def several_at_once(self) -> None:
        async def all_of_them() -> None:
            reads = [self.client.scene.current_level(timeout=TIMEOUT_S) for _ in range(3)]
            for outcome in await asyncio.gather(*reads, return_exceptions=True):
                assert isinstance(outcome, (str, URLabError)), outcome

        self.run(all_of_them(), TIMEOUT_S)

    @rule()
    def resync(self) -> None:
        sent = self.client._state.pending.steps
        found = self.run(self.client.resync(timeout=TIMEOUT_S), TIMEOUT_S)
        if not isinstance(found, URLabError):
            assert found.steps_sent == sent
            if found.steps_applied is not None:
                assert 0 <= found.steps_applied <= sent
                if self.unsure == sent:  # what was in doubt is all that there was
                    self.sure, self.unsure = self.sure + found.steps_applied, 0

    @rule()
    def restart_play(self) -> None:
        self.run(self.client.sim.stop(timeout=TIMEOUT_S), 4 * TIMEOUT_S)
        self.run(self.client.sim.start(timeout=2.0), 8.0)

    @precondition(lambda self: self.states is None)
    @rule(policy=st.sampled_from(["latest", "all"]))
    def open_stream(self, policy: str) -> None:
        self.states = self.client.state_stream(policy, buffer=4)

    @precondition(lambda self: self.states is not None)
    @rule()
    def read_stream(self) -> None:
        assert self.states is not None
        outcome = self.run(self.states.receive(timeout=TIMEOUT_S), TIMEOUT_S)
        assert not isinstance(outcome, URLabError) or isinstance(outcome, (URLabTimeoutError, StreamOverflow)), outcome

    @precondition(lambda self: self.states is not None)
    @rule()
    def close_stream(self) -> None:
        assert self.states is not None
        self.run(self.states.aclose(), 0.0)
        self.states = None

    # Another user

    @rule(count=st.integers(1, 5))
    def somebody_else_takes_over(self, count: int) -> None:
        self.run(self.other.discover(timeout=TIMEOUT_S), TIMEOUT_S)
        self.note(self.run(self.other.step(count, timeout=TIMEOUT_S), TIMEOUT_S), count)

    # The network

    @rule(fault=faults, up=st.booleans())
    def disturb(self, fault: Fault, up: bool) -> None:
        (self.proxy.up if up else self.proxy.down).append(fault)

    @rule(how=st.sampled_from(["cut", "freeze", "hold_replies", "hold_requests"]))
    def break_the_line(self, how: str) -> None:
        getattr(self.proxy, how)()

    @rule()
    def refuse(self) -> None:
        self.proxy.refusing = True
        self.proxy.cut()

    @rule()
    def heal(self) -> None:
        self.proxy.heal()

    # The server's machine

    @rule()
    def restart_server(self) -> None:
        async def again() -> None:
            await self.server.__aexit__(None, None, None)
            self.server = SimulatedServer("ball", play=True, **self.ports)
            await self.server.__aenter__()

        self.loop.run_until_complete(again())

    @invariant()
    def no_step_was_taken_twice(self) -> None:
        assert self.steps.taken - self.began <= self.sure + self.unsure

    @invariant()
    def no_step_was_promised_in_vain(self) -> None:
        assert self.steps.taken - self.began >= self.sure

    def teardown(self) -> None:
        async def recover() -> None:
            """Whatever happened: once the line is whole, the client works."""
            self.proxy.heal()
            self.proxy.cut()
            async with asyncio.timeout(60):
                while True:
                    # With heartbeats as hurried as here, a busy machine may lose a connection that is whole.
                    with contextlib.suppress(URLabConnectionError):
                        await self.client.discover(timeout=30)
                        if not self.client.manager_present:
                            await self.client.sim.start(timeout=30)
                        reached = self.client.step_count
                        assert (await self.client.step(2, timeout=30)).step == reached + 2
                        break
            await self.client.close()
            await self.other.close()
            await self.proxy.__aexit__()
            await self.server.__aexit__(None, None, None)
            await self.loop.shutdown_default_executor()

        try:
            if hasattr(self, "client"):
                self.loop.run_until_complete(recover())
        finally:
            self.states = None
            self.loop.run_until_complete(self.loop.shutdown_asyncgens())
            self.loop.close()
        assert all(call.done() for call in self.calls)
        threads, files = self.before
        eventually(lambda: not Counter((now := self.held())[0]) - Counter(threads) and now[1] <= files)


@pytest.mark.timeout(3600 if LONG else 120)
def test_any_history_of_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "HEARTBEAT_MS", 100)
    monkeypatch.setattr(connection, "SILENCE_MS", 300)
    steps = Steps()
    monkeypatch.setattr(mujoco, "mj_step", steps)
    monkeypatch.setattr(Machine, "steps", steps, raising=False)
    how = settings(
        max_examples=int(os.environ.get("URLAB_HISTORIES", "60" if LONG else "6")),
        stateful_step_count=40 if LONG else 15,
        deadline=None,
        derandomize=not LONG,
        database=None,
        # Making a failing history short takes longer than anybody waits.
        phases=[*Phase] if LONG else [Phase.generate],
        suppress_health_check=[*HealthCheck],
    )
    Machine.TestCase.settings = how
    case = Machine.TestCase()
    case.runTest()
