"""`urlab view` in child processes."""

from __future__ import annotations

from pathlib import Path
from typing import get_type_hints

import pytest
from commands import refusal, urlab

from urlab_client.cli import console, main
from urlab_client.cli._page_options import PageArguments

NO_DISPLAY = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}


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


def test_without_a_display_the_window_is_refused_and_others_are_named(tmp_path: Path) -> None:
    line = refusal(urlab("view", "sim://quadruped", cwd=tmp_path, environment=NO_DISPLAY))
    assert "no display" in line
    assert "--web, --rerun --page or --foxglove" in line


def test_options_of_another_view_are_refused(tmp_path: Path) -> None:
    assert "require --rerun" in refusal(urlab("view", "--foxglove", "--save", "a.rrd", cwd=tmp_path))
    assert "give one of" in refusal(urlab("view", "--rerun", "--page", "--save", "a.rrd", cwd=tmp_path))
    assert "do not apply to --web" in refusal(urlab("view", "--web", "--seconds", "1", cwd=tmp_path))


def test_the_console_is_told_all_that_it_asks_of_its_own_command(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[PageArguments] = []
    monkeypatch.setattr(console, "run", lambda arguments: told.append(arguments) or 0)
    assert main(["view", "sim://arm", "--web", "--port", "0"]) == 0
    assert {name: getattr(told[0], name) for name in get_type_hints(PageArguments)} == {
        "address": "sim://arm", "host": "127.0.0.1", "port": 0, "allow_host": [], "open": False, "handshake": None,
        "recordings": Path("recordings"), "mjcf_options": False, "server_key": None, "client_key": None,
        "step_port": 5559, "state_port": None,
    }  # fmt: skip
