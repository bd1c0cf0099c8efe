"""Trains PPO on a shipped task on a batch, and says how often what it learned succeeds.

    pip install -e '.[sb3,onnx,train]'
    python tools/train_task.py urlab/Reach-v0              # a million steps, some minutes
    python tools/train_task.py urlab/Push-v0 --steps 3000000

Success is counted at the end of episodes with seeds that training did not see, without exploration, with a 95 %
interval. The same episodes with a fresh network, and with set-points of 0, say what no training is worth. With
`-o reach.onnx`, the network is exported, and `urlab evaluate reach.toml` runs it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

import urlab_client.integrations.gym  # registers the tasks  # noqa: F401
from urlab_client.integrations.gym.sb3 import Sb3VecEnv
from urlab_client.integrations.policy import export_policy, wilson

__all__ = ["main"]

COPIES = 64
EVALUATED = 200
UNSEEN = 1_000_000  # the first seed of the evaluation
SETTINGS: dict[str, Any] = {
    "n_steps": 50,
    "batch_size": 800,
    "gamma": 0.97,
    "policy_kwargs": {"log_std_init": -1.5},  # actions are set-points: small changes are enough
    "device": "cpu",
}


def evaluate(task: str, act: Callable[[Any], Any]) -> tuple[int, float]:
    """Return in how many episodes the task was done at the end, and the mean return."""
    envs: Any = gymnasium.make_vec(task, num_envs=EVALUATED, backend="batch")
    observations, _ = envs.reset(seed=UNSEEN)
    done, total, over = np.zeros(EVALUATED, dtype=bool), np.zeros(EVALUATED), np.zeros(EVALUATED, dtype=bool)
    while not over.all():
        observations, rewards, terminated, truncated, infos = envs.step(act(observations))
        total += np.where(over, 0.0, rewards)
        done = np.where(over, done, infos["success"])
        over |= terminated | truncated
    envs.close()
    return int(done.sum()), float(total.mean())


def main(argv: Sequence[str] | None = None) -> int:
    """Train and evaluate; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task", help="id, such as urlab/Reach-v0; one whose task says what success is")
    parser.add_argument("--steps", type=int, default=1_000_000, help="environment steps")
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument(
        "-o", "--output", metavar="FILE", help="a .onnx file for the network, with a .toml file beside it"
    )
    arguments = parser.parse_args(argv)
    import_module("torch").set_num_threads(1)
    sb3: Any = import_module("stable_baselines3")
    wrappers: Any = import_module("stable_baselines3.common.vec_env")
    made = Sb3VecEnv(
        gymnasium.make_vec(arguments.task, num_envs=COPIES, backend="batch", autoreset_mode=AutoresetMode.SAME_STEP)
    )
    envs = wrappers.VecNormalize(made, gamma=SETTINGS["gamma"])
    model = sb3.PPO("MlpPolicy", envs, seed=arguments.seed, **SETTINGS)

    def say(name: str, act: Callable[[Any], Any]) -> None:
        done, total = evaluate(arguments.task, act)
        share = wilson(done, EVALUATED)
        print(
            f"{arguments.task}, {name}: {done} of {EVALUATED} episodes succeed ({share.low:.0%} to {share.high:.0%}), "
            f"mean return {total:.1f}",
            flush=True,
        )

    def learned(observations: Any) -> Any:
        return model.predict(envs.normalize_obs(observations), deterministic=True)[0]

    still = np.zeros((EVALUATED, *made.action_space.shape), dtype=np.float32)
    say("set-points of 0", lambda _: still)
    say("untrained", learned)
    started = time.perf_counter()
    model.learn(arguments.steps)
    say(f"{arguments.steps} steps, {time.perf_counter() - started:.0f} s", learned)
    if arguments.output is not None:
        export_policy(model, arguments.task, arguments.output)
    envs.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
