"""`urlab demo`: what it drives, what it prints and what it leaves on disk."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import math
import shutil
import struct
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from commands import GYMNASIUM_MODELS, urlab
from PIL import Image

from urlab_client import URLabClient
from urlab_client._installation import install_command
from urlab_client.cli import _parser, main
from urlab_client.cli.demo import Swing
from urlab_client.server import SimulatedServer


def png_size(path: Path) -> tuple[int, int]:
    """Return width and height from the file's header."""
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", head[16:])
    return width, height


def tilt(quaternion: list[float]) -> float:
    """Return the angle between a body's z axis and the vertical, degrees."""
    _, x, y, _ = quaternion
    return math.degrees(math.acos(1 - 2 * (x * x + y * y)))


@pytest.fixture(scope="module")
def demonstration(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("demo")
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        assert main(["demo", "--steps", "1200"]) == 0
    assert err.getvalue() == ""
    return folder / "urlab-demo", out.getvalue()


@pytest.fixture(scope="module")
def record(demonstration: tuple[Path, str]) -> dict[str, Any]:
    folder, _ = demonstration
    return json.loads((folder / "run.json").read_bytes())


def test_drives_one_robot_blocking_and_two_async(record: dict[str, Any]) -> None:
    one, two = record["runs"]
    assert (one["client"], one["robots"], one["steps"]) == ("blocking", 1, 1200)
    assert (two["client"], two["robots"], two["steps"]) == ("async", 2, 300)
    for run in (one, two):
        assert run["sim_time"] == pytest.approx(0.002 * run["steps"])
        assert run["steps_per_second"] == pytest.approx(run["steps"] / run["wall_time"])
        assert run["real_time_factor"] == pytest.approx(run["sim_time"] / run["wall_time"])


def test_walks_for_four_seconds_unless_told_otherwise() -> None:
    assert _parser("demo").parse_args(["demo"]).steps == 2000


def test_the_quadruped_walks_and_does_not_fall(record: dict[str, Any]) -> None:
    one, two = record["runs"]
    (alone,) = one["final_base_poses"]
    assert alone[0] > 0.5
    right, left = two["final_base_poses"]
    assert left[1] - right[1] > 0.5
    for pose in (alone, right, left):
        assert 0.27 < pose[2] < 0.32
        assert tilt(pose[3:]) < 10


def test_prints_a_table_and_what_it_wrote(demonstration: tuple[Path, str], record: dict[str, Any]) -> None:
    _, text = demonstration
    assert text.startswith("quadruped, direct mode\n")
    for heading in ("robots", "steps", "sim (s)", "steps/s", "factor", "final base pose"):
        assert heading in text
    x = record["runs"][0]["final_base_poses"][0][0]
    assert f"{x:6.3f}" in text
    for name in ("joints.png", "last_state.png", "run.json"):
        assert name in text


def test_plots_the_joints(demonstration: tuple[Path, str]) -> None:
    folder, _ = demonstration
    width, height = png_size(folder / "joints.png")
    assert width >= 1200
    assert height >= 900
    pixels = np.asarray(Image.open(folder / "joints.png"))[..., :3].astype(np.uint32)
    assert len(np.unique(pixels @ np.array([1, 256, 65536], np.uint32))) > 50  # a dozen lines and their soft edges


@pytest.mark.opengl
def test_draws_the_last_state(demonstration: tuple[Path, str]) -> None:
    folder, _ = demonstration
    picture = folder / "last_state.png"
    assert png_size(picture) == (1280, 960)
    red, green, blue = np.moveaxis(np.asarray(Image.open(picture)) / 255, -1, 0)
    shell = (red > 0.6) & (green < 0.75 * red) & (blue < 0.5 * red)  # the quadruped's orange
    rows, columns = np.nonzero(shell)
    assert shell.mean() > 0.005
    assert rows.max() - rows.min() > 0.3 * 960  # large in the picture …
    assert columns.max() - columns.min() > 0.3 * 1280
    assert min(rows.min(), columns.min(), 959 - rows.max(), 1279 - columns.max()) > 10  # … and whole


def test_records_the_configuration(record: dict[str, Any]) -> None:
    assert record["versions"]["mujoco"] == mujoco.mj_versionString()
    assert len(record["model"]["sha256"]) == 64
    assert record["options"]["timestep"] == 0.002
    assert record["seed"] == 0
    assert [run["controllers"] for run in record["runs"]] == [["trot"], ["trot", "trot"]]


def test_leaves_nothing_else(demonstration: tuple[Path, str]) -> None:
    folder, _ = demonstration
    assert {path.name for path in folder.iterdir()} - {"last_state.png"} == {"run.json", "joints.png"}
    assert [*folder.parent.iterdir()] == [folder]


@pytest.mark.parametrize(("name", "dialect"), [("ant", "alpha"), ("pusher_v5", "beta")])
def test_drives_the_robot_of_a_user(
    tmp_path: Path, name: str, dialect: str, capsys: pytest.CaptureFixture[str]
) -> None:
    model = shutil.copy(GYMNASIUM_MODELS / f"{name}.xml", tmp_path / "my-robot.xml")
    output = tmp_path / "a" / "b"
    options = ["--steps", "40", "--no-render", "--output", str(output), "--dialect", dialect]
    assert main(["demo", str(model), *options]) == 0
    record = json.loads((output / "run.json").read_bytes())
    assert record["model"]["path"] == str(model)
    assert record["options"]["timestep"] == mujoco.MjModel.from_xml_path(str(model)).opt.timestep
    assert [run["steps"] for run in record["runs"]] == [40, 10]
    assert not (output / "last_state.png").exists()
    assert "--no-render" in capsys.readouterr().out


def test_a_robot_without_floor_and_actuators_gets_one_and_is_not_said_to_be_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "block.xml"
    model.write_text(
        "<mujoco><worldbody><body pos='0 0 .11'><freejoint/>"
        "<geom type='box' size='.1 .1 .1'/></body></worldbody></mujoco>"
    )
    assert main(["demo", str(model), "--steps", "200", "--no-render", "--output", str(tmp_path)]) == 0
    runs = json.loads((tmp_path / "run.json").read_bytes())["runs"]
    assert [pose[2] for run in runs for pose in run["final_base_poses"]] == pytest.approx([0.1] * 3, abs=0.01)
    assert {kind for run in runs for kind in run["controllers"]} == {"none"}
    assert "0 actuators: nothing is driven" in capsys.readouterr().out


def test_goes_on_without_opengl(tmp_path: Path) -> None:
    stale = tmp_path / "last_state.png"
    stale.write_bytes(b"of an earlier run")
    done = urlab(
        "demo", "arm", "--steps", "8", "--output", tmp_path, cwd=tmp_path, environment={"MUJOCO_GL": "disable"}
    )
    assert done.returncode == 0, done.stderr
    assert "not drawn: nothing can be drawn here: MUJOCO_GL=disable" in done.stdout
    assert not stale.exists()
    assert (tmp_path / "joints.png").exists()


def test_a_missing_extra_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else object())
    assert main(["demo", "--output", str(tmp_path)]) == 2
    command = install_command("demo")
    assert "[demo]" in command
    assert capsys.readouterr() == ("", f"urlab demo: matplotlib is not installed; run: {command}\n")


def test_a_model_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><geom type='potato'/></worldbody></mujoco>")
    cases = (
        ("robbot", ["robbot", "quadruped"]),
        (broken, [str(broken), "potato"]),
        ("floor", ["floor.xml", "no joints"]),
    )
    for model, words in cases:
        assert main(["demo", str(model), "--output", str(tmp_path / "output")]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert all(word in err for word in words), err
    assert [*tmp_path.iterdir()] == [broken]


def test_an_output_folder_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main(["demo", "--output", str(file)]) == 2
    assert str(file) in capsys.readouterr().err


def test_the_gentle_controller_stays_inside_the_control_ranges() -> None:
    with SimulatedServer("arm", play=True) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        client.reset(per_articulation_qpos={"arm": {"elbow": 0.5}})
        arm = client.articulations["arm"]
        controller = Swing(arm)
        controller.act(0.0)
        elbow = arm.actuators["elbow"]
        assert abs(elbow.value) > 0.1
        assert elbow.value == pytest.approx(arm.joints["elbow"].position), "it begins where the robot is"
        seen = []
        for time in np.linspace(0, 5, 200):
            controller.act(time)
            seen.append(arm.ctrl_array.copy())
        ranges = np.array([actuator.ctrlrange for actuator in arm.actuators.values()])
    low, high = np.min(seen, axis=0), np.max(seen, axis=0)
    assert (low >= ranges[:, 0]).all()
    assert (high <= ranges[:, 1]).all()
    assert (high - low > 0.1 * np.ptp(ranges, axis=1)).all()
