"""Recording and its files, asked for as raw bytes; numbers are those of the checklist of observable behaviours."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire import Wire

from urlab_client.server.recording import Frame, Layout, decode_csv, decode_json, encode_json

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


@pytest.mark.parametrize("path", ["/etc/ep.json", "../../../ep.json", "a\0b"])
def test_files_elsewhere_are_refused(bot: Wire, path: str) -> None:
    bot.ask("recording_start")
    bot.ask("step")
    reply = bot.raw({"op": "recording_save", "session_id": bot.session_id, "path": path})
    assert reply["code"] == "path_not_writable"
    assert bot.refused("replay_load", path=path) == "path_not_readable"


def test_links_lead_nowhere_else_and_models_stay(bot: Wire, tmp_path: Path, models: Path) -> None:
    replays = tmp_path / "saved" / "URLab" / "Replays"
    replays.mkdir(parents=True)
    (replays / "out").symlink_to(tmp_path)
    bot.ask("recording_start")
    bot.ask("step")
    for path in ("out/ep.json", str(models / "bot.xml")):
        reply = bot.raw({"op": "recording_save", "session_id": bot.session_id, "path": path})
        assert reply["code"] == "path_not_writable", path
    assert "<mujoco" in (models / "bot.xml").read_text()
    inside = tmp_path / "saved" / "mine" / "ep.json"
    assert bot.ask("recording_save", path=str(inside))["absolute_path"] == str(inside)
    assert inside.exists()


def frames_equal(ours: list[Frame], theirs: list[Frame]) -> bool:
    return len(ours) == len(theirs) and all(
        a.time == b.time and a.layout == b.layout and np.array_equal(a.qpos, b.qpos) and np.array_equal(a.qvel, b.qvel)
        for a, b in zip(ours, theirs, strict=True)
    )


numbers = st.floats(allow_nan=False, allow_infinity=False)
joints = st.dictionaries(st.text(max_size=5), st.sampled_from([(7, 6), (4, 3), (1, 1)]), max_size=3)


@given(joints, st.lists(numbers, max_size=4), st.data())
def test_what_is_saved_is_loaded(widths: dict[str, tuple[int, int]], times: list[float], data: Any) -> None:
    layout = Layout.of((name, *width) for name, width in widths.items())
    nq, nv = sum(width[0] for width in widths.values()), sum(width[1] for width in widths.values())

    def row(size: int) -> np.ndarray[Any, Any]:
        return np.array(data.draw(st.lists(numbers, min_size=size, max_size=size)), dtype=float)

    frames = [Frame(time, layout, row(nq), row(nv)) for time in times]
    assert frames_equal(decode_json(encode_json(frames)), frames)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_file_of_the_plugin(encoding: str) -> None:
    text = '{"frames":[{"TIMESTAMP":1,"JointStates":{"é":{"QPos":[2],"qvel":[3]}},"extra":0},{}]}'
    first, second = decode_json(text.encode(encoding))
    assert (first.time, first.qpos.tolist(), first.qvel.tolist()) == (1.0, [2.0], [3.0])
    assert "é" in first.layout.joints
    assert second.layout.joints == {}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"Frames": 3}', '{"Frames": ['])
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
