"""The HTTP and WebSocket API against a simulated server over real sockets."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import io
import json
import re
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from made_recordings import Message, Robot, messages_of, with_later_pictures, write_messages, write_recording
from PIL import Image
from starlette.applications import Starlette
from starlette.routing import Mount
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from waiting import attempts, eventually

from urlab_client.aio import URLabClient
from urlab_client.console import mujoco_viewer
from urlab_client.console.lease import DrivingLease, NotDriving, Viewer
from urlab_client.integrations.record import read_run
from urlab_client.protocol.registry import OPS
from urlab_client.server import ControllerConfig, SimulatedServer
from urlab_client.web import Access, app


@pytest.fixture(scope="module")
def server() -> Iterator[SimulatedServer]:
    with SimulatedServer("arm", play=True, unpaused=True, camera_size=(64, 48)) as running:
        yield running


def mounted(
    server: SimulatedServer,
    at: str,
    access: Access | None = None,
    recordings: str | Path = "recordings",
    **options: Any,
) -> Starlette:
    """Mount the console in an application of one's own, which owns the client."""
    client = URLabClient(**server.client_options(), **options)
    inner = app(client, access=access, lease_seconds=600.0, recordings=recordings)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        async with client, inner.router.lifespan_context(inner):
            yield

    outer = Starlette(routes=[Mount(at, inner)], lifespan=lifespan)
    outer.state.access = inner.state.access
    return outer


@pytest.fixture
def site(server: SimulatedServer, tmp_path: Path) -> Starlette:
    return mounted(server, "/", recordings=tmp_path / "recordings")


@pytest.fixture
def http(site: Starlette) -> Iterator[TestClient]:
    with TestClient(site, base_url="http://localhost") as client:
        key = client.post("/api/session", json={"token": site.state.access.invite()}).json()["key"]
        client.headers["authorization"] = f"Bearer {key}"
        with client.websocket_connect("ws://localhost/api/live") as live:
            heard(live, "world", lambda message: bool(message["world"]["articulations"]))
        yield client


def heard(live: Any, kind: str, wanted: Callable[[dict[str, Any]], bool] = lambda message: True) -> dict[str, Any]:
    """Return the first message of that kind that is as wanted; messages come at least twice a second."""
    for _ in range(2000):
        message = live.receive_json()
        if message["type"] == "state":
            live.send_json({"type": "ack"})
        if message["type"] == kind and wanted(message):
            return dict(message)
    raise AssertionError(f"no {kind} as wanted in 2000 messages")


def test_nothing_is_shown_without_a_key(site: Starlette) -> None:
    with TestClient(site, base_url="http://localhost") as client:
        assert client.get("/api/world").status_code == 401
        assert client.get("/").status_code == 401
        with pytest.raises(WebSocketDisconnect), client.websocket_connect("ws://localhost/api/live"):
            pass


def test_a_token_lets_one_browser_in_once(site: Starlette) -> None:
    token = site.state.access.invite()
    with TestClient(site, base_url="http://localhost", follow_redirects=False) as client:
        entered = client.get(f"/?token={token}")
        assert (entered.status_code, entered.headers["location"]) == (303, "/")
        assert "httponly" in entered.headers["set-cookie"].lower()
        assert "samesite=strict" in entered.headers["set-cookie"].lower()
        assert client.get("/").status_code == 200
        client.cookies.clear()  # another browser
        assert client.get(f"/?token={token}").status_code == 401
        assert client.get("/").status_code == 401


def test_other_hosts_and_origins_are_refused(http: TestClient) -> None:
    assert http.get("/api/world", headers={"host": "evil.example"}).json()["error"]["code"] == "bad_host"
    for origin in ("http://evil.example", "null", "http://localhost:1"):
        refused = http.post("/api/ops/set_paused", json={"paused": True}, headers={"origin": origin})
        assert refused.json()["error"]["code"] == "bad_origin"
        with (
            pytest.raises(WebSocketDisconnect),
            http.websocket_connect("ws://localhost/api/live", headers={"origin": origin}),
        ):
            pass
    assert http.post("/api/lease", headers={"origin": "http://localhost"}).status_code == 200


def test_openapi_describes_every_op_that_is_served(http: TestClient) -> None:
    document = http.get("/api/openapi.json").json()
    described = {path.removeprefix("/api/ops/") for path in document["paths"] if path.startswith("/api/ops/")}
    assert described == set(OPS) - {"hello"}
    speed = document["components"]["schemas"]["SetSimSpeed"]
    assert speed["required"] == ["percent"]
    assert set(speed["properties"]) == {"percent"}
    assert set(document["components"]["schemas"]["BeginPieOk"]["properties"]) == {"op", "state", "compile_error"}
    named = json.dumps(document).split('"#/components/schemas/')[1:]
    assert {part.partition('"')[0] for part in named} <= set(document["components"]["schemas"])


def test_openapi_describes_parameters_bodies_and_responses(http: TestClient) -> None:
    from jsonschema import Draft202012Validator
    from openapi_spec_validator import validate

    document = http.get("/api/openapi.json").json()
    validate(document)
    operations = {(method, path): said for path, of in document["paths"].items() for method, said in of.items()}
    ids = [said["operationId"] for said in operations.values()]
    assert len(ids) == len(set(ids))
    for (method, path), said in operations.items():
        named = {one["name"] for one in said.get("parameters", ()) if one["in"] == "path"}
        assert named == set(re.findall(r"\{(\w+)\}", path)), path
        assert (
            "requestBody" in said
            or method in {"get", "delete"}
            or path
            in {
                "/api/lease",
                "/api/connection",
                "/api/invitations",
            }
        )
    bodies = [json.dumps(said.get("requestBody")) for (_, path), said in operations.items() if "/ops/" not in path]
    named = {name for body in bodies for name in re.findall(r"schemas/(\w+)", body)}
    assert [name for name in named if document["components"]["schemas"][name]["additionalProperties"]] == []
    assert operations["post", "/api/run"]["requestBody"]["required"]
    assert not operations["post", "/api/step"]["requestBody"]["required"], "one step without"
    for path in ("world", "status", "log", "state", "bodies", "bodies/{id}", "explain", "recordings"):
        told = operations["get", f"/api/{path}"]["responses"]["200"]["content"]["application/json"]["schema"]
        validator = Draft202012Validator({**told, "components": document["components"]})
        validator.validate(http.get(f"/api/{path.format(id=1)}").json())


@pytest.mark.opengl
def test_asyncapi_describes_every_message_of_the_websockets(http: TestClient) -> None:
    from jsonschema import Draft202012Validator

    document = http.get("/api/asyncapi.json").json()
    assert document["servers"]["console"]["host"] == "localhost"
    components = document["components"]

    def check(kind: str, message: Any) -> None:
        validator = Draft202012Validator({**components["messages"][kind]["payload"], "components": components})
        validator.validate(message)

    named = json.dumps(document).split('"#/')[1:]
    for reference in (part.partition('"')[0].split("/") for part in named):
        found = document
        for key in reference:
            found = found[key]
    http.post("/api/run", json={"running": True})
    http.delete("/api/lease")
    seen: set[str] = set()
    with http.websocket_connect("ws://localhost/api/live") as live:
        for said in ({"type": "ping", "at": 1.0}, {"type": "name", "name": "Ann"}, {"type": "ctrl", "values": {}},
                     {"type": "ack"}):  # fmt: skip
            check(said["type"], said)
            live.send_json(said)
        live.send_json({"type": "shout"})
        for _ in attempts("not all kinds of messages came"):
            message = live.receive_json()
            check(message["type"], message)
            seen.add(message["type"])
            if message["type"] == "refused":
                assert "shout" in message["error"]["message"]
            elif message["type"] == "pong":
                assert (message["at"], message["now"]) == (1.0, pytest.approx(1e3 * time.time(), abs=60e3))
            if seen == {"you", "world", "state", "status", "log", "refused", "pong"}:
                break
    with http.websocket_connect("ws://localhost/api/cameras/arm/wrist/live") as camera:
        frame = camera.receive_bytes()
    head = json.loads(frame[4 : 4 + int.from_bytes(frame[:4], "little")])
    Draft202012Validator(components["schemas"]["PictureHead"]).validate(head)


def test_openapi_says_where_it_is_mounted(server: SimulatedServer) -> None:
    for proxy in ("", "/behind/proxy"):
        outer = mounted(server, "/lab", Access(hosts=["robots.example"], tokens=False))
        with TestClient(outer, base_url="http://robots.example", root_path=proxy) as client:
            told = client.get(f"{proxy}/lab/api/openapi.json").json()
        assert told["servers"] == [{"url": f"{proxy}/lab"}]


def test_it_says_why_a_robot_does_not_move(http: TestClient) -> None:
    http.post("/api/run", json={"running": False})
    findings = http.get("/api/explain").json()["findings"]
    assert any(finding["verdict"] == "problem" and "paused" in finding["text"] for finding in findings)


def test_an_op_is_done_and_a_refusal_is_said(http: TestClient) -> None:
    assert http.post("/api/ops/set_sim_speed", json={"percent": 300}).json()["percent"] == 100
    wrong = http.post("/api/ops/set_sim_speed", json={"percent": "fast"})
    assert (wrong.status_code, wrong.json()["error"]["code"]) == (400, "bad_request")
    assert "$.percent" in wrong.json()["error"]["message"]
    refused = http.post("/api/ops/set_twist", json={"articulation": "nobody"})
    assert (refused.status_code, refused.json()["error"]["code"]) == (409, "unknown_articulation")
    assert http.post("/api/ops/hello", json={}).status_code == 404
    logged = [(entry["kind"], entry["what"]) for entry in http.get("/api/log").json()]
    assert ("call", "set_sim_speed") in logged
    assert ("error", "set_twist") in logged


def test_set_points_move_joints_and_stay_when_unknown(http: TestClient) -> None:
    http.post("/api/run", json={"running": True})
    assert http.post("/api/ctrl", json={"arm": {"elbow": 0.5, "no_such": 1.0}}).status_code == 400
    assert http.post("/api/ctrl", json={"arm": {"elbow": 0.5}}).status_code == 200
    with http.websocket_connect("ws://localhost/api/live") as live:
        index = next(
            joint["index"]
            for joint in heard(live, "world")["world"]["articulations"][0]["joints"]
            if joint["name"] == "elbow"
        )
        moved = heard(live, "state", lambda state: abs(state["articulations"]["arm"]["qpos"][index] - 0.5) < 0.02)
        assert moved["articulations"]["arm"]["targets"][2] == 0.5


@pytest.mark.long
def test_a_hand_moves_for_a_moment_and_episodes_are_judged(http: TestClient, tmp_path: Path) -> None:
    def hand(live: Any) -> np.ndarray:
        state = heard(live, "state")
        return np.array(state["articulations"]["arm"]["sensors"]["grip_position"])

    def at_rest(live: Any) -> np.ndarray:
        for _ in attempts("the hand moves on"):
            state = heard(live, "state")
            then = state["time"] + 0.1
            later = heard(live, "state", lambda one, then=then: one["time"] > then)
            places = [np.array(one["articulations"]["arm"]["sensors"]["grip_position"]) for one in (state, later)]
            if np.abs(places[1] - places[0]).max() < 1e-4:
                return places[1]
        raise AssertionError

    with (
        http.websocket_connect("ws://localhost/api/live") as live,
        http.websocket_connect("ws://localhost/api/live") as other,
    ):
        me = {"X-URLab-Viewer": heard(live, "you")["viewer"]}
        http.post("/api/run", json={"running": True}, headers=me)
        http.post("/api/ops/reset", json={}, headers=me)
        refused = http.post("/api/recording/outcome", json={"outcome": "success"}, headers=me).json()
        assert "no recording runs" in refused["error"]["message"]
        assert http.post("/api/recording", json={"cameras": False}, headers=me).status_code == 200
        before = at_rest(live)
        order = {"type": "hand", "articulation": "arm", "linear": [0.0, 0.0, -1.0], "gripper": 1.0}
        for _ in attempts("the hand does not move down"):
            live.send_json(order)
            if hand(live)[2] <= before[2] - 0.05:
                break
        other.send_json(order)
        assert heard(other, "refused")["error"]["code"] == "not_driving"
        last = at_rest(live)  # nobody says more: it stops by itself
        assert 0.05 < before[2] - last[2] < 0.05 + 0.25 * (0.25 + 0.1) + 0.1
        assert last[:2] == pytest.approx(before[:2], abs=0.01)
        targets = heard(live, "state")["articulations"]["arm"]["targets"]
        assert targets[6] > 0.0
        http.post("/api/ops/reset", json={}, headers=me)
        home = at_rest(live)
        live.send_json({**order, "linear": [0.0, 0.0, 1e-3]})
        assert at_rest(live) == pytest.approx(home, abs=0.02), "from where it is, and not from where it was driven"
        for wrong, said in (
            ({"articulation": "leg"}, "leg"),
            ({"site": "toe"}, "no site 'toe'"),
            ({"linear": [1.0, 0.0]}, "Expected `array` of length 3"),
        ):
            live.send_json({**order, **wrong})
            assert said in heard(live, "refused")["error"]["message"]
        assert http.post("/api/recording/outcome", json={"outcome": "won"}, headers=me).status_code == 400
        assert http.post("/api/recording/outcome", json={"outcome": "success"}, headers=me).status_code == 200
        name = http.delete("/api/recording", headers=me).json()["name"]
    marks = read_run(tmp_path / "recordings" / name).summary().outcomes
    assert [mark.outcome for mark in marks] == ["success"]


def test_states_are_dropped_and_not_queued_for_a_viewer_that_is_busy(http: TestClient) -> None:
    http.post("/api/run", json={"running": True})
    with (
        http.websocket_connect("ws://localhost/api/live") as busy,
        http.websocket_connect("ws://localhost/api/live") as quick,
    ):
        messages = (busy.receive_json() for _ in attempts("no state came"))
        states = (message["seq"] for message in messages if message["type"] == "state")
        _, last = next(states), next(states)  # takes two, and says nothing of having shown them
        ahead = heard(quick, "state", lambda state: state["seq"] > last + 30)["seq"]
        busy.send_json({"type": "ack"})
        assert heard(busy, "state")["seq"] >= ahead


@pytest.mark.parametrize("path", ["/api/live", "/api/cameras/arm/wrist/live"])
def test_a_binary_frame_closes_its_socket_and_no_other(http: TestClient, path: str) -> None:
    with http.websocket_connect("ws://localhost/api/live") as other:
        with http.websocket_connect(f"ws://localhost{path}") as socket:
            socket.send_bytes(b"\x00")
            messages = (socket.receive() for _ in attempts("the socket was not closed"))
            assert next(said for said in messages if said["type"] == "websocket.close")["code"] == 1003
        heard(other, "status")


def test_the_states_of_the_last_seconds_are_kept(http: TestClient) -> None:
    def kept(after: float | None = None) -> list[float]:
        found = http.get("/api/states", params={} if after is None else {"after": after}).json()["states"]
        return [state["time"] for state in found]

    http.post("/api/ops/set_paused", json={"paused": False})
    with http.websocket_connect("ws://localhost/api/live") as live:
        seen = [heard(live, "state")["time"] for _ in range(20)]
        http.post("/api/ops/set_paused", json={"paused": True})
        heard(live, "status", lambda status: not status["moving"])
        times = kept()
        assert times == sorted({*times})
        assert {*seen} <= {*times}
        assert kept(times[3]) == times[4:]
        http.post("/api/ops/reset", json={})
        heard(live, "state", lambda state: state["time"] < seen[-1])
        assert kept() == [0.0], "those of another run are gone"


def test_a_message_too_deep_to_read_is_refused(http: TestClient) -> None:
    deep = '{"type": "name", "more": ' + "[" * 100_000 + "]" * 100_000 + "}"
    with http.websocket_connect("ws://localhost/api/live") as live:
        live.send_text(deep)
        assert heard(live, "refused")["error"]["code"] == "bad_request"
    assert http.post("/api/step", content=deep).status_code == 400


def test_one_drives_and_the_others_wait(http: TestClient) -> None:
    with (
        http.websocket_connect("ws://localhost/api/live") as one,
        http.websocket_connect("ws://localhost/api/live") as two,
    ):
        found = [heard(live, "you") for live in (one, two)]
        names, (first, second) = [you["name"] for you in found], [{"x-urlab-viewer": you["viewer"]} for you in found]
        assert http.post("/api/lease", headers=first).json()["mine"]
        refused = http.post("/api/ops/reset", json={}, headers=second)
        assert (refused.status_code, refused.json()["error"]["code"]) == (423, "not_driving")
        two.send_json({"type": "ctrl", "values": {"arm": {"elbow": 1.0}}})
        assert heard(two, "refused")["error"]["code"] == "not_driving"
        status = heard(two, "status", lambda status: status["driver"] is not None)
        assert not status["mine"]
        assert http.post("/api/ops/list_keyframes", json={}, headers=second).status_code == 200
        assert http.post("/api/run", json={"running": False}, headers=second).status_code == 200, "everybody may stop"
        assert http.post("/api/lease", headers=second).status_code == 423
        http.delete("/api/lease", headers=second)
        assert http.post("/api/lease", headers=first).json()["mine"]
        http.delete("/api/lease", headers=first)
        assert http.post("/api/ops/reset", json={}, headers=second).status_code == 200
        log = [(one["who"], one["what"]) for one in http.get("/api/log").json() if "controls" in one["what"]]
        assert log[-2:] == [(names[0], "take the controls"), (names[0], "release the controls")], (
            "and nothing that failed"
        )


@pytest.mark.opengl
def test_direct_mode_steps_and_shows_what_cameras_see(http: TestClient) -> None:
    try:
        assert http.post("/api/ops/set_mode", json={"mode": "direct"}).json()["current_mode"] == "direct"
        assert http.post("/api/step", json={"n_steps": 7}).json()["step"] == 7
        assert http.post("/api/step", json={"n_steps": 3}).json()["step"] == 10
        http.post("/api/run", json={"running": True})
        with http.websocket_connect("ws://localhost/api/live") as live:
            heard(live, "state", lambda state: state["step"] > 30)
        with http.websocket_connect("ws://localhost/api/cameras/arm/wrist/live") as camera:
            (first, _), (second, jpeg) = picture_in(camera), picture_in(camera)
        assert second["mode"] == "real"
        assert second["received"] > first["received"]
        assert Image.open(io.BytesIO(jpeg)).size == (64, 48)
        http.post("/api/run", json={"running": False})
        assert http.post("/api/step", json={"n_steps": -1}).status_code == 400
    finally:
        http.post("/api/ops/set_mode", json={"mode": "live"})
    refused = http.post("/api/step", json={"n_steps": 1})
    assert "direct" in refused.json()["error"]["message"]


def picture_in(socket: Any) -> tuple[dict[str, Any], bytes]:
    """Return the next picture of a camera: its head, and the JPEG."""
    data = socket.receive_bytes()
    socket.send_text("shown")
    size = int.from_bytes(data[:4], "little")
    return json.loads(data[4 : 4 + size]), data[4 + size :]


def picture_of(socket: Any, time: float) -> tuple[dict[str, Any], bytes]:
    """Return the next picture of a moment, in seconds."""
    pictures = (picture_in(socket) for _ in attempts(f"no picture of {time} s came"))
    return next(picture for picture in pictures if picture[0]["sim_time"] == pytest.approx(time, abs=1e-6))


def test_the_world_shows_the_controller_of_a_robot() -> None:
    with SimulatedServer("arm", play=True, controllers={"arm": ControllerConfig(kp=40.0)}) as server:
        site = mounted(server, "/", access=Access(tokens=False))
        with TestClient(site, "http://localhost") as http, http.websocket_connect("ws://localhost/api/live") as live:
            world = heard(live, "world", lambda message: bool(message["world"]["articulations"]))["world"]
    (arm,) = world["articulations"]
    assert arm["controller"]["kind"] == "pd"
    assert set(arm["controller"]["params"]["kp"].values()) == {40.0}
    assert arm["controller"]["schema"]["kp"]["type"] == "per_joint"


@pytest.mark.opengl
def test_a_recording_is_made_converted_replayed_in_seconds_and_removed(
    server: SimulatedServer, http: TestClient, tmp_path: Path
) -> None:
    def elbow(state: dict[str, Any]) -> float:
        return float(state["articulations"]["arm"]["qpos"][place])

    art = http.get("/api/world").json()["articulations"][0]
    place = next(joint["index"] for joint in art["joints"] if joint["name"] == "elbow")
    http.post("/api/run", json={"running": False})
    http.post("/api/ops/set_mode", json={"mode": "direct"})
    http.post("/api/ops/reset", json={})
    try:
        assert http.post("/api/replay", json={"time": 0.1}).status_code == 400
        assert http.delete("/api/recording").status_code == 400
        name = http.post("/api/recording", json={"cameras": True}).json()["name"]
        assert http.post("/api/recording", json={}).status_code == 400, "one at a time"
        assert http.get("/api/status").json()["recording"]["name"] == name
        assert "is being recorded" in http.delete(f"/api/recordings/{name}").json()["error"]["message"]
        http.post("/api/ctrl", json={"arm": {"elbow": -0.4}})
        for _ in range(10):
            http.post("/api/step", json={"n_steps": 100})
        eventually(
            lambda: http.get("/api/status").json()["recording"]["seconds"] == 1.8
        )  # of its clock, like the length
        made = http.delete("/api/recording").json()
        assert made["seconds"] == pytest.approx(1.8, abs=0.01), "ten steps of 0.2 s, of which each is one state"
        assert made["states"] == 10
        assert (made["robots"], made["damage"], made["lost"]) == (["arm"], "", 0)
        noted = [entry["text"] for entry in http.get("/api/log").json() if entry["what"] == "record"]
        assert noted[0] == name
        assert http.get("/api/recordings").json()["recordings"][0]["name"] == name

        file = tmp_path / name
        file.write_bytes(http.get(f"/api/recordings/{name}").content)
        table = read_run(file).table()
        rows = http.get(f"/api/recordings/{name}?as=csv").text.splitlines()
        assert rows[0].startswith("time,sim_time")
        assert len(rows) == len(table)  # a header, and a row for each state but the last, which no action follows
        camera = made["cameras"][0]
        film = http.get(f"/api/recordings/{name}?as=mp4&camera={camera}")
        assert b"ftyp" in film.content[:16]
        assert f"-{camera.replace('/', '-')}.mp4" in film.headers["content-disposition"]
        assert http.get(f"/api/recordings/{name}?as=mp4&camera=none").status_code == 400
        for wrong in ("none.mcap", "..%2F..%2Fetc%2Fpasswd", "a.txt"):
            assert http.get(f"/api/recordings/{wrong}").status_code in {400, 404}

        column = table.columns["arm/qpos"]
        recorded = column.values[:, column.names.index("elbow")]
        live = elbow(http.get("/api/state").json())
        http.post("/api/replay", json={"name": name, "playing": False})
        for wanted, row in ((0.0, 0), (1.0, 5), (99.0, -1), (0.39, 1)):
            view = http.post("/api/replay", json={"time": wanted}).json()
            assert view["time"] == pytest.approx(min(wanted, view["seconds"]))
            state = http.get("/api/state").json()
            assert elbow(state) == pytest.approx(recorded[row], abs=1e-4)
            assert state["time"] == pytest.approx(table.time[row] - table.time[0])
        assert abs(recorded[0] - live) > 0.03
        http.post("/api/replay", json={"time": 1.0})
        past = http.get("/api/replay/states?seconds=0.5").json()["states"]
        assert [elbow(state) for state in past] == pytest.approx(recorded[2:6], abs=1e-4), "those of the curves"
        pictures = list(read_run(file).frames(camera))
        with http.websocket_connect(f"ws://localhost/api/cameras/{camera}/live") as watching:
            for wanted in (pictures[4], pictures[0], pictures[-1]):
                http.post("/api/replay", json={"time": wanted.time - table.time[0]})
                head, shown = picture_of(watching, wanted.time - table.time[0])
                assert head["recorded"]
                assert np.array_equal(np.asarray(Image.open(io.BytesIO(shown))), wanted.pixels)
        refused = http.delete(f"/api/recordings/{name}")
        assert "go back to live" in refused.json()["error"]["message"]
        http.post("/api/replay", json={"time": 0.0, "playing": True, "rate": 4})
        with http.websocket_connect("ws://localhost/api/live") as viewer:
            heard(viewer, "status", lambda status: status["replay"]["playing"] and status["rate"] == 4)
            assert heard(viewer, "state")["recorded"]
            ended = heard(viewer, "status", lambda status: not status["replay"]["playing"])
            assert ended["replay"]["time"] == pytest.approx(1.8, abs=0.01)
            http.delete("/api/replay")
            http.post("/api/step", json={"n_steps": 1})
            heard(
                viewer, "state", lambda state: elbow(state) == pytest.approx(live, abs=0.01) and not state["recorded"]
            )

        http.post("/api/replay", json={"name": name, "placing": True, "playing": False})
        assert http.get("/api/status").json()["mode"] == "puppet"
        for wanted, row in ((1.0, 5), (0.0, 0), (0.39, 1)):
            http.post("/api/replay", json={"time": wanted})
            placed = http.post("/api/ops/forward", json={}).json()["per_articulation"]["arm"]["qpos"][place]
            assert placed == pytest.approx(recorded[row], abs=1e-4)
        http.post("/api/replay", json={"time": 0.0, "playing": True})
        for _ in attempts("the robots are not placed while it plays"):
            placed = http.post("/api/ops/forward", json={}).json()["per_articulation"]["arm"]["qpos"][place]
            if placed == pytest.approx(recorded[-1], abs=1e-4):
                break
        http.delete("/api/replay")
        assert http.get("/api/status").json()["mode"] == "direct"
        reached = http.post("/api/ops/forward", json={}).json()["per_articulation"]["arm"]["qpos"][place]
        assert reached == pytest.approx(live, abs=0.01), "the simulation is where it was before the replay"

        with_later_pictures(file, tmp_path / "late.mcap", 1)
        assert http.put("/api/recordings/late.mcap", content=(tmp_path / "late.mcap").read_bytes()).status_code == 200
        end = http.post("/api/replay", json={"name": "late.mcap", "playing": False}).json()["seconds"]
        with http.websocket_connect(f"ws://localhost/api/cameras/{camera}/live") as watching:
            http.post("/api/replay", json={"time": end})
            picture_of(watching, pictures[-1].time - table.time[0])
        http.delete("/api/replay")
        http.delete("/api/recordings/late.mcap")

        cut = http.put("/api/recordings/cut.mcap", content=file.read_bytes()[:-100])
        assert cut.json()["damage"] == "the end of the file is missing"
        assert http.post("/api/replay", json={"name": "cut.mcap"}).json()["damage"] == cut.json()["damage"]
        assert http.post("/api/replay", json={"name": name}).json()["damage"] == ""
        http.delete("/api/replay")
        http.delete("/api/recordings/cut.mcap")

        taken = http.put("/api/recordings/other.mcap", content=file.read_bytes())
        assert taken.json()["seconds"] == made["seconds"]
        assert http.put("/api/recordings/other.mcap", content=b"").status_code == 400, "the name is taken"
        assert http.put("/api/recordings/broken.mcap", content=b"nonsense").status_code == 409
        assert {one["name"] for one in http.get("/api/recordings").json()["recordings"]} == {name, "other.mcap"}
        for one in (name, "other.mcap"):
            assert http.delete(f"/api/recordings/{one}").status_code == 200
        assert http.get("/api/recordings").json()["recordings"] == []
    finally:
        http.post("/api/ops/set_mode", json={"mode": "live"})


def test_a_recording_of_wrong_contents_costs_its_reader_an_explanation(http: TestClient, tmp_path: Path) -> None:
    poses = [({"arm": Robot([angle, *[0.0] * 7])}, {}) for angle in (0.0, 0.1, 0.2)]
    write_recording(tmp_path / "good.mcap", poses)
    good = messages_of(tmp_path / "good.mcap")
    _, middle, last = (one._replace(data=one.data.replace(b'"sample":', b'"sample":"one","x":')) for one in good)
    bomb = good[2]._replace(data=b" " * (150 << 20) + good[2].data)

    def put(content: list[Message]) -> Any:
        file = write_messages(tmp_path / "odd.mcap", content)
        return http.put("/api/recordings/odd.mcap", content=file.read_bytes())

    for content, said in (
        ([good[0], good[1], last], "message 3 of /state/arm cannot be read: Expected `int`, got `str`"),
        ([good[0], good[1], bomb], "unpacks to 157"),
    ):
        refused = put(content)
        assert refused.status_code == 409
        assert said in refused.json()["error"]["message"]
    try:
        assert put([good[0], middle, good[2]]).status_code == 200
        assert http.post("/api/replay", json={"name": "odd.mcap", "playing": False}).status_code == 200
        for tried in (
            http.post("/api/replay", json={"time": 0.01}),
            http.get("/api/replay/states?seconds=1"),
            http.get("/api/recordings/odd.mcap?as=csv"),
        ):
            assert (tried.status_code, "message 2 of /state/arm" in tried.json()["error"]["message"]) == (409, True)
        assert http.post("/api/replay", json={"time": 0.02}).json()["time"] == 0.02
    finally:
        http.delete("/api/replay")
        http.delete("/api/recordings/odd.mcap")


def test_a_replay_that_is_at_its_end_plays_from_the_start(http: TestClient, tmp_path: Path) -> None:
    poses = [({"arm": Robot([angle, *[0.0] * 7])}, {}) for angle in np.linspace(0.0, 1.0, 101).tolist()]
    write_recording(tmp_path / "odd.mcap", poses, period_ns=10_000_001)  # 1.0000001 s
    assert http.put("/api/recordings/odd.mcap", content=(tmp_path / "odd.mcap").read_bytes()).status_code == 200
    try:
        view = http.post("/api/replay", json={"name": "odd.mcap", "playing": False}).json()
        http.post("/api/replay", json={"time": view["seconds"]})
        assert http.get("/api/state").json()["articulations"]["arm"]["qpos"][0] == 1.0
        again = http.post("/api/replay", json={"playing": True}).json()
        assert again["playing"]
        assert again["time"] < 0.5
    finally:
        http.delete("/api/replay")
        http.delete("/api/recordings/odd.mcap")


@pytest.mark.opengl
def test_pictures_come_as_files_too_while_running_paused_and_stepped(http: TestClient) -> None:
    def shown(kind: str) -> tuple[int, int]:
        answer = http.get(f"/api/cameras/arm/overview.{kind}")
        assert answer.status_code == 200, answer.text
        assert answer.headers["content-type"] == {"jpg": "image/jpeg", "png": "image/png"}[kind]
        return Image.open(io.BytesIO(answer.content)).size

    try:
        for prepare in (
            lambda: http.post("/api/run", json={"running": True}),
            lambda: http.post("/api/run", json={"running": False}),
            lambda: http.post("/api/ops/set_mode", json={"mode": "direct"}),
        ):
            prepare()
            assert shown("jpg") == shown("png") == (64, 48)
    finally:
        http.post("/api/ops/set_mode", json={"mode": "live"})
    for kind in ("jpg", "png"):
        assert http.get(f"/api/cameras/arm/nothing.{kind}").status_code == 404


def test_a_mujoco_without_its_viewer_is_named_and_bodies_do_not_need_it(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mujoco_viewer, "files", lambda: None)
    monkeypatch.setattr(mujoco_viewer, "_payload", lambda: None)
    http: TestClient = request.getfixturevalue("http")  # describes the world when it has connected
    assert f"MuJoCo {mujoco.__version__} has no web viewer" in http.get("/api/world").json()["no_view"]
    with http.websocket_connect("ws://localhost/api/live") as live:
        heard(live, "state")
        assert "hand" in {one["name"] for one in http.get("/api/bodies").json()["bodies"]}


def test_the_viewer_gets_the_model_and_the_state_that_is_shown(http: TestClient) -> None:
    import mujoco
    from mujoco.studio.web import state_payload

    http.post("/api/run", json={"running": True})
    http.post("/api/ctrl", json={"arm": {"elbow": 0.7}})
    assert http.get("/viewer/").status_code == 200
    size = http.get("/viewer/model?total_bytes").json()["total_bytes"]
    half = size // 2
    parts = [http.get(f"/viewer/model?offset_bytes={at}&size_bytes={half + 1}").content for at in (0, half + 1)]
    binary, *_ = state_payload.parse_model_bundle(b"".join(parts))
    assert len(b"".join(parts)) == size
    assert http.get("/viewer/model?offset_bytes=half").status_code == 400
    assert http.get("/viewer/model?crc32=1").status_code == 404
    with (
        http.websocket_connect("ws://localhost/viewer/state") as viewer,
        http.websocket_connect("ws://localhost/api/live") as live,
    ):
        assert "role=spectator" in viewer.receive_text()
        layout = viewer.receive_text()
        assert layout.startswith("layout=")
        # What a page needs to have a camera, a selection, overlays and a pull of its own.
        wanted = {"camera", "select", "active", "localpos", "refselpos", "frame", "contacts", "fovy"}
        assert wanted <= json.loads(layout.removeprefix("layout=")).keys()
        viewer.receive_bytes()
        viewer.receive_bytes()  # two on their way, and no more before it says that one came
        moved = heard(live, "state", lambda state: abs(state["articulations"]["arm"]["qpos"][2] - 0.7) < 0.02)
        viewer.send_text("force_control")  # MuJoCo's own; heard and not heeded
        viewer.send_text("state_ack")
        payload = viewer.receive_bytes()
        qpos = moved["articulations"]["arm"]["qpos"]
        near = [
            np.allclose(np.frombuffer(payload, np.float64, len(qpos), at), qpos, atol=0.03)
            for at in range(len(payload) - 8 * len(qpos))
        ]
        assert any(near)
    assert mujoco.MjModel.from_binary_path("m.mjb", {"m.mjb": binary}).nq == len(qpos)
    with pytest.raises(WebSocketDisconnect) as taken, http.websocket_connect("ws://localhost/viewer/ui") as panels:
        panels.receive_text()
    assert taken.value.code == 4001


def test_a_body_is_found_by_a_ray_and_pushed_by_who_drives(http: TestClient) -> None:
    with http.websocket_connect("ws://localhost/api/live") as live:
        heard(live, "state")
        found = http.get("/api/bodies").json()
        hand = next(one for one in found["bodies"] if one["name"] == "hand")
        assert hand["robot"] == "arm"
        assert hand["mass"] > 0
        assert np.linalg.norm(np.array(hand["position"]) - found["center"]) < found["radius"] < 0.9
        above = [hand["position"][0], hand["position"][1], 3.0]
        picked = http.post("/api/pick", json={"origin": above, "direction": [0, 0, -1]}).json()
        assert picked["body"]["robot"] == "arm"
        assert http.post("/api/pick", json={"origin": above, "direction": [0, 0, 1]}).json()["body"] is None
        up = {"body": hand["id"], "local": [0, 0, 0], "target": [hand["position"][0], 0.0, hand["position"][2] + 0.5]}
        refused = http.post("/api/push", json=up)
        assert refused.status_code == 400
        assert "direct mode" in refused.json()["error"]["message"]
        http.post("/api/ops/set_mode", json={"mode": "direct"})
        try:
            began = http.post("/api/step", json={"n_steps": 10}).json()["time"]
            for _ in range(40):
                assert http.post("/api/push", json=up).status_code == 200
                http.post("/api/step", json={"n_steps": 5})
            heard(live, "state", lambda state: state["time"] > began + 0.3)
            assert http.get(f"/api/bodies/{hand['id']}").json()["position"][2] > hand["position"][2] + 0.005
            assert http.delete("/api/push").status_code == 200
            with http.websocket_connect("ws://localhost/api/live") as two:
                other = {"x-urlab-viewer": heard(two, "you")["viewer"]}
                assert http.post("/api/push", json=up, headers=other).status_code == 423
            assert http.post("/api/push", json={**up, "body": 999}).status_code == 400
            http.post("/api/ops/set_mode", json={"mode": "puppet"})
            assert "fixed to the world" in http.post("/api/push", json=up).json()["error"]["message"]
        finally:
            http.post("/api/ops/set_mode", json={"mode": "live"})


def test_the_viewer_is_behind_the_same_door(site: Starlette, http: TestClient) -> None:
    evil = {"origin": "http://evil.example"}
    with pytest.raises(WebSocketDisconnect), http.websocket_connect("ws://localhost/viewer/state", headers=evil):
        pass
    assert http.get("/viewer/model", headers={"host": "evil.example"}).status_code == 403
    del http.headers["authorization"]
    for path in ("/viewer/", "/viewer/model", "/viewer/web_client.wasm", "/viewer/assets/ibl.ktx"):
        assert http.get(path).status_code == 401
    with pytest.raises(WebSocketDisconnect), http.websocket_connect("ws://localhost/viewer/state"):
        pass


class Inline(HTMLParser):
    """The scripts and handlers inside a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.code: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.code += [value for name, value in attrs if name.startswith("on") and value]
        if tag == "script" and not dict(attrs).get("src"):
            self.code.append("")

    def handle_data(self, data: str) -> None:
        if self.get_starttag_text() == "<script>" and self.cdata_elem == "script":
            self.code[-1] += data


def test_the_viewer_s_policy_admits_what_its_page_runs_and_nothing_else_inline(http: TestClient) -> None:
    page = http.get("/viewer/")
    inline = Inline(page.text).code
    digests = {base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in inline}
    policy = page.headers["content-security-policy"]
    assert len(digests) > 1
    assert set(re.findall(r"'sha256-([^']*)'", policy)) == digests
    assert "script-src 'self' 'unsafe-eval' 'unsafe-hashes' 'sha256-" in policy
    assert "'unsafe-inline'" not in policy.partition("script-src")[2].partition(";")[0]


def test_the_viewer_s_files_are_sent_once(http: TestClient) -> None:
    page = http.get("/viewer/")
    assert "unsafe-eval" in page.headers["content-security-policy"]
    assert "unsafe" not in http.get("/").headers["content-security-policy"]
    script = http.get("/viewer/web_client.js")
    again = http.get("/viewer/web_client.js", headers={"if-none-match": script.headers["etag"]})
    assert (script.status_code, again.status_code) == (200, 304)
    for large in ("viewer/web_client.wasm", "viewer/assets/pbr.filamat", "static/bar.js", "static/style.css"):
        sent = http.get(f"/{large}", headers={"accept-encoding": "gzip"})
        assert sent.headers["content-encoding"] == "gzip", large


def test_another_program_takes_over_and_the_console_takes_it_back(http: TestClient, server: SimulatedServer) -> None:
    from urlab_client import URLabClient as Blocking

    with http.websocket_connect("ws://localhost/api/live") as live:
        heard(live, "status", lambda status: status["link"]["state"] == "connected")
        with Blocking(**server.client_options()) as other:
            other.discover()
            http.post("/api/ops/list_keyframes", json={})
            heard(live, "status", lambda status: status["link"]["state"] == "taken_over")
            heard(live, "state")
        http.post("/api/connection", json={})
        heard(live, "status", lambda status: status["link"]["state"] == "connected")


@pytest.mark.parametrize("mode", ["direct", "puppet"])
def test_a_session_that_is_taken_back_has_the_step_mode_that_it_had(
    http: TestClient, server: SimulatedServer, mode: str
) -> None:
    from urlab_client import URLabClient as Blocking

    with http.websocket_connect("ws://localhost/api/live") as live:
        heard(live, "status", lambda status: status["link"]["state"] == "connected" and status["mode"] == "live")
        with Blocking(**server.client_options()) as other:
            other.discover()
            other.runtime.set_mode(mode)
            http.post("/api/ops/list_keyframes", json={})
            heard(live, "status", lambda status: status["link"]["state"] == "taken_over")
        heard(live, "status", lambda status: not status["moving"])
        http.post("/api/connection", json={})
        heard(live, "status", lambda status: status["link"]["state"] == "connected")
        status = http.get("/api/status").json()
        assert (status["mode"], status["running"]) == ("live", False), "physics that stood still stands still"
        (entry,) = [one for one in http.get("/api/log").json() if one["what"] == "restore_mode"]
        assert json.loads(entry["text"]) == {"mode": "live"}
        assert http.post("/api/ops/set_paused", json={"paused": False}).status_code == 200
        heard(live, "status", lambda status: status["running"])


def test_it_can_be_mounted_in_a_backend_that_has_its_own_door(server: SimulatedServer) -> None:
    outer = mounted(server, "/lab", Access(hosts=["robots.example"], tokens=False))
    with TestClient(outer, base_url="http://robots.example") as client:
        page = client.get("/lab/")
        assert page.status_code == 200
        assert client.get("/lab/static/main.js").status_code == 200
        assert client.get("/lab/api/status").json()["address"] == server.address


def test_the_controls_are_lost_by_not_using_them() -> None:
    now = 0.0
    lease = DrivingLease(10.0, clock=lambda: now)
    ann, bob = Viewer("a", "Ann"), Viewer("b", "Bob")
    lease.use(ann)
    now = 9.0
    with pytest.raises(NotDriving, match="Ann"):
        lease.use(bob)
    lease.use(ann)
    now = 18.9
    lease.release(bob)
    assert lease.holder is ann
    now = 19.0
    assert lease.holder is None
    lease.use(bob)
    assert lease.holder is bob


async def test_controls_that_were_taken_while_a_block_waited_are_not_taken_back() -> None:
    lease = DrivingLease(10.0, clock=lambda: 0.0)
    agent, ann = Viewer("a", "agent", yields=True), Viewer("b", "Ann")
    ran: list[str] = []

    async def waiting() -> None:
        async with lease.hold(agent):
            ran.append("agent")

    async with lease._one:  # an earlier block is cleaning up
        second = asyncio.create_task(waiting())
        await asyncio.sleep(0)
        assert lease.holder is agent
        lease.use(ann)
    with pytest.raises(NotDriving, match="Ann"):
        await second
    assert (ran, lease.holder) == ([], ann)


def test_agents_give_way_to_people_and_not_to_each_other() -> None:
    now = 0.0
    lease = DrivingLease(10.0, clock=lambda: now)
    ann = Viewer("a", "Ann")
    one, two = (Viewer(name, name, yields=True, keeps=60.0) for name in ("agent 1", "agent 2"))
    lease.use(one)
    now = 59.0
    with pytest.raises(NotDriving, match="agent 1"):
        lease.use(two)
    lease.interrupt(two)
    assert lease.holder is one
    lease.interrupt(ann)
    assert lease.holder is ann
    with pytest.raises(NotDriving, match="Ann"):
        lease.use(one)
    now = 69.5
    lease.use(two)
    assert lease.holder is two


@pytest.mark.opengl
def test_a_paused_beta_is_seen_and_driven() -> None:
    with (
        SimulatedServer("arm", play=True, camera_size=(64, 48), dialect="beta") as beta,
        TestClient(site := mounted(beta, "/"), base_url="http://localhost") as http,
    ):
        key = http.post("/api/session", json={"token": site.state.access.invite()}).json()["key"]
        http.headers["authorization"] = f"Bearer {key}"
        with http.websocket_connect("ws://localhost/api/live") as live:
            heard(live, "world", lambda message: bool(message["world"]["articulations"]))
            with http.websocket_connect("ws://localhost/api/cameras/arm/wrist/live") as camera:
                frame = camera.receive_bytes()  # though its stream is silent
            assert Image.open(io.BytesIO(frame[4 + int.from_bytes(frame[:4], "little") :])).size == (64, 48)
            assert http.post("/api/ctrl", json={"arm": {"elbow": 0.5}}).status_code == 200
            http.post("/api/run", json={"running": True})
            heard(live, "state", lambda state: abs(state["articulations"]["arm"]["qpos"][2]) > 0.01)
