"""Commands and environments with a server whose MuJoCo is another one than that of this process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from scripted_beta import ScriptedBeta

from urlab_client.cli import main
from urlab_client.integrations.gym import URLabEnv, URLabVectorEnv
from urlab_client.integrations.record import read_run

SAYS = r"The server runs MuJoCo 3\.11\.1"


@pytest.fixture
def beta() -> Iterator[ScriptedBeta]:
    server = ScriptedBeta(skew=True)
    yield server
    server.close()


def test_a_recording_says_it_once_and_is_made(
    beta: ScriptedBeta, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    address = f"tcp://127.0.0.1:{beta.port}"
    assert main(["record", address, str(path), "--step-mode", "direct", "--seconds", "0.02"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("urlab record: warning: The server runs MuJoCo 3.11.1, this process has MuJoCo ")
    assert "approximates" in line
    summary = read_run(path).summary()
    assert summary.complete
    assert summary.duration_s == pytest.approx(0.02, abs=0.005)


def test_environments_work(beta: ScriptedBeta) -> None:
    with pytest.warns(UserWarning, match=SAYS):
        env = URLabEnv.connect(f"tcp://127.0.0.1:{beta.port}")
    try:
        observation, _ = env.reset(seed=1)
        assert env.client.model_is_approximate
        observation, *_, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert info["sim_time"] == 0.002
    finally:
        env.close()


def test_environments_of_several_servers_work(beta: ScriptedBeta) -> None:
    with pytest.warns(UserWarning, match=SAYS):
        envs = URLabVectorEnv([f"tcp://127.0.0.1:{beta.port}"])
    try:
        envs.reset(seed=1)
        observations, *_ = envs.step(envs.action_space.sample())
        assert envs.observation_space.contains(observations)
    finally:
        envs.close()
