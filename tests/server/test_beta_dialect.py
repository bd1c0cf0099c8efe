"""The simulated server's beta, over a raw socket: each test holds numbered statements of the beta's description."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import pytest
import zmq
from test_meta import DATA, by_name, mismatches
from wire import Wire, write_models

from urlab_client.server import SimulatedServer

ME, OTHER = "lab-7/4711/train", "dashboard"


class Bench:
    """A beta server in play with two bots: `arm_a`, whose actor id is `arm a`, and one without an id.

    Attributes:
        a: Object name of the first; its public name is `arm_a`.
        b: Object and public name of the second.
    """

    def __init__(self, server: SimulatedServer, wire: Wire, models: Path) -> None:
        self.server = server
        self.wire = wire
        wire.hello()
        self.job("create_level", name="bench")
        wire.ask("ensure_manager")
        blueprint = self.job("import_xml", path=str(models / "bot.xml"))["blueprint_class_path"]
        self.a = self.job("spawn_actor", blueprint=blueprint, actor_id="arm a")["actor_name"]
        self.b = self.job("spawn_actor", blueprint=blueprint, actor_id="", location=[0, 2, 0])["actor_name"]

    def job(self, op: str, **fields: Any) -> dict[str, Any]:
        """Do an editor op and return what its job comes to."""
        started = self.raw(op, **fields)
        assert started["op"] == "op_started", started
        return self.end(started["job_id"])

    def end(self, job: str) -> dict[str, Any]:
        for status in self.wire.until("op_status", job_id=job):
            if status["state"] != "running":
                return status["result"]
        raise AssertionError

    def raw(self, op: str, **fields: Any) -> dict[str, Any]:
        return self.wire.raw({"op": op, "session_id": self.wire.session_id, **fields})

    def refused(self, op: str, **fields: Any) -> tuple[str, str | None]:
        """Send an op that must fail; return code and owner."""
        reply = self.raw(op, **fields)
        assert reply["op"] == "error", reply
        return reply["code"], reply.get("owner")

    def play(self, mode: str = "direct") -> dict[str, Any]:
        """Begin a play session anew, in which nothing is claimed, and return the handshake."""
        self.wire.ask("stop_pie")
        started = self.wire.ask("begin_pie", timeout_s=30)
        assert started["state"] == "ready", started
        self.wire.ask("set_mode", mode=mode)
        return started["handshake_payload"]

    def claim(self, robot: str = "arm_a", owner: str = ME, **fields: Any) -> dict[str, Any]:
        return self.wire.ask("claim_control", articulation=robot, control_owner=owner, **fields)

    def step(self, **fields: Any) -> dict[str, Any]:
        return self.wire.ask("step", **fields)

    def drive(self, value: float = 0.25, robot: str = "arm_a", owner: str = ME) -> dict[str, Any]:
        return {"per_articulation": {robot: {"ctrl": [value]}}, "control_owner": owner}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    models = write_models(tmp_path_factory.mktemp("models"))
    channels = {"arm_a/grip": 1.5, "arm_a/mode": "idle", "scene/door": False, "scene/goal": {"pos": [0], "quat": [1]}}
    with (
        SimulatedServer(dialect="beta", model_roots=[models], user_channels=channels) as server,
        Wire(server) as wire,
    ):
        yield Bench(server, wire, models)


@pytest.fixture
def playing(bench: Bench) -> Bench:
    bench.play()
    return bench


# Handshake.


def test_the_catalogue(bench: Bench) -> None:
    """Beta statement 1. Generation 2 statement 13."""
    ours = by_name(bench.wire.raw({"op": "meta"}))
    recorded = by_name(msgspec.json.decode((DATA / "meta-beta.json").read_bytes()))
    assert mismatches(ours, recorded) == set()
    assert ours.keys() >= {"claim_control", "set_control_source", "op_status", "remove_actor", "set_camera_delay"}
    assert not ours.keys() & {"destroy_actor", "hello", "meta"}
    assert ours["op_status"]["required_fields"] == ["job_id"]


def test_the_handshake_without_play(bench: Bench) -> None:
    """Beta statement 2."""
    bench.wire.ask("stop_pie")
    reply = bench.wire.hello(client_version="x/0.2", favourite={"colour": 1})
    assert list(reply) == [
        "op",
        "session_id",
        "urlab_version",
        "mujoco_version_int",
        "mujoco_version",
        "manager_present",
        "articulations",
    ]
    assert reply["articulations"] == []


def test_the_handshake_in_play(playing: Bench) -> None:
    """Beta statements 3, 4, 5, 6, 47 and 87."""
    reply = playing.wire.hello()
    assert len(reply["instance"]) == 11
    assert reply["instance"]["step_port"] == playing.server.step_port
    assert reply["instance"]["state_port"] == playing.server.state_port
    assert reply["urlab_version"] == "urlab/0.2"
    a, b = reply["articulations"]
    assert (a["prefix"], a["actor_id"], a["actor_name"]) == ("arm_a", "arm a", playing.a)
    assert (b["prefix"], b["actor_id"], b["actor_name"]) == (playing.b, "", playing.b)
    assert a["original_names"] == {"actuators": {}, "joints": {}, "sensors": {}, "bodies": {}}
    assert list(a["camera_topics"]) == ["arm_a/cam"]
    assert a["camera_topics"]["arm_a/cam"]["zmq_topic"] == "arm_a/cam"
    assert reply["global_cameras"] == {}


def test_the_handshake_in_the_start_of_play(bench: Bench) -> None:
    """Beta statement 4."""
    assert bench.play()["urlab_version"] == "urlab/0.1"


def test_a_second_hello(playing: Bench) -> None:
    """Beta statement 7."""
    playing.claim()
    playing.wire.hello(observations="minimal")
    before = playing.wire.session_id
    playing.step(n_steps=3)
    playing.wire.hello()
    assert playing.wire.raw({"op": "step", "session_id": before})["code"] == "session_expired"
    reply = playing.step(**playing.drive())
    assert (reply["step"], set(reply["arts"]["arm_a"]) - {"twist", "actions"}) == (1, {"qpos", "qvel"})
    playing.wire.hello(observations="standard")


# Claims.


def test_nothing_is_claimed_at_first(playing: Bench) -> None:
    """Beta statements 9, 10 and 11."""
    before = playing.step()["time"]
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", "(unclaimed)")
    assert playing.refused("step", per_articulation={"arm_a": {"ctrl": []}}) == ("not_control_owner", "(unclaimed)")
    for harmless in ({}, {"arm_a": {}}, {"arm_a": {"control_mode": "raw"}}):
        playing.step(per_articulation=harmless)
    assert playing.step()["time"] == pytest.approx(before + 4 * 0.002, abs=0.02)


@pytest.mark.parametrize("name", ["arm_a", "arm a", "ARM_A", None])
def test_a_robot_is_claimed_by_any_of_its_names(playing: Bench, name: str | None) -> None:
    """Beta statements 12 and 13."""
    reply = playing.claim(name or playing.a)
    assert reply == {"op": "claim_control_ok", "articulation": playing.a, "owner": ME, "ttl_s": 0.0}


def test_one_owner_at_a_time(playing: Bench) -> None:
    """Beta statements 14 and 15."""
    playing.claim()
    assert playing.refused("claim_control", articulation="arm_a", control_owner=OTHER) == ("control_claimed", ME)
    playing.step(**playing.drive())
    assert playing.claim(owner=OTHER, force=True)["owner"] == OTHER
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", OTHER)
    assert playing.claim(owner=OTHER, ttl_s=5)["ttl_s"] == 5


def test_all_or_nothing_of_a_step(playing: Bench) -> None:
    """Beta statements 17 and 18."""
    playing.claim()
    playing.step(**playing.drive(0.25))
    both = {"arm_a": {"ctrl": [0.75]}, playing.b: {"ctrl": [0.75]}}
    assert playing.refused("step", per_articulation=both, control_owner=ME) == ("not_control_owner", "(unclaimed)")
    assert playing.step()["arts"]["arm_a"]["ctrl"] == [0.25]
    assert playing.refused("step", per_articulation={"nobody": {"ctrl": [1]}}) == ("not_control_owner", "(unclaimed)")
    playing.step(per_articulation={"nobody": {"control_mode": "raw"}})


def test_releasing(playing: Bench) -> None:
    """Beta statement 19."""
    playing.claim()
    released = playing.wire.ask("release_control", articulation="arm a", control_owner=ME)
    assert released["articulation"] == playing.a
    again = playing.refused("release_control", articulation="arm_a", control_owner=ME)
    assert again == ("not_control_owner", "(unclaimed)")
    assert playing.refused("release_control", articulation="nobody")[0] == "unknown_articulation"
    assert playing.refused("release_control")[0] == "missing_field"


def test_the_other_writes_that_need_an_owner(playing: Bench) -> None:
    """Beta statements 20, 21 and 89."""
    twist = {"articulation": "arm_a", "linear": [0.1, 0, 0]}
    assert playing.refused("set_twist", **twist)[0] == "not_control_owner"
    assert playing.refused("set_twist", articulation="nobody")[0] == "unknown_articulation"
    qpos = {"target": "arm_a", "target_by": "actor_name", "qpos": [0.0]}
    assert playing.refused("set_qpos", **qpos)[0] == "not_control_owner"
    assert playing.refused("set_qpos", target="nobody", qpos=[0])[0] == "unknown_articulation"
    assert playing.refused("set_control_source", source="moon", articulation="arm_a")[0] == "bad_value"
    assert playing.refused("set_control_source", source="ui", articulation="arm_a")[0] == "not_control_owner"
    playing.wire.ask("set_control_source", source="zmq")
    playing.claim()
    playing.wire.ask("set_twist", **twist, control_owner=ME)
    assert playing.refused("set_qpos", **qpos, control_owner=ME)[0] == "dim_mismatch"
    assert playing.refused("set_control_source", source="zmq", control_owner=OTHER) == ("not_control_owner", ME)
    playing.wire.ask("set_control_source", source="zmq", control_owner=ME)


def test_what_needs_no_owner(playing: Bench) -> None:
    """Beta statement 22."""
    playing.wire.ask("reset")
    playing.wire.ask("forward")
    playing.wire.ask("set_user_channels", scene={"door": True})
    playing.wire.ask("set_mode", mode="puppet")
    playing.step(qpos=[0.0] * 16, time=0.5)


def test_a_claim_ends_with_play_and_belongs_to_its_name(playing: Bench) -> None:
    """Beta statements 23 and 24."""
    playing.claim()
    gated = {"per_articulation": {"arm_a": {"ctrl": [0.25]}}}
    assert playing.refused("step", **gated) == ("not_control_owner", ME)
    playing.play()
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", "(unclaimed)")
    playing.wire.ask("claim_control", articulation="arm_a")
    playing.step(**gated)


# Leases.


def test_the_driver_lease(bench: Bench) -> None:
    """Beta statements 26, 27, 28 and 93."""
    bench.wire.ask("stop_pie")
    lease = bench.wire.ask("acquire_lease", owner="pool-3")
    assert lease["ttl_s"] == 60
    assert re.fullmatch(r"[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}", lease["lease_id"])
    busy = bench.raw("acquire_lease", owner="pool-3")
    assert (busy["code"], busy["lease_id"]) == ("busy", lease["lease_id"])
    bench.play()
    assert bench.wire.hello()["instance"]["busy"] is True
    bench.step()
    assert bench.refused("release_lease", lease_id="x")[0] == "bad_request"
    bench.wire.ask("release_lease", lease_id=lease["lease_id"])
    assert bench.wire.hello()["instance"]["busy"] is False
    assert bench.refused("release_lease", lease_id=lease["lease_id"])[0] == "bad_request"
    bench.wire.ask("acquire_lease", ttl_s=0)
    bench.wire.ask("acquire_lease", ttl_s=0)


# Steps.


def test_the_shapes_of_replies(playing: Bench) -> None:
    """Beta statements 30 and 31."""
    step = playing.step()
    assert list(step) == ["op", "time", "step", "sim_time", "wall_time", "frame_id", "arts", "scene"]
    assert list(step["arts"]) == ["arm_a", playing.b]
    for op in ("reset", "forward"):
        assert list(playing.wire.ask(op)) == ["op", "time", "step", "sim_time", "wall_time", "arts"]


@pytest.mark.parametrize("mode", ["direct", "puppet"])
def test_snapshots_are_numbered(playing: Bench, mode: str) -> None:
    """Beta statement 32. Generation 2 statements 20 and 21."""
    playing.wire.ask("set_mode", mode=mode)
    first = playing.step(n_steps=10)["frame_id"]
    playing.wire.ask("reset")
    assert [playing.step(n_steps=10)["frame_id"] for _ in range(3)] == [first + 1, first + 2, first + 3]


def test_numbers_stand_still_in_a_pause(bench: Bench) -> None:
    """Beta statements 33, 34 and 42."""
    bench.play("live")
    first, second = bench.step(), bench.step(n_steps=10)
    assert (first["frame_id"], first["time"]) == (second["frame_id"], second["time"])
    bench.claim()
    bench.step(**bench.drive(0.125))
    for reply in bench.wire.until("step"):
        if reply["arts"]["arm_a"]["ctrl"] == [0.125]:
            break
    for word in ("auto", "streaming"):
        assert bench.wire.ask("set_mode", mode=word)["current_mode"] == "live"


def test_the_level_of_one_step_is_its_own(playing: Bench) -> None:
    """Beta statements 36 and 37."""
    assert {"bodies", "actuator_force"} <= playing.step(observations="full")["arts"]["arm_a"].keys()
    assert "bodies" not in playing.step()["arts"]["arm_a"]
    assert playing.step(observations="minimal")["arts"]["arm_a"].keys() == {"qpos", "qvel", "twist", "actions"}


def test_controls_are_exact_and_forces_act_once(playing: Bench) -> None:
    """Beta statements 35 and 38."""
    playing.claim()
    assert playing.step(**playing.drive(0.1))["arts"]["arm_a"]["ctrl"] == [0.1]
    push = {"xfrc_applied": {f"{playing.a}_base": [0, 0, 100, 0, 0, 0]}}
    before = playing.step()["arts"]["arm_a"]["qvel"][2]
    pushed = playing.step(per_articulation={"arm_a": push}, control_owner=ME)["arts"]["arm_a"]["qvel"][2]
    assert pushed > before
    assert playing.step()["arts"]["arm_a"]["qvel"][2] < pushed


def test_pushes(playing: Bench) -> None:
    """Beta statements 39, 40, 90 and 95."""
    playing.wire.ask("set_mode", mode="puppet")
    playing.wire.ask("set_paused", paused=True)
    pose = [0.0, 0, 1, 1, 0, 0, 0, 0.5] * 2
    reply = playing.step(qpos=pose, time=0.5)
    assert (reply["time"], reply["arts"]["arm_a"]["qpos"][7]) == (0.5, 0.5)
    assert playing.step(qpos=[1.0], time=0.75)["arts"]["arm_a"]["qpos"][7] == 0.5
    assert playing.step(qpos=pose)["time"] == 0
    assert "perturbation" not in reply
    playing.wire.ask("set_mode", mode="puppet")
    assert playing.step(qpos=pose, time=1.0)["frame_id"] == reply["frame_id"] + 3


def test_user_channels(playing: Bench) -> None:
    """Beta statements 45 and 46."""
    reply = playing.wire.ask(
        "set_user_channels",
        arts={"arm_a": {"grip": 2.5, "nope": 1, "mode": 3}},
        scene={"door": True, "odd": {"a": 1}, "goal": None},
    )
    assert reply["applied"] == 2
    assert reply["rejected"] == {
        "arm_a/nope": "undeclared_or_kind_mismatch",
        "arm_a/mode": "undeclared_or_kind_mismatch",
        "scene/odd": "unsupported_object",
        "scene/goal": "unsupported_value",
    }
    assert playing.step()["arts"]["arm_a"]["user"] == {"grip": 2.5, "mode": "idle"}
    assert "user" not in playing.step(observations="minimal")["arts"]["arm_a"]


# Stream.


@pytest.fixture
def published(bench: Bench) -> Iterator[Callable[[], list[bytes]]]:
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.rcvtimeo = 5000
        socket.subscribe(b"")
        socket.connect(f"{bench.server.address}:{bench.server.state_port}")
        yield socket.recv_multipart


def test_snapshots_come_in_live_mode_only(bench: Bench, published: Callable[[], list[bytes]]) -> None:
    """Beta statements 43, 44 and 45."""
    bench.play("live")
    topics = set()
    for _ in range(5):
        topic, payload = published()
        topics.add(topic)
    assert topics == {b"state/full"}
    snapshot = msgspec.msgpack.decode(payload)
    assert list(snapshot) == ["op", "time", "step", "sim_time", "wall_time", "arts", "scene", "user"]
    assert snapshot["user"].keys() == {"door", "goal"}
    bench.wire.ask("set_mode", mode="direct")
    last = bench.step(n_steps=5)["time"]
    bench.wire.ask("set_mode", mode="live")
    bench.wire.ask("set_paused", paused=False)
    times = []
    while not times or times[-1] <= last:
        times.append(msgspec.msgpack.decode(published()[1])["time"])
    # Of the direct steps nothing came: what is between is of live mode before.
    assert last not in times


# Jobs.


def test_jobs(bench: Bench, tmp_path: Path) -> None:
    """Beta statement 57. Generation 2 statements 1, 2, 3, 4, 5, 6 and 7."""
    started = [bench.raw("create_level", name="bench", force_overwrite=True) for _ in range(2)]
    assert all(re.fullmatch(r"job_[1-9][0-9]*", one["job_id"]) for one in started)
    first, second = (int(one["job_id"].removeprefix("job_")) for one in started)
    assert second == first + 1
    for one in started:
        bench.end(one["job_id"])
        assert bench.refused("op_status", job_id=one["job_id"])[0] == "unknown_job"
    missing = bench.job("import_xml", path=str(tmp_path / "nothing.xml"))
    assert (missing["op"], missing["code"]) == ("error", "import_failed")
    assert bench.refused("import_xml")[0] == "missing_field"
    assert bench.job("import_xml", path="")["code"] == "missing_field"
    assert bench.refused("op_status")[0] == "missing_field"
    assert bench.refused("op_status", job_id="")[0] == "bad_request"
    assert bench.refused("op_status", job_id="job_999999")[0] == "unknown_job"


def test_jobs_and_direct_answers_go_in_order(models: Path) -> None:
    """Generation 2 statements 8, 9, 10, 12 and 14."""
    with SimulatedServer(dialect="beta", model_roots=[models]) as server, Wire(server) as wire:
        wire.hello()
        session = {"session_id": wire.session_id}
        started = wire.raw({"op": "import_xml", "path": str(models / "bot.xml"), **session})
        assert [one["blueprint_short_name"] for one in wire.ask("list_blueprints")["blueprints"]] == ["bot"]
        wire.hello()
        done = next(s for s in wire.until("op_status", job_id=started["job_id"]) if s["state"] != "running")
        assert done["result"]["op"] == "import_xml_ok"
        grid = {"blueprint": done["result"]["blueprint_class_path"], "base_actor_id": "g", "count_x": 2, "count_y": 1}
        started = wire.raw({"op": "spawn_grid", **grid, "session_id": wire.session_id})
        done = next(s for s in wire.until("op_status", job_id=started["job_id"]) if s["state"] != "running")
        assert [cell["actor_id"] for cell in done["result"]["actors"]] == ["g_0_0", "g_1_0"]


def test_removing(bench: Bench) -> None:
    """Generation 2 statement 14."""
    assert bench.job("remove_actor", target="nobody")["code"] == "destroy_failed"
    assert bench.refused("destroy_actor", target="nobody")[0] == "unknown_op"


# Options, ports.


def test_options(playing: Bench) -> None:
    """Beta statements 64 and 65."""
    options = playing.wire.ask("set_sim_options", options={"timestep": 0.002})["options"]
    assert options["timestep"] == 0.002
    for word in ("RK4", "rk4"):
        assert playing.wire.ask("set_sim_options", options={"integrator": word})["options"]["integrator"] == "RK4"
    before = options["disableflags"]
    after = playing.wire.ask("set_sim_options", options={"enable_multiccd": False})["options"]
    assert after["disableflags"] == int(before) | int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    assert after["enableflags"] == options["enableflags"]


def test_an_instance_of_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, models: Path) -> None:
    """Beta statement 66."""
    monkeypatch.setenv("URLAB_REGISTRY_DIR", str(tmp_path))
    with SimulatedServer(models / "bot.xml", play=True, dialect="beta", instance_id="left") as server:
        (file,) = tmp_path.glob("left_*.json")
        told = msgspec.json.decode(file.read_bytes())
        assert (told["instance_id"], told["step_port"]) == ("left", server.step_port)
        assert isinstance(told["registry_written_at"], str)
    assert not list(tmp_path.iterdir())


def test_steps_that_wait_in_a_pause(playing: Bench) -> None:
    """Beta statements 41 and 88."""
    before = playing.step()["time"]
    playing.wire.ask("set_paused", paused=True)
    began = time.monotonic()
    assert playing.refused("step")[0] == "step_timeout"
    assert time.monotonic() - began >= 4
    playing.wire.ask("set_paused", paused=False)
    assert playing.wire.ask("forward")["time"] == before


# Cameras.


def test_pictures_in_steps(playing: Bench) -> None:
    """Beta statements 48, 49, 50 and 52. Generation 2 statements 25, 26 and 28."""
    assert "cameras" not in playing.step(include_cameras={"cam": "sync"})
    for mode in ("direct", "live"):
        playing.wire.ask("set_mode", mode=mode)
        reply = playing.step(include_cameras={"arm_a/cam": "sync"}, render="sync")
        (frame,) = reply["cameras"].values()
        assert list(frame) == ["width", "height", "frame_id", "sim_time", "dtype", "data"]
        assert frame["frame_id"] >= reply["frame_id"]
    assert "cameras" not in playing.step(include_cameras={"arm_a/cam": {"frame_id": 1e15}})
    assert playing.step(include_cameras={"arm_a/cam": {"frame_id": 1}})["cameras"]
    assert playing.step(include_cameras={"arm_a/cam": 1e15})["cameras"]
    assert set(playing.step(include_cameras=True)["cameras"]) == {"arm_a/cam", f"{playing.b}/cam"}


def test_the_camera_switch(playing: Bench) -> None:
    """Beta statements 53 and 56. Generation 2 statements 35, 36, 38, 39 and 40."""
    on = {"cameras": {"arm_a/cam": {"zmq": True, "shm": False}, "nobody/cam": True}}
    first, second = (playing.wire.ask("set_camera_streaming", **on)["cameras"] for _ in range(2))
    assert first == second
    assert list(first) == ["arm_a/cam"]
    told = first["arm_a/cam"]
    assert (told["streaming"], told["zmq"], told["shm"], told["zmq_topic"]) == (True, True, False, "arm_a/cam")
    both = playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": True, f"{playing.b}/cam": {}})["cameras"]
    assert both["arm_a/cam"]["zmq_endpoint"] != both[f"{playing.b}/cam"]["zmq_endpoint"]
    assert both[f"{playing.b}/cam"]["shm"] is True
    only = playing.wire.ask("set_camera_streaming", cameras={"arm_a/cam": {"shm": True}})["cameras"]["arm_a/cam"]
    assert only == {"streaming": True, "zmq": False, "shm": True}
    assert playing.wire.ask("set_camera_streaming", cameras={"nobody/cam": True})["cameras"] == {}
    assert playing.refused("set_camera_streaming", cameras={})[0] == "bad_request"
    assert playing.refused("set_camera_streaming")[0] == "missing_field"
    playing.wire.ask("set_camera_streaming", **on)
    number = playing.step()["frame_id"]
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger = 0
        socket.rcvtimeo = 20_000
        socket.subscribe(b"arm_a/cam ")
        socket.connect(told["zmq_endpoint"])
        topic, payload = socket.recv_multipart()
    assert topic == b"arm_a/cam "
    assert (payload[:4], len(payload)) == (b"UCM1", 640 * 480 * 4 + 40)
    assert int.from_bytes(payload[8:16], "little") == number
