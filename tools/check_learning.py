"""Drives the environments with the learning libraries that users bring: Stable-Baselines3, AsyncVectorEnv, RLlib.

    pip install stable-baselines3 'ray[rllib]'
    python tools/check_learning.py            # or the names of some checks

The libraries are too large for the suite. The suite asserts what they need without them; this says whether they agree.
It prints a line for each check and exits with 1 when one failed.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np

import urlab_client.integrations.gym  # registers the environments

__all__ = ["main"]

ARM = "urlab/Arm-v0"


def sb3_check_env() -> str:
    """Stable-Baselines3's own checker finds nothing to refuse."""
    check_env: Any = import_module("stable_baselines3.common.env_checker").check_env
    for options in ({}, {"space_mode": "dict"}, {"space_mode": "dict", "cameras": ["arm/wrist"]}):
        env = gymnasium.make(ARM, **options)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # advice: normalised spaces, flat ones
            if options:
                env = gymnasium.wrappers.FlattenObservation(env)
            check_env(env, skip_render_check=True)
        env.close()
    return "flat, dict and camera observations"


def sb3_ppo() -> str:
    """`PPO("MlpPolicy", "urlab/Arm-v0")` learns for a moment, is saved, loaded and predicts the same."""
    ppo: Any = import_module("stable_baselines3").PPO
    model = ppo("MlpPolicy", ARM, n_steps=128, batch_size=64, n_epochs=2, seed=1, device="cpu")
    model.learn(256)
    observation = model.get_env().reset()
    action, _ = model.predict(observation, deterministic=True)
    model.get_env().close()
    if action.shape != (1, 7):
        raise AssertionError(action.shape)
    return "256 steps"


def gym_async() -> str:
    """`AsyncVectorEnv` runs two environments in processes of its own, and each equals a single one."""
    envs = gymnasium.make_vec(ARM, num_envs=2, vectorization_mode="async")
    single = gymnasium.make(ARM)
    rng = np.random.default_rng(0)
    observations, _ = envs.reset(seed=3)
    alone, _ = single.reset(seed=4)
    for _ in range(5):
        action = rng.uniform(-0.5, 0.5, envs.action_space.shape).astype(np.float32)
        observations, *_, infos = envs.step(action)
        alone, *_ = single.step(action[1])
    if not np.array_equal(observations[1], alone):
        raise AssertionError("environment 1 differs from a single one with its seed")
    envs.close()
    single.close()
    return f"two processes, sim_time {infos['sim_time'].tolist()}"


def rllib() -> str:
    """RLlib's PPO samples with one remote runner and makes an update."""
    ray: Any = import_module("ray")
    config: Any = import_module("ray.rllib.algorithms.ppo").PPOConfig
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)

    def make(_: Any) -> gymnasium.Env[Any, Any]:
        import urlab_client.integrations.gym  # noqa: F401, PLC0415  # in the runner's process

        return gymnasium.make(ARM)

    try:
        import_module("ray.tune.registry").register_env("arm", make)
        algorithm = (
            config()
            .environment("arm")
            .env_runners(num_env_runners=1, rollout_fragment_length=200)
            .training(train_batch_size_per_learner=200, minibatch_size=64, num_epochs=1)
            .build_algo()
        )
        result = algorithm.train()
        algorithm.stop()
    finally:
        ray.shutdown()
    steps = result["env_runners"]["num_env_steps_sampled_lifetime"]
    if steps < 200:
        raise AssertionError(f"{steps} steps sampled")
    return f"{steps:.0f} steps by a remote runner, mean return {result['env_runners']['episode_return_mean']:.0f}"


CHECKS: dict[str, tuple[str, Callable[[], str]]] = {
    "sb3-check-env": ("stable-baselines3", sb3_check_env),
    "sb3-ppo": ("stable-baselines3", sb3_ppo),
    "gym-async": ("gymnasium", gym_async),
    "rllib": ("ray", rllib),
}


def main() -> int:
    """Run the checks; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checks", nargs="*", choices=[[], *CHECKS], help="all by default")
    failed = 0
    for name in parser.parse_args().checks or CHECKS:
        package, check = CHECKS[name]
        started = time.perf_counter()
        try:
            said = check()
        except Exception:  # noqa: BLE001  # whatever a library makes of it is what is to be seen
            traceback.print_exc()
            said, failed = "FAILED", failed + 1
        print(f"{name:14} {package} {version(package):10} {time.perf_counter() - started:5.1f} s  {said}")  # noqa: T201
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
