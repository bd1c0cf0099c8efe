"""A simulation that diverges ends its episode: MuJoCo resets it in the middle, and nothing of that is a transition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from urlab_client import URLabClient
from urlab_client.integrations.gym import Task, URLabBatchEnv, URLabEnv, URLabVectorEnv
from urlab_client.integrations.gym.task import EpisodeEnd, States
from urlab_client.server import SimulatedServer

STIFF = """
<mujoco model="stiff"><option timestep="0.02" integrator="Euler"><flag autoreset="{autoreset}"/></option>
  <worldbody><body pos="0 0 1"><joint name="j" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".1"/></body></worldbody>
  <actuator><general name="a" joint="j" gainprm="1e7" biastype="affine" biasprm="0 -1e7 -1e5" ctrlrange="-1 1"/>
  </actuator></mujoco>
"""
OPTIONS: dict[str, Any] = {"n_substeps": 1, "observations": ["qpos", "qvel"], "max_episode_steps": 50}
UNSTABLE, STILL = [1.0], [0.0]


def model(folder: Path, autoreset: str = "enable") -> str:
    path = folder / "stiff.xml"
    path.write_text(STIFF.format(autoreset=autoreset).replace("<body pos", "<body gravcomp='1' pos"))
    return f"sim://{path}?mjcf-options"


def paid(*_: Any) -> Any:
    return 1.0


@pytest.mark.parametrize("kind", [URLabVectorEnv, URLabBatchEnv])
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_its_episode_ends_without_reward_and_the_others_go_on(
    kind: type[URLabVectorEnv | URLabBatchEnv], mode: AutoresetMode, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    address: Any = model(tmp_path)
    where = (address, 2) if kind is URLabBatchEnv else ([address] * 2,)
    envs: Any = kind(*where, reward_fn=paid, autoreset_mode=mode, **OPTIONS)
    try:
        envs.reset(seed=0)
        for _ in range(5):  # until MuJoCo notices
            _, rewards, terminated, truncated, infos = envs.step(np.array([UNSTABLE, STILL], np.float32))
            assert not terminated.any()
            if truncated.any():
                break
        assert (truncated.tolist(), rewards.tolist()) == ([True, False], [0.0, 1.0])
        told = infos["final_info"] if mode is AutoresetMode.SAME_STEP else infos
        assert told["_error"].tolist() == [True, False]
        assert str(told["error"][0]).startswith("Simulation time went from 0.0")
        (said,) = [record.getMessage() for record in caplog.records if record.name == "urlab_client.gym"]
        assert said.startswith("episodes that ended because their simulations diverged: 1; the last: Simulation time")
        for _ in range(3):  # the next episode is like any other
            observations, _, _, truncated, infos = envs.step(np.array([STILL, STILL], np.float32))
            assert not truncated.any()
        assert np.allclose(observations, 0.0, atol=1e-6)
    finally:
        envs.close()


def test_a_single_environment_is_truncated_too(tmp_path: Path) -> None:
    path = model(tmp_path).removeprefix("sim://").partition("?")[0]
    with (
        SimulatedServer(path, play=True, mjcf_options=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        env = URLabEnv(client, reward_fn=paid, **OPTIONS)
        env.reset(seed=0)
        steps = [env.step(np.array(UNSTABLE, np.float32)) for _ in range(3)]
        ended = [(reward, str(info["error"])) for _, reward, _, truncated, info in steps if truncated]
        assert ended, "MuJoCo notices within three steps"
        assert all(reward == 0.0 and "diverges" in error for reward, error in ended)


def test_positions_that_are_no_numbers_end_an_episode(tmp_path: Path) -> None:
    envs = URLabBatchEnv(model(tmp_path, "disable"), 1, **OPTIONS)
    try:
        envs.reset(seed=0)
        ends = [envs.step(np.array([UNSTABLE], np.float32)) for _ in range(60)]
        errors = [str(infos["error"][0]) for *_, infos in ends if "error" in infos]
        assert errors
        assert "Joint positions stopped being finite during an action." in errors[0]
    finally:
        envs.close()


def test_no_task_is_told_of_such_an_end(tmp_path: Path) -> None:
    class Still(Task):
        def __init__(self) -> None:
            self.ends: list[int] = []

        def reward(self, states: States, actions: Any) -> Any:
            return np.ones(len(states.time))

        def success(self, states: States) -> Any:
            return np.abs(states.qpos[:, 0]) < 0.1  # as is where MuJoCo puts it

        def ended(self, episode: EpisodeEnd) -> None:
            self.ends.append(episode.index)

    task = Still()
    envs = URLabBatchEnv(model(tmp_path), 2, task=task, **OPTIONS | {"max_episode_steps": 5})
    try:
        envs.reset(seed=0)
        for _ in range(5):
            *_, infos = envs.step(np.array([UNSTABLE, STILL], np.float32))
            if "error" in infos:
                assert infos["_success"].tolist() == [False, True]
        assert task.ends == [1]
    finally:
        envs.close()
