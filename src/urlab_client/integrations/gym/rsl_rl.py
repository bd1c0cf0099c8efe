"""A vector environment for RSL-RL. Needs the extra `rsl-rl`."""

from __future__ import annotations

import importlib
from typing import Any, cast

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client.integrations.gym.vectorized import Vectorized, need_same_step

Tensor = Any


class RslRlVecEnv:
    """A `URLabBatchEnv` or `URLabVectorEnv`, also in Gymnasium's wrappers, for `OnPolicyRunner(RslRlVecEnv(env), …)`.

    Observations are a `TensorDict` with the group `policy`, float32 like the rewards. `extras` contains `time_outs`,
    and under `log` the share of successes among the episodes that ended, if the task defines success.

    Attributes:
        env: The environment.
        num_envs: Number of environments.
        num_actions: Length of an action.
        max_episode_length: Actions per episode.
        device: Device of the tensors.
        cfg: Empty; RSL-RL stores it with its logs.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any], device: str = "cpu") -> None:
        """Wrap an environment and start an episode in all of them.

        Args:
            env: The environment, made with `autoreset_mode=AutoresetMode.SAME_STEP` and flat spaces. RSL-RL does not
                limit actions, so its task should declare `actions`.
            device: Device of the tensors.

        Raises:
            ValueError: The environment has another autoreset mode, dictionaries as spaces, or no `max_episode_steps`.
            MissingExtra: The extra `rsl-rl` is not installed.
        """
        need("torch", "tensordict", extra="rsl-rl")
        need_same_step(env, "RSL-RL")
        base = cast("Vectorized", env.unwrapped)
        if base.mapping.mode == "dict" or base.max_episode_steps is None:
            raise ValueError("RSL-RL needs flat spaces (space_mode='flat') and max_episode_steps")
        self._torch: Any = importlib.import_module("torch")
        self._grouped: Any = importlib.import_module("tensordict").TensorDict
        self._base = base
        self.env: Any = env
        self.num_envs: int = env.num_envs
        self.num_actions: int = self.env.single_action_space.shape[0]
        self.max_episode_length: int = base.max_episode_steps
        self.device = device
        self.cfg: dict[str, Any] = {}
        self._seen = self._observed(self.env.reset()[0])

    @property
    def episode_length_buf(self) -> Tensor:
        """Actions of each episode so far, int64, shape (num_envs,). May be assigned, to stagger the episodes' ends."""
        return self._torch.from_numpy(self._base.elapsed)

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: Tensor) -> None:
        self._base.elapsed[:] = lengths.cpu().numpy()

    def get_observations(self) -> Any:
        """Return the current observations."""
        return self._seen

    def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in all environments; return the observations, and the infos of the environment."""
        observations, infos = self.env.reset(seed=seed)
        self._seen = self._observed(observations)
        return self._seen, infos

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Apply actions, shape (num_envs, num_actions).

        Returns:
            Observations, rewards (float32) and ends (uint8), both of shape (num_envs,), and `extras`.
        """
        observations, rewards, terminated, truncated, infos = self.env.step(actions.detach().cpu().numpy())
        ended = terminated | truncated
        extras: dict[str, Any] = {"time_outs": self._tensor(truncated & ~terminated)}
        successes = infos.get("final_info", {}).get("success")
        if successes is not None:
            extras["log"] = {"/success": float(successes[ended].mean())}
        self._seen = self._observed(observations)
        return self._seen, self._tensor(rewards.astype(np.float32)), self._tensor(ended.view(np.uint8)), extras

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _observed(self, observations: NDArray[Any]) -> Any:
        group = {"policy": self._tensor(observations.astype(np.float32))}
        return self._grouped(group, batch_size=[self.num_envs], device=self.device)

    def _tensor(self, array: NDArray[Any]) -> Tensor:
        return self._torch.from_numpy(array).to(self.device)
