"""Recordings turned into other files, read back and compared with the recording."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from made_recordings import Robot, write_recording
from PIL import Image
from pyarrow import parquet

import urlab_client
from urlab_client.cli import main
from urlab_client.cli.plot import Curves, plot_curves
from urlab_client.integrations._feed.scene import SceneLayout
from urlab_client.integrations.gym import URLabEnv
from urlab_client.integrations.record import (
    RecordingError,
    Run,
    export,
    read_run,
    record,
    tables,
)
from urlab_client.integrations.record import lerobot as lerobot_dataset
from urlab_client.integrations.record.contents import even, visible
from urlab_client.integrations.record.lerobot import LeRobot, _rate
from urlab_client.integrations.record.tables import component_name, quantities
from urlab_client.integrations.record.transitions import transitions
from urlab_client.server import SimulatedServer

C0_AND_C2 = (0x1F, 0x77, 0xB4), (0x2C, 0xA0, 0x2C)
"""Matplotlib's first and third colour."""

# Stands in for LeRobot, which the tests do not install: keeps what it is given.
LEROBOT = """
import json
from pathlib import Path
class LeRobotDataset:
    @classmethod
    def create(cls, repo_id, fps, features, root, robot_type, use_videos):
        made = cls()
        made.root, made.frames, made.log = Path(root), [], {"fps": fps, "repo_id": repo_id, "episodes": []}
        made.log |= {"robot_type": robot_type, "use_videos": use_videos}
        made.root.mkdir()
        made.log["features"] = {k: [v["dtype"], list(v["shape"]), v["names"]] for k, v in features.items()}
        return made
    def add_frame(self, frame):
        for name, (dtype, shape, _) in self.log["features"].items():
            assert list(frame[name].shape) == shape
            assert str(frame[name].dtype) == ("uint8" if dtype in ("image", "video") else dtype)
        shown = {k: v if isinstance(v, str) else v.ravel()[:: max(1, v.size // 99)].tolist() for k, v in frame.items()}
        self.frames.append(shown)
    def save_episode(self):
        self.log["episodes"].append(self.frames)
        self.frames = []
    def finalize(self):
        (self.root / "log.json").write_text(json.dumps(self.log))
"""


@pytest.fixture(scope="module")
def recorded(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two episodes of two arms, with pictures of odd size and depths."""
    folder = tmp_path_factory.mktemp("recorded")
    mjcf = folder / "eye.xml"
    mjcf.write_text(
        "<mujoco><visual><global offwidth='64' offheight='64'/></visual><worldbody><light pos='0 0 3'/>"
        "<body name='base'><geom type='box' size='.1 .2 .1' rgba='1 0 0 1' mass='1'/>"
        "<joint name='spin' axis='0 0 1'/>"
        "<camera name='up' pos='0 0 1' resolution='33 21'/></body></worldbody>"
        "<actuator><motor name='spin' joint='spin'/></actuator></mujoco>",
        encoding="utf-8",
    )
    rng = np.random.default_rng(2)
    with (
        SimulatedServer("arm", str(mjcf), play=True, model_roots=[folder]) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.reset()
        with record(client, folder / "run.mcap", cameras=["eye/up"], camera_hz=25, image_format="png"):
            for i in range(100):
                for art in client.articulations.values():
                    art.ctrl_array[:] = rng.uniform(-0.3, 0.3, len(art.ctrl_array))
                if i == 60:
                    client.reset()
                else:
                    client.step(n_steps=2)
    return read_run(folder / "run.mcap")


def test_a_moment_is_what_the_table_and_the_frames_hold(recorded: Run) -> None:
    table, frames = recorded.table(), list(recorded.frames("eye/up"))
    assert recorded.time_range() == (table.time[0], table.time[-1])
    assert recorded.state_at(table.time[0] - 1e-6) is None
    assert recorded.picture_at("eye/up", frames[0].time - 1e-6) is None
    for wanted in (0, 1, 58, 59, 60, 61, len(table) - 1):
        row = int(np.flatnonzero(table.time == table.time[wanted])[-1])  # of several at one time the last
        state = recorded.state_at(table.time[row] + 1e-6)
        assert state is not None
        assert (state.time, state.step, state.episode) == (table.time[row], table.step[row], table.episode[row])
        for key, robot in state.articulations.items():
            for name in ("qpos", "qvel", "set_points", "ctrl"):
                assert getattr(robot, name).tolist() == table.columns[f"{key}/{name}"].values[row].tolist()
    for before, picture in pairwise(frames):
        found = recorded.picture_at("eye/up", picture.time - 1e-6)
        assert found is not None
        assert found.time == before.time
        assert np.array_equal(found.pixels, before.pixels)
    assert [*recorded.table(fields=["qpos"]).columns] == ["arm/qpos", "eye/qpos"]
    with pytest.raises(KeyError, match="arm/nose"):
        recorded.picture_at("arm/nose", 0.0)


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording of a hundred states is read in about fifteen pieces, as one of a night is."""
    monkeypatch.setattr(tables, "PIECE_VALUES", 500)
    monkeypatch.setattr(lerobot_dataset, "_TOGETHER", 3)


@pytest.mark.usefixtures("small_pieces")
def test_csv_and_parquet_hold_every_value_to_the_bit(recorded: Run, tmp_path: Path) -> None:
    flat = transitions(recorded.table()).flat()
    assert export.write_csv(recorded, tmp_path / "run.csv") == 98
    assert export.write_parquet(recorded, tmp_path / "run.parquet") == 98
    with (tmp_path / "run.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    table = parquet.read_table(tmp_path / "run.parquet")
    assert parquet.ParquetFile(tmp_path / "run.parquet").num_row_groups > 5
    assert list(rows[0]) == table.column_names == list(flat)
    assert {"time", "episode", "arm/qpos/shoulder_pan", "arm/sensors/grip_position.0", "eye/ctrl/spin"} <= flat.keys()
    for name, column in flat.items():
        assert np.array([type(column[0].item())(row[name]) for row in rows], column.dtype).tobytes() == column.tobytes()
        assert table[name].to_numpy().tobytes() == column.tobytes()


@pytest.mark.opengl
def test_rows_pair_an_observation_with_the_action_taken_at_it(tmp_path: Path) -> None:
    """Held against what was driven, over episodes that begin with noise and pictures, which take several resets."""
    rng = np.random.default_rng(5)
    driven: list[list[tuple[Any, Any]]] = []
    with (
        SimulatedServer("arm", play=True, camera_size=(32, 24)) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        env = URLabEnv(
            client, space_mode="dict", observations=["qpos"], cameras=["arm/wrist"], n_substeps=10, reset_noise=0.1
        )
        with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=50, image_format="png"):
            for steps in (6, 1, 4):
                seen, _ = env.reset()
                driven.append([])
                for _ in range(steps):
                    action = {"arm": rng.uniform(-0.3, 0.3, 7).astype(np.float32)}
                    driven[-1].append((seen, action["arm"]))
                    seen, *_ = env.step(action)
    run = read_run(tmp_path / "run.mcap")
    table = transitions(run.table())
    assert table.episode.tolist() == [i for i, episode in enumerate(driven) for _ in episode]
    expected = [pair for episode in driven for pair in episode]
    assert np.array_equal(table.columns["arm/qpos"].values, [seen["arm"]["qpos"] for seen, _ in expected])
    assert np.array_equal(table.columns["arm/action"].values, [action for _, action in expected])
    assert table.columns["arm/action"].names == table.columns["arm/set_points"].names
    pictures = {round(picture.time, 6): picture.pixels for picture in run.frames("arm/wrist")}
    for time, (seen, _) in zip(table.time, expected, strict=True):
        assert np.array_equal(pictures[round(float(time), 6)], seen["cameras"]["arm/wrist"][..., :3])


@pytest.mark.usefixtures("small_pieces")
def test_npz_holds_arrays_names_and_pictures(recorded: Run, tmp_path: Path) -> None:
    export.write_npz(recorded, tmp_path / "run.npz", cameras=["eye/up"])
    table, pictures = recorded.table(), list(recorded.frames("eye/up"))
    with np.load(tmp_path / "run.npz", allow_pickle=False) as arrays:
        for key, column in table.columns.items():
            assert arrays[key].tobytes() == column.values.tobytes()
            assert arrays[f"{key}.names"].tolist() == column.names
        assert arrays["camera/eye/up"].shape == (len(pictures), 21, 33, 3)
        assert np.array_equal(arrays["camera/eye/up"][-1], pictures[-1].pixels)
        assert arrays["camera/eye/up.time"].tolist() == [picture.time for picture in pictures]


def test_mp4_shows_each_picture_at_its_time(recorded: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = list(recorded.frames("eye/up"))
    assert export.write_mp4(recorded, tmp_path / "run.mp4", "eye/up") == len(pictures) > 8
    with av.open(tmp_path / "run.mp4") as container:
        frames = [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert len(frames) == len(pictures)
    for (time, shown), picture in zip(frames, pictures, strict=True):
        assert time == pytest.approx(picture.time - pictures[0].time, abs=1e-4)
        assert shown.shape == (22, 34, 3)
        assert np.abs(shown[:21, :33].astype(int) - picture.pixels).mean() < 12
    with pytest.raises(KeyError, match="eye/up"):
        export.write_mp4(recorded, tmp_path / "none.mp4", "eye/down")
    monkeypatch.delitem(export._CODECS, "libx264")  # the other codec writes each picture at once
    with pytest.raises(KeyboardInterrupt):
        export.write_mp4(recorded, tmp_path / "none.mp4", "eye/up", lambda _: signal.raise_signal(signal.SIGINT))
    assert os.listdir(tmp_path) == ["run.mp4"]


def test_depth_becomes_grey() -> None:
    depths = np.array([[0.0, 1.0], [2.0, np.inf]], dtype=np.float32)
    assert visible(depths, 2.0)[..., 0].tolist() == [[255, 128], [0, 0]]


@pytest.fixture
def lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An interpreter that has something called LeRobot."""
    package = tmp_path / "site" / "lerobot" / "datasets"
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    (package / "lerobot_dataset.py").write_text(LEROBOT, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"), prepend=os.pathsep)
    return sys.executable


@pytest.mark.usefixtures("small_pieces")
def test_a_lerobot_dataset_is_written_by_the_other_interpreter(recorded: Run, tmp_path: Path, lerobot: str) -> None:
    written = export.write_lerobot(
        recorded, tmp_path / "spins", python=lerobot, fps=25, task="spin", max_picture_age=0.05
    )
    log: dict[str, Any] = json.loads((tmp_path / "spins" / "log.json").read_text())
    table = recorded.table()
    assert (log["fps"], log["repo_id"]) == (25, "local/spins")
    assert log["features"]["observation.state"][1:] == [
        [9],
        [f"arm.{n}" for n in table.columns["arm/qpos"].names] + ["eye.spin"],
    ]
    assert (log["robot_type"], log["use_videos"]) == ("arm+eye", True)
    assert log["features"]["observation.images.eye.up"][:2] == ["video", [22, 34, 3]]
    assert [len(episode) for episode in log["episodes"]] == [6, 4]
    assert sum(map(len, log["episodes"])) == written
    row = 61 + 3 * 10  # the fourth frame of the second episode, from its first picture on: 0.04 s are ten samples
    frame = log["episodes"][1][3]
    assert frame["task"] == "spin"
    state = np.concatenate([table.columns[f"{key}/qpos"].values[row] for key in ("arm", "eye")])
    assert frame["observation.state"] == state.astype(np.float32).tolist()
    action = np.concatenate([table.columns[f"{key}/set_points"].values[row + 1] for key in ("arm", "eye")])
    assert frame["action"] == action.astype(np.float32).tolist()
    pictures = list(recorded.frames("eye/up"))
    for start, frames in zip((0, 61), log["episodes"], strict=True):
        for i, frame in enumerate(frames):
            when = table.time[start + (10 * i if start else 0)] + (0.0 if start else 0.04 * i) + 1e-6
            newest = [picture for picture in pictures if picture.time <= when][-1]
            assert frame["observation.images.eye.up"] == even(visible(newest.pixels, 1.0)).ravel()[::22].tolist()
    with pytest.raises(FileExistsError):
        export.write_lerobot(recorded, tmp_path / "spins", python=lerobot, fps=50, task="spin")


def test_what_outlives_a_lerobot_is_not_waited_for(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text(
        f"#!{sys.executable}\nimport os, time\n"
        "if encodes := os.fork():\n    open(os.sys.argv[3] + '/encodes', 'w').write(str(encodes))\n    os._exit(0)\n"
        "time.sleep(600)\n"
    )
    python.chmod(0o700)
    with LeRobot(str(python), tmp_path) as writer:
        writer._process.wait()
        writer.finish()
    os.kill(int((tmp_path / "encodes").read_text()), signal.SIGKILL)


def test_a_lerobot_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "script.py"
    script.write_text("import sys\nsys.stdin.read()\n")
    monkeypatch.setattr(lerobot_dataset, "_SCRIPT", script)
    monkeypatch.setattr(lerobot_dataset, "_DEADLINE_S", 0.1)
    monkeypatch.setattr(lerobot_dataset, "_FRAME_S", 0.0)
    with LeRobot(sys.executable, tmp_path) as writer:
        writer.add({"state": np.zeros((1, 2))}, ends_episode=True)
        with pytest.raises(RecordingError, match=r"LeRobot did not finish within 0\.1 s"):
            writer.finish()


@pytest.mark.usefixtures("small_pieces")
def test_a_lerobot_dataset_is_whole_or_not_there(recorded: Run, tmp_path: Path, lerobot: str) -> None:
    stand_in = next(tmp_path.rglob("lerobot_dataset.py"))
    written = partial(
        export.write_lerobot, recorded, tmp_path / "spins", python=lerobot, fps=25, task="spin", max_picture_age=0.05
    )
    told: list[int] = []
    written(progress=told.append)
    assert told == sorted(told)
    shutil.rmtree(tmp_path / "spins")
    presses = iter([lambda: None] * (len(told) - 1))
    with pytest.raises(KeyboardInterrupt):
        written(progress=lambda _: next(presses, lambda: signal.raise_signal(signal.SIGINT))())
    assert os.listdir(tmp_path) == ["site"]
    stand_in.write_text(LEROBOT.replace("self.frames = []\n    def", "raise OSError('disk full')\n    def"), "utf-8")
    with pytest.raises(RecordingError, match="LeRobot failed: OSError: disk full"):
        written()
    assert os.listdir(tmp_path) == ["site"]


def test_a_lerobot_dataset_holds_what_kept_episodes_were_about(tmp_path: Path, lerobot: str) -> None:
    with (
        SimulatedServer("arm", play=True) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, tmp_path / "run.mcap", pose_hz=0) as recorder:
            for outcome in ("success", "discarded", "failure"):
                client.reset()
                for _ in range(3):
                    client.step(10)
                number = float(len(outcome))
                recorder.mark(outcome, goal={"place": np.array([number, 0.5]), "height": number})
            client.reset()
            client.step(10)
    run = read_run(tmp_path / "run.mcap")
    assert export.write_lerobot(run, tmp_path / "dataset", python=lerobot, task="go there", fps=50) == 6
    log = json.loads((tmp_path / "dataset" / "log.json").read_text(encoding="utf-8"))
    feature = log["features"]["observation.environment_state"]
    assert feature == ["float32", [3], ["place.0", "place.1", "height.0"]]
    abouts = [[frame["observation.environment_state"] for frame in frames] for frames in log["episodes"]]
    assert abouts == [[[7.0, 0.5, 7.0]] * 3] * 2
    one = export.write_lerobot(run, tmp_path / "good", python=lerobot, task="go there", fps=50, episodes="success")
    assert one == 3


def test_a_frame_never_shows_an_older_picture_unasked(recorded: Run, tmp_path: Path, lerobot: str) -> None:
    with pytest.raises(
        RecordingError, match=r"8 of 20 frames would show an older picture of eye/up.*--max-picture-age"
    ):
        export.write_lerobot(recorded, tmp_path / "spins", python=lerobot, fps=50, task="spin")
    assert not (tmp_path / "spins").exists()


def test_the_rate_is_the_usual_one_although_pictures_are_missing(recorded: Run) -> None:
    times = np.arange(50) / 25
    assert _rate(recorded, [np.delete(times, [7, 8, 20]), np.delete(times, [3])]) == 25


def test_a_dataset_of_centuries_is_refused(tmp_path: Path, lerobot: str) -> None:
    write_recording(tmp_path / "run.mcap", [({"arm": Robot([0.0])}, {})] * 3, period_ns=10**18)
    with pytest.raises(RecordingError, match=r"run\.mcap: .* more than 10000000 frames"):
        export.write_lerobot(read_run(tmp_path / "run.mcap"), tmp_path / "made", python=lerobot, task="t", fps=30)


def test_a_missing_lerobot_is_told(recorded: Run, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"has no LeRobot: .*No module named 'lerobot'.*--python"):
        export.write_lerobot(recorded, tmp_path / "data", python=sys.executable, fps=50, task="x")
    with pytest.raises(RecordingError, match="cannot be run"):
        export.write_lerobot(recorded, tmp_path / "data", python=str(tmp_path / "nothing"), fps=50, task="x")
    assert not (tmp_path / "data").exists()


# The commands


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_info_tells_what_is_there(recorded: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", recorded.path) == 0
    shown = capsys.readouterr().out
    for part in ("2 episodes", "/state/arm", "foxglove.CompressedImage", "250.0", "direct mode"):
        assert part in shown
    assert "\npositions of arm: shoulder_pan, shoulder_lift," in shown
    assert run("info", recorded.path, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["topics"]["/state/arm"]["messages"] == 100
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recorded.path.read_bytes()[:-100])
    assert run("info", cut) == 1
    assert "not finished" in capsys.readouterr().out
    cut.write_bytes(b"nonsense" * 10)
    assert run("info", cut) == 2
    assert "neither an MCAP file" in capsys.readouterr().err
    assert run("info", tmp_path / "none.mcap") == 2
    assert "No such file" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet", "mp4"])
def test_convert_writes_whole_files_and_overwrites_only_when_told(
    recorded: Run, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / f"run.{kind}"
    target.write_text("precious", encoding="utf-8")
    assert run("convert", recorded.path, target) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert target.read_text(encoding="utf-8") == "precious"
    assert run("convert", recorded.path, target, "--overwrite") == 0
    assert target.stat().st_size > 500
    assert os.listdir(tmp_path) == [target.name]
    said = capsys.readouterr().out
    assert said.startswith(f"{target}  ")
    assert said.endswith(" rows: states, with the actions that followed\n") == (kind in {"csv", "parquet"})


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["out"], "--format"),
        (["out.mp4", "--camera", "nose"], "no pictures of 'nose'"),
        (["out", "--format", "lerobot"], "--task"),
        (["out", "--format", "lerobot", "--task", "x", "--python", sys.executable], "has no LeRobot"),
    ],
)
def test_convert_says_what_is_wrong(
    recorded: Run, tmp_path: Path, arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out, *rest = arguments
    assert run("convert", recorded.path, tmp_path / out, *rest) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert complaint in line
    assert os.listdir(tmp_path) == []


def test_plot_draws_the_joints_that_are_named(
    recorded: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("plot", recorded.path, "--joints", "arm/shoulder*", "spin", "-o", tmp_path / "a.png") == 0
    assert "3 curves, 100 states\n" in capsys.readouterr().out
    assert run("plot", recorded.path, "-o", tmp_path / "a.png") == 0
    assert capsys.readouterr().out.endswith(" 100 states, instead of the file that was there\n")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert run("plot", recorded.path, "--joints", "nose", "-o", tmp_path / "b.png") == 2
    assert "arm/shoulder_pan" in capsys.readouterr().err


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_plot_draws_joints_that_are_called_like_coordinates(
    field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "cart.xml"
    model.write_text(
        '<mujoco model="cart"><worldbody><body><joint name="x" type="slide"/><geom size="0.1"/>'
        '<body><joint name="y"/><joint name="wx" axis="0 1 0"/><geom size="0.1"/></body></body>'
        '<body name="ball"><freejoint name="root"/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    with (
        SimulatedServer(str(model), play=True, model_roots=[tmp_path]) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, tmp_path / "run.mcap"):
            client.step()
    drawn: list[Curves] = []
    monkeypatch.setattr("urlab_client.cli.plot.plot_curves", lambda _title, _time, curves, _path: drawn.extend(curves))
    assert run("plot", tmp_path / "run.mcap", "--field", field) == 0
    assert [one.names for one in drawn] == [["x"], ["y", "wx"]]


def test_a_recording_without_states_has_nothing_to_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    write_recording(path, [])
    assert run("plot", path) == 2
    assert capsys.readouterr().err == f"urlab plot: {path} has no states\n"


def test_values_say_what_they_measure() -> None:
    base, hinges, slides = [f"base.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")], ["y", "leg.x"], ["x"]
    layout = SceneLayout(qpos=base + hinges + slides, slides=slides, sensors={"imu": "accelerometer"})
    expected = ["position (m)"] * 3 + ["orientation (w, x, y, z)"] * 4 + ["angle (rad)"] * 2 + ["position (m)"]
    assert quantities(layout, "qpos", layout.qpos) == expected
    speeds = [f"base.{part}" for part in ("vx", "vy", "vz", "wx", "wy", "wz")]
    expected = ["velocity (m/s)"] * 3 + ["angular velocity (rad/s)"] * 3
    assert quantities(layout, "qvel", [*speeds, "wx", "x"]) == [*expected, "angular velocity (rad/s)", "velocity (m/s)"]
    assert quantities(SceneLayout(), "qvel", ["vx", "vy", "vz", "wx", "wy", "wz"]) == expected, "of a plain entity"
    assert quantities(layout, "sensors", ["imu.0", "odd"]) == ["linear acceleration (m/s²)", "reading"]
    assert [component_name(layout, name) for name in ("imu.0", "imu.2", "odd.1")] == ["imu.x", "imu.z", "odd.1"]
    # A recording of an earlier release does not say which joints slide.
    assert quantities(SceneLayout(), "qpos", ["elbow"]) == ["position (rad, m)"]


def test_sensors_of_one_kind_share_an_axis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Curves] = []
    monkeypatch.setattr("urlab_client.cli.plot.plot_curves", lambda _title, _time, curves, _path: drawn.extend(curves))
    with (
        SimulatedServer("quadruped", play=True) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, tmp_path / "run.mcap"):
            client.step()
    assert run("plot", tmp_path / "run.mcap", "--field", "sensors", "--joints", "imu_gyro.*", "imu_acc*.x") == 0
    assert [(curves.label, curves.names) for curves in drawn] == [
        ("quadruped\nlinear acceleration (m/s²)", ["imu_accelerometer.x"]),
        ("quadruped\nangular velocity (rad/s)", ["imu_gyro.x", "imu_gyro.y", "imu_gyro.z"]),
    ]


def test_curves_in_one_place_can_be_told_apart(tmp_path: Path) -> None:
    time = np.linspace(0, 1, 50)
    values = np.stack([np.sin(time), np.cos(time), np.sin(time)], axis=1)
    colours = []
    for columns in ([0, 1], [0, 1, 2]):
        names = ["a", "b", "c"][: len(columns)]
        plot_curves("", time, [Curves("q", names, values[:, columns])], tmp_path / "plot.png")
        pixels = np.asarray(Image.open(tmp_path / "plot.png"))[:, :1150, :3]  # without the legend
        colours.append([int((np.abs(pixels.astype(int) - colour).max(axis=-1) < 10).sum()) for colour in C0_AND_C2])
    (alone, none), (shared, twin) = colours
    assert none == 0
    assert 0.3 < twin / shared < 3
    assert 0.7 < (shared + twin) / alone < 1.3


def test_rounding_noise_is_drawn_as_one_straight_line(tmp_path: Path) -> None:
    time = np.linspace(0, 1, 50)
    noise = 1e-14 * np.stack([np.sin(40 * time), np.cos(40 * time)], axis=1)
    plot_curves("", time, [Curves("q", ["a", "b"], noise)], tmp_path / "plot.svg")
    said = re.findall("<!-- (.*) -->", (tmp_path / "plot.svg").read_text(encoding="utf-8"))
    assert "b (like a)" in said, "the legend names the curve that covers another"
    assert not [text for text in said if "14" in text], "no axis is scaled to the noise"


def test_the_axis_of_what_hardly_varies_has_plain_numbers(tmp_path: Path) -> None:
    time = np.linspace(0, 1, 50)
    plot_curves("run.mcap", time, [Curves("q", ["a"], 0.3 + 1e-8 * np.sin(time)[:, None])], tmp_path / "plot.svg")
    said = re.findall("<!-- (.*) -->", (tmp_path / "plot.svg").read_text(encoding="utf-8"))
    assert {"0.30", "0.32"} <= {*said}, "not an offset and a power of ten"
    assert {"run.mcap", "q", "a", "simulation time (s)"} <= {*said}


def test_record_says_that_no_picture_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    path = tmp_path / "run.mcap"
    options = ["--camera", "all", "--step-mode", "direct", "--seconds", "0.02"]
    with SimulatedServer("arm", play=True) as server:
        ports = ["--step-port", server.step_port, "--state-port", server.state_port]
        assert run("record", server.address, path, *ports, *options) == 1
    assert "no picture of arm/overview, arm/wrist came" in capsys.readouterr().err
    assert read_run(path).table().sim_time[0] == 0.0, "the state after the reset, too"
    # A server of its own draws with what is here, so that this is known before.
    assert run("record", "sim://arm", tmp_path / "other.mcap", *options) == 2
    assert "MUJOCO_GL=disable" in capsys.readouterr().err
    assert not (tmp_path / "other.mcap").exists()


def test_record_writes_mcap_files_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("record", tmp_path / "out.txt") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "out.txt" in line
    assert "out.mcap" in line


@pytest.mark.parametrize("mode", ["direct", "live"])
def test_record_steps_or_watches(mode: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    with SimulatedServer("arm", play=True) as server:
        ports = ["--step-port", server.step_port, "--state-port", server.state_port]
        command = ["record", server.address, path, *ports, "--step-mode", mode, "--seconds", "0.3"]
        assert run(*command) == 0
        assert run(*command) == 2
    assert "--overwrite" in capsys.readouterr().err
    table = read_run(path).table()
    steps = np.diff(table.sim_time) / 0.002
    assert table.sim_time[-1] >= (0.29 if mode == "direct" else 0.15)
    assert np.allclose(steps, steps.round(), atol=1e-6)
    assert steps.min() > 0.5
    if mode == "direct":  # in live mode a server that is short of time leaves snapshots out
        assert table.sim_time[0] < 0.003
        assert steps.max() < 1.5
