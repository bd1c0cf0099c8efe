"""What clients observe of stepping: modes, queue, resets, wrenches, faults; pacing against a simulated clock."""

from __future__ import annotations

import functools
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ASSETS, BALL, BOT, hasty, make_scene
from waiting import eventually

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.session import ArticulationCommand, Step
from urlab_client.server.handlers.runtime import parse_control_source, parse_mode
from urlab_client.server.physics import engine as engine_module
from urlab_client.server.physics import scheduling
from urlab_client.server.physics.controllers import ControlSource
from urlab_client.server.physics.engine import Engine
from urlab_client.server.refusal import Refusal
from urlab_client.simulation.controller_config import ControllerConfig

DT = 0.002
DEADLINE = 30.0
"""Seconds after which a test that waits for another thread gives up."""


class Sim:
    """A running engine with the shorthands the tests speak in."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.model, self.data = engine.scene.model, engine.scene.data

    def step(self, n_steps: int = 1, **fields: Any) -> float:
        """Step and return `time` right after it."""
        return self.engine.step(Step(n_steps=n_steps, **fields), lambda mode: self.engine.time)

    def command(self, key: str = "bot", n_steps: int = 1, **command: Any) -> list[float]:
        """Command one articulation and return the whole `ctrl` after the step."""
        request = Step(n_steps=n_steps, per_articulation={key: ArticulationCommand(**command)})
        return self.engine.step(request, lambda mode: self.data.ctrl.tolist())

    def qpos(self) -> np.ndarray:
        with self.engine.lock:
            return self.data.qpos.copy()


Start = Callable[..., Sim]


@pytest.fixture
def start() -> Iterator[Start]:
    engines: list[Engine] = []

    def _start(
        *,
        mode: StepMode = StepMode.DIRECT,
        make: Callable[..., Engine] = Engine,
        options: dict[str, Any] | None = None,
        **parts: str | Path,
    ) -> Sim:
        engine = make(make_scene(**(parts or {"bot": BOT})), **(options or {})).start()
        engines.append(engine)
        engine.set_mode(mode)
        return Sim(engine)

    yield _start
    for engine in engines:
        assert engine.close(DEADLINE)


@pytest.fixture
def pool() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor() as executor:
        yield executor


def refused(call: Callable[[], object]) -> str:
    with pytest.raises(Refusal) as caught:
        call()
    return caught.value.code


def fresh(model: Any) -> Any:
    """Return data as it is after a reset: `mj_forward` leaves a warm start for the solver."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


class Queue(deque[Any]):
    """The engine's queue, which tells when a step was queued."""

    def __init__(self, engine: Engine) -> None:
        super().__init__()
        self._queued = threading.Semaphore(0)
        engine._queue = self

    def append(self, step: Any) -> None:
        super().append(step)
        self._queued.release()

    def wait(self) -> None:
        assert self._queued.acquire(timeout=DEADLINE)


class Beat:
    """A hook that lets a test wait for the next few calls."""

    def __init__(self, hooks: list[Callable[[], None]], engine: Engine) -> None:
        self._calls = threading.Semaphore(0)
        with engine.lock:
            hooks.append(self._calls.release)

    def wait(self, calls: int = 1) -> None:
        for _ in range(calls):
            assert self._calls.acquire(timeout=DEADLINE)


# Live.


def test_a_session_starts_paused_in_live(start: Start) -> None:
    sim = start(mode=StepMode.LIVE)
    assert sim.engine.mode is StepMode.LIVE
    assert sim.engine.paused
    ticks = Beat(sim.engine.on_tick, sim.engine)
    ticks.wait(3)
    assert sim.step() == 0.0


def test_live_time_grows_without_requests_once_unpaused_and_does_not_count_steps(start: Start) -> None:
    sim = start(mode=StepMode.LIVE)
    substeps = Beat(sim.engine.on_substep, sim.engine)
    assert sim.engine.set_paused(False) is False
    substeps.wait(3)
    assert sim.step(n_steps=100) >= 3 * DT - 1e-9
    assert sim.engine.step_count == 0


@pytest.mark.parametrize("paused", [True, False])
def test_live_step_stages_positional_controls_only(start: Start, *, paused: bool) -> None:
    sim = start(mode=StepMode.LIVE)
    sim.engine.set_paused(paused)
    sim.command(ctrl=[0.7], ctrl_map={"m": 0.1}, control_mode="raw", xfrc_applied={"base": [0, 0, 9, 0, 0, 0]})
    ticks = Beat(sim.engine.on_tick, sim.engine)
    ticks.wait(2)
    with sim.engine.lock:
        assert sim.data.ctrl.tolist() == [0.699999988079071]
        assert not sim.data.xfrc_applied.any()


def test_returning_to_live_leaves_the_simulation_running(start: Start) -> None:
    sim = start()
    substeps = Beat(sim.engine.on_substep, sim.engine)
    sim.engine.set_mode(StepMode.LIVE)
    substeps.wait(2)
    assert not sim.engine.paused


def test_auto_is_reported_as_auto_and_behaves_as_live(start: Start) -> None:
    sim = start(mode=StepMode.LIVE)
    substeps = Beat(sim.engine.on_substep, sim.engine)
    assert sim.engine.set_mode(StepMode.AUTO) == (StepMode.LIVE, StepMode.AUTO)
    substeps.wait(2)
    assert sim.step(5) > 0.0
    assert sim.engine.step_count == 0


# Pacing, in simulated time.


class FakeClock:
    """Stands for the engine's `time` module and for its condition: sleeping and computing take simulated time."""

    def __init__(self, *, overshoot: float = 0.0, step_cost: float = 0.0) -> None:
        self.now = 1000.0
        self.overshoot = overshoot
        self.step_cost = step_cost

    def perf_counter(self) -> float:
        return self.now

    monotonic = perf_counter

    def wait(self, timeout: float) -> None:
        assert 0.0 < timeout < 1.0
        self.now += timeout + self.overshoot

    def notify(self) -> None: ...

    def compute(self) -> None:
        self.now += self.step_cost


class PacedSim:
    """A live engine without its thread, driven through simulated seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, clock: FakeClock) -> None:
        for module in (engine_module, scheduling):
            monkeypatch.setattr(module, "time", clock)
        self.clock = clock
        self.engine = Engine(make_scene(bot=BOT), paused=False)
        self.engine._wake = clock  # type: ignore[assignment] # a stand-in
        self.engine.on_substep.append(clock.compute)

    def run(self, seconds: float) -> float:
        """Run for so many seconds of wall time and return the simulated seconds per wall second."""
        began, time = self.clock.now, self.engine.time
        while self.clock.now - began < seconds:
            self.engine._iterate()
        return (self.engine.time - time) / (self.clock.now - began)


@given(
    costs=st.tuples(st.floats(0.0, 0.001), st.floats(0.0, 0.0015)) | st.tuples(st.just(0.0156), st.floats(0.0, 0.0003)),
    speed=st.sampled_from([5.0, 30.0, 50.0, 100.0]),
)
def test_live_keeps_the_wanted_speed_whatever_sleep_and_step_take(costs: tuple[float, float], speed: float) -> None:
    overshoot, step_cost = costs
    with pytest.MonkeyPatch.context() as patch:
        sim = PacedSim(patch, FakeClock(overshoot=overshoot, step_cost=step_cost))
        sim.engine.set_sim_speed(speed)
        sim.run(1.0)
        assert sim.run(4.0) == pytest.approx(speed / 100.0, rel=0.01)


@given(st.floats(0.03, 5.0))
def test_live_does_not_catch_up_after_a_stall(stall: float) -> None:
    with pytest.MonkeyPatch.context() as patch:
        sim = PacedSim(patch, FakeClock())
        sim.run(0.1)
        sim.clock.now += stall
        assert sim.run(0.1) == pytest.approx(1.0, abs=0.03)


def test_live_slower_than_real_time_still_gives_the_lock_away(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = FakeClock(step_cost=0.004)
    sim = PacedSim(monkeypatch, clock)
    rests: list[float] = []
    monkeypatch.setattr(clock, "wait", rests.append)
    sim.run(1.0)
    assert len(rests) > 50


def test_a_new_speed_acts_on_the_step_that_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = PacedSim(monkeypatch, FakeClock())
    sim.engine.set_sim_speed(5.0)
    sim.run(0.2)
    sim.engine.set_sim_speed(100.0)
    assert sim.run(0.5) == pytest.approx(1.0, abs=0.02)


def test_a_paused_session_takes_staged_controls_over_without_waiting_for_its_next_look(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sim = PacedSim(monkeypatch, FakeClock())
    sim.engine.set_paused(True)
    sim.run(1.0)
    request = Step(per_articulation={"bot": ArticulationCommand(ctrl=[0.5])})
    sim.engine.step(request, lambda mode: None)
    asked = sim.clock.now
    sim.engine._iterate()
    assert sim.engine.scene.data.ctrl.tolist() == [0.5]
    assert sim.clock.now == asked


@pytest.mark.parametrize("timestep", [0.0, -1.0, float("inf"), float("nan")])
def test_a_timestep_that_makes_no_sense_does_not_spoil_the_pacing(
    monkeypatch: pytest.MonkeyPatch, timestep: float
) -> None:
    sim = PacedSim(monkeypatch, FakeClock())
    sim.engine.on_tick.append(lambda: None)
    sim.engine.set_paused(True)
    sim.engine.scene.model.opt.timestep = timestep
    for _ in range(10):
        sim.engine._iterate()
    sim.engine.scene.model.opt.timestep = DT
    sim.engine.set_paused(False)
    assert sim.run(0.5) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("asked", "echoed"), [(1, 5.0), (250, 100.0), (25, 25.0), (33.3, float(np.float32(33.3)))])
def test_set_sim_speed_echoes_the_clamped_value_in_single_precision(start: Start, asked: float, echoed: float) -> None:
    assert start(mode=StepMode.LIVE).engine.set_sim_speed(asked) == echoed


# Direct.


def test_entering_direct_unpauses_and_time_moves_by_requests_only(start: Start) -> None:
    sim = start()
    assert not sim.engine.paused
    ticks = Beat(sim.engine.on_tick, sim.engine)
    ticks.wait(2)
    assert sim.engine.time == 0.0
    assert sim.step(10) == pytest.approx(10 * DT, abs=1e-9)
    assert sim.engine.step_count == 10


@pytest.mark.parametrize("n_steps", [0, -3, 1])
def test_direct_advances_at_least_one_step(start: Start, n_steps: int) -> None:
    sim = start()
    assert sim.step(n_steps) == pytest.approx(DT, abs=1e-9)
    assert sim.engine.step_count == 1


class InlineOrQueued:
    """Forces one of the two ways a direct step can take."""

    def __init__(self, way: str) -> None:
        self.way = way

    def prepare(self, sim: Sim) -> None:
        if self.way == "queued":
            sim.engine._inline_budget_s = -1.0
        else:
            sim.engine._substep_s, sim.engine._inline_budget_s = 1e-6, float("inf")


WAYS = pytest.mark.parametrize("way", [InlineOrQueued("inline"), InlineOrQueued("queued")], ids=lambda w: w.way)


@WAYS
@pytest.mark.parametrize(("asset", "n_steps"), [("humanoid.xml", 1), ("ant.xml", 1), ("humanoid.xml", 5)])
@pytest.mark.parametrize("recorded", [False, True], ids=["plain", "recorded"])
def test_direct_is_bitwise_what_mj_step_gives(
    start: Start, way: InlineOrQueued, asset: str, n_steps: int, *, recorded: bool
) -> None:
    sim = start(robot=ASSETS / asset)
    way.prepare(sim)
    if recorded:
        sim.engine.on_substep.append(lambda: None)
    local = fresh(sim.model)
    rng = np.random.default_rng(7)
    for _ in range(300 // n_steps):
        ctrl = rng.uniform(-1.0, 1.0, sim.model.nu)
        sim.command("robot", n_steps, ctrl=ctrl.tolist())
        local.ctrl[:] = ctrl.astype(np.float32)
        for _ in range(n_steps):
            mujoco.mj_step(sim.model, local)
    for field in ("qpos", "qvel", "qacc", "xpos", "sensordata", "actuator_force", "cfrc_ext", "qacc_warmstart"):
        assert getattr(sim.data, field).tobytes() == getattr(local, field).tobytes(), field
    assert sim.data.time == local.time


def test_two_robots_step_as_one_model(start: Start) -> None:
    sim = start(a=ASSETS / "ant.xml", b=ASSETS / "ant.xml", ball=BALL)
    local = fresh(sim.model)
    for at in range(100):
        left, right = np.full(8, 0.01 * at), np.full(8, -0.5)
        request = {"a": ArticulationCommand(ctrl=left.tolist()), "b": ArticulationCommand(ctrl=right.tolist())}
        sim.step(2, per_articulation=request)
        local.ctrl[:] = np.concatenate([left, right]).astype(np.float32)
        mujoco.mj_step(sim.model, local, 2)
    assert sim.data.qpos.tobytes() == local.qpos.tobytes()


def test_reset_and_the_same_controls_give_the_same_trajectory(start: Start) -> None:
    sim = start(robot=ASSETS / "humanoid.xml")
    runs: list[np.ndarray] = []
    for _ in range(2):
        sim.engine.reset()
        rng = np.random.default_rng(3)
        for _ in range(50):
            sim.command("robot", 4, ctrl=rng.uniform(-0.4, 0.4, sim.model.nu).tolist())
        runs.append(sim.qpos())
    assert runs[0].tobytes() == runs[1].tobytes()


def test_paused_direct_times_out_and_the_step_runs_once_unpaused(start: Start) -> None:
    sim = start(make=hasty(0.05))
    sim.engine.set_paused(True)
    assert refused(lambda: sim.step(7)) == "step_timeout"
    assert sim.engine.time == 0.0
    substeps = Beat(sim.engine.on_substep, sim.engine)
    sim.engine.set_paused(False)
    substeps.wait(7)
    sim.engine.forward()  # takes its turn after the request
    assert sim.engine.time == pytest.approx(7 * DT, abs=1e-9)
    assert sim.engine.step_count == 7


def test_queued_steps_run_in_order_and_a_later_one_waits_its_turn(start: Start, pool: ThreadPoolExecutor) -> None:
    sim = start()
    sim.step()
    sim.engine.set_paused(True)
    queue = Queue(sim.engine)
    futures: list[Future[list[float]]] = []
    for at in range(1, 4):
        futures.append(pool.submit(sim.command, "bot", at, ctrl=[at / 4]))
        queue.wait()
    with sim.engine.lock:
        sim.engine.set_paused(False)
        futures.append(pool.submit(sim.command, "bot", 5, ctrl=[1.0]))
    assert [future.result(DEADLINE) for future in futures] == [[0.25], [0.5], [0.75], [1.0]]
    assert sim.engine.step_count == 1 + 1 + 2 + 3 + 5


def test_a_mode_change_drops_queued_steps_and_tells_their_callers(start: Start, pool: ThreadPoolExecutor) -> None:
    """Beta statement 41. Requests are handled one at a time, so that no other client can bring it about."""
    sim = start()
    sim.engine.set_paused(True)
    queue = Queue(sim.engine)
    waiting = pool.submit(sim.step, 5)
    queue.wait()
    sim.engine.set_mode(StepMode.PUPPET)
    assert refused(lambda: waiting.result(DEADLINE)) == "step_timeout"
    sim.engine.set_mode(StepMode.DIRECT)
    assert sim.step() == pytest.approx(DT, abs=1e-9)


def test_an_error_of_the_observer_reaches_the_caller(start: Start) -> None:
    sim = start()

    def observe(mode: StepMode) -> None:
        raise LookupError(mode)

    for _ in range(2):  # queued first, then on the calling thread
        with pytest.raises(LookupError):
            sim.engine.step(Step(), observe)
    assert sim.engine.step_count == 2


def test_a_step_that_nobody_wants_to_see_wakes_nobody(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "IDLE_S", DEADLINE)
    sim = start()
    seen: list[float] = []
    with sim.engine.lock:
        sim.engine.on_tick.append(lambda: seen.append(sim.engine.time))
        sim.engine.step_wanted = lambda: bool(seen)
    for _ in range(20):
        sim.step()
    assert seen == []
    seen.append(0.0)
    last = sim.step()
    eventually(lambda: seen == [0.0, last])


def test_ticks_show_the_state_of_each_direct_request(start: Start) -> None:
    sim = start()
    sim.step()
    seen: list[float] = []
    sim.engine.on_tick.append(lambda: seen.append(sim.engine.time))
    stepped = [sim.step(2) for _ in range(20)]
    sim.engine.forward()
    with sim.engine.lock:
        assert sorted({*seen} & {*stepped}) == stepped


def test_substeps_are_shown_one_by_one(start: Start) -> None:
    sim = start()
    seen: list[float] = []
    sim.engine.on_substep.append(lambda: seen.append(round(sim.engine.time / DT)))
    sim.step(3)
    sim.step()
    assert seen == [1, 2, 3, 4]


def test_a_failing_hook_is_removed_and_physics_goes_on(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    sim = start()
    calls: list[int] = []

    def broken() -> None:
        calls.append(1)
        raise RuntimeError("no more disk")

    sim.engine.on_substep.append(broken)
    sim.step(3)
    assert calls == [1]
    assert sim.engine.on_substep == []
    assert "no more disk" in caplog.text


# Modes.


@pytest.mark.parametrize(
    ("text", "mode"), [("Streaming", StepMode.LIVE), ("DIRECT", StepMode.DIRECT), ("auto", StepMode.AUTO)]
)
def test_mode_names_come_in_any_case_and_streaming_is_live(text: str, mode: StepMode) -> None:
    assert parse_mode(text) is mode


def test_unknown_names_are_refused() -> None:
    assert refused(lambda: parse_mode("foo")) == "bad_mode"
    assert refused(lambda: parse_control_source("foo")) == "bad_value"
    assert parse_control_source("UI") is ControlSource.UI


def test_the_active_mode_again_changes_nothing(start: Start) -> None:
    sim = start()
    sim.engine.set_paused(True)
    assert sim.engine.set_mode(StepMode.DIRECT) == (StepMode.DIRECT, StepMode.DIRECT)
    assert sim.engine.paused


def test_a_pinned_mode_is_in_force_from_the_start_paused_and_locked() -> None:
    with hasty(0.02)(make_scene(bot=BOT), pinned_mode=StepMode.DIRECT) as engine:
        assert (engine.mode, engine.paused) == (StepMode.DIRECT, True)
        assert refused(lambda: engine.set_mode(StepMode.DIRECT)) == "mode_locked_by_server"
        assert refused(lambda: engine.step(Step(), lambda mode: None)) == "step_timeout"


def test_pinned_to_auto_means_free(start: Start) -> None:
    sim = start(options={"pinned_mode": StepMode.AUTO})
    assert sim.engine.mode is StepMode.DIRECT
    assert sim.engine.pinned_mode is None


# Puppet.


def test_puppet_takes_the_state_over_and_counts_one(start: Start) -> None:
    sim = start(mode=StepMode.PUPPET)
    qpos, qvel = np.array([3.0, 2, 1, 1, 0, 0, 0, 0.5]), np.arange(7.0)
    assert sim.step(10, qpos=qpos, qvel=qvel, ctrl=np.array([0.1]), time=4.2) == 4.2
    assert sim.data.qpos.tolist() == qpos.tolist()
    assert sim.data.qvel.tolist() == qvel.tolist()
    assert sim.data.ctrl.tolist() == [0.1]
    assert sim.data.body("bot_base").xpos.tolist() == [3.0, 2, 1]
    assert sim.engine.step_count == 1


def test_puppet_without_time_sets_time_to_zero_and_ignores_what_does_not_fit(start: Start) -> None:
    sim = start(mode=StepMode.PUPPET)
    before = sim.qpos()
    sim.step(time=4.2)
    assert sim.step(0, qpos=np.zeros(3), qvel=np.zeros(8), ctrl=np.zeros(2)) == 0.0
    assert sim.qpos().tolist() == before.tolist()
    assert sim.engine.step_count == 2


def test_puppet_works_while_paused_and_ignores_commands(start: Start) -> None:
    sim = start(mode=StepMode.PUPPET)
    sim.engine.set_paused(True)
    assert sim.command(ctrl=[0.9]) == [0.0]
    ticks = Beat(sim.engine.on_tick, sim.engine)
    ticks.wait(2)
    assert sim.data.ctrl.tolist() == [0.0]


def test_puppet_pushes_are_recorded(start: Start) -> None:
    sim = start(mode=StepMode.PUPPET)
    seen: list[float] = []
    sim.engine.on_substep.append(lambda: seen.append(sim.engine.time))
    sim.step(time=1.0)
    sim.step(time=2.0)
    assert seen == [1.0, 2.0]


# Reset and forward.


def test_reset_returns_to_the_start_but_staged_set_points_survive(start: Start) -> None:
    sim = start()
    assert sim.command(ctrl=[0.25]) == [0.25]
    sim.engine.articulations.set_twist("bot", [0.5, 0.25, 9], [9, 9, 1.5])
    sim.engine.reset()
    assert (sim.engine.time, sim.engine.step_count) == (0.0, 0)
    assert sim.data.qpos.tolist() == sim.model.qpos0.tolist()
    assert sim.data.ctrl.tolist() == [0.0]
    assert sim.engine.articulations.control("bot").twist.linear == (0.5, 0.25, 0.0)
    sim.step()
    assert sim.data.ctrl.tolist() == [0.25]


def test_reset_to_a_keyframe_takes_time_and_controls_from_it(start: Start) -> None:
    sim = start()
    sim.engine.reset(keyframe_name="bot_home")
    assert sim.engine.time == 1.5
    assert sim.data.joint("bot_j").qpos.tolist() == [0.5]
    assert sim.data.ctrl.tolist() == [0.3]
    sim.step()
    assert sim.data.ctrl.tolist() == [0.0]  # what is staged


def test_an_unknown_keyframe_is_refused_with_its_name_after_the_seed_is_stored(start: Start) -> None:
    sim = start()
    sim.step()
    with pytest.raises(Refusal) as caught:
        sim.engine.reset(keyframe_name="home", seed=42)
    assert (caught.value.code, caught.value.message) == ("unknown_keyframe", "home")
    assert sim.engine.seed == 42
    assert sim.engine.time == pytest.approx(DT)


def test_an_empty_keyframe_name_means_none(start: Start) -> None:
    sim = start()
    sim.step()
    sim.engine.reset(keyframe_name="")
    assert sim.engine.time == 0.0


def test_reset_overrides_the_first_coordinate_of_joints_it_finds(start: Start) -> None:
    sim = start(bot=BOT, two=BOT)
    overrides = {"BOT": {"j": 0.25, "nope": 1.0, "root": 9.0}, "two": {"two_j": 0.5}, "who": {"j": 7.0}}
    sim.engine.reset(per_articulation_qpos=overrides)
    expected = sim.model.qpos0.copy()
    expected[[0, 7, 15]] = 9.0, 0.25, 0.5
    assert sim.data.qpos.tolist() == expected.tolist()
    assert sim.data.body("bot_base").xpos[0] == 9.0


def test_forward_changes_neither_time_nor_counter(start: Start) -> None:
    sim = start()
    sim.step(3)
    with sim.engine.lock:
        sim.data.qpos[2] = 5.0
    sim.engine.forward()
    assert sim.data.body("bot_base").xpos[2] == 5.0
    assert sim.engine.step_count == 3
    assert sim.engine.time == pytest.approx(3 * DT)


def test_a_handshake_sets_the_counter_to_zero_and_leaves_the_mode(start: Start) -> None:
    sim = start()
    sim.step(3)
    sim.engine.reset_step_count()
    assert sim.engine.step_count == 0
    assert sim.engine.mode is StepMode.DIRECT


# Commands.


def test_a_named_set_point_wins_over_a_position_and_persists(start: Start) -> None:
    sim = start()
    assert sim.command(ctrl=[0.25, 8.0], ctrl_map={"m": 0.5, "nope": 1.0}) == [0.5]
    assert sim.command(ctrl_map={"bot_m": 0.75}) == [0.75]
    assert sim.command("nobody", ctrl=[0.1]) == [0.75]


def test_mujoco_clamps_what_ctrl_does_not(start: Start) -> None:
    sim = start()
    assert sim.command(ctrl=[5.0]) == [5.0]
    assert sim.data.actuator_force.tolist() == [1.0]


def test_a_controller_acts_on_every_substep_and_raw_bypasses_it_for_one_request(start: Start) -> None:
    sim = start(options={"controllers": {"*": ControllerConfig(kp=1.0, kv=0.5, torque_limit=10.0)}})
    local = fresh(sim.model)
    sim.command(n_steps=20, ctrl=[0.5])
    adr, dof = sim.model.joint("bot_j").qposadr[0], sim.model.joint("bot_j").dofadr[0]
    one = np.float32
    for _ in range(20):
        local.ctrl[0] = one(1.0) * (one(0.5) - one(local.qpos[adr])) - one(0.5) * one(local.qvel[dof])
        mujoco.mj_step(sim.model, local)
    assert sim.data.qpos.tobytes() == local.qpos.tobytes()
    assert sim.command(control_mode="RAW") == [0.5]
    assert sim.command() != [0.5]
    assert sim.command(control_mode="whatever") != [0.5]


def test_controllers_are_attached_by_key_with_a_default_for_the_rest() -> None:
    configs = {"a": ControllerConfig(kp=7.0), "*": ControllerConfig(kp=9.0)}
    engine = Engine(make_scene(a=BOT, b=BOT), controllers=configs)
    gains = [
        control.controller.params()["default_kp"]
        for control in engine.articulations.controls.values()
        if control.controller
    ]
    assert gains == [7.0, 9.0]


def test_configure_controller_answers_with_all_parameters_or_says_why_not(start: Start) -> None:
    sim = start(bot=BOT, two=BOT, options={"controllers": {"bot": ControllerConfig()}})
    assert sim.engine.articulations.configure_controller("BOT", {"kp": {"m": 2.0}})["kp"] == {"m": 2.0}
    assert sim.engine.articulations.configure_controller("bot", "nonsense")["kp"] == {"m": 2.0}
    assert refused(lambda: sim.engine.articulations.configure_controller("who", {})) == "unknown_articulation"
    assert refused(lambda: sim.engine.articulations.configure_controller("two", {})) == "no_controller"


def test_the_control_source_is_switched_for_one_or_for_all(start: Start) -> None:
    sim = start(a=BOT, b=BOT)
    sim.command("a", ctrl=[0.5])
    sim.command("b", ctrl=[0.25])
    sim.engine.articulations.set_source(ControlSource.UI, "a")
    assert sim.command("a", ctrl=[0.75]) == [0.0, 0.25]
    sim.engine.articulations.set_source(ControlSource.UI)
    assert sim.command("a") == [0.0, 0.0]
    sim.engine.articulations.set_source(ControlSource.ZMQ)
    assert sim.command("a") == [0.75, 0.25]
    assert refused(lambda: sim.engine.articulations.set_source(ControlSource.UI, "who")) == "unknown_articulation"


def test_articulations_are_found_in_any_case_the_exact_spelling_first(start: Start) -> None:
    sim = start(Bot=BOT, bot=BOT)
    assert [sim.engine.articulations.control(key).index.key for key in ("Bot", "bot", "BOT")] == ["Bot", "bot", "Bot"]
    assert sim.engine.articulations.find("who") is None
    with pytest.raises(Refusal) as caught:
        sim.engine.articulations.control("who")
    assert (caught.value.code, caught.value.message) == ("unknown_articulation", "who")


def test_a_twist_moves_nothing(start: Start) -> None:
    sim = start()
    twist = sim.engine.articulations.set_twist("bot", [5, 0, 0], [])
    assert (twist.linear, twist.angular) == ((5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    local = fresh(sim.model)
    sim.step(10)
    mujoco.mj_step(sim.model, local, 10)
    assert sim.data.qpos.tobytes() == local.qpos.tobytes()
    assert refused(lambda: sim.engine.articulations.set_twist("who", [], [])) == "unknown_articulation"


@WAYS
@pytest.mark.parametrize(("key", "name"), [("PB", "ball"), ("PB", "PB_ball"), ("anything", "PB_ball")])
def test_a_wrench_holds_for_its_request_and_no_longer(start: Start, way: InlineOrQueued, key: str, name: str) -> None:
    sim = start(PB=BALL)
    way.prepare(sim)
    sim.command(key, 50, xfrc_applied={name: [0, 0, 9.81, 0, 0, 0]})
    assert sim.data.body("PB_ball").xpos[2] == pytest.approx(1.0, abs=1e-6)
    assert not sim.data.xfrc_applied.any()
    sim.step(50)
    assert sim.data.body("PB_ball").xpos[2] < 0.999


def test_a_wrench_finds_the_body_of_its_articulation_before_one_that_is_called_so_in_full(start: Start) -> None:
    """`crane_hook` is the hook of `crane`, and a body of `big`, where it is compiled as `big_crane_hook`."""
    body = '<mujoco><worldbody><body name="{}"><freejoint/><geom size=".1" mass="1"/></body></worldbody></mujoco>'
    sim = start(big=body.format("crane_hook"), crane=body.format("hook"))
    before = {name: sim.data.body(name).xpos[0] for name in ("big_crane_hook", "crane_hook")}
    sim.command("big", 10, xfrc_applied={"crane_hook": [100, 0, 0, 0, 0, 0]})
    assert sim.data.body("big_crane_hook").xpos[0] > before["big_crane_hook"]
    assert sim.data.body("crane_hook").xpos[0] == before["crane_hook"]


@given(st.lists(st.floats(-10, 10), max_size=8).filter(lambda wrench: len(wrench) != 6))
@settings(max_examples=10)
def test_a_wrench_that_is_not_six_numbers_or_on_an_unknown_body_is_ignored(wrench: list[float]) -> None:
    with Engine(make_scene(PB=BALL)) as engine:
        engine.set_mode(StepMode.DIRECT)
        local = fresh(engine.scene.model)
        command = ArticulationCommand(xfrc_applied={"ball": wrench, "nope": [1.0, 0, 0, 0, 0, 0]})
        engine.step(Step(per_articulation={"PB": command}), lambda mode: None)
        mujoco.mj_step(engine.scene.model, local)
        assert engine.scene.data.qvel.tobytes() == local.qvel.tobytes()


# Faults and the end.


def break_integrator(sim: Sim) -> Callable[[], None]:
    """Make every step fail with `mujoco.FatalError` and return what repairs it."""

    def assign(integrator: int) -> None:
        with sim.engine.lock:
            sim.model.opt.integrator = integrator

    repair = functools.partial(assign, int(sim.model.opt.integrator))
    assign(99)
    return repair


@WAYS
def test_a_mujoco_error_is_answered_and_pauses_until_reset(start: Start, way: InlineOrQueued) -> None:
    sim = start()
    way.prepare(sim)
    repair = break_integrator(sim)
    for _ in range(2):
        with pytest.raises(Refusal) as caught:
            sim.step()
        assert caught.value.code == "not_ready"
        assert "invalid integrator" in caught.value.message
    assert sim.engine.paused
    repair()
    sim.engine.reset()
    assert sim.engine.fault is None
    sim.engine.set_paused(False)
    assert sim.step() == pytest.approx(DT)


def test_a_mujoco_error_in_reset_forward_or_a_push_is_answered_too(start: Start) -> None:
    sim = start(mode=StepMode.PUPPET, PB=BALL.replace('pos="0 0 1"', 'pos="0 0 0.09"'))
    sim.model.opt.solver = 77
    for failing in (sim.engine.reset, sim.engine.forward, sim.step):
        with pytest.raises(Refusal, match=r"physics stopped: .*solver") as caught:
            failing()
        assert (caught.value.code, sim.engine.fault) == ("not_ready", caught.value.message)
    sim.model.opt.solver = int(mujoco.mjtSolver.mjSOL_NEWTON)
    assert sim.step(time=1.0) == 1.0


def test_the_physics_thread_survives_a_mujoco_error_in_live(start: Start) -> None:
    sim = start(mode=StepMode.LIVE)
    logged = threading.Event()
    watch = logging.Handler(logging.ERROR)
    watch.emit = lambda record: logged.set()  # type: ignore[method-assign]
    logger = logging.getLogger("urlab_client.server")
    logger.addHandler(watch)
    try:
        repair = break_integrator(sim)
        sim.engine.set_paused(False)
        assert logged.wait(DEADLINE)
    finally:
        logger.removeHandler(watch)
    assert refused(sim.step) == "not_ready"
    repair()
    substeps = Beat(sim.engine.on_substep, sim.engine)
    sim.engine.set_paused(False)
    substeps.wait(2)
    assert sim.engine.fault is None


def test_warnings_of_mujoco_go_to_the_log_and_not_to_a_file(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    sim = start()
    caplog.clear()
    monkeypatch.chdir(tmp_path)
    for _ in range(5):
        sim.engine.reset()
        with sim.engine.lock:
            sim.data.qpos[0] = np.nan
        sim.step()
    assert [record.getMessage().startswith("MuJoCo: Nan") for record in caplog.records] == [True, True, True]
    assert list(tmp_path.iterdir()) == []


def test_a_warning_handler_of_the_host_program_stays() -> None:
    seen: list[str] = []
    mujoco.set_mju_user_warning(seen.append)
    try:
        with Engine(make_scene(bot=BOT)) as engine:
            engine.set_mode(StepMode.DIRECT)
            engine.scene.data.qpos[0] = np.nan
            engine.step(Step(), lambda mode: None)
        assert [text for text in seen if text.startswith("Nan")] == seen[-1:]
        assert mujoco.get_mju_user_warning() is not None
    finally:
        mujoco.set_mju_user_warning(None)


def test_warnings_of_mujoco_go_to_the_log_as_long_as_anybody_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduling, "_mujoco_warnings", scheduling._WarningLog())
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    try:
        with Engine(make_scene(bot=BOT)):
            with Engine(make_scene(bot=BOT)):
                handler = mujoco.get_mju_user_warning()
            assert mujoco.get_mju_user_warning() == handler is not None
        assert mujoco.get_mju_user_warning() is None
    finally:
        mujoco.set_mju_user_warning(before)


@WAYS
@pytest.mark.parametrize("controlled", [False, True], ids=["raw", "controlled"])
def test_closing_ends_a_very_long_request(way: InlineOrQueued, pool: ThreadPoolExecutor, *, controlled: bool) -> None:
    configs = {"*": ControllerConfig()} if controlled else {}
    engine = Engine(make_scene(robot=ASSETS / "humanoid.xml"), controllers=configs).start()
    engine.set_mode(StepMode.DIRECT)
    way.prepare(Sim(engine))
    under_way = threading.Event()
    mujoco.set_mjcb_control(lambda model, data: under_way.set())
    try:
        request = pool.submit(engine.step, Step(n_steps=2**31), lambda mode: None)
        assert under_way.wait(DEADLINE)
        assert engine.close(DEADLINE)
        assert refused(lambda: request.result(DEADLINE)) == "shutting_down"
    finally:
        mujoco.set_mjcb_control(None)


def test_nothing_hangs_behind_a_request_that_outlasts_its_timeout() -> None:
    engine = Engine(make_scene(bot=BOT), pinned_mode=StepMode.DIRECT, paused=False, step_timeout_s=0.05).start()
    under_way = threading.Event()
    mujoco.set_mjcb_control(lambda model, data: under_way.set())
    try:
        assert refused(lambda: engine.step(Step(n_steps=2**31), lambda mode: None)) == "step_timeout"
        assert under_way.wait(DEADLINE)
        for call in (engine.forward, engine.reset, engine.lock.__enter__, lambda: engine.set_paused(True)):
            assert refused(call) == "not_ready"
        assert refused(lambda: engine.step(Step(), lambda mode: None)) == "step_timeout"
        assert len(engine._queue) == 1
        assert engine.close(DEADLINE)
        assert len(engine._queue) == 0
    finally:
        mujoco.set_mjcb_control(None)


def test_closing_releases_queued_steps(pool: ThreadPoolExecutor) -> None:
    engine = Engine(make_scene(bot=BOT), pinned_mode=StepMode.DIRECT).start()
    queue = Queue(engine)
    waiting = pool.submit(engine.step, Step(), lambda mode: None)
    queue.wait()
    assert engine.close(DEADLINE)
    assert refused(lambda: waiting.result(DEADLINE)) == "shutting_down"
    assert refused(lambda: engine.step(Step(), lambda mode: None)) == "shutting_down"
    assert engine.close()


def test_an_engine_that_was_never_started_closes() -> None:
    assert Engine(make_scene(bot=BOT)).close()
