"""Replays, asked for as raw bytes; numbers are those of the checklist of observable behaviours."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import BOT, make_scene
from wire import Wire

from urlab_client.server.physics.replay import Player
from urlab_client.simulation.joint_recording import Frame, JointLayout


@pytest.fixture
def replays(tmp_path: Path) -> Path:
    folder = tmp_path / "saved" / "URLab" / "Replays"
    folder.mkdir(parents=True)
    frames = [
        {"timestamp": t, "jointStates": {"old_root": {"qPos": [5 + t, 0, 0, 1, 0, 0, 0]}, "old_j": {"qPos": [t]}}}
        for t in (0.0, 0.004)
    ]
    (folder / "ep.json").write_text(json.dumps({"Frames": frames}))
    (folder / "table.csv").write_text("time,j\n0,0\n")
    (folder / "broken.json").write_text("{")
    return folder


@pytest.fixture
def bot(serve: Callable[..., Wire], tmp_path: Path, replays: Path) -> Wire:
    return serve("bot", play=True, saved_dir=tmp_path / "saved")


def state(reply: dict[str, Any]) -> dict[str, Any]:
    (found,) = reply["per_articulation"].values()
    return found


def test_103_104_105_sessions(bot: Wire) -> None:
    assert bot.ask("replay_list_sessions")["sessions"] == ["Live Recording", "ep", "table"]
    assert bot.ask("replay_load", path="ep.json")["name"] == "ep"
    assert bot.refused("replay_load", path="ghost.json") == "path_not_readable"
    assert bot.refusal("replay_set_active", name="ghost") == ("replay_session_not_found", "ghost")
    bot.ask("replay_set_active", name="LIVE recording")


def test_106_a_replay_needs_a_stepped_mode(bot: Wire) -> None:
    bot.ask("replay_load", path="ep.json")
    assert bot.refused("replay_start") == "replay_requires_stepped"
    bot.ask("set_mode", mode="direct")
    assert bot.ask("replay_start") == {"op": "replay_start_ok", "active_session": "ep", "total_frames": 2.0}


@pytest.mark.parametrize("mode", ["direct", "puppet"])
def test_steps_play_a_file_in_a_loop(bot: Wire, mode: str) -> None:
    bot.ask("set_mode", mode=mode)
    bot.ask("replay_load", path="ep.json")
    bot.ask("replay_start")
    seen = [bot.ask("step") for _ in range(4)]
    assert [reply["replay"]["current_frame"] for reply in seen] == [0, 1, 0, 0]
    assert seen[0]["replay"]["total_frames"] == 2
    assert [state(reply)["qpos"][7] for reply in seen] == pytest.approx([0.002, 0.004, 0.0, 0.002])
    assert [state(reply)["qpos"][0] for reply in seen] == pytest.approx([0.002, 0.004, 0.0, 0.002]), "relative"
    assert seen[3]["time"] == 0.0
    bot.ask("replay_stop")
    assert "replay" not in bot.ask("step")


def test_a_free_body_turns_the_short_way(bot: Wire, replays: Path) -> None:
    """A quaternion and its negative are one orientation: between frames of either sign nothing spins."""
    half = np.sqrt(0.5)
    turns = [[1, 0, 0, 0], [-half, 0, 0, -half]]  # from none to a quarter about z, which is written with the other sign
    frames = [
        {"timestamp": 0.004 * i, "jointStates": {"root": {"qPos": [0, 0, 0, *turn]}, "j": {"qPos": [0]}}}
        for i, turn in enumerate(turns)
    ]
    (replays / "turn.json").write_text(json.dumps({"Frames": frames}))
    bot.ask("set_mode", mode="direct")
    bot.ask("replay_load", path="turn.json")
    bot.ask("replay_start")
    quaternion = np.array(state(bot.ask("step"))["qpos"][3:7])
    eighth = np.array([np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])
    assert abs(quaternion @ eighth) == pytest.approx(1.0, abs=1e-6)


def test_a_live_recording_comes_back_exactly(bot: Wire) -> None:
    bot.ask("set_mode", mode="direct")
    bot.ask("recording_start")
    recorded = [state(bot.ask("step"))["qpos"] for _ in range(10)]
    assert bot.ask("replay_start")["total_frames"] == 10
    assert bot.refused("recording_stop") == "recording_not_active"
    played = [state(bot.ask("step"))["qpos"] for _ in range(9)]
    assert np.allclose(played, recorded[1:], atol=1e-6)
    bot.ask("recording_start")
    assert bot.ask("step")["time"] == pytest.approx(0.002), "a recording ends the replay"


def test_only_what_was_there_at_the_start_is_found(bot: Wire, replays: Path) -> None:
    (replays / "later.json").write_bytes((replays / "ep.json").read_bytes())
    if sys.platform != "win32":
        os.mkfifo(replays / "fifo.json")  # to read it would block for ever
    assert bot.ask("replay_list_sessions")["sessions"] == ["Live Recording", "ep", "table"]
    bot.ask("stop_pie")
    bot.ask("begin_pie")
    assert bot.ask("replay_list_sessions")["sessions"] == ["Live Recording", "ep", "later", "table"]
    assert bot.refused("replay_load", path="fifo.json") == "path_not_readable"


def test_a_loaded_session_is_saved_as_it_is_and_replaces_its_namesake(bot: Wire, replays: Path) -> None:
    bot.ask("replay_load", path="ep.json")
    copy = Path(bot.ask("recording_save", path="copy.json")["absolute_path"])
    original = json.loads((replays / "ep.json").read_text())["Frames"]
    frames = json.loads(copy.read_text())["Frames"]
    assert [frame["timestamp"] for frame in frames] == [frame["timestamp"] for frame in original]
    assert [frame["jointStates"]["old_root"]["qPos"] for frame in frames] == [
        frame["jointStates"]["old_root"]["qPos"] for frame in original
    ]
    (replays / "ep.json").write_text(json.dumps({"Frames": original[:1]}))
    bot.ask("replay_load", path="ep.json")
    bot.ask("set_mode", mode="direct")
    assert bot.ask("replay_start")["total_frames"] == 1
    assert bot.ask("step", n_steps=7)["replay"] == {"current_frame": 0.0, "total_frames": 1.0}
    assert bot.ask("replay_list_sessions")["sessions"] == ["Live Recording", "ep", "table"]


def test_one_robots_recording_drives_another_and_turns_along_the_arc(
    serve: Callable[..., Wire], tmp_path: Path, replays: Path
) -> None:
    half = math.sqrt(0.5)
    states = [
        {"bot_C_7_root": {"qPos": [3, 4, 5, 1, 0, 0, 0]}, "bot_C_7_j": {"qPos": [0.0], "qVel": [2.0]}},
        {"bot_C_7_root": {"qPos": [3, 4, 7, half, 0, 0, half]}, "bot_C_7_j": {"qPos": [1.0], "qVel": [3.0]}},
    ]
    frames = [{"timestamp": 5 + 0.006 * at, "jointStates": state} for at, state in enumerate(states)]
    (replays / "turn.json").write_text(json.dumps({"Frames": frames}))
    wire = serve("bot", play=True, saved_dir=tmp_path / "saved")
    wire.ask("set_mode", mode="direct")
    start = state(wire.ask("reset"))["qpos"][:3]
    wire.ask("replay_load", path="turn.json")
    wire.ask("replay_start")
    third = state(wire.ask("step"))
    angle = math.radians(90 / 3) / 2
    assert third["qpos"] == pytest.approx([*start[:2], start[2] + 2 / 3, math.cos(angle), 0, 0, math.sin(angle), 1 / 3])
    assert third["qvel"][-1] == 2.0, "velocities are those of the earlier frame"


def test_a_replay_ends_with_the_mode_and_not_with_a_reset(bot: Wire) -> None:
    bot.ask("set_mode", mode="direct")
    bot.ask("replay_load", path="ep.json")
    bot.ask("replay_start")
    bot.ask("step")
    bot.ask("reset")
    assert bot.ask("step")["replay"]["current_frame"] == 1
    bot.ask("set_mode", mode="live")
    bot.ask("set_mode", mode="direct")
    assert "replay" not in bot.ask("step")


def test_nothing_to_play_and_nothing_to_stop(bot: Wire) -> None:
    bot.ask("set_mode", mode="direct")
    assert bot.ask("replay_start")["total_frames"] == 0
    bot.ask("replay_stop")
    assert bot.ask("step")["time"] == pytest.approx(0.002)


@given(st.lists(st.floats(-3, 3), min_size=2, max_size=6), st.integers(1, 200))
def test_poses_lie_between_their_frames(values: list[float], n_steps: int) -> None:
    scene = make_scene(bot=BOT)
    layout = JointLayout.of([("bot_j", 1, 1)])
    frames = [Frame(0.01 * at, layout, np.array([value]), np.zeros(1)) for at, value in enumerate(values)]
    one, many = (Player(scene, frames, relative=False) for _ in range(2))
    for _ in range(n_steps):
        one.advance(1)
    stepped = scene.data.qpos[7]
    many.advance(n_steps)
    assert scene.data.qpos[7] == pytest.approx(stepped, abs=1e-6)
    at = many.current_frame
    low, high = sorted((values[at], values[min(at + 1, len(values) - 1)]))
    assert low - 1e-6 <= stepped <= high + 1e-6
