"""Recording and its files, asked for as raw bytes; numbers are those of the checklist of observable behaviours."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire import Wire

from urlab_client.server import Limits
from urlab_client.simulation import joint_recording as recording
from urlab_client.simulation.joint_recording import Frame, JointLayout, decode_csv, decode_json, encode_json

Serve = Callable[..., Wire]


@pytest.fixture
def bot(serve: Serve, tmp_path: Path) -> Wire:
    wire = serve("bot", play=True, saved_dir=tmp_path / "saved")
    wire.ask("set_mode", mode="direct")
    return wire


def test_097_098_start_and_stop(bot: Wire) -> None:
    assert bot.refused("recording_stop") == "recording_not_active"
    started = bot.ask("recording_start", name="mine")
    assert started == {
        "op": "recording_start_ok",
        "name": "Live Recording",
        "max_duration_s": 3.4028234663852886e38,
    }
    assert bot.refused("recording_start") == "recording_already_active"


def test_099_one_frame_per_step(bot: Wire) -> None:
    bot.ask("recording_start")
    bot.ask("step", n_steps=50)
    stopped = bot.ask("recording_stop")
    assert stopped["frame_count"] == 50
    assert stopped["sim_duration_s"] == pytest.approx(49 * 0.002)


def test_100_the_window_rolls(bot: Wire) -> None:
    bot.ask("recording_start", max_duration_s=0.1)
    bot.ask("step", n_steps=500)
    assert bot.ask("recording_stop")["sim_duration_s"] <= 0.1 + 0.002


def test_a_recording_takes_no_more_memory_than_it_may(
    serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    wire = serve("bot", play=True, saved_dir=tmp_path / "saved", limits=Limits(recording_bytes=20_000))
    wire.ask("set_mode", mode="direct")
    for times in (1, 2):
        wire.ask("recording_start")
        wire.ask("step", n_steps=200)
        stopped = wire.ask("recording_stop")
        kept = int(stopped["frame_count"])
        assert 1 < kept < 200
        assert stopped["sim_duration_s"] == pytest.approx((kept - 1) * 0.002), "the newest, and no gap"
        said = f"the recording has reached the limit recording_bytes, 20000 ({kept} frames): the oldest are dropped"
        assert caplog.messages.count(said) == times, "once for each"


def test_101_the_file(bot: Wire, tmp_path: Path) -> None:
    bot.ask("recording_start")
    bot.ask("step", n_steps=3)
    path = Path(bot.ask("recording_save", path="ep.json")["absolute_path"])
    assert path == tmp_path / "saved" / "URLab" / "Replays" / "ep.json"
    content = json.loads(path.read_text())
    assert set(content) == {"Frames"}
    frame = content["Frames"][0]
    assert set(frame) == {"timestamp", "jointStates", "cameraPosition", "cameraRotation", "bHasCameraData"}
    widths = {name: (len(s["qPos"]), len(s["qVel"])) for name, s in frame["jointStates"].items()}
    assert sorted(widths.values()) == [(1, 1), (7, 6)]
    assert [name for name in widths if name.endswith("_j")]
    assert [*path.parent.iterdir()] == [path], "no temporary file stays"


def test_102_nothing_to_save(bot: Wire) -> None:
    bot.ask("recording_start")
    bot.ask("step")
    bot.ask("recording_clear")
    reply = bot.raw({"op": "recording_save", "session_id": bot.session_id})
    assert set(reply) == {"op", "code", "absolute_path"}
    assert (reply["op"], reply["code"]) == ("error", "path_not_writable")


@pytest.mark.parametrize("path", ["/etc/ep.json", "../../../ep.json", "a\0b", ".", "..", "inner/", "../../Levels"])
def test_files_elsewhere_are_refused(bot: Wire, path: str) -> None:
    bot.ask("recording_start")
    bot.ask("step")
    reply = bot.raw({"op": "recording_save", "session_id": bot.session_id, "path": path})
    assert reply["code"] == "path_not_writable"
    assert bot.refused("replay_load", path=path) == "path_not_readable"


def test_a_refusal_names_the_folders_that_recordings_are_loaded_from(bot: Wire, tmp_path: Path, models: Path) -> None:
    said = bot.refusal("replay_load", path="/etc/ep.json")[1]
    assert f"({(tmp_path / 'saved/URLab/Replays').resolve()}, {models.resolve()})" in said


def test_links_lead_nowhere_else_and_models_stay(bot: Wire, tmp_path: Path, models: Path) -> None:
    replays = tmp_path / "saved" / "URLab" / "Replays"
    replays.mkdir(parents=True)
    (replays / "out").symlink_to(tmp_path)
    bot.ask("recording_start")
    bot.ask("step")
    inside = tmp_path / "saved" / "mine" / "ep.json"
    for path in ("out/ep.json", "inner/ep.json", str(inside), str(models / "bot.xml"), str(models / "ep.json")):
        reply = bot.raw({"op": "recording_save", "session_id": bot.session_id, "path": path})
        assert reply["code"] == "path_not_writable", path
        assert reply["absolute_path"] == str((replays / path).resolve())
    assert "<mujoco" in (models / "bot.xml").read_text()
    assert not inside.exists()
    named = replays / "ep.json"
    assert bot.ask("recording_save", path=str(named))["absolute_path"] == str(named)


def test_no_recording_is_in_the_way_of_levels_and_models(bot: Wire, models: Path) -> None:
    bot.ask("recording_start")
    bot.ask("step")
    for path in ("../../Levels", "../../MuJoCoImports", "../../Levels/lab.json", "../../MuJoCoImports/bot"):
        reply = bot.raw({"op": "recording_save", "session_id": bot.session_id, "path": path})
        assert reply["code"] == "path_not_writable", path
    bot.ask("stop_pie")
    bot.ask("import_xml", path=str(models / "bot.xml"), force_reimport=True)
    assert bot.ask("create_level", name="lab")["level_path"] == "/Game/Levels/lab"


def frames_equal(ours: list[Frame], theirs: list[Frame]) -> bool:
    return len(ours) == len(theirs) and all(
        a.time == b.time and a.layout == b.layout and np.array_equal(a.qpos, b.qpos) and np.array_equal(a.qvel, b.qvel)
        for a, b in zip(ours, theirs, strict=True)
    )


numbers = st.floats(allow_nan=False, allow_infinity=False)
joints = st.dictionaries(st.text(max_size=5), st.sampled_from([(7, 6), (4, 3), (1, 1)]), max_size=3)


@given(joints, st.lists(numbers, max_size=4), st.data())
def test_what_is_saved_is_loaded(widths: dict[str, tuple[int, int]], times: list[float], data: Any) -> None:
    layout = JointLayout.of((name, *width) for name, width in widths.items())
    nq, nv = sum(width[0] for width in widths.values()), sum(width[1] for width in widths.values())

    def row(size: int) -> np.ndarray[Any, Any]:
        return np.array(data.draw(st.lists(numbers, min_size=size, max_size=size)), dtype=float)

    frames = [Frame(time, layout, row(nq), row(nv)) for time in times]
    assert frames_equal(decode_json(encode_json(frames)), frames)


def test_a_damaged_file_and_one_with_a_huge_frame_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    layout = JointLayout.of([("j", 2, 2)])
    content = encode_json([Frame(float(at), layout, np.full(2, 0.25), np.full(2, -0.125)) for at in range(90)])
    broken = content.replace(b'"timestamp":89', b'"timestamp"=89')
    with pytest.raises(ValueError, match=rf"byte {broken.index(b'=')}\)"):
        decode_json(broken)
    monkeypatch.setattr(recording, "_FRAME_BYTES", 100)
    with pytest.raises(ValueError, match="a frame has more than 100 bytes"):
        decode_json(content)


def test_frames_take_no_more_memory_than_a_file_of_their_size_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "_SMALL_BYTES", 1000)
    assert len(decode_json(b'{"Frames":[{},{}]}')) == 2
    content = b'{"Frames":[' + b"{}," * 40 + b"{}]}"
    with pytest.raises(ValueError, match=f"its frames take more than {16 * len(content)} bytes of memory"):
        decode_json(content)
    one = [Frame(0.5, JointLayout.of([("j", 1, 1)]), np.zeros(1), np.zeros(1))]
    assert len(decode_json(encode_json(one * 100))) == 100


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_file_of_the_plugin(encoding: str) -> None:
    text = '{"frames":[{"TIMESTAMP":1,"JointStates":{"é":{"QPos":[2],"qvel":[3]}},"extra":0},{}]}'
    first, second = decode_json(text.encode(encoding))
    assert (first.time, first.qpos.tolist(), first.qvel.tolist()) == (1.0, [2.0], [3.0])
    assert "é" in first.layout.joints
    assert second.layout.joints == {}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"Frames": 3}',
        '{"Frames": [',
        '{"Frames": ' + 100_000 * "[",
        '{"frames": [{"timestamp": 1' + 400 * "0" + "}]}",
        '{"Frames": [{"timestamp": 1e400}]}',
    ],
    ids=lambda text: text[:30],
)
def test_no_recordings(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode_json(text.encode())


def test_tables() -> None:
    frames = decode_csv(b"time,a,b[0],b[1],b[2],b[3],cam_x\n1.5,0.1,1,0,0,0,9\n")
    assert frames[0].time == 1.5
    assert frames[0].qpos.tolist() == [0.1, 1.0, 0.0, 0.0, 0.0]
    assert [frame.time for frame in decode_csv(b"a\n1\n2\n")] == [0.0, 0.002]
    with pytest.raises(ValueError, match="row 2"):
        decode_csv(b"a,b\n1\n")
    with pytest.raises(ValueError, match="not a table"):
        decode_csv(b"a\n" + 200_000 * b"x")


def test_live_physics_is_recorded_step_by_step(serve: Serve, tmp_path: Path) -> None:
    wire = serve("bot", play=True, saved_dir=tmp_path / "saved")
    wire.ask("recording_start")
    wire.ask("set_paused", paused=False)
    for status in wire.until("pie_status"):
        if status["sim_time"] > 0.05:
            break
    wire.ask("set_paused", paused=True)
    stopped = wire.ask("recording_stop")
    times = [frame["timestamp"] for frame in json.loads(saved(wire))["Frames"]]
    assert len(times) == stopped["frame_count"]
    assert np.allclose(times, 0.002 * np.arange(1, len(times) + 1))
    assert stopped["sim_duration_s"] == pytest.approx(times[-1] - times[0])


def test_pushes_are_recorded_one_by_one(serve: Serve, tmp_path: Path) -> None:
    wire = serve("bot", play=True, saved_dir=tmp_path / "saved")
    wire.ask("set_mode", mode="puppet")
    wire.ask("recording_start", max_duration_s=-1)
    for at in (0.5, 0.25, 7.0):
        wire.ask("step", qpos=[0, 0, 1, 1, 0, 0, 0, at], time=at, n_steps=10)
    assert wire.ask("recording_stop")["frame_count"] == 3
    frames = json.loads(saved(wire))["Frames"]
    assert [(frame["timestamp"], joint(frame, "_j")) for frame in frames] == [(at, [at]) for at in (0.5, 0.25, 7.0)]


def test_clearing_goes_on_recording(bot: Wire) -> None:
    bot.ask("recording_start")
    bot.ask("step", n_steps=5)
    bot.ask("recording_clear")
    bot.ask("step", n_steps=3)
    assert bot.ask("recording_stop")["frame_count"] == 3


def test_a_recording_begun_after_a_replay_was_loaded_is_the_one_that_is_saved(bot: Wire) -> None:
    bot.ask("recording_start")
    bot.ask("step", n_steps=3)
    bot.ask("recording_stop")
    loaded = bot.ask("recording_save", path="old.json")["absolute_path"]
    bot.ask("replay_load", path=loaded)
    bot.ask("recording_start")
    bot.ask("step", n_steps=5)
    bot.ask("recording_stop")
    frames = json.loads(saved(bot))["Frames"]
    assert [frame["timestamp"] for frame in frames] == pytest.approx([0.002 * step for step in range(4, 9)])


def saved(wire: Wire) -> bytes:
    return Path(wire.ask("recording_save")["absolute_path"]).read_bytes()


def joint(frame: dict[str, Any], suffix: str) -> list[float]:
    (found,) = (state["qPos"] for name, state in frame["jointStates"].items() if name.endswith(suffix))
    return found


SAVER = """
import os, random, signal, sys, time
from pathlib import Path
import numpy as np
from urlab_client._platform.files import write_whole
from urlab_client.simulation.joint_recording import Frame, JointLayout, encode_json
from urlab_client.simulation import joint_recording as recording

layout = JointLayout.of([("j", 1, 1)])
file, chance = Path(sys.argv[1]), random.Random(0)

def content(version):
    return encode_json([Frame(float(version), layout, np.full(1, version), np.zeros(1))] * 2000)

contents = [content(version) for version in range(8)]
killed = 0
for _ in range(60):
    child = os.fork()
    if child == 0:
        while True:
            for one in contents:
                write_whole(file, one)
    while killed == 0 and not file.exists():  # the first one has time to write it
        time.sleep(0.001)
    time.sleep(chance.uniform(0.0, 0.02))
    os.kill(child, signal.SIGKILL)
    killed += os.WIFSIGNALED(os.waitpid(child, 0)[1])
    if file.exists() and file.read_bytes() not in contents:
        sys.exit("half a file")
print(killed, file.exists())
"""


def test_a_kill_while_saving_leaves_one_file_or_the_other(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SAVER, str(tmp_path / "ep.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout.strip(), done.stderr) == ("60 True", "")
