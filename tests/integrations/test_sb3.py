"""The adapter for Stable-Baselines3, with a stand-in for its base class. tools/check_learning.py has the library."""

from __future__ import annotations

import importlib
import importlib.machinery
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics, RescaleAction

from urlab_client.integrations.gym import Reach, URLabBatchEnv

NAME = "urlab_client.integrations.gym.sb3"


class VecEnv:
    """What the library's base class does with what it is given."""

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs, self.observation_space, self.action_space = num_envs, observation_space, action_space
        self._reset_seeds()
        self._reset_options()
        self.render_mode = self.get_attr("render_mode")[0]  # type: ignore[attr-defined]

    def _reset_seeds(self) -> None:
        self._seeds: list[int | None] = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options: list[dict[str, Any]] = [{}] * self.num_envs

    def seed(self, seed: int) -> None:
        self._seeds = [seed + i for i in range(self.num_envs)]


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    for name in ("stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env"):
        module = ModuleType(name)
        module.__spec__ = importlib.machinery.ModuleSpec(name, None)
        module.VecEnv = VecEnv  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, NAME, raising=False)
    yield importlib.import_module(NAME)
    sys.modules.pop(NAME, None)


@pytest.fixture
def batch(serving: Callable[..., str]) -> Callable[..., URLabBatchEnv]:
    return lambda **options: URLabBatchEnv(serving("arm"), 3, task=Reach(), max_episode_steps=2, **options)


def test_episodes_end_as_the_library_expects_it(adapter: Any, batch: Callable[..., URLabBatchEnv]) -> None:
    ours, plain = (batch(autoreset_mode=mode) for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED))
    envs = adapter.Sb3VecEnv(ours)
    envs.seed(4)
    assert np.array_equal(envs.reset(), plain.reset(seed=4)[0])
    assert envs.reset_infos[1]["step_count"] == 0
    assert (envs.observation_space, envs.action_space) == (plain.single_observation_space, plain.single_action_space)
    action = np.full(plain.action_space.shape, 0.1, dtype=np.float32)
    for step in (1, 2):
        envs.step_async(action)
        observations, rewards, ended, infos = envs.step_wait()
        last, expected, _, truncated, _ = plain.step(action)
        assert rewards.dtype == np.float32
        assert np.array_equal(rewards, expected.astype(np.float32))
        assert ended.tolist() == truncated.tolist() == [step == 2] * 3
        assert [info["step_count"] for info in infos] == [10 * step] * 3
        assert all(info["success"] in (True, False) for info in infos)
    for i, info in enumerate(infos):
        assert np.array_equal(info["terminal_observation"], last[i])
        assert info["TimeLimit.truncated"]
    again, _ = plain.reset(options={"reset_mask": truncated})
    assert np.array_equal(observations, again)
    envs.close()
    plain.close()


def test_wrappers_of_gymnasium_stand_between(adapter: Any, batch: Callable[..., URLabBatchEnv]) -> None:
    """Actions from -1 to 1 mean the whole range; the episode's statistics arrive with its end."""
    ours, plain = (batch(autoreset_mode=mode) for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED))
    wrapped = RecordEpisodeStatistics(RescaleAction(ours, np.float32(-1.0), np.float32(1.0)))
    envs = adapter.Sb3VecEnv(wrapped)
    assert envs.action_space.high.tolist() == [1.0] * 7
    envs.seed(4)
    envs.reset()
    plain.reset(seed=4)
    low, high = plain.single_action_space.low, plain.single_action_space.high  # type: ignore[attr-defined]
    total = np.zeros(3)
    for _ in range(2):
        envs.step_async(np.full((3, 7), 0.5, dtype=np.float32))
        _, rewards, ended, infos = envs.step_wait()
        _, expected, *_ = plain.step(np.tile(low + 0.75 * (high - low), (3, 1)))
        np.testing.assert_allclose(rewards, expected, rtol=1e-4)
        total += rewards
    assert ended.all()
    for i, info in enumerate(infos):
        assert info["episode"]["l"] == 2
        assert info["episode"]["r"] == pytest.approx(total[i], rel=1e-5)
        assert info["terminal_observation"].shape == envs.observation_space.shape
    envs.close()
    plain.close()


def test_what_the_adapter_cannot_do_is_said(adapter: Any, batch: Callable[..., URLabBatchEnv]) -> None:
    with pytest.raises(ValueError, match=r"autoreset_mode=AutoresetMode\.SAME_STEP, not NEXT_STEP"):
        adapter.Sb3VecEnv(batch())
    envs = adapter.Sb3VecEnv(batch(autoreset_mode=AutoresetMode.SAME_STEP))
    assert envs.get_attr("num_envs", 1) == [3]
    assert envs.get_images() == [None] * 3
    assert envs.env_is_wrapped(object) == [False] * 3
    with pytest.raises(NotImplementedError, match=r"call it on \.env"):
        envs.env_method("jump")
    with pytest.raises(ValueError, match="omit indices"):
        envs.set_attr("reward_fn", None, [0])
    envs.close()
