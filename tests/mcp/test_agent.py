"""An agent that knows only what the tools say: its loop, its limits, and people who take over."""

from __future__ import annotations

import asyncio
import contextlib
import io
import math
import time
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path

import anyio
import pytest
from agents import ALL, Desk, desk, text_of
from jsonschema import Draft202012Validator
from mcp import Client
from mcp.shared.exceptions import MCPError
from mcp.types import Implementation
from PIL import Image
from waiting import until

from urlab_client.aio import URLabClient
from urlab_client.console.lease import Viewer
from urlab_client.integrations.record import read_run
from urlab_client.mcp import Agent, Limits
from urlab_client.server import SimulatedServer
from urlab_client.server.assets.bundled_robots import bundled_models

PERSON = Viewer("a person's key", "Ann")


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True, camera_size=(64, 48)) as running:
        yield running


@pytest.fixture
async def direct(server: SimulatedServer) -> AsyncGenerator[Desk]:
    # In a task of its own: pytest ends fixtures in another than it began them in, which cancel scopes do not bear.
    ready, over = asyncio.get_running_loop().create_future(), asyncio.Event()

    async def host() -> None:
        async with desk(server) as one:
            await one.call("reset")
            ready.set_result(one)
            await over.wait()

    task = asyncio.create_task(host())
    await asyncio.wait((task, ready), return_when=asyncio.FIRST_COMPLETED)
    yield task.result() if task.done() else ready.result()
    over.set()
    await task


@pytest.mark.opengl
async def test_an_agent_finds_out_why_nothing_moves_mends_it_and_records(tmp_path: Path) -> None:
    with SimulatedServer("arm", play=True, camera_size=(64, 48)) as server:
        async with desk(server, step_mode="live", recordings=tmp_path) as one:
            robot = (await one.call("look"))["scene"]["articulations"][0]
            elbow = next(joint for joint in robot["joints"] if joint["name"] == "elbow")
            assert (elbow["unit"], elbow["kind"]) == ("rad", "hinge")
            target = round(elbow["limits"][0] / 2, 2)
            order = {"robot": robot["name"], "joints": {"elbow": target}}
            said = await one.refused("move_to", **order)
            assert "stood still" in said
            assert "play with action='resume'" in said, "it names a tool, not a method"
            found = await one.call("explain")
            assert sum(one["verdict"] == "problem" for one in found["findings"]) == 1
            assert any("paused. Call play with action='resume'" in finding["text"] for finding in found["findings"])
            await one.call("play", action="resume")
            assert "settled" in (await one.call("move_to", **order))["done"]

            camera = f"{robot['name']}/{robot['cameras'][0]['name']}"
            picture = await one.mcp.call_tool("picture", {"camera": camera, "size": 32})
            assert (picture.structured_content or {})["camera"] == camera

            await one.call("record", action="start")
            await one.call("move_to", robot=robot["name"], joints={"elbow": 0.0})
            episode = await one.call("record", action="stop")
    assert (episode["robots"], episode["lost"]) == (["arm"], 0)
    assert len(read_run(tmp_path / episode["name"]).table()) > 10


async def test_tools_say_what_they_take_give_and_do(direct: Desk) -> None:
    tools = {tool.name: tool for tool in (await direct.mcp.list_tools()).tools}
    for tool in tools.values():
        assert tool.description
        assert tool.output_schema is not None
        for schema in (tool.input_schema, tool.output_schema):
            assert schema["type"] == "object"
            Draft202012Validator.check_schema(schema)
        assert {"sim_time", "step", "mode"} < set(tool.output_schema["properties"])
        assert all(field.get("description") for field in tool.output_schema["properties"].values()), tool.name
    hints = {name: tool.annotations for name, tool in tools.items()}
    assert all(hint is not None and hint.open_world_hint is False for hint in hints.values())
    assert {name for name, hint in hints.items() if hint and hint.read_only_hint} == {
        "look", "state", "picture", "contacts", "explain", "log",
    }  # fmt: skip
    assert {name for name, hint in hints.items() if hint and hint.destructive_hint} == {"reset", "play", "remove"}
    assert {name for name, hint in hints.items() if hint and not hint.idempotent_hint} == {
        "log", "run", "record", "import_model", "spawn",
    }  # fmt: skip


async def test_without_leave_an_agent_only_looks(server: SimulatedServer) -> None:
    async with desk(server, Limits()) as one:
        names = {tool.name for tool in (await one.mcp.list_tools()).tools}
        assert names == {"look", "state", "picture", "contacts", "explain", "log"}
        before = await one.call("state", robot="arm")
        assert "--allow-drive" in await one.refused("run", seconds=1.0)
        assert "--allow-edit" in await one.refused("remove", actor="arm")
        assert await one.call("state", robot="arm") == before
        assert "--allow-drive, --allow-edit" in (one.mcp.instructions or "")


@pytest.mark.opengl
async def test_an_agent_that_looks_on_takes_nothing_from_whoever_drives() -> None:
    with SimulatedServer("arm", play=True, unpaused=True, camera_size=(64, 48)) as server:
        async with (
            URLabClient(**server.client_options(), step_mode="live") as driver,
            contextlib.AsyncExitStack() as stack,
        ):
            await driver.discover()
            one = await stack.enter_async_context(desk(server, Limits(), handshake=driver.handshake))
            names = {tool.name for tool in (await one.mcp.list_tools()).tools}
            assert names == {"look", "state", "picture", "explain", "log"}
            assert "--take-over" in await one.refused("contacts")
            assert (await one.call("look"))["scene"]["articulations"][0]["joints"][2]["name"] == "elbow"
            driver.articulations["arm"].set_ctrl({"elbow": 1.0})
            await driver.step()

            async def elbow() -> float:
                return float((await one.call("state", robot="arm"))["joints"]["elbow"])

            await until(lambda: one.client.articulations["arm"].joints["elbow"].position > 0.5)
            assert await elbow() > 0.5
            assert not (await one.mcp.call_tool("picture", {"camera": "arm/overview"})).is_error
            assert "read-only" in str(await one.call("explain"))
            # What it knows follows the driver's next play.
            await driver.sim.stop()
            await driver.sim.start()
            await driver.runtime.set_paused(False)
            await until(
                lambda: one.client.sim_time < 1 and abs(one.client.articulations["arm"].joints["elbow"].position) < 0.1
            )
            assert (await one.call("look"))["scene"]["playing"]
            assert one.client.session_id == ""
            await driver.step()
            with pytest.raises(ValueError, match="read-only"):
                Agent(one.console, Limits(drive=True))


async def test_what_an_agent_gets_wrong_is_said_and_nothing_is_done(direct: Desk) -> None:
    for tool, arguments, words in (
        ("nothing", {}, ["No tool is called 'nothing'", "move_to"]),
        ("state", {"robot": "arn"}, ["'arm'"]),
        ("state", {}, ["robot"]),
        ("run", {}, ["seconds", "steps"]),
        ("run", {"seconds": 11}, ["up to 10 s", "Call again"]),
        ("run", {"seconds": -1}, ["seconds"]),
        ("run", {"steps": 10**6}, ["up to 10 s"]),
        ("run", {"second": 1}, ["second", "It takes: seconds, steps"]),
        ("move_to", {"robot": "arm", "joints": {"elbow": 9}}, ["2.61799 rad"]),
        ("move_to", {"robot": "arm", "joints": {"elbo": 0}}, ["'elbow'"]),
        ("move_to", {"robot": "arm", "joints": {"elbow": "high"}}, ["float"]),
        ("move_to", {"robot": "arm", "joints": {"elbow": "nan"}}, ["finite"]),
        ("move_to", {"robot": "arm", "joints": {}}, ["joints"]),
        ("set_actuators", {"robot": "arm", "set_points": {"elbow": 99}}, ["got 99"]),
        ("reset", {"keyframe": "nowhere"}, ["nowhere"]),
        ("reset", {"joints": {"arm": {"elbow": 9}}}, ["got 9"]),
        ("play", {"action": "pause"}, ["direct", "run"]),
        ("record", {"action": "stop"}, ["no recording runs"]),
        ("import_model", {"model": "/etc/passwd"}, ["No model is called"]),
        ("spawn", {"blueprint": "../arm", "actor_id": "b", "position": [0, 0, 0]}, ["No blueprint is called"]),
        ("spawn", {"blueprint": "arm", "actor_id": "b", "position": [0, 0]}, ["position"]),
        ("remove", {"actor": "nobody"}, ["There are: arm"]),
        ("picture", {"camera": "arm/nothing"}, ["nothing"]),
    ):
        said = await direct.refused(tool, **arguments)
        assert all(word in said for word in words), said
    after = await direct.call("state", robot="arm")
    assert (after["step"], set(after["set_points"].values())) == (0, {0.0})


async def test_arguments_in_the_form_of_text_are_understood(direct: Desk) -> None:
    await direct.call("set_actuators", robot="arm", set_points='{"elbow": 0.25}')
    assert (await direct.call("state", robot="arm"))["set_points"]["elbow"] == 0.25
    assert (await direct.call("run", steps="20"))["step"] == 20
    assert (await direct.call("run", seconds="1e-5"))["step"] == 21, "no call that lets time pass does nothing"


async def test_a_diverged_simulation_is_said(direct: Desk) -> None:
    direct.client.articulations["arm"].ctrl_array[0] = math.nan
    assert "diverged" in await direct.refused("state", robot="arm")
    direct.client.articulations["arm"].ctrl_array = [0.0] * 7


async def test_progress_is_told_and_a_cancelled_run_leaves_the_robot_at_rest(direct: Desk) -> None:
    told: list[tuple[float, float | None]] = []
    with anyio.CancelScope() as scope:

        async def progress(done: float, total: float | None, message: str | None) -> None:
            told.append((done, total))
            scope.cancel()

        # So slow that there is something to cancel, whatever the machine.
        await direct.client.runtime.set_sim_options(timestep=1e-5)
        await direct.mcp.call_tool("run", {"seconds": 10}, progress_callback=progress)
    assert 0 <= told[0][0] < 10 == told[0][1]
    await until(lambda: not direct.console.lease.held)
    await direct.client.runtime.set_sim_options(timestep=0.002)
    at = (await direct.call("state", robot="arm"))["step"]
    assert (await direct.call("run", steps=5))["step"] == at + 5


async def test_a_cancelled_call_pauses_what_runs_by_itself() -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        async with desk(server, step_mode="live") as one:
            with anyio.CancelScope() as scope:

                async def progress(done: float, total: float | None, message: str | None) -> None:
                    scope.cancel()

                await one.mcp.call_tool("run", {"seconds": 10}, progress_callback=progress)
            await until(lambda: not one.console.lease.held)
            assert any("paused" in finding["text"] for finding in (await one.call("explain"))["findings"])


async def test_a_call_that_takes_too_long_is_broken_off() -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        async with desk(server, Limits(drive=True, wall_seconds=0.3), step_mode="live") as one:
            said = await one.refused("run", seconds=10)
            assert "longer than 0.3 s" in said
            assert any("paused" in finding["text"] for finding in (await one.call("explain"))["findings"])


async def test_another_program_takes_the_server_over_and_a_person_has_to_take_it_back() -> None:
    with SimulatedServer("arm", play=True) as server:
        async with desk(server) as one, URLabClient(**server.client_options()) as other:
            await one.call("run", steps=1)
            await other.discover()
            assert "Ask a person to take it back" in await one.refused("run", steps=1)
            await until(lambda: one.console.link.state == "taken_over")
            assert "Ask a person to take it back" in await one.refused("state", robot="arm")


async def test_a_person_takes_over_and_the_agent_waits(direct: Desk) -> None:
    lease = direct.console.lease
    await direct.client.runtime.set_sim_options(timestep=1e-5)
    running = asyncio.create_task(direct.refused("run", seconds=10))
    await until(lambda: direct.console.lease.held)
    await direct.console.controls.run(PERSON, running=False)
    assert "Ann took the controls" in await running
    assert lease.holder is PERSON
    assert "Ann has the controls" in await direct.refused("reset")
    assert (await direct.call("look"))["driver"] == "Ann"
    lease.release(PERSON)
    await direct.client.runtime.set_sim_options(timestep=0.002)
    await direct.call("reset")
    entries = (await direct.call("log", since=0))["entries"]
    assert {("Ann", "stop"), ("agent 1 (mcp)", "reset")} <= {(entry["who"], entry["what"]) for entry in entries}


async def test_one_agent_drives_at_a_time_and_a_person_takes_over_from_each(direct: Desk) -> None:
    lease = direct.console.lease
    other = Agent(direct.console, ALL)
    async with Client(other.server, read_timeout_seconds=60) as mcp:
        second = Desk(direct.client, direct.console, other, mcp)
        await direct.call("set_actuators", robot="arm", set_points={"elbow": 0.5})
        for tool, arguments in (
            ("set_actuators", {"robot": "arm", "set_points": {"elbow": -0.5}}),
            ("run", {"steps": 1}),
            ("remove", {"actor": "arm"}),
        ):
            said = await second.refused(tool, **arguments)
            assert "agent 1 (mcp) has the controls" in said
            assert "Nothing was done. Call again later" in said
        assert (await second.call("look"))["driver"] == "agent 1 (mcp)"
        assert (await direct.call("look"))["driver"] == "you"
        after = await second.call("state", robot="arm")
        assert (after["set_points"]["elbow"], after["step"]) == (0.5, 0)
        # Each keeps its own place in the log.
        await direct.call("log")
        assert "run" in {entry["what"] for entry in (await second.call("log"))["entries"]}

        await direct.client.runtime.set_sim_options(timestep=1e-5)
        running = asyncio.create_task(direct.refused("run", seconds=10))
        await until(lambda: lease.held)
        assert "agent 1 (mcp) has the controls" in await second.refused("reset")
        lease.use(PERSON)
        assert "Ann took the controls" in await running
        lease.release(PERSON)
        await direct.client.runtime.set_sim_options(timestep=0.002)
        await second.call("run", steps=1)
        assert "agent 2 (mcp) has the controls" in await direct.refused("run", steps=1)
        lease.use(PERSON)
        assert "Ann has the controls" in await second.refused("run", steps=1)
        lease.release(PERSON)
        await direct.call("set_actuators", robot="arm", set_points={"elbow": 0.0})


async def test_agents_that_come_and_go_are_forgotten_but_not_the_one_that_drives(
    direct: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("urlab_client.mcp.agent._MOST_CALLERS", 3)
    await direct.call("run", steps=1)
    for n in range(6):
        async with Client(direct.agent.server, client_info=Implementation(name=f"visitor {n}", version="1")) as visitor:
            assert not (await visitor.call_tool("look", {})).is_error
    assert len(direct.agent._callers) == 3
    assert (await direct.call("look"))["driver"] == "you"


async def test_the_log_goes_on_from_the_last_call(direct: Desk) -> None:
    first = await direct.call("log")
    await direct.call("run", steps=1)
    news = await direct.call("log")
    assert all(entry["n"] > first["next"] for entry in news["entries"])
    assert [entry["what"] for entry in news["entries"] if entry["who"].startswith("agent 1")] == ["run"]
    assert abs(news["entries"][-1]["at"] - time.time()) < 3600, "times keep their seconds"
    last = await direct.call("log")
    assert not [entry for entry in last["entries"] if entry["who"].startswith("agent 1")]
    assert news["next"] > first["next"]


async def test_a_model_that_replaces_another_on_its_server_says_so(tmp_path: Path) -> None:
    """Statement 9.2 of beta.md: every upload makes the class `model`."""
    files = {name: tmp_path / f"{name}.xml" for name in ("box", "crate")}
    for file in files.values():
        file.write_text("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
    (tmp_path / "elsewhere").mkdir()
    with SimulatedServer("arm", dialect="beta", model_roots=[tmp_path / "elsewhere"]) as server:
        async with desk(server, models=files) as one:
            assert "replaced" not in (await one.call("import_model", model="box"))["done"]
            assert "has replaced the model" in (await one.call("import_model", model="crate"))["done"]


async def test_a_scene_is_edited_by_names(tmp_path: Path) -> None:
    files = {**bundled_models(), "box": tmp_path / "box.xml"}
    with SimulatedServer("arm", play=True, model_roots=[tmp_path], saved_dir=tmp_path) as server:
        async with desk(server, models=files) as one:
            (tmp_path / "box.xml").write_text(
                '<mujoco><worldbody><body name="box"><freejoint/><geom size=".1" type="box" size=".1 .1 .1"/></body>'
                "</worldbody></mujoco>".replace(' size=".1" type', " type")
            )
            assert "box" in (await one.call("look"))["models"]
            await one.call("run", steps=2)
            await one.call("import_model", model="box")
            placed = await one.call("spawn", blueprint="box", actor_id="b1", position=[1, 0, 2], yaw=90)
            assert placed["robots"] == ["arm", "box"]
            assert "it is the robot 'box'" in placed["done"]
            assert (placed["sim_time"], placed["step"]) == (0, 0), "the simulation has begun anew"
            again = await one.refused("spawn", blueprint="box", actor_id="b1", position=[0, 0, 2])
            assert "move moves it" in again
            await one.call("move", actor="b1", position=[1, 1, 3])
            pose = (await one.call("state", robot="box"))["pose"]
            assert pose["position"] == [1, 1, 3]
            assert (await one.call("remove", actor="box"))["robots"] == ["arm"]
            await one.call("play", action="stop")
            for tool, arguments in (("state", {"robot": "arm"}), ("run", {"steps": 1}), ("contacts", {})):
                assert "play with action='start'" in await one.refused(tool, **arguments)
            await one.call("play", action="start")
            await one.call("state", robot="arm")
            assert one.console.cameras.feed("arm/wrist") is not None
            await one.call("remove", actor="arm")
            await until(lambda: not one.console.cameras._feeds)  # nor is the robot kept by its pictures


@pytest.mark.opengl
async def test_a_person_sees_what_an_agent_records(server: SimulatedServer, tmp_path: Path) -> None:
    async with desk(server, recordings=tmp_path) as one:
        await one.call("run", steps=1)
        first = await one.call("record", action="start", cameras=True)
        assert one.console.recordings.running is not None
        assert "runs already" in await one.refused("record", action="start")
        await one.call("run", seconds=0.1)
        assert (await one.call("record", action="stop"))["cameras"] == ["arm/overview", "arm/wrist"]
        second = await one.call("record", action="start")
        await one.call("run", seconds=0.1)
    # What is not stopped is finished when the console closes.
    assert [len(read_run(tmp_path / made["name"]).table()) for made in (first, second)] == [5, 5]


async def test_arguments_of_wrong_types_are_refused_by_their_tool(direct: Desk) -> None:
    deep: list[object] = []
    for _ in range(150):
        deep = [deep]
    for tool in (await direct.mcp.list_tools()).tools:
        for name in tool.input_schema["properties"]:
            for odd in ("[" * 100_000, '{"a": ' * 100_000, deep, {"a": deep}, [1], [None], 10**400, {"": {}}):
                assert f"{tool.name}: " in await direct.refused(tool.name, **{name: odd, "nothing": odd})


async def test_resources(direct: Desk) -> None:
    listed = (await direct.mcp.list_resources()).resources
    assert {resource.name for resource in listed} == {"model", "log"}
    model = (await direct.mcp.read_resource("urlab://model")).contents[0]
    assert '"shoulder_lift"' in str(getattr(model, "text", ""))
    with pytest.raises(MCPError, match="urlab://model"):
        await direct.mcp.read_resource("urlab://nothing")


@pytest.mark.opengl
async def test_pictures_are_not_larger_than_they_may_be(direct: Desk) -> None:
    result = await direct.mcp.call_tool("picture", {"camera": "arm/overview", "size": 32})
    assert not result.is_error, text_of(result)
    data = getattr(result.content[1], "data", "")
    import base64

    assert Image.open(io.BytesIO(base64.b64decode(data))).size == (32, 24)
    assert (result.structured_content or {})["step"] == 0
    assert "1024" in await direct.refused("picture", camera="arm/overview", size=4096)


async def test_the_limits_bind_agents_alone(server: SimulatedServer) -> None:
    async with desk(server, ALL) as one:
        holder = one.console.lease
        holder.use(PERSON)
        assert "Ann has the controls" in await one.refused("run", steps=1)
        assert await one.call("explain")
