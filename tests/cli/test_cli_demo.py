"""`urlab demo`: what it drives, what it prints and what it leaves on disk."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import math
import shutil
import struct
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from commands import GYMNASIUM_MODELS
from PIL import Image

from urlab_client import URLabClient
from urlab_client._installation import install_command
from urlab_client.cli import _parser, main
from urlab_client.cli.demo_controllers import SineController
from urlab_client.cli.robot_file import read_robot
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
    assert alone["position"][0] > 0.5
    right, left = two["final_base_poses"]
    assert left["position"][1] - right["position"][1] > 0.5
    for pose in (alone, right, left):
        assert 0.27 < pose["position"][2] < 0.32
        assert tilt(pose["quaternion"]) < 10


def test_prints_a_table_and_what_it_wrote(demonstration: tuple[Path, str], record: dict[str, Any]) -> None:
    _, text = demonstration
    assert "1200/1200" in text
    assert "300/300" in text
    for heading in ("robots", "steps", "sim (s)", "steps/s", "factor", "final base pose"):
        assert heading in text
    x = record["runs"][0]["final_base_poses"][0]["position"][0]
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


def test_draws_the_last_state_or_says_what_is_missing(demonstration: tuple[Path, str], record: dict[str, Any]) -> None:
    folder, text = demonstration
    picture = folder / "last_state.png"
    if record["opengl"] is None:
        assert "libegl1" in text
        assert not picture.exists()
        return
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
    assert record["model"]["name"] == "quadruped"
    assert len(record["model"]["sha256"]) == 64
    assert record["options"]["timestep"] == 0.002
    assert record["seed"] == 0
    assert {controller["kind"] for controllers in record["controllers"].values() for controller in controllers} == {
        "trot"
    }


def test_leaves_nothing_else(demonstration: tuple[Path, str], record: dict[str, Any]) -> None:
    folder, _ = demonstration
    pictures = {"joints.png"} if record["opengl"] is None else {"joints.png", "last_state.png"}
    assert {path.name for path in folder.iterdir()} == {"run.json", *pictures}
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
        "<mujoco><worldbody><body pos='0 0 -5'><freejoint/>"
        "<geom type='box' size='.1 .1 .1'/></body></worldbody></mujoco>"
    )
    assert main(["demo", str(model), "--steps", "200", "--no-render", "--output", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "run.json").read_bytes())
    heights = [pose["position"][2] for run in record["runs"] for pose in run["final_base_poses"]]
    assert heights == pytest.approx([0.1, 0.1, 0.1], abs=0.01)
    kinds = {controller["kind"] for controllers in record["controllers"].values() for controller in controllers}
    assert kinds == {"none"}
    assert "0 actuators: nothing is driven" in capsys.readouterr().out


def test_goes_on_without_opengl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stale = tmp_path / "last_state.png"
    stale.write_bytes(b"of an earlier run")
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert main(["demo", "arm", "--steps", "8", "--output", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    for advice in ("libegl1", "libosmesa6") if sys.platform == "linux" else ("install a graphics driver",):
        assert advice in text
    assert not stale.exists()
    assert (tmp_path / "joints.png").exists()


def test_a_missing_extra_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rich" else object())
    assert main(["demo", "--output", str(tmp_path)]) == 2
    command = install_command("demo")
    assert "[demo]" in command
    assert capsys.readouterr() == ("", f"urlab demo: rich is not installed; run: {command}\n")


def test_a_model_that_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><worldbody><geom type='potato'/></worldbody></mujoco>")
    for model, words in (("robbot", ["robbot", "quadruped"]), (broken, [str(broken), "potato"])):
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
        arm = client.articulations["arm"]
        controller = SineController(arm, read_robot("arm").home_ctrl)
        seen = []
        for time in np.linspace(0, 5, 200):
            controller.act(time)
            seen.append(arm.ctrl_array.copy())
        ranges = np.array([actuator.ctrlrange for actuator in arm.actuators.values()])
    low, high = np.min(seen, axis=0), np.max(seen, axis=0)
    assert (low >= ranges[:, 0]).all()
    assert (high <= ranges[:, 1]).all()
    assert (high - low > 0.1 * np.ptp(ranges, axis=1)).all()


ROBOT_WITHOUT_FLOOR = """
<mujoco model="crab">
  <asset><mesh name="claw" file="claw.obj"/></asset>
  <worldbody>
    <body name="shell" pos="0 0 0.1">
      <freejoint/>
      <geom size="0.1"/>
      <body name="arm" pos="0.1 0 0.1"><joint name="hip"/><geom type="mesh" mesh="claw"/></body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="hip"/></actuator>
</mujoco>
"""


@pytest.fixture
def crab(tmp_path: Path) -> Path:
    """A robot that can fall, brings no floor, and has a file beside it."""
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "claw.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    (folder / "crab.xml").write_text(ROBOT_WITHOUT_FLOOR)
    return folder / "crab.xml"


def demo_on(server: SimulatedServer, *arguments: str | Path) -> int:
    options = server.client_options()
    address = f"{options['address']}:{options['step_port']}"
    return main(["demo", *map(str, arguments), "--address", address, "--no-render"])


def test_a_model_goes_over_the_wire_to_a_server_that_runs_already(crab: Path, tmp_path: Path) -> None:
    output = tmp_path / "output"
    with SimulatedServer("arm", play=True, dialect="beta") as server:
        assert demo_on(server, "arm", "--steps", "8", "--output", output) == 0  # the next empties its levels
        assert demo_on(server, crab, "--steps", "60", "--output", output) == 0
        record = json.loads((output / "run.json").read_bytes())
        assert record["address"].startswith("tcp://")
        assert [run["steps"] for run in record["runs"]] == [60, 15]
        assert [len(run["final_base_poses"]) for run in record["runs"]] == [1, 2]
        for run in record["runs"]:
            assert all(0.08 < pose["position"][2] < 0.15 for pose in run["final_base_poses"]), "there is a floor"
        with URLabClient(**server.client_options()) as client:
            client.discover()
            robots = {actor.actor_id for actor in client.scene.snapshot().actors if actor.is_articulation}
    assert robots == {"crab_1", "crab_2"}


def test_a_server_that_cannot_be_given_the_model(
    crab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with SimulatedServer("arm", play=True) as server:
        assert demo_on(server, crab, "--output", tmp_path / "output") == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "does not accept uploads" in err
    assert str(crab) in err


def test_an_address_that_would_start_a_server(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--address", "sim://arm"])
    assert "give the address of a running one" in capsys.readouterr().err
