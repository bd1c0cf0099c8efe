"""`urlab snapshot`: pictures of models and levels, of cameras of servers, and what it says when there is none."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import urlab
from PIL import Image

from urlab_client import URLabClient
from urlab_client._installation import install_command
from urlab_client.cli import main
from urlab_client.enums import StepMode
from urlab_client.protocol.base import DialectName
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.server import SimulatedServer


@pytest.fixture(autouse=True)
def _in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def picture(*arguments: str) -> np.ndarray[Any, Any]:
    """Run the command and return its picture, channels in 0..1."""
    assert main(["snapshot", *arguments, "-o", "out.png"]) == 0
    return np.asarray(Image.open("out.png")) / 255


@pytest.mark.opengl
def test_models_in_a_process_of_its_own(tmp_path: Path) -> None:
    done = urlab("snapshot", "quadruped", "arm", "--size", "160x90", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "snapshot.png: 160x90\n", "")
    assert np.asarray(Image.open(tmp_path / "snapshot.png")).shape == (90, 160, 3)


@pytest.mark.opengl
def test_the_ending_chooses_the_format(tmp_path: Path) -> None:
    picture = tmp_path / "ball.jpg"
    assert main(["snapshot", "ball", "--size", "32x24", "-o", str(picture)]) == 0
    with Image.open(picture) as image:
        assert (image.format, image.size) == ("JPEG", (32, 24))


@pytest.mark.opengl
def test_modes_and_moments_differ() -> None:
    size = ["--size", "64x48"]
    pictures = [
        picture("quadruped", *size, "--keyframe", "home"),
        picture("quadruped", *size, "--seconds", "0.4", "--mode", "lit"),
        picture("quadruped", *size, "--mode", "wireframe"),
    ]
    assert len({image.tobytes() for image in pictures}) == len(pictures)


@pytest.mark.opengl
def test_a_saved_level(tmp_path: Path) -> None:
    with SimulatedServer(saved_dir=tmp_path) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        client.scene.create_level("lab")
        client.scene.spawn_actor(client.scene.import_xml("ball"), "ball", location=(0, 0, 1))
        client.scene.save_level()
    assert picture(str(tmp_path / "Levels" / "lab.json"), "--size", "64x64")[28:36, 28:36, :3].max() > 0.2


@pytest.mark.opengl
def test_cameras_and_what_their_pixels_mean() -> None:
    camera = ["arm", "--camera", "arm/overview", "--size", "64x48"]
    real, depth, semantic = (picture(*camera, "--mode", mode) for mode in ("real", "depth", "semantic"))
    assert real.shape == depth.shape == semantic.shape
    assert (depth[:, :, 0] == depth[:, :, 1]).all()
    assert depth[:, :, 0].max() > 0.99
    assert len(np.unique(semantic.reshape(-1, 3), axis=0)) == 2


@pytest.mark.opengl
def test_a_camera_of_a_running_server(capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedServer("arm", play=True, unpaused=True) as server:
        address = f"{server.address}:{server.step_port}"
        assert main(["snapshot", address]) == 2
        assert "--camera, one of arm/overview, arm/wrist" in capsys.readouterr().err
        assert main(["snapshot", address, "--camera", "arm/wirst"]) == 2
        assert "Did you mean 'arm/wrist'" in capsys.readouterr().err
        assert picture(address, "--camera", "arm/overview", "--timeout", "60").shape == (480, 640, 3)
        assert main(["snapshot", address, "--camera", "arm/overview", "--seconds", "1"]) == 2
        assert "--seconds are for models" in capsys.readouterr().err


@pytest.mark.opengl
def test_a_camera_of_a_paused_beta_whose_streams_are_silent() -> None:
    with SimulatedServer("arm", play=True, dialect="beta") as server:
        address = f"{server.address}:{server.step_port}"
        assert picture(address, "--camera", "arm/overview", "--timeout", "60").shape == (480, 640, 3)


@pytest.mark.opengl
@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_a_camera_of_a_server_that_somebody_steps(dialect: DialectName) -> None:
    with (
        SimulatedServer("arm", play=True, dialect=dialect) as server,
        URLabClient(**server.client_options(), step_mode="direct", auto_promote_step_mode=False) as client,
    ):
        client.discover()
        client.call(SetMode(mode="direct"))
        address = f"{server.address}:{server.step_port}"
        assert picture(address, "--camera", "arm/wrist").shape == (480, 640, 3)
        # It is left as it was: in direct mode, where time stands still.
        client.discover()
        assert client.call(SetMode(mode="direct")).previous_mode == StepMode.DIRECT
        assert client.sim.status().sim_time == 0
        assert client.step().step == 1


def test_a_server_that_is_pinned_to_steps_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedServer("arm", play=True, step_mode="direct") as server:
        address = f"{server.address}:{server.step_port}"
        assert main(["snapshot", address, "--camera", "arm/wrist"]) == 2
    assert "In this mode, pictures come with steps" in capsys.readouterr().err


@pytest.mark.opengl
def test_a_picture_beside_the_client_that_drives(tmp_path: Path) -> None:
    with (
        SimulatedServer("arm", play=True, unpaused=True) as server,
        URLabClient(**server.client_options(), step_mode="live") as driver,
    ):
        driver.discover()
        (tmp_path / "arm.hello").write_bytes(driver.handshake())
        options = ["--camera", "arm/wrist", "--handshake", "arm.hello", "--state-port", str(server.state_port)]
        assert picture(f"{server.address}:{server.step_port}", *options).shape == (480, 640, 3)
        driver.step()


SERVED = pytest.mark.opengl  # found out by the server, which is started only where it can draw


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        pytest.param(["nosuch"], ["nosuch", "quadruped"], marks=SERVED),
        pytest.param(["arm", "--camera", "arm/tail"], ["arm/tail", "arm/wrist"], marks=SERVED),
        pytest.param(["arm", "--camera", "arm/tail", "--mode", "depth"], ["arm/tail", "arm/wrist"], marks=SERVED),
        pytest.param(["arm", "--keyframe", "nope"], ["nope", "Known: 'home'"], marks=SERVED),
        (["arm", "--mode", "depth"], ["without --camera", "wireframe"]),
        (["arm", "--mode", "unlit", "--camera", "arm/wrist"], ["with --camera", "semantic"]),
        (["arm", "-o", "nowhere/x.png"], ["nowhere"]),
        (["arm", "x.png"], ["x.png is a picture, not a model; write to it with -o x.png"]),
        (["arm", "-o", "x.txt"], ["x.txt", ".png or .jpg", "x.png"]),
        pytest.param(["amr"], ["amr", "Did you mean 'arm'?"], marks=SERVED),
        (["tcp://localhost:1", "--mjcf-options"], ["sim://MODEL", "tcp://localhost:1"]),
        (["tcp://localhost:1", "arm"], ["one address"]),
        (["arm", "--handshake", "x"], ["--handshake", "running server"]),
    ],
)
def test_refusals(arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["snapshot", *arguments]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    for word in words:
        assert word in said
    assert not list(tmp_path.glob("*.png"))


def test_no_opengl_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert main(["snapshot", "arm"]) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert out == ""
    assert "MUJOCO_GL=disable" in line


def test_without_the_library_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["snapshot", "arm"]) == 2
    assert install_command("demo") in capsys.readouterr().err


def test_without_pip_the_command_that_adds_an_extra_is_uv_s(monkeypatch: pytest.MonkeyPatch) -> None:
    assert " -m pip install " in install_command("demo")
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pip" else find(name))
    assert install_command("demo").startswith("uv pip install --python ")
