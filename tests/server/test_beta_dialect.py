"""The simulated server's beta over a raw socket: handshake, steps, state and options, statement by statement."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import mujoco
import pytest
import zmq
from beta_bench import ME, Bench
from test_meta import DATA, by_name, mismatches
from waiting import attempts
from wire import Wire

from urlab_client.server import SimulatedServer

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
    """Beta statements 2 and 8."""
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
    assert reply["instance"]["capabilities"] == [
        *("render_sync", "render_async", "shm_rpc", "model_upload", "content_cache")
    ]
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
    for _ in attempts("no later snapshot came"):
        times.append(msgspec.msgpack.decode(published()[1])["time"])
        if times[-1] > last:
            break
    # Of the direct steps nothing came: what is between is of live mode before.
    assert last not in times


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


def test_a_step_that_waits_in_a_pause(playing: Bench) -> None:
    """Beta statement 88."""
    before = playing.step()["time"]
    playing.wire.ask("set_paused", paused=True)
    playing.core.play.running().engine._step_timeout_s = 0.1
    assert playing.refused("step")[0] == "step_timeout"
    playing.wire.ask("set_paused", paused=False)
    assert playing.wire.ask("forward")["time"] == before


def test_a_step_that_takes_too_long_is_taken_whole_or_not_at_all(playing: Bench) -> None:
    """Beta statement 92."""
    before = playing.step()["step"]
    engine = playing.core.play.running().engine
    engine._step_timeout_s = engine._inline_budget_s = 0.01
    assert playing.refused("step", n_steps=5000)[0] == "step_timeout"
    assert playing.wire.ask("forward")["step"] in {before, before + 5000}


def test_numbers_of_a_new_play_session_begin_anew(bench: Bench) -> None:
    """Generation 2 statements 19 and 22."""
    pose = [0.0, 0, 1, 1, 0, 0, 0, 0] * 2
    for mode in ("puppet", "live", "direct"):
        bench.play(mode)
        bench.wire.ask("set_paused", paused=False)
        numbers = [reply["frame_id"] for reply, _ in zip(bench.wire.until("step", qpos=pose), range(5), strict=False)]
        assert numbers == sorted(map(int, numbers))
        if mode != "live":
            assert numbers == [1, 2, 3, 4, 5]
        next(reply for reply in bench.wire.until("step", qpos=pose) if reply["frame_id"] >= 6)


MESHED = """
<mujoco model="crab"><option timestep="0.001" iterations="7"/><asset><mesh name="claw" file="claw.obj"/></asset>
  <worldbody><body><joint name="hip"/><geom type="mesh" mesh="claw"/></body></worldbody>
  <actuator><motor joint="hip"/></actuator></mujoco>
"""


def test_a_scene_can_be_built_from_what_comes_with_it(tmp_path: Path) -> None:
    """Beta statement 86. A document for each robot, and the options of all merged, as 4.5 and 9.5 say."""
    (tmp_path / "claw.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    (tmp_path / "crab.xml").write_text(MESHED)
    crab = tmp_path / "crab.xml"
    with SimulatedServer(crab, "arm", crab, play=True, dialect="beta") as server, Wire(server) as wire:
        reply = wire.hello(include_assets=True)
        options = wire.ask("set_sim_options", options={})["options"]
    assert (options["timestep"], options["iterations"], options["integrator"]) == (0.001, 7, "implicitfast")
    scene, assets = reply["mjcf_compiled"], reply["vfs_assets"]
    texts = [scene, *(content.decode() for name, content in assets.items() if name.endswith(".xml"))]
    for info in reply["articulations"]:
        prefix = f"{info['actor_name']}_"
        assert f'<model name="{prefix}" file="{prefix}model.xml"' in scene
        assert f'<attach model="{prefix}" prefix="{prefix}"' in scene
    files = {file for text in texts for file in re.findall(r'file="([^"]+)"', text)}
    assert files
    assert files <= assets.keys()
    built = mujoco.MjModel.from_xml_string(scene, assets)
    sent = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": reply["mjb"]})
    assert (built.nq, built.nv, built.nu) == (sent.nq, sent.nv, sent.nu)
    assert (built.opt.timestep, built.opt.integrator) == (sent.opt.timestep, sent.opt.integrator)
