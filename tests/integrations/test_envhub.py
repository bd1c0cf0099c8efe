"""Environments for LeRobot's EnvHub. tools/check_learning.py has the library load and evaluate them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from urlab_client.integrations.gym import envhub
from urlab_client.server import SimulatedServer


@pytest.mark.opengl
def test_lerobot_sees_what_datasets_hold_under_their_names() -> None:
    with SimulatedServer("arm", play=True) as server:
        options: dict[str, Any] = {
            "address": f"{server.address}:{server.step_port}",
            "cameras": ["arm/wrist"],
            "observations": ["qpos"],
            "max_episode_steps": 3,
        }
        rng = np.random.default_rng(0)
        actions = [rng.uniform(-0.3, 0.3, (1, 7)).astype(np.float32) for _ in range(3)]
        plain: Any = gymnasium.make("urlab/Reach-v0", space_mode="dict", **options)
        start, _ = plain.reset(seed=4)
        steps = [plain.step({"arm": action[0]}) for action in actions]
        expected = [start, *(step[0] for step in steps)]
        plain.close()
        envs = envhub.vector_env("urlab/Reach-v0", description="reach", **options)
        assert envs.single_action_space.shape == (7,)
        assert envs.single_observation_space["pixels"]["arm.wrist"].dtype == np.uint8
        seen, _ = envs.reset(seed=[4], options={"lerobot_new_rollout": True})
        infos: dict[str, Any] = {}
        for i, action in enumerate(actions):
            assert np.array_equal(seen["agent_pos"][0], np.float32(expected[i]["arm"]["qpos"]))
            assert np.array_equal(seen["environment_state"][0], np.float32(expected[i]["task"]))
            assert np.array_equal(seen["pixels"]["arm.wrist"][0], expected[i]["cameras"]["arm/wrist"])
            seen, *_, infos = envs.step(action)
        last = infos["final_obs"][0]
        assert np.array_equal(last["agent_pos"], np.float32(expected[3]["arm"]["qpos"]))
        # This seed's target is where the hand starts.
        assert infos["final_info"]["is_success"].tolist() == [steps[-1][4]["success"]] == [True]
        assert envs.call("task_description") == ("reach",)
        assert envs.call("_max_episode_steps") == (3,)
        assert envs.call("render")[0].dtype == np.uint8
        envs.close()
        flat = {**options, "cameras": None}
        with pytest.raises(ValueError, match="space_mode='dict'"):
            envhub.vector_env("urlab/Reach-v0", space_mode="flat", **flat)


def test_the_examples_file_is_one_for_the_hub(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(envhub, "vector_env", lambda env_id, n, **options: (env_id, n, options["asynchronous"]))
    path = Path(__file__).parents[2] / "examples/envhub/env.py"
    spec: Any = importlib.util.spec_from_file_location("hub_env", path)
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.make_env(n_envs=3, use_async_envs=True) == {"urlab_push": {0: ("urlab/PushPictures-v0", 3, True)}}
