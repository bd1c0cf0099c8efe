"""Each op that changes what the client mirrors, cancelled or timed out: after `resync()` the client knows the truth."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import numpy as np
import pytest
from resting import rest
from waiting import DEADLINE_S, gives_up

from urlab_client.aio import URLabClient
from urlab_client.protocol.base import Effect
from urlab_client.protocol.registry import OPS
from urlab_client.server import ControllerConfig, Delay, Faults, SimulatedServer

LONG = bool(os.environ.get("URLAB_LONG_TESTS"))

Call = Callable[..., Awaitable[Any]]

SAVED = "run.json"


async def record(client: URLabClient) -> None:
    await client.recording.start()
    await client.step(3)


async def save(client: URLabClient) -> None:
    await record(client)
    await client.recording.stop()
    await client.recording.save(SAVED)


async def load(client: URLabClient) -> None:
    await save(client)
    await client.replay.load(SAVED)
    await client.runtime.set_paused(True)


def home(client: URLabClient) -> np.ndarray[Any, Any]:
    return np.full_like(client.articulations["arm"].qpos_array, 0.25)


def stiff(client: URLabClient) -> dict[str, float]:
    controller = client.articulations["arm"].controller
    assert controller is not None
    return dict.fromkeys(controller.params["kp"], 7.0)


# How a user calls each op, and what comes before.
CALLS: dict[str, tuple[Callable[[URLabClient], Call], Callable[[URLabClient], Awaitable[Any]] | None]] = {
    "hello": (lambda client: client.discover, None),
    "step": (lambda client: lambda **kw: client.step(3, **kw), None),
    "reset": (lambda client: lambda **kw: client.reset(seed=7, **kw), None),
    "set_mode": (lambda client: lambda **kw: client.runtime.set_mode("puppet", **kw), None),
    "set_paused": (lambda client: lambda **kw: client.runtime.set_paused(True, **kw), None),
    "configure_controller": (
        lambda client: lambda **kw: client.articulations["arm"].controller.configure(kp=stiff(client), **kw),  # type: ignore[union-attr]
        None,
    ),
    "set_sim_options": (lambda client: lambda **kw: client.runtime.set_sim_options(gravity=(0, 0, -1), **kw), None),
    "set_qpos": (
        lambda client: lambda **kw: client.runtime.set_qpos("arm", home(client), by_name=True, **kw),
        None,
    ),
    "recording_start": (lambda client: client.recording.start, None),
    "recording_stop": (lambda client: client.recording.stop, record),
    "recording_clear": (lambda client: client.recording.clear, save),
    "replay_load": (lambda client: lambda **kw: client.replay.load(SAVED, **kw), save),
    "replay_set_active": (lambda client: lambda **kw: client.replay.set_active("Live Recording", **kw), load),
    "replay_start": (lambda client: client.replay.start, load),
    "begin_pie": (lambda client: client.sim.start, lambda client: client.sim.stop()),
    "stop_pie": (lambda client: client.sim.stop, None),
    "claim_control": (
        lambda client: client.articulations["arm"].claim,
        lambda client: client.articulations["arm"].release(),
    ),
    "release_control": (
        lambda client: client.articulations["arm"].release,
        lambda client: client.articulations["arm"].claim(),
    ),
}

# The client mirrors nothing of these. `set_camera_streaming` is in `test_camera_settings`.
UNMIRRORED = {
    *(name for name, op in OPS.items() if op.ns in {"scene", "outliner", "debug", "viewport", "farm"}),
    *("upload_model_manifest", "upload_model_chunk", "upload_model_commit"),
    *("set_sim_speed", "set_control_source", "set_twist", "set_mocap_pose", "set_user_channels", "set_camera_delay"),
    *("recording_save", "replay_stop", "set_camera_streaming"),
}

CASES = [
    (name, dialect, transport, fault)
    for i, name in enumerate(CALLS)
    for beta, dialect in enumerate(OPS[name].dialects)
    for j, transport in enumerate(("zmq", "shm"))
    for k, fault in enumerate(("cancelled", "timed out"))
    if LONG or ((i + beta) % 2 == j and (i // 2 + beta) % 2 == k)
]


def test_every_op_with_an_effect_is_here() -> None:
    changing = {name for name, op in OPS.items() if op.effect is Effect.WRITE} | {"hello"}
    assert changing == CALLS.keys() | (UNMIRRORED & changing)
    assert not CALLS.keys() & UNMIRRORED


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[SimulatedServer, Faults]]]:
    made = {}
    for dialect in ("alpha", "beta"):
        faults = Faults()
        server = SimulatedServer(
            "arm",
            play=True,
            faults=faults,
            dialect=dialect,
            shm_dir=tmp_path_factory.mktemp("shm"),
            controllers={"*": ControllerConfig()},
        )
        made[dialect] = server.start(), faults
    yield made
    for server, _ in made.values():
        server.close()


def mirrored(client: URLabClient) -> dict[str, Any]:
    """What the client takes to be so."""
    known = {"session": client.session_id, "playing": client.manager_present, "seed": client.reset_seed}
    if not client.manager_present:
        return known | {"recording": client.recording.is_active}
    arm = client.articulations["arm"]
    assert client.model is not None
    assert arm.controller is not None
    return known | {
        "mode": str(client.step_mode),
        "paused": client._state.mode._paused_between_steps,
        "step": client.step_count,
        "time": client.sim_time,
        "qpos": arm.qpos_array.tolist(),
        "gravity": client.model.opt.gravity.tolist(),
        "gains": dict(arm.controller.params),
        "owner": arm.control_owner,
        "recording": client.recording.is_active,
        "replay": client.replay.active_session,
    }


def actual(server: SimulatedServer, client: URLabClient) -> dict[str, Any]:
    """What is so."""
    core: Any = server._running.core  # type: ignore[union-attr]
    known = {"session": core.session.id, "playing": core.play.manager_present}
    if not core.play.manager_present:
        return known | {"seed": client.reset_seed, "recording": False}
    running = core.play.current
    engine, sessions = running.engine, running.sessions
    owner = running.claims.owner(next(iter(engine.articulations.controls.values())).index.key)
    return known | {
        "seed": engine.seed,
        "mode": str(engine.mode),
        "paused": engine.paused,
        "step": engine.step_count,
        "time": engine.time,
        "qpos": running.scene.data.qpos.tolist(),
        "gravity": running.scene.model.opt.gravity.tolist(),
        "gains": next(iter(engine.articulations.controls.values())).controller.params(),
        "owner": None if owner == "(unclaimed)" else owner,
        "recording": sessions.live.capture in engine.on_substep,
        "replay": client.replay.active_session and sessions.active,
    }


@pytest.mark.parametrize(("name", "dialect", "transport", "fault"), CASES)
async def test_after_resync_the_client_mirrors_what_is_so(
    servers: dict[str, tuple[SimulatedServer, Faults]], name: str, dialect: str, transport: str, fault: str
) -> None:
    server, faults = servers[dialect]
    options = server.client_options() | {"step_mode": "direct", "transport": transport, "live_pictures": False}
    call, prepare = CALLS[name]
    async with URLabClient(**options) as client:
        await client.discover()
        await client.sim.stop()
        await client.sim.start()
        await client.step(2)
        if prepare is not None:
            await prepare(client)
        late = faults.add(Delay(name, times=1, seconds=DEADLINE_S))
        await gives_up(call(client), lambda: late.applied, fault)
        resync = asyncio.create_task(client.resync())
        late.remove()
        found = await resync
        assert mirrored(client) == actual(server, client)
        assert found.playing == client.manager_present == (name != "stop_pie")
        if name == "recording_clear":
            assert client.recording.frame_count == 0
        if client.manager_present:
            await client.runtime.set_paused(False)
            await client.runtime.set_mode("direct")
            await client.replay.stop()
            assert (await client.step(2)).step == client.step_count == found.step + 2
    rest(server)
