"""The adapter for RSL-RL, with stand-ins for its tensors. tools/check_learning.py has the library."""

from __future__ import annotations

import importlib.machinery
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from urlab_client.integrations.gym import Reach, URLabBatchEnv
from urlab_client.integrations.gym.rsl_rl import RslRlVecEnv


class Tensor(np.ndarray[Any, Any]):
    """The methods of PyTorch's tensors in use."""

    def to(self, device: str) -> Tensor:
        assert device == "cpu"
        return self

    def detach(self) -> Tensor:
        return self

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray[Any, Any]:
        return np.asarray(self)


def tensor(array: Any) -> Tensor:
    return array.view(Tensor)


class TensorDict(dict[str, Any]):
    def __init__(self, groups: dict[str, Any], batch_size: list[int], device: str) -> None:
        super().__init__(groups)
        assert all([len(group)] == batch_size for group in groups.values())


@pytest.fixture(autouse=True)
def libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, members in (("torch", {"from_numpy": tensor}), ("tensordict", {"TensorDict": TensorDict})):
        module = ModuleType(name)
        module.__spec__ = importlib.machinery.ModuleSpec(name, None)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def batch(serving: Callable[..., str]) -> Callable[..., URLabBatchEnv]:
    return lambda **options: URLabBatchEnv(serving("arm"), 3, task=Reach(), **{"max_episode_steps": 2, **options})


def test_episodes_end_as_the_library_expects_it(batch: Callable[..., URLabBatchEnv]) -> None:
    ours, plain = (batch(autoreset_mode=mode) for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED))
    envs = RslRlVecEnv(RecordEpisodeStatistics(ours))
    assert (envs.num_envs, envs.num_actions, envs.max_episode_length) == (3, 7, 2)
    first, _ = envs.reset(seed=4)
    assert np.array_equal(first["policy"], plain.reset(seed=4)[0].astype(np.float32))
    assert envs.get_observations() is first
    action = np.full((3, 7), 0.1, dtype=np.float32)
    for step in (1, 2):
        observations, rewards, dones, extras = envs.step(tensor(action))
        last, expected, _, truncated, infos = plain.step(action)
        assert np.array_equal(rewards, expected.astype(np.float32))
        assert (rewards.dtype, dones.dtype, observations["policy"].dtype) == (np.float32, np.uint8, np.float32)
        assert dones.tolist() == extras["time_outs"].tolist() == truncated.tolist() == [step == 2] * 3
        if step == 1:
            assert np.array_equal(observations["policy"], last.astype(np.float32))
            assert "log" not in extras
    assert extras["log"] == {"/success": infos["success"].mean()}
    again, _ = plain.reset(options={"reset_mask": truncated})
    assert np.array_equal(observations["policy"], again.astype(np.float32))
    envs.close()
    plain.close()


def test_the_ends_of_episodes_can_be_staggered(batch: Callable[..., URLabBatchEnv]) -> None:
    envs = RslRlVecEnv(batch(autoreset_mode=AutoresetMode.SAME_STEP, max_episode_steps=3))
    envs.episode_length_buf = tensor(np.array([0, 1, 2]))
    ends = [envs.step(tensor(np.zeros((3, 7))))[2].tolist() for _ in range(3)]
    assert ends == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert envs.episode_length_buf.tolist() == [0, 1, 2]
    envs.close()


def test_what_the_library_cannot_use_is_refused(batch: Callable[..., URLabBatchEnv]) -> None:
    with pytest.raises(ValueError, match=r"autoreset_mode=AutoresetMode\.SAME_STEP, not NEXT_STEP"):
        RslRlVecEnv(batch())
    with pytest.raises(ValueError, match="needs flat spaces"):
        RslRlVecEnv(batch(autoreset_mode=AutoresetMode.SAME_STEP, space_mode="dict"))
