"""What viewers may not do, and what the console remembers of what they did: a robot that walks, beside a crate."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncGenerator, Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import Robot, write_recording
from starlette.applications import Starlette
from starlette.routing import Mount
from starlette.testclient import TestClient
from waiting import eventually

from urlab_client.aio import URLabClient
from urlab_client.console.description import describe
from urlab_client.console.lease import Viewer
from urlab_client.console.mujoco_viewer import MujocoViewer
from urlab_client.console.session import ConsoleSession
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import StepMode
from urlab_client.errors import (
    ConnectionLost,
    ModeLocked,
    NotReady,
    OutcomeUnknown,
    ProtocolError,
    URLabError,
    URLabTimeoutError,
)
from urlab_client.integrations.record import record
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.server import SimulatedServer
from urlab_client.web import app, endpoints
from urlab_client.web.endpoints import explain_error


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("quadruped", dialect="beta", play=True, camera_size=(32, 24)) as running:
        yield running


@pytest.fixture
def http(server: SimulatedServer, tmp_path: Path) -> Iterator[TestClient]:
    server.restore()
    client = URLabClient(**server.client_options(), step_mode="direct")
    inner = app(client, lease_seconds=600.0, recordings=tmp_path / "recordings")

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with client, inner.router.lifespan_context(inner):
            yield

    outer = Starlette(routes=[Mount("/", inner)], lifespan=lifespan)
    with TestClient(outer, base_url="http://localhost") as http:
        key = http.post("/api/session", json={"token": inner.state.access.invite()}).json()["key"]
        http.headers["authorization"] = f"Bearer {key}"
        with http.websocket_connect("ws://localhost/api/live") as live:
            while not live.receive_json().get("world", {}).get("articulations"):
                pass
        assert http.post("/api/step", json={"n_steps": 1}).status_code == 200
        yield http


def refusal(answer: Any, status: int = 400) -> str:
    assert answer.status_code == status, answer.text
    return str(answer.json()["error"]["message"])


def test_what_the_server_does_not_report_is_remembered(http: TestClient) -> None:
    twist = {"articulation": "quadruped", "linear": [0.5, 0.25, 0.0], "angular": [0.0, 0.0, -1.0]}
    assert http.post("/api/ops/set_twist", json=twist).status_code == 200
    assert http.post("/api/ops/set_control_source", json={"source": "ui"}).status_code == 200
    assert http.post("/api/ops/set_sim_speed", json={"percent": 50}).status_code == 200
    status = http.get("/api/status").json()
    assert status["twists"] == {"quadruped": [0.5, 0.25, -1.0]}
    assert (status["source"], status["speed"]) == ("ui", 50.0)
    http.post("/api/ops/set_control_source", json={"articulation": "quadruped", "source": "zmq"})
    assert http.get("/api/status").json()["source"] == "ui", "of all robots, not of this one"


def test_ops_that_the_client_must_know_of_go_through_it(http: TestClient) -> None:
    camera = http.get("/api/world").json()["articulations"][0]["cameras"][0]["name"]
    delayed = http.post("/api/ops/set_camera_delay", json={"cameras": {camera: 0.25}})
    assert (delayed.status_code, delayed.json()["cameras"][camera]["delay_s"]) == (200, 0.25)
    assert http.post("/api/ops/stop_pie", json={}).status_code == 200
    assert http.get("/api/world").json()["articulations"] == []
    late = http.post("/api/ops/begin_pie", json={"timeout_s": 0.0})
    assert (late.status_code, late.json()["state"]) in {(200, "timeout"), (200, "ready")}
    assert http.post("/api/ops/begin_pie", json={}).json()["state"] == "ready"
    assert [one["key"] for one in http.get("/api/world").json()["articulations"]] == ["quadruped"]


def test_options_and_the_switch_of_cameras_go_through_the_client_too(http: TestClient, server: SimulatedServer) -> None:
    options = http.post("/api/ops/set_sim_options", json={"options": {"timestep": 0.004}})
    assert (options.status_code, options.json()["options"]["timestep"]) == (200, 0.004)
    before = http.post("/api/step", json={"n_steps": 1}).json()["time"]
    assert http.post("/api/step", json={"n_steps": 5}).json()["time"] == pytest.approx(before + 0.02)
    camera = http.get("/api/world").json()["articulations"][0]["cameras"][0]["name"]
    switched = http.post("/api/ops/set_camera_streaming", json={"cameras": {camera: True}})
    assert (switched.status_code, switched.json()["cameras"][camera]["streaming"]) == (200, True)
    assert http.post("/api/ops/set_sim_options", json={"options": {"timestep": 0.002}}).status_code == 200


async def test_a_client_that_only_watches_takes_the_handshake_from_the_console(
    http: TestClient, server: SimulatedServer
) -> None:
    answer = http.get("/api/handshake")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "application/octet-stream")
    async with URLabClient(**server.client_options(), read_only=True) as watching:
        await watching.discover(handshake=answer.content)
        assert list(watching.articulations) == ["quadruped"]
        assert watching.model is not None


def test_an_invitation_lets_one_more_in_once(http: TestClient) -> None:
    invitation = http.post("/api/invitations").json()
    assert invitation["path"] == f"/?token={invitation['token']}"
    token = {"token": invitation["token"]}
    key = http.post("/api/session", json=token).json()["key"]
    assert http.get("/api/status", headers={"authorization": f"Bearer {key}"}).status_code == 200
    assert "unknown or has been used" in refusal(http.post("/api/session", json=token), 401)
    stranger = {"authorization": "", "accept": "text/html"}
    shut = http.get("/api/status", headers=stranger)
    assert (shut.status_code, shut.headers["content-type"].partition(";")[0]) == (401, "text/html")
    assert "Access denied" in shut.text
    assert "Open the link that `urlab console` printed" in shut.text


def test_rays_and_pushes_take_finite_numbers_and_bodies_of_robots(http: TestClient) -> None:
    bodies = http.get("/api/bodies").json()["bodies"]
    trunk = next(one for one in bodies if one["robot"] == "quadruped")
    assert "direction other than zero" in refusal(
        http.post("/api/pick", json={"origin": [0, 0, 3], "direction": [0, 0, 0]})
    )
    ground = {"body": 0, "local": [0, 0, 0], "target": [0, 0, 1]}
    assert "there is no body 0: they are numbered from 1" in refusal(http.post("/api/push", json=ground))
    infinite = f'{{"body": {trunk["id"]}, "local": [0, 0, 0], "target": [1e999, 0, 0]}}'
    assert "$.target[0]" in refusal(http.post("/api/push", content=infinite))


def test_in_puppet_mode_the_mouse_moves_a_robot_that_is_free(http: TestClient) -> None:
    assert http.post("/api/ops/set_mode", json={"mode": "puppet"}).status_code == 200
    before = http.get("/api/bodies").json()["bodies"]
    trunk = next(one for one in before if one["robot"] == "quadruped")
    there = [trunk["position"][0] + 0.5, trunk["position"][1], trunk["position"][2] + 1.0]
    push = {"body": trunk["id"], "local": [0, 0, 0], "target": there}
    assert http.post("/api/push", json=push).status_code == 200
    path = f"/api/bodies/{trunk['id']}"
    eventually(lambda: http.get(path).json()["position"] == pytest.approx(there, abs=1e-3))


def test_in_puppet_mode_viewers_place_joints(http: TestClient) -> None:
    def angle(name: str) -> float:
        robot = next(one for one in http.get("/api/world").json()["articulations"] if one["key"] == "quadruped")
        index = next(joint["index"] for joint in robot["joints"] if joint["name"] == name)
        return float(http.get("/api/state").json()["articulations"]["quadruped"]["qpos"][index])

    knee = {"quadruped": {"FL_calf": -1.0}}
    assert "needs puppet mode, not" in refusal(http.post("/api/pose", json=knee))
    assert http.post("/api/ops/set_mode", json={"mode": "puppet"}).status_code == 200
    assert http.post("/api/pose", json=knee).status_code == 200
    eventually(lambda: angle("FL_calf") == pytest.approx(-1.0))
    far = refusal(http.post("/api/pose", json={"quadruped": {"FL_thigh": 0.5, "FL_calf": 3.0}}))
    assert "FL_calf goes from" in far
    assert "3 is out of reach" in far
    assert "only hinge and slide joints" in refusal(http.post("/api/pose", json={"quadruped": {"root": 1.0}}))
    thigh = angle("FL_thigh")
    assert http.post("/api/pose", json={"quadruped": {"FR_calf": -0.9}}).status_code == 200
    eventually(lambda: angle("FR_calf") == pytest.approx(-0.9))
    assert (angle("FL_calf"), angle("FL_thigh")) == pytest.approx((-1.0, thigh)), "what was refused placed nothing"
    placed = [entry["text"] for entry in http.get("/api/log").json() if entry["what"] == "pose"]
    assert [json.loads(one) for one in placed] == [{"quadruped": ["FL_calf"]}, {"quadruped": ["FR_calf"]}]


def recording(folder: Path, name: str, robots: dict[str, int]) -> None:
    """Write a recording of some robots, each with some joint positions, a second long."""
    folder.mkdir(exist_ok=True)
    samples = ({key: Robot([0.0] * size) for key, size in robots.items()} for _ in range(100))
    write_recording(folder / name, ((robot, {}) for robot in samples))


def test_a_robot_with_torque_motors_holds_its_home_pose_until_somebody_commands_it(http: TestClient) -> None:
    def height() -> float:
        assert http.post("/api/step", json={"n_steps": 1000}).status_code == 200
        return float(http.get("/api/state").json()["articulations"]["quadruped"]["qpos"][2])

    assert http.post("/api/hold", json={"quadruped": True}).status_code == 200
    assert http.get("/api/status").json()["holding"] == ["quadruped"]
    assert height() > 0.28
    assert height() > 0.28, "also in steps that are longer than a law with one torque would stand"
    assert http.post("/api/ctrl", json={"quadruped": {"FL_thigh": 1.0}}).status_code == 200
    assert http.get("/api/status").json()["holding"] == []
    http.post("/api/ops/reset", json={})
    assert http.post("/api/hold", json={"quadruped": True}).status_code == 200
    assert http.post("/api/hold", json={"quadruped": False}).status_code == 200
    assert height() < 0.2
    said = [entry["what"] for entry in http.get("/api/log").json() if entry["kind"] == "call"]
    assert [one for one in said if one != "step"][-2:] == ["hold pose", "let go"]
    assert "'quadruped'" in refusal(http.post("/api/hold", json={"nobody": True}))
    assert http.post("/api/hold", json={"quadruped": True}).status_code == 200
    http.post("/api/ops/set_mode", json={"mode": "live"})
    assert http.get("/api/status").json()["holding"] == [], "in live mode its law would come too late"
    assert http.get("/api/log").json()[-1]["what"] == "let go"
    assert http.post("/api/run", json={"running": True}).status_code == 200
    try:
        eventually(lambda: not any(http.get("/api/state").json()["articulations"]["quadruped"]["ctrl"]))
    finally:
        http.post("/api/run", json={"running": False})


def test_physics_that_runs_goes_on_while_a_robot_begins_to_hold_its_pose(http: TestClient) -> None:
    http.post("/api/ops/set_mode", json={"mode": "live"})
    assert http.post("/api/run", json={"running": True}).status_code == 200

    def status() -> dict[str, Any]:
        found: dict[str, Any] = http.get("/api/status").json()
        return found

    eventually(lambda: status()["moving"])
    try:
        assert http.post("/api/hold", json={"quadruped": True}).status_code == 200
        assert (status()["mode"], status()["running"], status()["holding"]) == ("direct", True, ["quadruped"])
        # Whoever steps is not told that somebody else does.
        found = {one["subject"]: one["verdict"] for one in http.get("/api/explain").json()["findings"]}
        assert found["play"] == "ok"
    finally:
        http.post("/api/run", json={"running": False})
    http.post("/api/hold", json={"quadruped": False})
    assert http.post("/api/hold", json={"quadruped": True}).status_code == 200
    assert not status()["running"], "what stood still does not begin by itself"


async def test_the_status_says_whether_a_viewer_has_chosen_the_mode(tmp_path: Path) -> None:
    async with SimulatedServer("quadruped", play=True) as server, URLabClient(**server.client_options()) as client:
        await client.discover()
        console, viewer = ConsoleSession(client, recordings=tmp_path), Viewer("key", "me")
        assert (console.status(viewer).mode, console.status(viewer).mode_chosen) == ("live", False)
        for mode in (StepMode.DIRECT, StepMode.LIVE):
            await console.controls.do(viewer, SetMode(mode=mode))
            assert (console.status(viewer).mode, console.status(viewer).mode_chosen) == (mode, True)
        await client.runtime.set_mode(StepMode.DIRECT)  # by the program around it
        assert not console.status(viewer).mode_chosen


ARM = """<mujoco><worldbody><body name="upper"><joint name="turn" axis="0 1 0"/><geom size="0.1" fromto="0 0 0 1 0 0"/>
<body name="lower"><joint name="slide" type="slide"/><geom size="0.1"/></body></body></worldbody>
<actuator><motor name="motor" joint="turn"/><position name="grip" joint="slide" kp="10"/></actuator></mujoco>"""


def test_another_mode_ends_the_steps_of_the_console(http: TestClient) -> None:
    def status() -> tuple[str, bool]:
        found = http.get("/api/status").json()
        return found["mode"], found["running"]

    assert http.post("/api/run", json={"running": True}).status_code == 200
    http.post("/api/ops/set_mode", json={"mode": "puppet"})
    eventually(lambda: status() == ("puppet", False))
    assert "in mode puppet no physics runs" in refusal(http.post("/api/run", json={"running": True}))
    http.post("/api/ops/set_mode", json={"mode": "direct"})
    assert status() == ("direct", False), "it would say that it runs, and take no step"
    assert http.post("/api/run", json={"running": True}).status_code == 200
    assert status() == ("direct", True)
    assert http.post("/api/run", json={"running": False}).status_code == 200


async def test_holding_a_pose_leaves_to_others_what_they_command(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    async with (
        SimulatedServer(tmp_path / "arm.xml", play=True, dialect="beta") as server,
        URLabClient(**server.client_options()) as client,
    ):
        await client.discover()
        controls, viewer = ConsoleSession(client, recordings=tmp_path).controls, Viewer("key", "me")
        (key, robot), *_ = client.articulations.items()
        other_name = next(iter(client.articulations.aliases))
        await controls.hold(viewer, other_name, True)
        robot.set_ctrl({"grip": 0.25})
        await controls.step(viewer, 50)
        assert list(controls.holding) == [key]
        await controls.hold(viewer, key, False)
        assert robot.ctrl_array.tolist() == [0.0, 0.25], "only the motor is let go"
        await controls.hold(viewer, key, True)
        controls.set_points(viewer, {other_name: {"grip": 0.5}})
        assert not controls.holding
        await controls.hold(viewer, key, True)
        await controls.step(viewer, 50)
        robot.set_ctrl({"motor": 2.0})  # as an agent does, or the program around the console
        await controls.step(viewer, 50)
        assert (list(controls.holding), robot.ctrl_array.tolist()) == ([], [2.0, 0.5])


async def test_each_of_several_robots_has_its_own_home(tmp_path: Path) -> None:
    async with (
        SimulatedServer("quadruped", "arm", play=True) as server,
        URLabClient(**server.client_options()) as client,
    ):
        await client.discover()
        robots = {art.key: art for art in describe(client, 1).articulations}
    assert {one.name: one.home for one in robots["arm"].actuators}["gripper"] == pytest.approx(0.04)


async def test_a_robot_without_torque_motors_says_why_it_holds_no_pose(tmp_path: Path) -> None:
    async with SimulatedServer("arm", play=True) as server, URLabClient(**server.client_options()) as client:
        await client.discover()
        with pytest.raises(ValueError, match="arm cannot hold a pose: that needs torque motors"):
            await ConsoleSession(client, recordings=tmp_path).controls.hold(Viewer("key", "me"), "arm", True)


@pytest.mark.parametrize(
    ("joint", "motor"),
    [("", 'gear="0"'), ('type="ball"', 'gear="0 1 0"'), ("", "")],
    ids=["without a gear", "ball joint", "hinge"],
)
async def test_only_motors_that_turn_a_hinge_can_hold_a_pose(tmp_path: Path, joint: str, motor: str) -> None:
    (tmp_path / "one.xml").write_text(
        f"""<mujoco><worldbody><body><joint name="turn" {joint}/><geom size="0.1" pos="0.2 0 0"/></body></worldbody>
        <actuator><motor name="motor" joint="turn" {motor}/></actuator></mujoco>""",
        encoding="utf-8",
    )
    async with (
        SimulatedServer(tmp_path / "one.xml", play=True) as server,
        URLabClient(**server.client_options()) as client,
    ):
        await client.discover()
        (key,) = client.articulations
        held = ConsoleSession(client, recordings=tmp_path).controls.hold(Viewer("key", "me"), key, True)
        if joint or motor:
            with pytest.raises(ValueError, match="torque motors on hinge or slide joints"):
                await held
        else:
            await held


def test_recordings_are_refused_by_what_is_wrong_with_them(http: TestClient, tmp_path: Path) -> None:
    size = len(http.get("/api/state").json()["articulations"]["quadruped"]["qpos"])
    folder = tmp_path / "recordings"
    recording(folder, "own.mcap", {"quadruped": size})
    recording(folder, "other.mcap", {"humanoid": size})
    recording(folder, "smaller.mcap", {"quadruped": size - 1})
    recording(folder, "nobody.mcap", {})
    assert "no states of robots" in refusal(http.post("/api/replay", json={"name": "nobody.mcap"}))
    for other in ("other.mcap", "smaller.mcap"):
        said = refusal(http.post("/api/replay", json={"name": other}))
        assert said == f"{other} is a recording of other robots than the current ones (quadruped)."
    assert "is converted to csv, mp4, npz, not 'gif'" in refusal(http.get("/api/recordings/own.mcap?as=gif"))
    assert "must end in .mcap or .json" in refusal(http.put("/api/recordings/own.txt", content=b""))
    content = (folder / "own.mcap").read_bytes()
    assert "there is a recording 'own.mcap' already" in refusal(http.put("/api/recordings/own.mcap", content=content))
    assert not list(folder.glob("*.part"))

    assert "no recording is replayed" in refusal(http.get("/api/replay/states?seconds=1"))
    assert http.post("/api/replay", json={"name": "own.mcap", "playing": False}).status_code == 200
    for rate in (0.01, 50):
        assert f"the pace must be from 0.05 to 20, not {rate}" in refusal(http.post("/api/replay", json={"rate": rate}))
    trunk = next(one for one in http.get("/api/bodies").json()["bodies"] if one["robot"])
    push = {"body": trunk["id"], "local": [0, 0, 0], "target": [0, 0, 1]}
    assert "Go back to live to push" in refusal(http.post("/api/push", json=push))
    assert http.delete("/api/replay").status_code == 200


def test_what_the_server_has_saved_is_replayed_too(http: TestClient, server: SimulatedServer) -> None:
    """It has the positions of all compiled joints together, and no velocities."""
    assert http.post("/api/ops/recording_start", json={}).status_code == 200
    for _ in range(5):
        assert http.post("/api/step", json={"n_steps": 20}).status_code == 200
    assert http.post("/api/ops/recording_stop", json={}).status_code == 200
    saved = Path(http.post("/api/ops/recording_save", json={"path": "fall.json"}).json()["absolute_path"])
    assert http.put("/api/recordings/fall.json", content=saved.read_bytes()).status_code == 200
    last = json.loads(saved.read_bytes())["Frames"][-1]["jointStates"]
    fallen = [value for joint in last.values() for value in joint["qPos"]]
    http.post("/api/ops/reset", json={})
    replay = http.post("/api/replay", json={"name": "fall.json", "playing": False, "time": 1e6})
    assert replay.status_code == 200, replay.text
    shown = http.get("/api/state").json()["articulations"]["quadruped"]["qpos"]
    assert shown == pytest.approx(fallen, abs=2e-5)
    assert http.delete("/api/replay").status_code == 200


@pytest.mark.opengl
@pytest.mark.parametrize(
    ("recorded", "shown"),
    [(("alpha", "plugin"), ("beta", "plugin")), (("alpha", "model"), ("alpha", "plugin"))],
)
async def test_a_recording_is_replayed_whatever_the_engine_called_its_robots(
    recorded: tuple[Any, Any], shown: tuple[Any, Any], tmp_path: Path
) -> None:
    for dialect, naming in (recorded, shown):
        async with (
            SimulatedServer("arm", "block", dialect=dialect, actor_names=naming, play=True) as server,
            URLabClient(**server.client_options(), step_mode="direct") as client,
        ):
            await client.discover()
            if (dialect, naming) == recorded:
                async with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"]):
                    await client.step(5)
            else:
                console = ConsoleSession(client, recordings=tmp_path)
                await console.replay.begin(tmp_path / "run.mcap")
                await console.replay.change(at=1.0, playing=False)
                assert {*console.view.snapshot.per_articulation} == {*client.articulations}
                camera = f"{client.articulations.key('arm')}/wrist"
                assert [*console.replay.cameras] == [camera]
                assert await console.replay.picture(camera) is not None


async def test_a_replay_that_cannot_place_the_robots_does_not_begin(server: SimulatedServer, tmp_path: Path) -> None:
    async with URLabClient(**server.client_options(), step_mode="direct") as client:
        await client.discover()
        async with record(client, tmp_path / "run.mcap"):
            await client.step()
        await client.sim.stop()
        await client.sim.start()
        console = ConsoleSession(client, recordings=tmp_path)
        set_mode = client.runtime.set_mode

        async def refuse(_: object) -> None:
            raise ModeLocked("mode_locked_by_server", "the project pins direct", op="set_mode")

        client.runtime.set_mode = refuse
        with pytest.raises(ModeLocked):
            await console.replay.begin(tmp_path / "run.mcap", placing=True)
        assert not console.replay.open
        client.runtime.set_mode = set_mode
        await console.replay.begin(tmp_path / "run.mcap", placing=True)
        await console.replay.end()
        assert client.step_mode == "direct"


async def test_bodies_are_shown_where_robots_and_other_things_are(tmp_path: Path) -> None:
    """A crate that falls is not in the local model's initial pose, and a door moves only as the server says."""

    def prop(name: str, settings: dict[str, bool]) -> dict[str, Any]:
        mesh = {"shape": "box", "size": [0.1, 0.1, 0.1]}
        place = {"location": [3, len(name), 1], "quick_convert": settings}
        return {"name": name, "kind": "static_mesh", "mesh": mesh, **place}

    level = tmp_path / "level.json"
    actors = [prop("crate", {}), prop("door", {"driven_by_unreal": True})]
    level.write_text(json.dumps({"format": "urlab-level", "version": 1, "blueprints": {}, "actors": actors}))
    async with (
        SimulatedServer("arm", level, play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct", live_pictures=False) as client,
    ):
        await client.discover()
        view = SharedView(client)
        viewer = MujocoViewer(client, view)
        shown = await viewer.shown()
        assert shown is not None
        assert viewer.latest() is None, "no state has come yet"
        shown.data.mocap_pos[:] = 9.0
        client.articulations["arm"].set_ctrl({"elbow": 1.0})
        async with client.state_stream("all") as states:
            await client.step(50)
            view.snapshot = await states.receive()
            while view.snapshot.time < client.sim_time:
                view.snapshot = await states.receive()
        assert viewer.latest() is shown
        assert client.data is not None
        assert np.allclose(shown.data.qpos, client.data.qpos)
        speeds = [joint.qvel_offset for joint in client.articulations["arm"].joints.values()]
        assert np.abs(client.data.qvel[speeds]).max() > 0.01
        assert np.allclose(shown.data.qvel[speeds], client.data.qvel[speeds])
        crate, door = (client.entities[name] for name in ("crate_MjBody", "door_MjBody"))
        assert shown.data.xpos[crate.body_id] == pytest.approx(crate.root_pos_w)
        assert shown.data.xpos[crate.body_id][2] < 0.99, "it falls"
        assert shown.data.xpos[door.body_id].tolist() == [3.0, 4.0, 1.0]


def test_curves_and_arrays_of_a_recording_are_files(http: TestClient, tmp_path: Path) -> None:
    size = len(http.get("/api/state").json()["articulations"]["quadruped"]["qpos"])
    recording(tmp_path / "recordings", "own.mcap", {"quadruped": size})
    (tmp_path / "own.npz").write_bytes(http.get("/api/recordings/own.mcap?as=npz").content)
    with np.load(tmp_path / "own.npz") as arrays:
        assert arrays["quadruped/qpos"].shape[1] == size
    assert not [one.name for one in (tmp_path / "recordings").iterdir() if one.name != "own.mcap"]


def test_an_outcome_needs_a_recording(http: TestClient) -> None:
    said = refusal(http.post("/api/recording/outcome", json={"outcome": "success"}))
    assert "no recording runs" in said
    assert "no recording runs" in refusal(http.delete("/api/recording"))


def test_an_unknown_field_of_a_request_is_refused_by_name(http: TestClient) -> None:
    for path, sent, unknown in (
        ("/api/replay", {"name": "own.mcap", "pace": 2}, "pace"),
        ("/api/recording", {"camera": False}, "camera"),
        ("/api/step", {"steps": 3}, "steps"),
        ("/api/run", {"running": False, "speed": 3}, "speed"),
    ):
        assert f"unknown field `{unknown}`" in refusal(http.post(path, json=sent))
    status = http.get("/api/status").json()
    assert (status["replay"], status["recording"]) == (None, None)


def test_without_play_there_is_nothing_to_record(http: TestClient) -> None:
    http.post("/api/ops/stop_pie", json={})
    answer = http.post("/api/recording", json={})
    refused = answer.json()["error"]
    assert (answer.status_code, refused["code"]) == (409, "refused")
    assert (refused["message"], refused["hint"]) == ("There is nothing to record.", "Begin play first.")
    assert http.post("/api/ops/begin_pie", json={}).json()["state"] == "ready"


def test_the_pace_of_the_simulation_is_shown(http: TestClient) -> None:
    """Simulation time per real time, over about a second; 0 while it stands still."""
    http.post("/api/ops/set_mode", json={"mode": "live"})
    http.post("/api/ops/set_sim_speed", json={"percent": 50})
    with http.websocket_connect("ws://localhost/api/live") as live:

        def told(wanted: Callable[[dict[str, Any]], bool]) -> None:
            while True:
                message = live.receive_json()
                if message["type"] == "state":
                    live.send_json({"type": "ack"})
                if message["type"] == "status" and wanted(message):
                    return

        http.post("/api/run", json={"running": True})
        told(lambda status: status["moving"] and 0.3 < status["rate"] < 0.7)
        http.post("/api/run", json={"running": False})
        told(lambda status: not status["moving"] and status["rate"] == 0.0)


@pytest.mark.parametrize(
    ("error", "status", "code", "message"),
    [
        (NotReady("not_ready", "compiling"), 409, "not_ready", "compiling"),
        (URLabTimeoutError("step: no reply", op="step"), 504, "timeout", "step: no reply"),
        (OutcomeUnknown("step: lost", op="step"), 502, "outcome_unknown", "step: lost"),
        (ConnectionLost("step: gone", op="step"), 503, "unreachable", "step: gone"),
        (URLabError("odd"), 409, "refused", "odd"),
        (ProtocolError("step: not msgpack", op="step"), 502, "failed", "step: not msgpack"),
        (FileNotFoundError(2, "No such file", "x"), 500, "io_failed", "[Errno 2] No such file: 'x'"),
        (ValueError("7 is too many"), 400, "bad_request", "7 is too many"),
    ],
)
def test_each_failure_has_its_status_and_code(error: Exception, status: int, code: str, message: str) -> None:
    found, said = explain_error(error)
    assert (found, said["code"], said["message"]) == (status, code, message)
    assert said["hint"] == (getattr(error, "hint", None) or "")
    assert explain_error(URLabError("odd", hint="Try again."))[1]["hint"] == "Try again."


def test_parts_of_the_model_have_bounds(http: TestClient) -> None:
    size = http.get("/viewer/model", params={"total_bytes": ""}).json()["total_bytes"]
    for part in ({"offset_bytes": -1}, {"size_bytes": -1}):
        assert "must not be negative" in refusal(http.get("/viewer/model", params=part))
    whole = http.get("/viewer/model").content
    assert len(whole) == size
    assert http.get("/viewer/model", params={"offset_bytes": 0, "size_bytes": 0}).content == b""
    assert http.get("/viewer/model", params={"offset_bytes": 3, "size_bytes": 4}).content == whole[3:7]
    assert http.get("/viewer/model", params={"offset_bytes": size - 1}).content == whole[-1:]
    assert refusal(http.get("/viewer/model", params={"crc32": "1"}), 404) == "The model has changed."


def test_only_its_own_pages_and_hosts_may_use_it(http: TestClient) -> None:
    strange = http.get("/api/status", headers={"host": "lab.example"})
    assert "does not serve the host 'lab.example', only " in refusal(strange, 403)
    assert strange.json()["error"]["code"] == "bad_host"
    page = {"origin": "http://evil.example"}
    assert http.get("/api/status", headers=page).status_code == 200
    other = http.post("/api/step", json={"n_steps": 1}, headers=page)
    assert refusal(other, 403) == "A page of 'http://evil.example' may not use this console."
    assert other.json()["error"]["code"] == "bad_origin"
    assert http.get("/healthz", headers={"host": "10.0.0.7"}).status_code == 200
    basic = http.get("/api/status", headers={"authorization": http.headers["authorization"].replace("Bearer", "Basic")})
    assert basic.status_code == 401
    assert basic.headers["www-authenticate"] == 'Bearer realm="URLab"'
    assert http.get("/", params={"token": "used"}, headers={"authorization": ""}).json()["error"]["code"] == "bad_token"


def test_a_body_has_a_limit(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    body = b'{"n_steps": 1}'
    monkeypatch.setattr(endpoints, "_LARGEST_BODY", len(body))
    assert http.post("/api/step", content=body).status_code == 200
    assert refusal(http.post("/api/step", content=body + b" ")) == f"a body is at most {len(body)} bytes"
