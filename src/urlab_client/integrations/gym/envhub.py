"""Environments in LeRobot's format, for the `env.py` of a repository on its EnvHub. Does not need LeRobot."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray

from urlab_client.integrations.gym.env import URLabEnv
from urlab_client.integrations.gym.spaces import Space, dict_space
from urlab_client.integrations.gym.vectorized import of_one

__all__ = ["ForLeRobot", "vector_env"]


class ForLeRobot(gymnasium.Wrapper[dict[str, Any], NDArray[np.float32], Any, Any]):
    """A `URLabEnv` with the spaces and names of LeRobot's environments, matching the datasets of `urlab convert`.

    Observations contain `agent_pos`: the observed fields of all articulations, concatenated, float32. With
    `observations=["qpos"]` it equals the `observation.state` of datasets. If the task observes something, observations
    contain `environment_state`. With cameras they contain `pixels`, keyed by the names in the dataset, such as
    `arm.overview`. Actions are one array for all articulations. `info["is_success"]` is the task's success.

    Attributes:
        task: Id of the environment.
        task_description: What the robot is to do, in words.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], *, description: str) -> None:
        """Wrap an environment.

        Args:
            env: A `URLabEnv` with `space_mode="dict"`, possibly inside other wrappers.
            description: What the robot is to do, in words.

        Raises:
            ValueError: The spaces of the environment are flat.
        """
        super().__init__(env)
        inner = cast("URLabEnv", env.unwrapped)
        if inner.mapping.mode != "dict":
            raise ValueError("make the environment with space_mode='dict'")
        self.task: str = env.spec.id if env.spec else type(inner).__name__
        self.task_description: str = description
        actions = cast("Mapping[str, spaces.Box]", env.action_space)
        self._widths = {key: space.shape[0] for key, space in actions.items()}
        low, high = (np.concatenate([getattr(space, bound) for space in actions.values()]) for bound in ("low", "high"))
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        empty = self._renamed(of_one(create_empty_array(env.observation_space)))
        self.observation_space = dict_space({key: _space_of(value) for key, value in empty.items()})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """Start an episode. LeRobot's own options are ignored."""
        own = {key: value for key, value in (options or {}).items() if not key.startswith("lerobot_")}
        observation, info = self.env.reset(seed=seed, options=own or None)
        return self._renamed(observation), {**info, "is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Apply an action."""
        parts = np.split(np.asarray(action), np.cumsum([*self._widths.values()])[:-1])
        by_key: Any = dict(zip(self._widths, parts, strict=True))
        observation, reward, terminated, truncated, info = self.env.step(by_key)
        info = {**info, "is_success": info.get("success", False)}
        return self._renamed(observation), reward, terminated, truncated, info

    def _renamed(self, observation: Mapping[str, Any]) -> dict[str, Any]:
        fields = [
            value
            for key, by_field in observation.items()
            if key not in ("cameras", "task")
            for value in by_field.values()
        ]
        renamed: dict[str, Any] = {"agent_pos": np.concatenate([np.zeros(0), *fields]).astype(np.float32)}
        if "task" in observation:
            renamed["environment_state"] = np.asarray(observation["task"], dtype=np.float32)
        if "cameras" in observation:
            cameras: Mapping[str, Any] = observation["cameras"]
            renamed["pixels"] = {name.replace("/", "."): picture for name, picture in cameras.items()}
        return renamed


def vector_env(
    env_id: str, n_envs: int = 1, *, asynchronous: bool = False, description: str = "", **options: Any
) -> VectorEnv[Any, Any, Any]:
    """Make environments for LeRobot.

    Args:
        env_id: Id of an environment of this package, such as `urlab/PushPictures-v0`, or of your own `URLabEnv`.
        n_envs: Number of environments.
        asynchronous: Whether each environment runs in its own process. Each server is a separate process either way.
        description: What the robot is to do, in words; `env_id` if empty.
        options: Further arguments of the environment.

    Returns:
        A vector environment that resets in the step that ends an episode, like LeRobot's own.
    """
    makers = [partial(_make, env_id, description or env_id, options)] * n_envs
    kind = AsyncVectorEnv if asynchronous else SyncVectorEnv
    return kind(makers, autoreset_mode=AutoresetMode.SAME_STEP)


def _make(env_id: str, description: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    given: dict[str, Any] = {"space_mode": "dict", "render_mode": "rgb_array", **options}
    env = gymnasium.make(env_id, disable_env_checker=True, **given)
    try:
        return ForLeRobot(env, description=description)
    except BaseException:
        env.close()
        raise


def _space_of(value: Any) -> Space:
    if isinstance(value, dict):
        by_name = cast("dict[str, Any]", value)
        return dict_space({key: _space_of(inner) for key, inner in by_name.items()})
    if value.dtype == np.uint8:
        return spaces.Box(0, 255, value.shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, value.shape, value.dtype)
