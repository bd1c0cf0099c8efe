"""`urlab view`: what it writes, and what it refuses."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest
from commands import urlab

from urlab_client.cli import _parser, console, main


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
