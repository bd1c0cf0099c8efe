"""`urlab ping`: what it reports, and whom it disturbs."""

from __future__ import annotations

import json
import socket
from collections.abc import Generator
from pathlib import Path
from typing import Any

import mujoco
import pytest
from commands import GYMNASIUM_MODELS
from ports import free_port

from urlab_client import SessionTakenOver, URLabClient
from urlab_client.cli import main
from urlab_client.server import ControllerConfig, SimulatedServer


@pytest.fixture(scope="module")
def server() -> Generator[SimulatedServer]:
    models = GYMNASIUM_MODELS / "ant.xml", "arm"
    with SimulatedServer(*models, play=True, mjcf_options=True, controllers={"arm": ControllerConfig()}) as server:
        yield server


def rpc(server: SimulatedServer) -> str:
    """Return the address with the RPC port."""
    return f"{server.address}:{server.step_port}"


def ping_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["ping", "--json", "--timeout", "30", *arguments]) == 0
    return json.loads(capsys.readouterr().out)


def test_reports_who_is_there(server: SimulatedServer, capsys: pytest.CaptureFixture[str]) -> None:
    report = ping_json(capsys, rpc(server), "--count", "3")
    assert (report["address"], report["ops"]) == (rpc(server), 62)
    trips = report["round_trip_ms"]
    assert trips["count"] == 3
    assert 0 < trips["min"] <= trips["median"] <= trips["max"]
    found = report["server"]
    assert found["urlab_version"]
    assert found["mujoco_version"] == found["local_mujoco_version"] == mujoco.mj_versionString()
    assert found["same_mujoco_build"] is True
    assert found["play"] == {
        "state": "ready",
        "sim_time": 0.0,
        "physics": "standing still",
        "step_mode": None,
        "step_mode_pinned": False,
    }
    ant, arm = found["articulations"]
    assert ant == {
        "key": "ant", "actor_id": "ant", "joints": 9, "actuators": 8, "sensors": 0, "cameras": 1, "controller": None
    }  # fmt: skip
    assert (arm["key"], arm["actuators"], arm["controller"]) == ("arm", 7, "pd")


def test_the_same_in_words(server: SimulatedServer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ping", server.address, "--step-port", str(server.step_port), "--timeout", "30"]) == 0
    text = capsys.readouterr().out
    for words in (mujoco.mj_versionString(), "9 joints, 8 actuators", "pd controller", "round trip", "--no-session"):
        assert words in text


def test_opens_a_session_only_if_it_may(server: SimulatedServer, capsys: pytest.CaptureFixture[str]) -> None:
    with URLabClient(**server.client_options()) as client:
        client.discover()
        assert ping_json(capsys, rpc(server), "--no-session")["server"] is None
        client.step()
        ping_json(capsys, rpc(server))
        with pytest.raises(SessionTakenOver):
            client.step()


def test_the_mode_of_a_server_that_runs(capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedServer("ball", play=True, unpaused=True) as live:
        play = ping_json(capsys, rpc(live))["server"]["play"]
    assert (play["physics"], play["step_mode"], play["step_mode_pinned"]) == ("advancing", "live", False)


def test_the_mode_of_a_pinned_server(capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedServer("ball", play=True, step_mode="direct") as pinned:
        play = ping_json(capsys, rpc(pinned))["server"]["play"]
    assert (play["physics"], play["step_mode"], play["step_mode_pinned"]) == ("standing still", "direct", True)


def test_a_server_without_play(capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedServer("ball") as editor:
        found = ping_json(capsys, rpc(editor))["server"]
    assert (found["play"]["state"], found["play"]["physics"], found["articulations"]) == ("off", None, [])


def test_a_server_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ping", "sim://pallet?model=ball", "--timeout", "30"]) == 0
    text = capsys.readouterr().out
    assert "pallet" in text
    assert "--no-session" not in text  # nobody to disturb


def refused(capsys: pytest.CaptureFixture[str], address: str) -> str:
    """Return the line with which the command ended."""
    assert main(["ping", address, "--timeout", "2"]) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert out == ""
    assert line.startswith("urlab ping: ")
    return line


def test_nobody_there(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))  # taken, and nothing listens
        address = f"tcp://127.0.0.1:{reserved.getsockname()[1]}"
        line = refused(capsys, address)
    assert address in line
    assert "refused" in line


def test_somebody_who_does_not_answer(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        line = refused(capsys, address)
    assert address in line
    assert "does not speak ZeroMQ" in line


@pytest.mark.parametrize("address", ["http://localhost", "sim://nothing.xml", "tcp://"])
def test_an_address_that_is_none(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert address.removeprefix("sim://") in refused(capsys, address)


def test_the_registry_is_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beta statement 99: an entry counts, whatever says when it was written."""
    monkeypatch.setenv("URLAB_REGISTRY_DIR", str(tmp_path))
    assert main(["ping", "--all"]) == 0
    assert "lists no servers" in capsys.readouterr().out
    with SimulatedServer("ball", dialect="beta", instance_id="bench") as server:
        entry = {"instance_id": "gone", "host": socket.gethostname(), "step_port": free_port(), "pid": 1}
        for name, said in (
            ("text", "2026-11-22T10:00:00+00:00"),
            ("number", 1.0e9),
            ("odd", "yesterday"),
            ("none", None),
        ):
            content = entry | ({} if said is None else {"registry_written_at": said})
            (tmp_path / f"{name}_1.json").write_text(json.dumps(content))
        (tmp_path / "broken_1.json").write_text("{")
        (tmp_path / "deep_1.json").write_text('{"x": ' + "[" * 100_000)
        (tmp_path / "far_1.json").write_text(json.dumps(entry | {"host": "elsewhere.example", "instance_id": "far"}))
        assert main(["ping", "--all", "--json", "--timeout", "1"]) == 0
        listed = json.loads(capsys.readouterr().out)
        assert {(row["instance_id"], row["answers"]) for row in listed} == {
            ("bench", True),
            ("gone", False),
            ("far", None),
        }
        assert len(listed) == 6
        assert main(["ping", "--all", "--timeout", "1"]) == 0
        text = capsys.readouterr().out
        assert f"bench  tcp://127.0.0.1:{server.step_port}" in text
        assert "does not answer" in text
        assert "in use" not in text
