"""The client against a server of the beta that is written from the description of its wire alone."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Literal

import msgspec
import pytest
from scripted import ScriptedServer, client_of, meta_ok, names
from scripted_beta import BETA_OPS, ROBOT, ScriptedBeta, error
from waiting import DEADLINE_S

import urlab_client
from urlab_client import OutcomeUnknown, StepMode, URLabRPCError, URLabTimeoutError, URLabVersionMismatch
from urlab_client.aio import Stream, URLabClient
from urlab_client.errors import DestroyFailed, ProtocolError, StepTimeout
from urlab_client.protocol.messages.streams import CameraSample
from urlab_client.server import SimulatedServer
from urlab_client.types import Verdict
from urlab_client.values.types import JobStatus


@pytest.fixture
def client(beta_client: URLabClient) -> URLabClient:
    return beta_client


# One program on both generations.


@pytest.mark.parametrize("mode", ["live", "direct", "puppet"])
@pytest.mark.parametrize("generation", ["alpha", "beta"])
async def test_the_same_program_runs(generation: str, mode: str, tmp_path: Path) -> None:
    """Beta statement 67."""
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    server: Any = ScriptedBeta() if generation == "beta" else SimulatedServer(arm, play=True).start()
    try:
        options = {"step_port": server.port} if generation == "beta" else server.client_options()
        async with URLabClient(**options, step_mode=mode, live_pictures=False) as client:
            await client.discover()
            robot = next(iter(client.articulations.values()))
            actuator = next(iter(robot.actuators.values()))
            actuator.set_control(0.25)
            before = client.sim_time
            await client.step()
            assert client.step_mode is StepMode(mode)
            assert robot.qpos_array.shape == (len(robot.joints),)
            assert client.sim_time > before or mode == "live"
            await client.reset()
            assert client.server.generation == generation
    finally:
        server.close()


async def test_what_the_server_is(client: URLabClient, beta: ScriptedBeta) -> None:
    assert client.server.generation == "beta"
    assert client.server.features.claims
    assert client.server.instance is not None
    assert client.server.instance.step_port == beta.port
    assert client.server.features.renders_sync


async def test_state_and_user_channels_arrive(client: URLabClient) -> None:
    """Beta statement 73."""
    reply = await client.step(5)
    assert (reply.frame_id, client.sim_time, client.step_count) == (1, 0.01, 5)
    robot = client.articulations["arm_a"]
    assert (robot.qpos_array.tolist(), robot.user) == ([0.01], {"mode": "idle"})
    assert client.entities["crate"].root_pos_w.tolist() == [0.0, 2.0, 0.0]
    rejected = await client.runtime.set_user_channels({"arm a": {"nope": 1}}, scene={"door": True})
    assert rejected == {"arm_a/nope": "undeclared_or_kind_mismatch"}


async def test_a_robot_is_found_by_all_of_its_names(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 74."""
    robot = client.articulations["arm_a"]
    assert client.articulations["arm a"] is robot
    assert client.articulations["arm_C_0"] is robot
    assert client.articulations_by_id == {"arm a": robot}
    assert (robot.prefix, robot.compiled_prefix, list(robot.joints)) == ("arm_a", "arm_C_0", ["j"])
    assert robot.joints["arm_C_0_j"].name == "j"
    await client.reset("arm_C_0_up")
    await client.runtime.set_qpos("arm a", [0.5])
    assert robot.qpos_array.tolist() == [0.5]
    robot.apply_xfrc("hand", force=(0, 0, 9.81))
    client.entities["crate"].apply_xfrc(force=(1, 0, 0))
    await client.step()
    arrived = beta.arrived()
    assert next(r for r in arrived if r["op"] == "reset")["keyframe_name"] == "arm_C_0_up"
    step = next(r for r in arrived if r["op"] == "step")
    assert step["per_articulation"]["arm_a"]["xfrc_applied"] == {
        "arm_C_0_hand": [0.0, 0.0, 9.81, 0.0, 0.0, 0.0],
        "crate": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    }


@pytest.mark.parametrize("instance", [None, {}, {"instance_id": "x", "capabilities": ["fly"], "colour": {"r": 1}}])
async def test_an_instance_may_say_little_or_strange_things(beta: ScriptedBeta, instance: Any) -> None:
    """Beta statement 77."""

    def hello(request: dict[str, Any]) -> dict[str, Any]:
        reply = {**ScriptedBeta.hello(beta, request), "favourite": {"colour": 1}}
        del reply["instance"]
        return reply if instance is None else {**reply, "instance": instance}

    beta.on("hello", hello)
    async with client_of(beta, step_mode="direct") as client:
        await client.discover()
        assert set(client.articulations) == {"arm_a", "arm_C_1"}
        assert (await client.step()).time == client.sim_time == pytest.approx(0.002)


@pytest.mark.parametrize("given", [None, 5555, 5001])
async def test_a_state_port_that_is_given_is_not_replaced_by_the_announced_one(
    beta: ScriptedBeta, given: int | None
) -> None:
    """There may be a tunnel in between, also with the number of the default."""
    options = {} if given is None else {"state_port": given}
    async with client_of(beta, **options) as client:
        await client.discover()
        (found,) = [one for one in (await client.explain()).findings if one.subject == "state stream"]
        assert f":{given or beta.port + 1}" in found.text
        assert URLabClient(**client.config.options()).config == client.config
    for flavour in (URLabClient, urlab_client.URLabClient):
        parameter = inspect.signature(flavour).parameters["state_port"]
        assert (parameter.default, repr(parameter.default)) == (5555, "5555"), "help() shows a number"


@pytest.mark.parametrize("flavour", ["async", "blocking"])
@pytest.mark.parametrize(
    ("word", "mode"), [("stepped", "direct"), ("mirror", "direct"), ("statepushed", "puppet"), ("freerun", "live")]
)
async def test_the_words_of_the_next_generation(
    beta: ScriptedBeta, flavour: str, word: str, mode: Literal["direct", "puppet", "live"]
) -> None:
    """Beta statement 78."""

    def hello(request: dict[str, Any]) -> dict[str, Any]:
        reply = ScriptedBeta.hello(beta, request)
        robots = [{**robot, "id": 1.0} for robot in reply.pop("articulations")]
        for robot in robots:
            del robot["default_control_mode"]
        prop = {"id": 9.0, "has_free_base": True, "actor_name": "Crate_0"}
        return {**reply, "entities": [robots[0], prop, *robots[1:]]}

    def set_mode(request: dict[str, Any]) -> dict[str, Any]:
        if request["mode"] not in {"freerun", "stepped", "statepushed"}:
            return error("bad_mode", request["mode"])
        beta.mode = mode
        return {"op": "set_mode_ok", "previous_mode": "freerun", "current_mode": word}

    beta.on("hello", hello)
    listed = beta.answers["meta"]({})["ops"]
    beta.on("meta", {"op": "meta_ok", "ops": [op for op in listed if op["name"] != "set_control_source"]})
    beta.on("set_mode", set_mode)

    def drive() -> str:
        with urlab_client.URLabClient("tcp://127.0.0.1", step_port=beta.port, live_pictures=False) as client:
            client.discover()
            client.runtime.set_mode(mode)
            assert client.step_mode is StepMode(mode)
            assert list(client.articulations) == ["arm_a", "arm_C_1"]
            client.articulations["arm_a"].set_ctrl({"m": 0.5})
            client.step()
            return str(client.explain())

    if flavour == "blocking":
        said = await asyncio.to_thread(drive)
    else:
        async with client_of(beta) as client:
            await client.discover()
            await client.runtime.set_mode(mode)
            assert client.step_mode is StepMode(mode)
            assert list(client.articulations) == ["arm_a", "arm_C_1"]
            client.articulations["arm_a"].set_ctrl({"m": 0.5})
            await client.step()
            said = str(await client.explain())
    assert beta.ctrl["arm_C_0"] == [0.0 if mode == "puppet" else 0.5]  # in which no actuator acts
    assert "urlab/0.2, generation 3," in said


async def test_further_fields_of_an_error_are_kept(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 79."""
    beta.on("reset", error("brand_new", "because", owner="x", mood={"bad": True}))
    with pytest.raises(URLabRPCError) as caught:
        await client.reset()
    assert caught.value.details == {"owner": "x", "mood": {"bad": True}}


async def test_removing_an_actor_goes_by_the_servers_name(client: URLabClient, beta: ScriptedBeta) -> None:
    """Generation 2 statement 52."""
    await client.scene.destroy_actor("arm a")
    assert names(beta.arrived())[0] == "remove_actor"


# Puppet mode, and the pause that keeps its physics still.


async def test_puppet_mode_is_paused_and_left_running(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 90."""
    await client.runtime.set_mode("puppet")
    assert beta.paused
    await client.step(3)
    assert beta.time == pytest.approx(0.006)
    await client.runtime.set_mode("live")
    assert not beta.paused


async def test_puppet_mode_is_taken_back_on_close(beta: ScriptedBeta) -> None:
    async with client_of(beta, step_mode="puppet") as client:
        await client.discover()
        assert (beta.mode, beta.paused) == ("puppet", True)
    assert (beta.mode, beta.paused) == ("live", False)


# Another MuJoCo.


async def test_another_mujoco_is_refused_with_both_ways_out() -> None:
    beta = ScriptedBeta(skew=True)
    try:
        async with client_of(beta) as client:
            with pytest.raises(URLabVersionMismatch, match="mujoco_version_check=False") as caught:
                await client.discover()
            assert caught.value.server_version == "3.11.1"
            beta.playing = False
            await client.discover()
            with pytest.raises(URLabVersionMismatch, match=r"mujoco==3\.11\.1"):
                await client.sim.start()
    finally:
        beta.close()


@pytest.mark.parametrize("mode", ["live", "direct", "puppet"])
async def test_another_mujoco_is_worked_with(mode: str) -> None:
    """Beta statements 80 and 84."""
    beta = ScriptedBeta(skew=True)
    try:
        async with client_of(beta, step_mode=mode, mujoco_version_check=False) as client:
            with pytest.warns(UserWarning, match=r"MuJoCo 3\.11\.1"):
                await client.discover()
            await client.sim.stop()
            await client.sim.start()  # says nothing more: warnings are errors here
            assert client.model_is_approximate
            assert client.model is not None
            assert client.model.nq == 9
            client.articulations["arm_a"].set_ctrl({"m": 0.5})
            await client.step(2)
            assert client.entities["crate"].root_pos_w[:2].tolist() == [0.0, 2.0]
    finally:
        beta.close()


async def test_a_model_that_needs_another_mujoco_is_refused_with_its_release() -> None:
    beta = ScriptedBeta(skew=True)
    whole = beta.answers["hello"]
    newer = "<mujoco><actuator><novelty/></actuator></mujoco>"
    beta.on("hello", lambda request: {**whole(request), "mjcf_compiled": newer, "vfs_assets": {}})
    try:
        async with client_of(beta, mujoco_version_check=False) as client:
            with (
                pytest.warns(UserWarning, match=r"MuJoCo 3\.11\.1"),
                pytest.raises(
                    ProtocolError, match=r"novelty(.|\n)*Install mujoco==3\.11\.1, or pass local_model=False"
                ),
            ):
                await client.discover()
    finally:
        beta.close()


async def test_another_mujoco_without_xml_leaves_no_model_and_says_so() -> None:
    beta = ScriptedBeta(skew=True)
    whole = beta.answers["hello"]
    beta.on(
        "hello", lambda request: {k: v for k, v in whole(request).items() if k not in ("mjcf_compiled", "vfs_assets")}
    )
    try:
        async with client_of(beta, step_mode="direct", mujoco_version_check=False) as client:
            with pytest.warns(UserWarning, match=r"MuJoCo 3\.11\.1.*There is no local model") as said:
                await client.discover()
            assert len(said) == 1
            assert (client.model, client.model_is_approximate) == (None, False)
            client.articulations["arm_a"].ctrl_array[:] = 0.5
            await client.step(2)
            assert beta.ctrl["arm_C_0"] == [0.5]
    finally:
        beta.close()


async def test_a_version_string_decides_nothing(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 80."""
    await client.sim.start()
    assert client.urlab_version == "urlab/0.1"
    assert client.server.features.claims


# Jobs.


def done(server: ScriptedServer, op: str, result: dict[str, Any], *, running: int = 0) -> None:
    """Let an op be a job that ends with a result after some polls."""
    states = [{"op": "op_status_ok", "job_id": "job_7", "state": "running"} for _ in range(running)]
    state = "failed" if result["op"] == "error" else "done"
    states.append({"op": "op_status_ok", "job_id": "job_7", "state": state, "result": result})
    server.on(op, {"op": "op_started", "job_id": "job_7", "state": "running"})
    server.on("op_status", lambda _: states.pop(0) if states else error("unknown_job", "job_7 is not known"))


IMPORTED = {
    "op": "import_xml_ok",
    "blueprint_class_path": "/Game/MuJoCoImports/arm.arm_C",
    "blueprint_short_name": "arm",
    "imported_now": True,
}


@pytest.mark.parametrize("running", [None, 0, 3])
@pytest.mark.parametrize("encoding", ["msgpack", "json"])
async def test_a_job_returns_what_a_direct_answer_would(
    scripted: ScriptedServer, running: int | None, encoding: str
) -> None:
    """Generation 2 statement 45."""
    scripted.on("meta", meta_ok("beta"))
    if running is None:
        scripted.on("import_xml", IMPORTED)
    else:
        done(scripted, "import_xml", IMPORTED, running=running)
    if encoding == "json":
        for op, answer in list(scripted.answers.items()):
            scripted.on(op, lambda request, answer=answer: msgspec.json.encode(answer(request)))
    async with client_of(scripted, local_model=False, encoding=encoding) as client:
        await client.discover()
        told: list[JobStatus] = []
        blueprint = await client.scene.import_xml("/robots/arm.xml", on_progress=told.append)
        assert (blueprint.short_name, blueprint.imported_now) == ("arm", True)
    assert [status.state for status in told] == ([] if running is None else ["running"] * running + ["done"])


async def test_a_failed_job_raises_what_a_direct_refusal_would(client: URLabClient) -> None:
    """Generation 2 statement 46."""
    with pytest.raises(DestroyFailed) as caught:
        await client.scene.destroy_actor("nobody")
    assert (caught.value.op, caught.value.message) == ("remove_actor", "no such actor")


async def test_a_job_that_ends_without_a_result(scripted: ScriptedServer) -> None:
    scripted.on("meta", meta_ok("beta"))
    scripted.on("import_xml", {"op": "op_started", "job_id": "job_7", "state": "running"})
    async with client_of(scripted, local_model=False) as client:
        await client.discover()
        for state, kind, words in (
            ("failed", URLabRPCError, "job_7 failed, and the editor gave no reason"),
            ("done", ProtocolError, "job_7 is done, but its result is missing"),
        ):
            scripted.on("op_status", {"op": "op_status_ok", "job_id": "job_7", "state": state})
            with pytest.raises(kind, match=words) as caught:
                await client.scene.import_xml("/robots/arm.xml")
            assert caught.value.op == "import_xml"


async def test_a_diverged_simulation_and_a_packaged_build_are_explained(
    client: URLabClient, beta: ScriptedBeta, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = beta.arts
    monkeypatch.setattr(beta, "arts", lambda: {name: {**art, "qpos": [float("nan")]} for name, art in sound().items()})
    beta.on("pie_status", error("unknown_op", "pie_status"))
    await client.step()
    said = {(found.verdict, found.subject): found.text for found in (await client.explain()).findings}
    assert "the simulation has diverged. Call reset()" in said[Verdict.PROBLEM, "arm_a"]
    assert "does not report its play state" in said[Verdict.NOTE, "play"]


async def test_a_job_whose_end_was_told_to_nobody(client: URLabClient, beta: ScriptedBeta) -> None:
    """Generation 2 statement 47."""
    beta.on("op_status", error("unknown_job", "job_1 is not known"))
    with pytest.raises(OutcomeUnknown, match="job_1") as caught:
        await client.scene.import_xml("/robots/arm.xml")
    assert caught.value.job_id == "job_1"
    assert names(beta.arrived()).count("import_xml") == 1


async def test_a_job_that_takes_too_long(client: URLabClient, beta: ScriptedBeta) -> None:
    """Generation 2 statement 48."""
    beta.running = 10**9
    with pytest.raises(URLabTimeoutError, match=r"did not end within (?!0\.0 s).* continues") as caught:
        await client.scene.import_xml("/robots/arm.xml", timeout=0.1)
    assert caught.value.job_id == "job_1"
    assert await client.scene.current_level() == "/Game/Levels/lab"


async def test_a_job_that_is_not_waited_for_any_more(client: URLabClient, beta: ScriptedBeta) -> None:
    """Generation 2 statement 49."""
    beta.running = 10**9
    call = asyncio.create_task(client.scene.import_xml("/robots/arm.xml"))
    await asyncio.to_thread(beta.request, "op_status")
    call.cancel()
    with pytest.raises(asyncio.CancelledError) as caught:
        await call
    assert "job_1" in caught.value.__notes__[0]
    await client.step()
    beta.arrived()
    assert await client.scene.current_level() == "/Game/Levels/lab"
    assert names(beta.arrived()) == ["current_level"]


async def test_a_state_nobody_knows_counts_as_running(scripted: ScriptedServer) -> None:
    """Generation 2 statements 50 and 60."""
    # An odd mixture: jobs, and an `op_status` that the server does not list.
    done(scripted, "import_xml", IMPORTED)
    answers = [{"op": "op_status_ok", "job_id": "job_7", "state": "queued", "mood": 1}]
    last = scripted.answers["op_status"]
    scripted.on("op_status", lambda request: answers.pop() if answers else last(request))
    async with client_of(scripted, local_model=False) as client:
        await client.discover()
        assert (await client.scene.import_xml("/robots/arm.xml")).short_name == "arm"


async def test_steps_go_on_while_the_editor_works(client: URLabClient, beta: ScriptedBeta) -> None:
    beta.running = 3
    call = asyncio.create_task(client.scene.import_xml("/robots/arm.xml"))
    await asyncio.to_thread(beta.request, "op_status")
    await client.step()
    level = asyncio.create_task(client.scene.current_level())
    assert (await call).short_name == "arm"
    assert await level == "/Game/Levels/lab"
    arrived = names(beta.arrived())
    assert arrived.index("step") < arrived.index("current_level")
    assert arrived.index("current_level") > max(i for i, op in enumerate(arrived) if op == "op_status")


async def test_a_server_that_starts_everything(beta: ScriptedBeta) -> None:
    """Generation 2 statement 51."""
    async with client_of(beta, step_mode="direct") as client:
        await client.discover()
        for op in BETA_OPS:
            beta.on(op, {"op": "op_started", "job_id": "job_9", "state": "running"})
        for call in (client.step, client.reset, client.runtime.forward, client.scene.save_level):
            with pytest.raises(ProtocolError):
                await call()


async def test_unknown_fields_do_no_harm(client: URLabClient, beta: ScriptedBeta) -> None:
    """Generation 2 statement 59."""
    for op in ("step", "op_status"):
        answer = beta.answers[op]
        beta.on(op, lambda request, answer=answer: {**answer(request), "favourite": {"colour": 1}})
    assert (await client.step()).time == client.sim_time == pytest.approx(0.002)
    assert (await client.scene.import_xml("/robots/arm.xml")).short_name == "arm"


# Cameras, and the state stream outside live mode, against the simulated server's beta.


@pytest.fixture
async def served(tmp_path: Path) -> AsyncIterator[SimulatedServer]:
    arm = tmp_path / "arm.xml"
    arm.write_text(ROBOT)
    async with SimulatedServer(arm, arm, play=True, dialect="beta", camera_size=(16, 12)) as server:
        yield server


@pytest.mark.opengl
async def test_pictures_of_a_step(served: SimulatedServer) -> None:
    """Beta statements 50 and 75. Generation 2 statements 54 and 55."""
    async with URLabClient(**served.client_options(), step_mode="direct") as client:
        await client.discover()
        robot = client.articulations["copy1_arm"]
        reply = await client.step(include_cameras={"copy1_arm/wrist": "sync"})
        assert reply.cameras is not None
        assert list(reply.cameras) == ["copy1_arm/wrist"]
        assert reply.cameras["copy1_arm/wrist"].frame_id == reply.frame_id
        camera = robot.cameras["wrist"]
        assert (camera.frame_id, camera.sim_time, camera.delivered) == (reply.frame_id, client.sim_time, True)
        assert client.articulations["arm"].cameras["wrist"].latest_frame is None
        with pytest.raises(KeyError, match="ambiguous"):
            await client.step(include_cameras={"wrist": "sync"})
        everything = await client.step(include_cameras=True)
        assert everything.cameras is not None
        assert set(everything.cameras) == {"arm/wrist", "copy1_arm/wrist"}


async def test_an_older_picture_is_not_handed_out_as_that_of_the_step(
    client: URLabClient, beta: ScriptedBeta, caplog: pytest.LogCaptureFixture
) -> None:
    """Generation 2 statement 54."""
    caplog.set_level("INFO", "urlab_client.client")
    frame = {"width": 4.0, "height": 2.0, "frame_id": 0.0, "sim_time": 0.0, "dtype": "bgra8", "data": bytes(32)}
    answer = beta.answers["step"]
    beta.on("step", lambda request: {**answer(request), "cameras": {"arm_a/wrist": frame}})
    camera = client.articulations["arm_a"].cameras["wrist"]
    reply = await client.step(include_cameras={"arm a/wrist": "sync"})
    assert reply.cameras == {}
    assert "camera arm_a/wrist: its picture shows snapshot 0, but the step is snapshot 1" in caplog.messages
    assert (camera.delivered, camera.latest_frame) == (False, None)
    asked = beta.of("step")[0]
    assert (asked["include_cameras"], asked["render"]) == ({"arm_a/wrist": "sync"}, "sync")
    reply = await client.step(include_cameras={"arm a/wrist": "latest"})
    assert reply.cameras is not None
    assert list(reply.cameras) == ["arm a/wrist"]
    assert (camera.delivered, camera.frame_id, camera.sim_time) == (True, 0, 0.0)


@pytest.mark.opengl
async def test_a_camera_streams_while_somebody_looks(served: SimulatedServer) -> None:
    """Beta statements 53 and 56. Generation 2 statements 35 and 56."""
    async with URLabClient(**served.client_options(), step_mode="direct", live_pictures=False) as client:
        await client.discover()
        await client.step()
        camera = client.articulations["copy1_arm"].cameras["wrist"]

        async def next_picture(frames: Stream[CameraSample]) -> CameraSample:
            coming = asyncio.ensure_future(anext(frames))
            while not coming.done():  # a camera sees what moves
                await client.step()
            return await coming

        async with camera.frames(timeout=DEADLINE_S) as frames:
            picture = await next_picture(frames)
            assert picture.pixels.shape == (12, 16, 4)
            assert picture.sim_time == pytest.approx(0.002 * (picture.frame_id or 0))
            await client.sim.stop()
            await client.sim.start()
            # Play began with the camera off, and it was switched on again for whoever still looks.
            async with asyncio.timeout(DEADLINE_S):
                while picture.gap is None:
                    picture = await next_picture(frames)


async def test_the_state_stream_goes_on_outside_live_mode(served: SimulatedServer) -> None:
    """Beta statement 76."""
    async with URLabClient(**served.client_options(), step_mode="direct") as client:
        await client.discover()
        async with client.state_stream("all", timeout=DEADLINE_S) as snapshots:
            for _ in range(3):
                await client.step(2)
            times = [(await anext(snapshots)).time for _ in range(3)]
        assert times == pytest.approx([0.004, 0.008, 0.012])


async def test_a_step_that_timed_out_is_not_sent_again(served: SimulatedServer) -> None:
    """Beta statement 97: whoever wants it again compares `forward().step` first."""
    async with URLabClient(**served.client_options(), step_mode="direct") as client:
        await client.discover()
        before = (await client.step()).step
        await client.runtime.set_paused(True)
        core: Any = served._running.core  # type: ignore[union-attr]
        core.play.running().engine._step_timeout_s = 0.05
        sent = client.transport_stats.sent
        with pytest.raises(StepTimeout):
            await client.step()
        assert client.transport_stats.sent == sent + 1
        await client.runtime.set_paused(False)
        assert (await client.runtime.forward()).step == before
