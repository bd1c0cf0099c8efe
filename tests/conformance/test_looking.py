"""Looking changes nothing: whatever is read, recorded or discovered claims, sends and alters nothing."""

from __future__ import annotations

import importlib.util
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client.aio import URLabClient
from urlab_client.integrations.record import record
from urlab_client.integrations.view import rerun_view
from urlab_client.server import ControllerConfig, SimulatedServer

PILE = """
<mujoco model="pile"><worldbody><geom type="plane" size="5 5 .1"/>
  <camera name="overview" pos="0 -3 2"/>
  {boxes}
  <body name="arm" pos="1 0 .3"><joint name="swing" axis="0 1 0"/>
    <geom type="capsule" size=".05" fromto="0 0 0 .6 0 0"/></body>
</worldbody><actuator><motor name="swing" joint="swing"/></actuator>
<sensor><jointpos name="at" joint="swing"/></sensor></mujoco>
""".format(
    boxes="".join(
        f'<body name="box{i}" pos="{0.02 * i} {0.01 * i} {0.1 + 0.12 * i}"><freejoint/>'
        '<geom type="box" size=".1 .1 .05"/></body>'
        for i in range(5)
    )
)

READING = {"describe", "handshake", "shared_frame", "get_ctrl", "get_qpos", "get_sensors"}
"""Methods, besides properties, that only read."""


@pytest.fixture
def pile(models: Path) -> str:
    path = models / "pile.xml"
    path.write_text(PILE)
    return str(path)


def read(thing: Any, seen: dict[int, Any]) -> None:
    """Read everything public of a handle, and of those that it hands out."""
    if id(thing) in seen:
        return
    seen[id(thing)] = thing
    if isinstance(thing, Mapping):
        for one in thing.values():
            read(one, seen)
        return
    repr(thing)
    getattr(thing, "_repr_html_", str)()  # as in a notebook
    ours = type(thing).__module__.startswith(("urlab_client.aio", "urlab_client.sync"))
    for name in dir(thing) if ours and not isinstance(thing, np.ndarray) else ():
        value = None if name.startswith("_") else getattr(thing, name)
        if not callable(value):
            read(value, seen)
        elif name in READING:
            value()


async def test_private_attributes_are_not_offered_for_completion(connect: Any, serve: Any, pile: str) -> None:
    with serve(pile, play=True) as server:
        client = connect(server)
        await client.discover()
        robot = next(iter(client.articulations.values()))
        handles = [
            handle(client),
            client.sim,
            robot,
            *robot.joints.values(),
            *robot.cameras.values(),
            client.state_stream(),
        ]
        for thing in handles:
            offered = dir(thing)
            assert [name for name in offered if name.startswith("_") and not name.startswith("__")] == []
            assert {name for name in vars(type(thing)) if not name.startswith("_")} <= set(offered)


def handle(client: Any) -> Any:
    """Return the client itself, of either flavour."""
    return getattr(client, "twin", client)


def of_server(server: SimulatedServer) -> tuple[Any, ...]:
    """Return all that a request may change: the whole state, what was computed from it, and the owners of robots."""
    running = server._running.core.play.running()  # type: ignore[union-attr]
    engine = running.engine
    with engine.lock:
        model, data = engine._model, engine._data
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        computed = (data.xpos, data.qacc, data.qacc_warmstart, data.sensordata, data.cvel)
        keys = [control.index.key for control in engine.articulations.controls.values()]
        owners = tuple(running.claims.owner(key) for key in keys)
        return state.tobytes(), *(array.tobytes() for array in computed), engine.step_count, owners


def of_client(client: Any) -> tuple[Any, ...]:
    """Return what the client would send, and what it shows."""
    seen = handle(client)
    sent = seen.transport_stats.sent
    local = () if seen.data is None else (seen.data.qpos.tolist(), seen.data.qvel.tolist(), seen.data.ctrl.tolist())
    return sent, seen.describe().to_json(), seen.step_count, seen.sim_time, str(seen.step_mode), *local


@asynccontextmanager
async def watched(client: Any, folder: Path) -> AsyncIterator[None]:
    """Record a client of either flavour, and show it where the extra `rerun` is installed."""
    seen = handle(client)
    watchers: list[Any] = [record(seen, folder / "run.mcap", cameras=())]
    if importlib.util.find_spec("rerun") is not None:
        watchers.append(rerun_view(seen, save=folder / "run.rrd"))
    async with AsyncExitStack() as stack:
        for watcher in watchers:
            if isinstance(seen, URLabClient):
                await stack.enter_async_context(watcher)
            else:
                stack.enter_context(watcher)
        yield


@asynccontextmanager
async def owner_of(server: SimulatedServer, robot: str) -> AsyncIterator[None]:
    """Let another program own a robot, on a server whose robots have owners."""
    async with URLabClient(**server.client_options(), step_mode="direct") as other:
        other._session.control.owner = "another program"
        await other.discover()
        await other.articulations[robot].claim(ttl=0)
        yield


async def test_reading_everything_changes_nothing(connect: Any, serve: Any, pile: str, tmp_path: Path) -> None:
    with serve(pile, "arm", play=True, controllers={"pile": ControllerConfig()}) as server:
        client = connect(server, step_mode="direct")
        await client.discover(observations="full")
        await client.step(30)
        async with watched(client, tmp_path):
            handle(client).data  # noqa: B018  # computes what follows from the state, here
            before = of_client(client), of_server(server)
            seen: dict[int, Any] = {}
            read(handle(client), seen)
            assert (of_client(client), of_server(server)) == before
            names = {type(one).__name__ for one in seen.values()}
            assert names >= {
                "URLabArticulation", "Actuator", "Joint", "Sensor", "Body", "URLabCameraView", "URLabPDController",
                "SceneNamespace", "RecordingNamespace", "ReplayNamespace", "RuntimeNamespace",
            }  # fmt: skip
            await client.step()
            *_, owners = of_server(server)
            assert set(owners) == {"(unclaimed)"}
        read(handle(client).state_stream(), {})
        assert [art.control_owner for art in handle(client).articulations.values()] == [None, None]


async def test_reading_drives_no_robot_in_live_mode(connect: Any, serve: Any, pile: str, tmp_path: Path) -> None:
    with serve(pile, "arm", play=True, unpaused=True) as server:
        client = connect(server, step_mode="live", live_pictures=False)
        await client.discover()
        async with watched(client, tmp_path):
            sent = client.transport_stats.sent
            read(handle(client), {})
            await client.run_for(0.01)
            assert client.transport_stats.sent == sent, "set-points were sent"


async def test_a_robot_of_another_program_may_be_looked_at(
    connect: Any, serve: Any, pile: str, tmp_path: Path, dialect: str
) -> None:
    with serve(pile, "arm", play=True) as server:
        async with owner_of(server, "arm"):
            client = connect(server, step_mode="direct")
            await client.discover()
            async with watched(client, tmp_path):
                read(handle(client), {})
                client.articulations["pile"].ctrl_array[:] = 0.25
                await client.step()
                await client.step()
                assert client.articulations["pile"].last_applied_ctrl.tolist() == [0.25]
                *_, owners = of_server(server)
                assert ("another program" in owners) is (dialect == "beta")


async def test_discovering_changes_nothing_in_the_world_of_another(connect: Any, serve: Any, pile: str) -> None:
    """The last states are those of a run that nobody looked at, bit for bit."""

    ops: list[str] = []

    async def run(server: SimulatedServer, looking: str | None) -> tuple[bytes, bytes]:
        driver = connect(server, step_mode="direct")
        await driver.discover()
        for i in range(120):
            driver.articulations["pile"].set_ctrl({"swing": float(np.sin(i / 9))})
            await driver.step()
            if i == 60 and looking is not None:
                before = of_server(server)
                looker = connect(
                    server, step_mode=looking, live_pictures=False, observe=lambda call: ops.append(call.op)
                )
                await looker.discover()
                await looker.sim.start()
                assert of_server(server)[:-2] == before[:-2]
            if i == 60:
                await driver.discover()
        return driver.data.qpos.tobytes(), driver.data.qvel.tobytes()

    with serve(pile, play=True) as server:
        alone = await run(server, None)
        for looking in ("direct", "auto"):
            server.restore()
            assert await run(server, looking) == alone
    # On a busy machine the client asks for the keyframes, to see whether the server still answers.
    assert set(ops) - {"list_keyframes"} == {"hello", "meta", "set_mode", "begin_pie"}


async def test_a_request_of_the_caller_stays_as_it_is(connect: Any, serve: Any) -> None:
    from urlab_client.protocol.messages.runtime import ClaimControl, GetContacts
    from urlab_client.protocol.messages.session import Step

    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        requests = [GetContacts(), Step(per_articulation={}, n_steps=2)]
        if client.server.features.claims:
            requests.append(ClaimControl(articulation="arm"))
        for request in requests:
            before = repr(request)
            await client.call(request)
            assert repr(request) == before
            await client.discover()
            await client.call(request)
            assert repr(request) == before
