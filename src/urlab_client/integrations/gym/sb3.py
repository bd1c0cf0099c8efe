"""A vector environment for Stable-Baselines3. Needs the extra `sb3`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client.integrations.gym.spaces import Observation
from urlab_client.integrations.gym.vectorized import info_of, need_same_step

need("stable_baselines3", extra="sb3")

if TYPE_CHECKING:

    class _VecEnv:
        """The parts of `VecEnv` in use."""

        _seeds: list[int | None]
        reset_infos: list[dict[str, Any]]

        def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None: ...
        def _reset_seeds(self) -> None: ...
        def _reset_options(self) -> None: ...

else:
    _VecEnv = importlib.import_module("stable_baselines3.common.vec_env").VecEnv

Indices = None | int | Sequence[int]


class Sb3VecEnv(_VecEnv):
    """A `URLabBatchEnv` or `URLabVectorEnv`, also in Gymnasium's wrappers, for `PPO("MlpPolicy", Sb3VecEnv(env))`.

    The `info` of an environment contains the entries of `infos` at its index and, at the end of an episode, also
    `terminal_observation` and `TimeLimit.truncated`. If an environment fails, its episode ends as truncated, and `info`
    contains the exception as `error`.

    Args:
        env: The environment, made with `autoreset_mode=AutoresetMode.SAME_STEP`. Closing this object closes it.

    Raises:
        ValueError: The environment has a different autoreset mode.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        need_same_step(env, "Stable-Baselines3")
        self.env: Any = env
        self._actions: Any = None
        super().__init__(env.num_envs, self.env.single_observation_space, self.env.single_action_space)

    def reset(self) -> Observation:
        """Start an episode in all environments, with the seeds of `seed()`."""
        observations, infos = self.env.reset(seed=list(self._seeds))
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [info_of(infos, i) for i in range(self.env.num_envs)]
        return observations

    def step_async(self, actions: Any) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Apply the stored actions; return observations, rewards, dones and one info per environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        ended = terminated | truncated
        each: list[dict[str, Any]] = []
        for i in range(self.env.num_envs):
            if ended[i]:
                # Wrappers put the statistics of the ended episode beside the infos of the next one.
                info = info_of(infos, i) | info_of(infos["final_info"], i)
                info["terminal_observation"] = infos["final_obs"][i]
                info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            else:
                info = info_of(infos, i)
            each.append(info)
        return observations, rewards.astype(np.float32), ended, each

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return the picture of each environment, None without a render mode."""
        pictures = self.env.render()
        return [None] * self.env.num_envs if pictures is None else list(pictures)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute, which all environments share."""
        return [getattr(self.env, attr_name) for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute for all environments, which share it.

        Raises:
            ValueError: `indices` does not name all environments.
        """
        if len(self._chosen(indices)) != self.env.num_envs:
            raise ValueError(f"all environments share {attr_name}: omit indices")
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Indices = None, **kwargs: Any) -> list[Any]:
        """Raise an error: the environments have no methods of their own.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(f"cannot call {method_name} per environment: call it on .env, for all environments")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Return False for each: the environments have no individual wrappers."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: Indices) -> Sequence[int]:
        if indices is None:
            return range(self.env.num_envs)
        return [indices] if isinstance(indices, int) else indices
