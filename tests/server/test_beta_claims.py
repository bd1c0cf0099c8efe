"""The simulated server's beta over a raw socket: owners of robots and the driver lease, statement by statement."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import zmq
from beta_bench import ME, OTHER, Bench, Clock
from waiting import eventually
from wire import Wire, set_points

from urlab_client import URLabClient
from urlab_client.protocol.messages.runtime import SetUserChannels
from urlab_client.server import SimulatedServer
from urlab_client.server.core import DriverLease

# Claims.


def test_streamed_controls_of_a_robot_with_an_owner_are_dropped(bench: Bench) -> None:
    """Beta statement 25."""
    bench.play("live")
    bench.claim()
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
        publisher.linger = 0
        publisher.rcvtimeo = 20_000
        publisher.connect(f"{bench.server.address}:{bench.server.ctrl_port}")
        wanted = f"{bench.b}/control ".encode()
        eventually(lambda: publisher.recv() == b"\x01" + wanted, look=0)
        for actuator in (0, 1):  # the owned robot's first
            payload = set_points({actuator: 0.5})
            publisher.send_multipart([wanted, payload])
        for reply in bench.wire.until("step"):
            if reply["arts"][bench.b]["ctrl"] == [0.5]:
                break
    assert reply["arts"]["arm_a"]["ctrl"] == [0.0]


def test_raw_controls_of_a_live_step_last_for_an_iteration(bench: Bench) -> None:
    """Beta statement 91."""
    bench.play("live")
    bench.claim()
    raw = {"ctrl": [0.5], "control_mode": "raw"}
    assert bench.step(per_articulation={"arm_a": raw}, control_owner=ME)["arts"]["arm_a"]["ctrl"] == [0.5]
    for reply in bench.wire.until("step"):
        if reply["arts"]["arm_a"]["ctrl"] == [0.0]:
            break


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


def test_a_claim_with_a_limit_ends_in_silence(playing: Bench) -> None:
    """Beta statement 16."""
    clock = Clock()
    playing.core.play.running().claims._clock = clock
    playing.claim(ttl_s=0.5)
    for _ in range(10):
        clock.now += 0.2
        playing.step(**playing.drive())
    clock.now += 0.7
    playing.step()
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", "(unclaimed)")
    playing.claim(owner=OTHER)
    clock.now += 1e9
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", OTHER), "without a limit it stays"


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
    playing.step(n_steps=3)
    assert playing.wire.ask("reset")["time"] == 0.0
    assert playing.wire.ask("forward")["step"] == 0.0
    assert playing.wire.ask("set_user_channels", scene={"door": True})["applied"] == 1.0
    assert playing.refused("configure_controller", articulation="arm_a", params={})[0] == "no_controller"
    assert playing.wire.ask("set_mode", mode="puppet")["current_mode"] == "puppet"
    pushed = playing.step(qpos=[0.25] * 16, time=0.5)
    assert (pushed["time"], pushed["arts"]["arm_a"]["qpos"]) == (0.5, [0.25] * 8)


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
    assert lease["lease_id"] not in busy["message"]
    bench.play()
    assert bench.wire.hello()["instance"]["busy"] is True
    bench.step()
    assert bench.refused("release_lease", lease_id="x")[0] == "bad_request"
    bench.wire.ask("release_lease", lease_id=lease["lease_id"])
    assert bench.wire.hello()["instance"]["busy"] is False
    gone = bench.raw("release_lease", lease_id=lease["lease_id"])
    assert gone["code"] == "bad_request"
    assert lease["lease_id"] not in gone["message"]
    bench.wire.ask("acquire_lease", ttl_s=0)
    bench.wire.ask("acquire_lease", ttl_s=0)


def test_a_lease_ends_in_silence(playing: Bench) -> None:
    """Beta statement 29. Every request but a few is a sign of life, whoever sends it and whatever comes of it."""
    clock = Clock()
    playing.core.lease = DriverLease(clock)
    playing.wire.ask("acquire_lease", ttl_s=10)
    for sign in ({"op": "step"}, {"op": "forward", "session_id": "gone"}, {"op": "nonsense"}):
        clock.now += 9
        playing.wire.raw({"session_id": playing.wire.session_id, **sign})
    clock.now += 9
    assert playing.refused("acquire_lease")[0] == "busy"
    clock.now += 2
    playing.wire.raw({"op": "meta"})
    playing.wire.hello()
    playing.wire.ask("pie_status")
    playing.wire.ask("acquire_lease", ttl_s=0)


def test_a_storm_of_claims(playing: Bench) -> None:
    """Of fifty clients at once one gets the robot, the others are told whose it is, and the server goes on."""

    def claim(number: int) -> dict[str, Any]:
        with Wire(playing.server) as wire:
            fields = {"articulation": "arm_a", "control_owner": f"client-{number}"}
            return wire.raw({"op": "claim_control", "session_id": playing.wire.session_id, **fields})

    with ThreadPoolExecutor(50) as pool:
        replies = list(pool.map(claim, range(50)))
    granted = [reply for reply in replies if reply["op"] == "claim_control_ok"]
    refused = [reply for reply in replies if reply["op"] == "error"]
    assert (len(granted), len(refused)) == (1, 49)
    assert {(reply["code"], reply["owner"]) for reply in refused} == {("control_claimed", granted[0]["owner"])}
    playing.step(**playing.drive(owner=granted[0]["owner"]))


def test_a_claim_of_a_robot_that_is_not_there(playing: Bench) -> None:
    assert playing.refused("claim_control", articulation="nobody")[0] == "unknown_articulation"
    assert playing.refused("claim_control", articulation="")[0] == "missing_field"
    assert playing.refused("claim_control", articulation=7)[0] in {"missing_field", "unknown_articulation"}
    assert playing.refused("step", **playing.drive()) == ("not_control_owner", "(unclaimed)")


def test_channels_of_the_scene_are_no_robots(tmp_path: Path) -> None:
    """A robot that is called like the scene, in another case, leaves the scene's channels alone."""
    model = tmp_path / "robot.xml"
    model.write_text('<mujoco model="Scene"><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>')
    with (
        SimulatedServer(
            model, play=True, dialect="beta", actor_names="model", user_channels={"scene/door": False}
        ) as server,
        URLabClient(**server.client_options()) as client,
    ):
        client.discover()
        assert client.articulations
        assert client.call(SetUserChannels(scene={"door": True})).applied == 1
