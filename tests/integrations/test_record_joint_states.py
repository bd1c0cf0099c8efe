"""A recording that a server saved, read by the commands that read our own."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import urlab_client
from urlab_client.cli import main
from urlab_client.integrations.record import RecordingError, read_run
from urlab_client.server import SimulatedServer


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a server saves of a quadruped that falls for 20 steps, and is reset in between."""
    with (
        SimulatedServer("quadruped", play=True) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.recording.start()
        for _ in range(2):
            client.reset()
            for _ in range(10):
                client.step()
        client.recording.stop()
        content = Path(client.recording.save("falls.json")).read_bytes()
    file = tmp_path_factory.mktemp("saved") / "falls.json"
    file.write_bytes(content)
    return file


def test_it_is_a_table_of_joints_over_time(saved: Path) -> None:
    run = read_run(saved)
    frames = json.loads(saved.read_bytes())["Frames"]
    table = run.table()
    summary = run.summary()
    assert len(table) == len(frames)
    assert summary.complete
    assert summary.episodes == 2
    assert summary.topics["/state/joints"].messages == len(frames)
    assert table.time[0] == 0
    assert (np.diff(table.time) >= 0).all(), "the recording's clock goes on where a reset sets the other back"
    (base,) = (name for name, state in frames[0]["jointStates"].items() if len(state["qPos"]) == 7)
    column = table.columns["joints/qpos"]
    heights = column.values[:, column.names.index(f"{base}.z")]
    np.testing.assert_array_equal(heights, [frame["jointStates"][base]["qPos"][2] for frame in frames])
    assert column.quantities[column.names.index(f"{base}.qw")] == "orientation (w, x, y, z)"


def test_the_commands_read_it(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(saved)]) == 0
    assert "/state/joints" in capsys.readouterr().out
    assert main(["plot", str(saved), "--joints", "*hip*", "-o", str(tmp_path / "hips.png")]) == 0
    assert (tmp_path / "hips.png").read_bytes().startswith(b"\x89PNG")
    assert main(["convert", str(saved), str(tmp_path / "falls.csv")]) == 0
    with (tmp_path / "falls.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(json.loads(saved.read_bytes())["Frames"])
    assert any(name.startswith("joints/qpos/") for name in rows[0])
    assert main(["convert", str(saved), str(tmp_path / "falls.mp4")]) == 2
    assert "has no pictures" in capsys.readouterr().err


def test_a_file_that_only_begins_like_one_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text('{"Frames": [')
    with pytest.raises(RecordingError, match=r"broken\.json"):
        read_run(broken).table()
