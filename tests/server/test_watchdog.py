"""Physics that does not come back from MuJoCo: what is still answered, and what becomes of play."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
import mujoco
import pytest
from waiting import eventually
from wire import Wire

from urlab_client.aio import URLabClient
from urlab_client.errors import NotReady, StepTimeout
from urlab_client.server import Faults, SimulatedServer
from urlab_client.server.core import ServerCore
from urlab_client.server.rpc import dispatch

STEP_TIMEOUT_S = 0.2
BALLS = "".join(
    f'<body pos="{i * 0.15} 0 {0.05 + 0.1 * (i % 2)}"><freejoint/><geom size=".1"/></body>' for i in range(8)
)


class Stuck:
    """A call of MuJoCo that does not come back before it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch
        self.inside = threading.Event()
        self.let_go = threading.Event()

    def at(self, server: SimulatedServer, name: str) -> None:
        """From now on the next call of that function gets stuck."""
        hurry(server)
        call: Callable[..., None] = getattr(mujoco, name)

        def once(*arguments: Any) -> None:
            self._monkeypatch.setattr(mujoco, name, call)
            self.inside.set()
            assert self.let_go.wait(60)
            call(*arguments)

        self._monkeypatch.setattr(mujoco, name, once)


def core_of(server: SimulatedServer) -> ServerCore:
    return server._running.core


def hurry(server: SimulatedServer) -> None:
    """Let play time out soon."""
    engine = core_of(server).play.running().engine
    engine._step_timeout_s = engine.lock._timeout = engine._call._timeout_s = STEP_TIMEOUT_S


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    monkeypatch.setattr(dispatch, "INTERVAL_S", 0.02)
    made = Stuck(monkeypatch)
    yield made
    made.let_go.set()


@pytest.fixture
def bot(models: Path) -> Callable[..., SimulatedServer]:
    def make(mode: str, **options: Any) -> SimulatedServer:
        return SimulatedServer(models / "bot.xml", play=True, unpaused=True, step_mode=mode, **options)

    return make


@pytest.mark.parametrize("faults", [None, Faults()], ids=["plain", "faulty"])
@pytest.mark.parametrize(
    ("mode", "call", "op", "fields"),
    [
        ("direct", "mj_step", "step", {"n_steps": 2}),
        ("puppet", "mj_forward", "step", {"time": 1.0}),
        ("direct", "mj_forward", "reset", {}),
        ("direct", "mj_forward", "forward", {}),
        (
            "puppet",
            "mj_forward",
            "set_qpos",
            {"target": "bot", "target_by": "actor_name", "qpos": [0, 0, 1, 1, 0, 0, 0]},
        ),
    ],
    ids=["step", "push", "reset", "forward", "set_qpos"],
)
def test_a_request_that_does_not_come_back_holds_up_nobody(
    bot: Callable[..., SimulatedServer],
    stuck: Stuck,
    mode: str,
    call: str,
    op: str,
    fields: dict[str, Any],
    faults: Faults | None,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with bot(mode, faults=faults) as server, Wire(server) as holder, Wire(server) as other:
        holder.hello()
        before = holder.ask("step")["step"]
        stuck.at(server, call)

        code, message = holder.refusal(op, **fields)
        assert (code, op in message) == ("step_timeout", True)
        assert holder.raw({"op": "meta"})["op"] == "meta_ok"
        assert holder.ask("pie_status")["state"] == "ready"
        code, message = holder.refusal("get_contacts")
        assert (code, "has not returned" in message) == ("not_ready", True)
        eventually(lambda: [one.name for one in caplog.records if "stop_pie ends it" in one.message])
        assert {one.name for one in caplog.records if "stop_pie ends it" in one.message} == {"urlab_client.server"}
        assert holder.refused("step") == "not_ready"
        assert other.hello()["manager_present"] is True
        assert len(other.ask("list_keyframes")["keyframes"]) >= 0
        assert other.refused("forward") == "not_ready"

        stuck.let_go.set()  # play goes on where it was, with what had been asked for
        eventually(lambda: core_of(server).play.running().engine.overdue is None)
        count = other.ask("forward")["step"]
        assert count == {"step": 2 if mode == "direct" else 1}.get(op, 0)
        assert other.ask("step")["step"] == count + 1
        assert before == 1
        assert other.raw({"op": "meta"})["op"] == "meta_ok"


@pytest.mark.parametrize("mode", ["live", "direct", "puppet"])
def test_stop_pie_ends_it_and_play_begins_anew(bot: Callable[..., SimulatedServer], stuck: Stuck, mode: str) -> None:
    with bot(mode) as server, Wire(server) as holder, Wire(server) as other:
        holder.hello()
        holder.ask("step")
        old = core_of(server).play.running().engine
        stuck.at(server, "mj_forward" if mode == "puppet" else "mj_step")
        if mode == "live":
            assert stuck.inside.wait(30)
        else:
            assert holder.refused("step") == "step_timeout"
        eventually(lambda: old.overdue is not None)

        other.hello()
        other.ask("stop_pie")
        assert other.ask("pie_status")["state"] == "off"
        assert other.ask("begin_pie")["state"] == "ready"
        if mode == "live":
            other.ask("set_paused", paused=False)
        count = [other.ask("step")["step"] for _ in range(3)]
        assert count == ([0, 0, 0] if mode == "live" else [1, 2, 3])

        stuck.let_go.set()
        eventually(lambda: not old._thread.is_alive())
        assert other.ask("forward")["step"] == count[-1]


def test_a_server_closes_all_the_same(bot: Callable[..., SimulatedServer], stuck: Stuck) -> None:
    with bot("direct") as server, Wire(server) as wire:
        wire.hello()
        wire.ask("step")
        stuck.at(server, "mj_step")
        assert wire.refused("step") == "step_timeout"
    assert not stuck.let_go.is_set()


@pytest.mark.parametrize("solver", ["mjSOL_PGS", "mjSOL_CG", "mjSOL_NEWTON"])
def test_a_solver_that_would_go_on_for_days_gives_up(tmp_path: Path, stuck: Stuck, solver: str) -> None:
    (tmp_path / "balls.xml").write_text(
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{BALLS}</worldbody></mujoco>'
    )
    with SimulatedServer(tmp_path / "balls.xml", play=True, step_mode="live") as server, Wire(server) as wire:
        wire.hello()
        hurry(server)
        engine = core_of(server).play.running().engine
        option = engine.scene.model.opt
        option.solver = getattr(mujoco.mjtSolver, solver)
        option.iterations, option.tolerance = 2**31 - 1, 0.0
        wire.ask("set_paused", paused=False)
        eventually(lambda: engine.overdue is not None)
        assert wire.refused("step") == "not_ready"
        wire.ask("stop_pie")
        eventually(lambda: not engine._thread.is_alive())


@pytest.mark.parametrize("transport", ["zmq", "shm"])
async def test_what_a_client_sees(
    bot: Callable[..., SimulatedServer], stuck: Stuck, tmp_path: Path, transport: Any
) -> None:
    options: dict[str, Any] = {"shm_dir": tmp_path} if transport == "shm" else {}
    async with (
        bot("auto", **options) as server,
        URLabClient(**server.client_options(), step_mode="direct", transport=transport) as client,
    ):
        await client.discover()
        await client.step()
        await client.step()
        stuck.at(server, "mj_step")
        with pytest.raises(StepTimeout, match="MuJoCo has not returned"):
            await client.step()
        with pytest.raises(NotReady, match="stop_pie ends it"):
            await client.runtime.get_contacts()
        stuck.let_go.set()
        await anyio.to_thread.run_sync(eventually, lambda: core_of(server).play.running().engine.overdue is None)
        found = await client.resync()
        assert found.steps_applied == 1, found
        assert client.step_count == 3
