"""What an environment tells a recording of its client, and what becomes of it in tables and datasets."""

from __future__ import annotations

import json
from collections import Counter
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import urlab_client
from tests.integrations.test_record_export import lerobot, run  # noqa: F401  # a fixture
from urlab_client.integrations.gym import Reach, Start, States, URLabEnv, URLabVectorEnv
from urlab_client.integrations.record import RecordingError, read_run, record, transitions_of
from urlab_client.integrations.record.export import write_lerobot
from urlab_client.randomise import Delay, Randomisation
from urlab_client.server import SimulatedServer


class Brief(Reach):
    """Three actions, or until the hand is high; a success if the action was above zero."""

    max_episode_steps: ClassVar[int | None] = 3

    def success(self, states: States) -> Any:
        return states.last_action[:, 2] > 0

    def terminated(self, states: States) -> Any:
        return states.last_action[:, 2] > 0.3


@pytest.fixture(params=["alpha", "beta"])
def client(request: pytest.FixtureRequest) -> Any:
    with (
        SimulatedServer("arm", play=True, dialect=request.param) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        yield client


def drive(env: URLabEnv, elbow: list[list[float]]) -> list[dict[str, Any]]:
    """Run episodes with these actions of the elbow; return what was told about each action."""
    told: list[dict[str, Any]] = []
    for number, episode in enumerate(elbow):
        seen, _ = env.reset(seed=number)
        for each in episode:
            action = np.full(7, each, dtype=np.float32)
            goal = seen[-6:-3]
            after, reward, terminated, truncated, info = env.step(action)
            told.append(
                {
                    "episode": number,
                    "qpos": seen[:8],
                    "goal": goal,
                    "action": action,
                    "reward": reward,
                    "ends": (terminated, truncated, info["success"]),
                    "set_points": env.mapping.set_points(action)["arm"],
                }
            )
            seen = after
    return told


ELBOW = [[0.1, -0.1, 0.2], [-0.2, 0.4], [0.2, 0.1, -0.1]]


@pytest.mark.parametrize("delay", [None, Delay(action=1, action_substeps=4)])
def test_actions_rewards_ends_and_goals_are_those_of_the_environment(
    client: urlab_client.URLabClient, tmp_path: Path, delay: Delay | None
) -> None:
    env = URLabEnv(client, task=Brief(), randomise=None if delay is None else Randomisation(delay=delay))
    with record(client, tmp_path / "run.mcap", pose_hz=0):
        told = drive(env, ELBOW)
    env.close()
    whole = read_run(tmp_path / "run.mcap")
    pairs = transitions_of(whole)
    assert pairs.episode.tolist() == [each["episode"] for each in told]
    for column, name in (("arm/qpos", "qpos"), ("task/action", "action"), ("goal/target", "goal")):
        assert np.array_equal(pairs.columns[column].values, np.array([each[name] for each in told])), column
    ends = [pairs.columns[f"task/{name}"].values[:, 0] for name in ("terminated", "truncated", "success")]
    assert np.array_equal(np.transpose(ends), [each["ends"] for each in told])
    assert pairs.columns["task/reward"].values[:, 0].tolist() == [each["reward"] for each in told]
    meant = np.array([each["set_points"] for each in told])
    assert np.allclose(pairs.columns["arm/action"].values, meant, rtol=1e-6), "as chosen"
    if delay is None:
        assert "arm/applied" not in pairs.columns
    else:
        # One action and four of ten steps late: at the end of an action, the one before it is in force.
        first = np.append(True, np.diff(pairs.episode) > 0)
        late = np.where(first[:, None], 0.0, np.roll(meant, 1, axis=0))
        assert np.allclose(pairs.columns["arm/applied"].values, late, rtol=1e-6), "as applied"
        assert len(whole.table()) > 2 * len(pairs), "the states in the middle of an action are recorded, too"
    successes = transitions_of(whole, only="success")
    assert sorted(set(successes.episode.tolist())) == [0, 1]


def test_a_mark_wins_over_what_the_environment_told(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    env = URLabEnv(client, task=Brief())
    with record(client, tmp_path / "run.mcap", pose_hz=0) as recorder:
        drive(env, [[0.1]])
        recorder.mark("discarded")
        env.reset()
        env.step(np.zeros(7, dtype=np.float32))
        recorder.mark("success", goal={"target": [1.0, 2.0, 3.0]})
    env.close()
    pairs = transitions_of(read_run(tmp_path / "run.mcap"))
    assert pairs.episode.tolist() == [1]
    assert pairs.columns["goal/target"].values.tolist() == [[1.0, 2.0, 3.0]]


def test_a_dataset_has_rewards_successes_and_ends(
    client: urlab_client.URLabClient,
    tmp_path: Path,
    lerobot: str,  # noqa: F811
    capsys: pytest.CaptureFixture[str],
) -> None:
    env = URLabEnv(client, task=Brief())
    with record(client, tmp_path / "run.mcap", pose_hz=0):
        told = drive(env, [*ELBOW, [0.1, 0.1]])
    env.close()
    whole = read_run(tmp_path / "run.mcap")
    command = ["convert", whole.path, tmp_path / "all", "--format=lerobot", "--task=reach", "--python", lerobot]
    assert run(*command) == 0
    said = capsys.readouterr().out
    assert "10 frames" in said
    assert "left out" not in said

    def frames(folder: str) -> list[list[dict[str, Any]]]:
        log: dict[str, Any] = json.loads((tmp_path / folder / "log.json").read_text())
        assert log["features"]["next.reward"][:2] == ["float32", [1]]
        assert log["features"]["next.done"][:2] == log["features"]["next.success"][:2] == ["bool", [1]]
        return log["episodes"]

    every = [frame for episode in frames("all") for frame in episode]
    assert [frame["next.reward"][0] for frame in every] == [np.float32(each["reward"]) for each in told]
    assert [frame["next.success"][0] for frame in every] == [each["ends"][2] for each in told]
    # The last episode was broken off, and no other follows.
    assert [frame["next.done"][0] for frame in every] == [False, False, True, False, True, False, False, True] + 2 * [
        False
    ]
    left_out: Counter[str] = Counter()
    assert write_lerobot(whole, tmp_path / "half", python=lerobot, task="reach", fps=25, left_out=left_out) == 6
    assert +left_out == {"between frames at 25 per second": 4}
    half = frames("half")
    rewards = [each["reward"] for each in told]
    assert [frame["next.reward"][0] for frame in half[0]] == [np.float32(sum(rewards[:2])), np.float32(rewards[2])]
    assert [frame["next.done"][0] for frame in half[1]] == [True]
    assert write_lerobot(whole, tmp_path / "double", python=lerobot, task="reach", fps=100) == 16
    doubled = [float(frame["next.reward"][0]) for frame in frames("double")[0]]
    assert doubled == [
        0,
        np.float32(told[0]["reward"]),
        0,
        np.float32(told[1]["reward"]),
        np.float32(told[2]["reward"]),
    ]
    assert run(*command) == 2
    assert "--overwrite replaces it" in capsys.readouterr().err
    (tmp_path / "all" / "precious").touch()
    assert run(*command, "--overwrite") == 2
    assert "is not a LeRobot dataset, so it is not replaced" in capsys.readouterr().err
    (tmp_path / "all" / "meta").mkdir()
    (tmp_path / "all" / "meta" / "info.json").touch()
    assert run(*command, "--overwrite", "--episodes=success") == 0
    assert "left out: 3 pairs of a state and an action of episodes with failure" in capsys.readouterr().out
    assert [len(episode) for episode in frames("all")] == [3, 2, 2]
    assert not (tmp_path / "all" / "precious").exists()


def test_a_recording_has_a_picture_of_each_start(
    opengl: None, client: urlab_client.URLabClient, tmp_path: Path
) -> None:
    """The physics stays the same, and the environment need not observe pictures itself."""
    env = URLabEnv(client, task=Brief())
    before = drive(env, ELBOW)
    with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=50):
        env.reset()
        told = drive(env, ELBOW)
    env.close()
    for ours, theirs in zip(told, before, strict=True):
        assert np.array_equal(ours["qpos"], theirs["qpos"])
        assert ours["reward"] == theirs["reward"]
    whole = read_run(tmp_path / "run.mcap")
    pairs, times = transitions_of(whole), whole.picture_times("arm/wrist")
    assert len(pairs) == len(told)
    assert len(times) == 1 + len(ELBOW) + len(told), "one of every reset, also of two without a step in between"
    assert np.isin(pairs.time.round(6), times.round(6)).all(), "each pair has its own picture"


def test_servers_in_lockstep_are_recorded_each_into_a_file(tmp_path: Path) -> None:
    servers = URLabVectorEnv(Brief.scene_address, 2, task=Brief())
    with servers.recording(tmp_path / "runs", pose_hz=0) as files:
        servers.reset(seed=5)
        rewards = [servers.step(np.full((2, 7), 0.1, dtype=np.float32))[1].tolist() for _ in range(5)]
    with pytest.raises(FileExistsError), servers.recording(tmp_path / "runs"):
        pass
    with servers.recording(tmp_path / "closed", pose_hz=0) as closed:
        servers.reset(seed=5)
        servers.step(np.full((2, 7), 0.1, dtype=np.float32))
        servers.close()
    assert [(run.summary().complete, len(transitions_of(run))) for run in map(read_run, closed)] == [(True, 1)] * 2
    for number, file in enumerate(files):
        pairs = transitions_of(read_run(file))
        told = [each[number] for i, each in enumerate(rewards) if i != 3]  # the fourth step begins an episode
        assert pairs.columns["task/reward"].values[:, 0].tolist() == told
        assert pairs.episode.tolist() == [0, 0, 0, 1]


def test_record_runs_episodes_of_a_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["record", tmp_path / "reach.mcap", "--task", f"{__name__}:Brief", "--seconds=0.14", "--seed=4"]
    assert run(*command) == 0
    assert "reach.mcap" in capsys.readouterr().out
    table = read_run(tmp_path / "reach.mcap").table()
    actions = table.columns["task/actions"].values[:, 0]
    assert actions[np.isfinite(actions)].tolist() == [0, 1, 2, 3, 0, 1, 2, 3, 0, 1]
    target = table.columns["goal/target"].values[np.isfinite(actions)][0]
    assert np.array_equal(target, expected_target(4))
    assert run(*command, "--overwrite", "--keyframe", "home") == 2
    assert "--keyframe cannot be combined with --task" in capsys.readouterr().err
    assert run(*command, "--overwrite", "--step-mode", "live") == 2
    assert "--step-mode live cannot be combined with --task" in capsys.readouterr().err
    assert run(*command, "--overwrite", "--step-mode", "direct") == 0
    assert run("record", "sim://arm", tmp_path / "live.mcap", "--keyframe", "home") == 2
    assert "--keyframe resets the simulation, which needs --step-mode direct" in capsys.readouterr().err
    assert run(*command[:2], "--overwrite", "--task=urlab/Rech-v0") == 2
    assert "Did you mean 'urlab/Reach-v0'" in capsys.readouterr().err


def expected_target(seed: int) -> Any:
    env = URLabEnv.connect(Brief.scene_address, task=Brief())
    seen, _ = env.reset(seed=seed)
    env.close()
    return seen[-6:-3]


class Oddly(Brief):
    """A goal of a truth value and of an integer, whose names functions use for their own arguments."""

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        super().reset(rng, start)
        start.goal |= {"source": np.array(True), "self": np.array([1, 2])}


def test_goals_may_have_any_name_and_kind_of_number(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    env = URLabEnv(client, task=Oddly())
    with record(client, tmp_path / "run.mcap", pose_hz=0):
        drive(env, ELBOW[:1])
    env.close()
    pairs = transitions_of(read_run(tmp_path / "run.mcap"))
    assert pairs.columns["goal/source"].values.tolist() == [[1.0]] * 3
    assert pairs.columns["goal/self"].values.tolist() == [[1.0, 2.0]] * 3


def test_a_pinned_mode_only_costs_the_pictures_of_starts(opengl: None, tmp_path: Path) -> None:
    with (
        SimulatedServer("arm", play=True, step_mode="direct") as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        env = URLabEnv(client, task=Brief())
        with record(client, tmp_path / "run.mcap", cameras=["arm/wrist"], camera_hz=50, pose_hz=0):
            told = drive(env, ELBOW)
        env.close()
    whole = read_run(tmp_path / "run.mcap")
    assert len(transitions_of(whole)) == len(told)
    assert len(whole.picture_times("arm/wrist")) == len(told)


def test_a_recording_may_begin_and_end_within_episodes(client: urlab_client.URLabClient, tmp_path: Path) -> None:
    env = URLabEnv(client, task=Brief())
    action = np.full(7, 0.1, dtype=np.float32)
    env.reset(seed=1)
    env.step(action)
    with record(client, tmp_path / "run.mcap", pose_hz=0):
        rewards = [env.step(action)[1] for _ in range(2)][1:]  # the first one led to the first state that is recorded
        env.reset()
        rewards.append(env.step(action)[1])
        env.reset()
        rewards.append(env.step(action)[1])
    env.close()
    pairs = transitions_of(read_run(tmp_path / "run.mcap"))
    assert pairs.columns["task/reward"].values[:, 0].tolist() == rewards
    assert pairs.episode.tolist() == [0, 1, 2]


@pytest.mark.parametrize("name", ["task", "goal"])
def test_a_robot_with_the_name_of_columns_or_entries_is_refused(tmp_path: Path, name: str) -> None:
    block = tmp_path / f"{name}.xml"
    model = files("urlab_client.server.robots").joinpath("block.xml").read_text()
    block.write_text(model.replace('model="block"', f'model="{name}"'))
    with (
        SimulatedServer("arm", block, play=True) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        env = URLabEnv(client, task=Brief(), articulations=["arm"])
        with (
            pytest.raises(RecordingError, match=f"'{name}' cannot be the name of a robot or entity"),
            record(client, tmp_path / "run.mcap"),
        ):
            env.reset(seed=0)
        if name == "task":
            with pytest.raises(ValueError, match="an articulation is named 'task'"):
                URLabEnv(client, task=Brief(), articulations=["arm", "task"], space_mode="dict")
