"""`urlab view`: what it writes, and what it refuses."""

from __future__ import annotations

import os
import re
from argparse import Namespace
from pathlib import Path
from typing import Any

import httpx2
import pytest
from children import child
from commands import urlab
from made_recordings import Robot, write_recording
from waiting import attempts

from urlab_client import URLabClient
from urlab_client.cli import _parser, console, main
from urlab_client.integrations.record import record
from urlab_client.server import SimulatedServer


@pytest.mark.view
def test_a_run_goes_into_a_file(tmp_path: Path) -> None:
    done = urlab(
        "view",
        "sim://quadruped?play&dialect=beta",
        "--rerun",
        "--save",
        "run.rrd",
        "--step-mode",
        "direct",
        "--seconds",
        "0.2",
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (0, "")
    first, last = done.stdout.splitlines()
    assert "run.rrd" in first
    assert int(last.split()[0]) >= 1
    from rerun.chunk import RrdReader

    paths = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "run.rrd")).stream().to_chunks()}
    assert "/joints/quadruped/FL_hip" in paths


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Return the line with which the command ended."""
    assert main(["view", *arguments]) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert out == ""
    return line


def test_without_a_display_the_window_is_refused_and_others_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    line = refused(capsys, "sim://quadruped")
    assert "no display" in line
    assert "--web, --rerun --page or --foxglove" in line


def test_a_recording_that_does_not_exist_is_named_even_without_a_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    missing = str(tmp_path / "run.mcap")
    assert missing in refused(capsys, missing)


def test_options_of_another_view_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "require --rerun" in refused(capsys, "--foxglove", "--save", "a.rrd")
    assert "give one of" in refused(capsys, "--rerun", "--page", "--save", "a.rrd")
    assert "do not apply to --web" in refused(capsys, "--web", "--seconds", "1")
    # The address of a viewer, as the help writes it, is accepted: it is not the URL of a page.
    viewer = "rerun+http://localhost:9876/proxy"
    assert "require --rerun" in refused(capsys, "--foxglove", "--connect", viewer)


def test_the_console_is_told_all_that_it_asks_of_its_own_command(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Namespace] = []
    monkeypatch.setattr(console, "run", lambda arguments: told.append(arguments) or 0)
    assert main(["view", "sim://arm", "--web", "--port", "0"]) == 0
    names = set(vars(_parser("console").parse_args(["console"]))) - {"name", "run", "version"}
    assert {name: getattr(told[0], name) for name in names} == {
        "address": "sim://arm", "host": "127.0.0.1", "port": 0, "allow_host": [], "open": False, "handshake": None,
        "recordings": Path("recordings"), "mjcf_options": False, "server_key": None, "client_key": None,
        "step_port": 5559, "state_port": None, "public_url": None, "json_log": False,
    }  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of two robots, of which one moves, and of a block; their server is gone."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    with (
        SimulatedServer("arm", "quadruped", "block", play=True, step_mode="direct", camera_size=(64, 48)) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, path, cameras=["arm/overview"] if server.can_render else ()):
            client.articulations["arm"].set_ctrl({"elbow": 0.7})
            client.step(250)
            client.step(1)
    return path


@pytest.mark.parametrize("command", [("console",), ("view", "--web")])
def test_a_recording_is_shown_in_the_browser_without_a_server(recording: Path, command: tuple[str, ...]) -> None:
    with child("-m", "urlab_client", *command, recording, "--port", "0", cwd=recording.parent) as process:
        printed = process.stdout.readline()
        found = re.search(r"(http://\S+)/\?token=(\S+)", printed)
        assert found is not None, printed + process.communicate()[1]
        assert printed.startswith(f"{recording} is shown at ")
        with httpx2.Client(base_url=found[1]) as page:
            key = page.post("/api/session", json={"token": found[2]}).json()["key"]
            page.headers["authorization"] = f"Bearer {key}"
            replay: dict[str, Any] = {}
            for _ in attempts():
                replay = page.get("/api/status").json()["replay"] or {}
                if replay:
                    break
            assert (replay["name"], replay["alone"]) == ("run.mcap", True)
            end = page.post("/api/replay", json={"time": replay["seconds"], "playing": False}).json()["time"]
            state = page.get("/api/state").json()
            assert state["time"] == pytest.approx(end, abs=1e-6)
            robots = {robot["key"]: robot for robot in page.get("/api/world").json()["articulations"]}
            (elbow,) = [joint["index"] for joint in robots["arm"]["joints"] if joint["name"] == "elbow"]
            assert state["articulations"]["arm"]["qpos"][elbow] > 0.1
            assert {"arm", "quadruped"} <= set(robots)
            assert page.get("/api/world").json()["no_view"] == ""
            if replay["cameras"]:
                (camera,) = robots["arm"]["cameras"]
                assert (camera["path"], camera["width"], camera["height"]) == ("arm/overview", 64, 48)
            errors = [entry for entry in page.get("/api/log").json() if entry["kind"] == "error"]
            assert not errors


def test_a_recording_that_cannot_be_shown_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "bare.mcap"
    write_recording(file, [({"arm": Robot([0.0])}, {})])
    for arguments, reason in (
        ([str(file)], "the recording has no model"),
        ([str(tmp_path / "none.mcap")], "No such file"),
        ([str(file), "--mjcf-options"], "are for servers, not for a recording"),
    ):
        assert main(["console", *arguments, "--port", "0"]) == 2
        assert reason in capsys.readouterr().err


def test_enter_prints_a_link_again_after_the_console_was_in_the_background(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read_end, write_end = os.pipe()
    monkeypatch.setattr(console, "_BACKGROUND_S", 0.0)
    monkeypatch.setattr(console.signal, "pthread_sigmask", lambda *_: None, raising=False)
    places = iter([-1, read_end, read_end])  # first a terminal that cannot be read

    class Terminal:
        def fileno(self) -> int:
            return next(places)

    monkeypatch.setattr(console.sys, "stdin", Terminal())
    with open(read_end, "rb", closefd=True):
        os.write(write_end, b"\n")
        os.close(write_end)
        console._print_links(lambda: "http://link")
    assert capsys.readouterr().out == "http://link (good for one browser)\n"
