"""Trains PPO on a batch and on Gymnasium's own environment of the same robot, and draws both learning curves.

    pip install -e '.[sb3,demo]' imageio
    python tools/learning_curve.py              # ten runs, about ten minutes; docs/images/learning_curve.png
    python tools/learning_curve.py --seeds 1 --steps 20000 -o curve.png

The task is `InvertedPendulum-v5`: the batch steps the MJCF file that Gymnasium's environment steps, with its reward,
its end and its number of substeps. Both train with the same settings and seeds. They start episodes from noise of the
same size, but Gymnasium draws velocities, too, which a batch does not. Prints the figures that the documentation
states.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib as mpl
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from urlab_client.integrations.gym import ResetNoise, URLabBatchEnv
from urlab_client.integrations.gym.sb3 import Sb3VecEnv

mpl.use("agg")
import matplotlib.pyplot as plt  # after the backend was chosen

__all__ = ["main"]

OWN = "InvertedPendulum-v5"
FALLEN = 0.2  # radians, as Gymnasium's
COPIES = 8
REACHED = 900  # of 1000, the most that an episode can give
WINDOW = 5_000  # steps over which a curve is averaged
SETTINGS: dict[str, Any] = {"n_steps": 256, "batch_size": 64, "device": "cpu"}


def batch() -> Any:
    """Return the copies in one batch."""
    scene = Path(gymnasium.__file__).parent / "envs/mujoco/assets/inverted_pendulum.xml"
    return Sb3VecEnv(
        URLabBatchEnv(
            f"sim://{scene}",
            COPIES,
            observations=["qpos", "qvel"],
            n_substeps=2,
            max_episode_steps=1000,
            reset_noise=ResetNoise(hinge=0.01, slide=0.01),
            reward_fn=lambda before, action, after, info: (np.abs(after[..., 1]) <= FALLEN).astype(float),
            termination_fn=lambda after, info: np.abs(after[..., 1]) > FALLEN,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
    )


def gymnasiums() -> Any:
    """Return as many of Gymnasium's own, stepped one after the other, as Stable-Baselines3 does by default."""
    return import_module("stable_baselines3.common.vec_env").DummyVecEnv([lambda: gymnasium.make(OWN)] * COPIES)


@dataclass(frozen=True)
class Run:
    """One training: the step at which each episode ended, its return, seconds in all and in the environments."""

    ended: NDArray[np.int64]
    returns: NDArray[np.float64]
    seconds: float
    stepping: float


def train(make: Callable[[], Any], seed: int, steps: int) -> Run:
    """Train once."""
    sb3: Any = import_module("stable_baselines3")
    monitor: Any = import_module("stable_baselines3.common.vec_env").VecMonitor
    base: Any = import_module("stable_baselines3.common.callbacks").BaseCallback
    made = make()
    stepping = 0.0
    wait = made.step_wait

    def timed() -> Any:
        nonlocal stepping
        started = time.perf_counter()
        try:
            return wait()
        finally:
            stepping += time.perf_counter() - started

    made.step_wait = timed
    envs = monitor(made)
    envs.seed(seed)
    ended, returns = list[int](), list[float]()

    class Note(base):
        def _on_step(self) -> bool:
            for info in self.locals["infos"]:
                if "episode" in info:
                    ended.append(self.num_timesteps)
                    returns.append(float(info["episode"]["r"]))
            return True

    model = sb3.PPO("MlpPolicy", envs, seed=seed, **SETTINGS)
    started = time.perf_counter()
    model.learn(steps, callback=Note())
    seconds = time.perf_counter() - started
    envs.close()
    return Run(np.array(ended), np.array(returns), seconds, stepping)


def curve(run: Run, grid: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean return of episodes that ended in the window before each point; the last one known for none."""
    means = list[float]()
    for point in grid:
        inside = run.returns[(run.ended > point - WINDOW) & (run.ended <= point)]
        means.append(float(inside.mean()) if len(inside) else means[-1] if means else 0.0)
    return np.array(means)


def main(argv: Sequence[str] | None = None) -> int:
    """Train, draw and print; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="runs of each, with the seeds 0 to SEEDS - 1")
    parser.add_argument("--steps", type=int, default=120_000, help="environment steps of a run")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/learning_curve.png"), metavar="FILE")
    arguments = parser.parse_args(argv)
    import_module("torch").set_num_threads(1)  # what is measured is not to depend on what else runs
    grid = np.arange(WINDOW, arguments.steps + 1, WINDOW // 2)
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    kinds = (("URLabBatchEnv", batch, "tab:blue"), (f"Gymnasium's {OWN}", gymnasiums, "tab:orange"))
    runs: dict[str, list[Run]] = {name: [] for name, _, _ in kinds}
    for seed in range(arguments.seeds):
        for name, make, _ in kinds:  # by turns: what else the machine does hits both
            run = train(make, seed, arguments.steps)
            runs[name].append(run)
            print(
                f"{name}, seed {seed}: {len(run.ended)} episodes, {run.seconds:.0f} s, {run.stepping:.0f} of them in "
                f"the environments; the last {WINDOW} steps' mean return {curve(run, grid)[-1]:.0f}",
                flush=True,
            )
    for name, _, colour in kinds:
        curves = np.stack([curve(run, grid) for run in runs[name]])
        for each in curves:
            axes.plot(grid, each, color=colour, linewidth=0.6, alpha=0.4)
        axes.plot(grid, np.median(curves, axis=0), color=colour, label=f"{name}, median of {len(curves)} seeds")
        reached = grid[np.median(curves, axis=0) >= REACHED]
        first = f"after {reached[0]} steps" if len(reached) else "never"
        print(f"{name}: the median reaches {REACHED} {first}, and ends at {np.median(curves[:, -1]):.0f}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return (at most 1000)")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    figure.savefig(arguments.output, dpi=110)
    return 0


if __name__ == "__main__":
    sys.exit(main())
