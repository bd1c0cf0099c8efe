"""An agent that knows only what the tools say: its loop, its limits, and people who take over."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import io
import json
import math
import re
import time
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from agents import ALL, Desk, desk, text_of
from jsonschema import Draft202012Validator
from mcp import Client
from mcp.shared.exceptions import MCPError
from mcp.types import ElicitResult, Implementation
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
            robot = (await one.call("look"))["robots"][0]
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

            camera = (await one.call("look"))["cameras"][0]
            assert camera == "arm/overview"
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
        assert tool.input_schema["type"] == "object"
        for schema in filter(None, (tool.input_schema, tool.output_schema)):
            Draft202012Validator.check_schema(schema)
            named = set(re.findall(r'"\$ref": "#/\$defs/(\w+)"', json.dumps(schema)))
            assert named == set(schema.get("$defs", ())), "nothing is missing, and nothing in vain"
    listed = json.dumps([tool.model_dump(mode="json", by_alias=True, exclude_none=True) for tool in tools.values()])
    assert len(listed.encode()) <= 15_000, "an agent pays for this list with each of its conversations"
    hints = {name: tool.annotations for name, tool in tools.items()}
    assert all(hint is not None and hint.open_world_hint is False for hint in hints.values())
    assert {name for name, hint in hints.items() if hint and hint.read_only_hint} == {
        "look", "state", "picture", "contacts", "explain", "log", "hand_pose",
    }  # fmt: skip
    assert {name for name, hint in hints.items() if hint and hint.destructive_hint} == {
        "reset", "play", "apply_scene", "move", "remove",
    }  # fmt: skip
    assert {name for name, hint in hints.items() if hint and not hint.idempotent_hint} == {"log", "run", "record"}


async def test_without_leave_an_agent_only_looks(server: SimulatedServer) -> None:
    async with desk(server, Limits()) as one:
        names = {tool.name for tool in (await one.mcp.list_tools()).tools}
        assert names == {"look", "state", "picture", "contacts", "explain", "log", "hand_pose"}
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
            assert names == {"look", "state", "picture", "explain", "log", "hand_pose"}
            assert "--take-over" in await one.refused("contacts")
            assert (await one.call("look"))["robots"][0]["joints"][2]["name"] == "elbow"
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
            assert (await one.call("look"))["playing"]
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
        (
            "apply_scene",
            {"objects": [{"id": "b", "model": "/etc/passwd", "position": [0, 0, 0]}]},
            ["No model is called"],
        ),
        ("apply_scene", {"objects": [{"id": "b", "position": [0, 0, 0]}]}, ["No model is called ''"]),
        ("apply_scene", {"objects": [{"id": "b", "model": "arm", "position": [0, 0]}]}, ["position"]),
        ("apply_scene", {"objects": [], "remove": ["nobody"]}, ["There are: arm"]),
        ("move", {"actor": "arm"}, ["a position, a quaternion"]),
        ("move", {"actor": "arm", "quaternion": [0, 0, 0, 0]}, ["four zeros"]),
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
            objects = [{"id": name, "model": name, "position": [1, 0, 1]} for name in files]
            assert "replaced" not in (await one.call("apply_scene", objects=objects[:1]))["done"]
            assert "crate has replaced the model" in (await one.call("apply_scene", objects=objects[1:]))["done"]


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
            box = {"id": "b1", "model": "box", "position": [1, 0, 2], "quaternion": [1, 0, 0, 1]}
            placed = await one.call("apply_scene", objects=[box, {"id": "b2", "model": "box", "position": [2, 0, 2]}])
            assert (placed["robots"], placed["objects"]) == (["arm"], ["b1", "b2"])
            assert (placed["sim_time"], placed["step"]) == (0, 0), "the simulation has begun anew"
            objects = {one["name"]: one["pose"] for one in (await one.call("look"))["objects"]}
            assert objects["b1"] == {"position": [1, 0, 2], "quaternion": [0.707107, 0, 0, 0.707107]}
            await one.call("move", actor="b1", position=[1, 1, 3])
            await one.call("move", actor="b1", quaternion=[1, 0, 0, 0])
            pose = (await one.call("state", robot="b1"))["pose"]
            assert pose == {"position": [1, 1, 3], "quaternion": [1, 0, 0, 0]}
            # What is there already is moved.
            again = await one.call("apply_scene", objects=[{"id": "b2", "position": [2, 2, 2]}], remove=["b1"])
            assert again["objects"] == ["b2"]
            assert again["done"].startswith("Placed: b2. Removed: b1.")
            assert (await one.call("state", robot="b2"))["pose"]["position"] == [2, 2, 2]
            assert (await one.call("remove", actor="b2"))["objects"] == []
            assert (await one.call("play", action="stop"))["done"].startswith("Play has ended.")
            for tool, arguments in (("state", {"robot": "arm"}), ("run", {"steps": 1}), ("contacts", {})):
                assert "play with action='start'" in await one.refused(tool, **arguments)
            assert (await one.call("play", action="start"))["done"] == "Play has started."
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
    assert {resource.name for resource in listed} == {"model", "log", "recordings"}
    model = (await direct.mcp.read_resource("urlab://model")).contents[0]
    assert '"shoulder_lift"' in str(getattr(model, "text", ""))
    for wrong, words in (
        ("nothing", "urlab://model"),
        ("recordings/no.mcap", "no.mcap"),
        ("cameras/arm/no", "'arm/no'"),
    ):
        with pytest.raises(MCPError, match=words):
            await direct.mcp.read_resource(f"urlab://{wrong}")


@pytest.mark.opengl
async def test_cameras_recordings_and_the_log_have_addresses(server: SimulatedServer, tmp_path: Path) -> None:
    async with desk(server, recordings=tmp_path) as one:

        async def read(uri: str) -> Any:
            return (await one.mcp.read_resource(uri)).contents[0]

        templates = (await one.mcp.list_resource_templates()).resource_templates
        assert {template.name for template in templates} == {"cameras", "recordings", "log"}
        shown = await read("urlab://cameras/arm/wrist")
        assert Image.open(io.BytesIO(base64.b64decode(shown.blob))).size == (64, 48)
        await one.call("record", action="start")
        await one.call("run", seconds=0.1)
        made = (await one.call("record", action="stop"))["name"]
        assert [file["name"] for file in json.loads((await read("urlab://recordings")).text)] == [made]
        assert json.loads((await read(f"urlab://recordings/{made}")).text)["robots"] == ["arm"]
        last = json.loads((await read("urlab://log")).text)[-1]
        assert json.loads((await read(f"urlab://log/{last['n'] - 1}")).text) == [last]


async def test_prompts_name_only_tools_that_there_are(direct: Desk) -> None:
    prompts = (await direct.mcp.list_prompts()).prompts
    assert [prompt.name for prompt in prompts] == ["why_it_does_not_move", "pick_and_place"]
    given = {"robot": "arm", "object": "block", "target": "(0.5, 0, 0)"}
    for prompt in prompts:
        takes = {argument.name: given[argument.name] for argument in prompt.arguments or []}
        got = await direct.mcp.get_prompt(prompt.name, takes)
        assert all(value in str(got.messages[0].content) for value in takes.values())
        with pytest.raises(MCPError, match=next(iter(takes))):
            await direct.mcp.get_prompt(prompt.name, {})


@pytest.mark.parametrize("mode", ["auto", "legacy"])
@pytest.mark.parametrize("action", ["accept", "decline"])
async def test_a_person_is_asked_before_state_is_discarded(direct: Desk, mode: str, action: Any) -> None:
    asked: list[str] = []

    async def answer(context: Any, params: Any) -> ElicitResult:
        asked.append(params.message)
        return ElicitResult(action=action, content={} if action == "accept" else None)

    async with Client(
        direct.agent.server,
        mode=mode,
        elicitation_callback=answer,
        client_info=Implementation(name="host", version="1"),
    ) as host:
        one = Desk(direct.client, direct.console, direct.agent, host)
        direct.console.lease.use(PERSON)
        direct.console.lease.release(PERSON)
        await one.call("run", steps=3)
        if action == "accept":
            assert (await one.call("reset"))["step"] == 0
        else:
            assert "did not agree to reset" in await one.refused("reset")
            assert (await one.call("state", robot="arm"))["step"] == 3
        assert len(asked) == 1
        assert "begins anew" in asked[0]
        assert "time passes only while" in await one.refused("play", action="pause")
        assert len(asked) == 1, "only stop ends the session"


@pytest.mark.opengl
async def test_pictures_are_not_larger_than_they_may_be(direct: Desk) -> None:
    result = await direct.mcp.call_tool("picture", {"camera": "arm/overview", "size": 32})
    assert not result.is_error, text_of(result)
    data = getattr(result.content[1], "data", "")
    assert Image.open(io.BytesIO(base64.b64decode(data))).size == (32, 24)
    assert (result.structured_content or {})["step"] == 0
    assert "1024" in await direct.refused("picture", camera="arm/overview", size=4096)


async def test_the_limits_bind_agents_alone(server: SimulatedServer) -> None:
    async with desk(server, ALL) as one:
        holder = one.console.lease
        holder.use(PERSON)
        assert "Ann has the controls" in await one.refused("run", steps=1)
        assert await one.call("explain")
