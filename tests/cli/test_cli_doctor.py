"""`urlab doctor` says in sentences what keeps a robot from moving."""

from __future__ import annotations

import json
import socket
from pathlib import Path

from commands import urlab

from urlab_client.server import SimulatedServer


def test_a_paused_simulation(tmp_path: Path) -> None:
    with SimulatedServer("arm", play=True) as server:
        address, state_port = f"{server.address}:{server.step_port}", f"--state-port={server.state_port}"
        done = urlab("doctor", address, state_port, "--timeout=30", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert "it is paused. Call runtime.set_paused(False), or start `urlab serve` with --unpaused." in done.stdout


def test_json_of_a_running_one_where_only_ascii_can_be_written(tmp_path: Path) -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        command = ["doctor", f"{server.address}:{server.step_port}", "--json", "--timeout=30"]
        done = urlab(*command, cwd=tmp_path, environment={"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr
    assert "m/s²" in str(json.loads(done.stdout))
    subjects = {finding["subject"]: finding["verdict"] for finding in json.loads(done.stdout)["findings"]}
    assert subjects["play"] == "ok"


def test_nobody_there(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        done = urlab("doctor", f"tcp://127.0.0.1:{probe.getsockname()[1]}", "--timeout=0.3", cwd=tmp_path)
    assert done.returncode == 1
    (line,) = done.stdout.splitlines()
    assert line.startswith("problem")
    assert "is the server running" in line
