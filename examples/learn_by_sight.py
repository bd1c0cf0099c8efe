"""Stable-Baselines3's CNN policy learns from pictures alone to send a cart to a ball.

    pip install -e '.[gym,sb3]'
    python examples/learn_by_sight.py            # without a graphics card, too

Only the camera tells where the ball is. In each episode it begins somewhere else, with another colour, under another
light. The batch draws the pictures in this process; a server would show the same ones (docs/environments.md).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

from urlab_client.integrations.gym import Start, States, Task, URLabBatchEnv
from urlab_client.integrations.gym.sb3 import Sb3VecEnv
from urlab_client.randomise import Randomisation, Vary

__all__ = ["main"]

MODEL = """
<mujoco model="rail">
  <option timestep="0.005"/>
  <worldbody>
    <light name="lamp" pos="0 -1 3" dir="0 0.3 -1"/>
    <camera name="eye" pos="0 -2.4 1.6" xyaxes="1 0 0 0 0.6 0.8"/>
    <geom type="plane" size="2 2 0.1" rgba="0.3 0.3 0.3 1"/>
    <body name="cart" pos="0 -0.25 0.12">
      <joint name="cart" type="slide" axis="1 0 0" range="-1 1" damping="40"/>
      <geom type="box" size="0.14 0.1 0.1" rgba="0.9 0.9 0.9 1" mass="1"/>
    </body>
    <body name="ball" pos="0 0.3 0.15">
      <joint name="ball" type="slide" axis="1 0 0" range="-1 1" damping="1"/>
      <geom name="ball" type="sphere" size="0.15" rgba="0.9 0.2 0.2 1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><position name="cart" joint="cart" kp="400" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
ACTIONS = 5  # of an episode
LOOKS = Randomisation(
    vary=(
        Vary(what="colour", on="rail/ball", add=((-0.2, -0.1, -0.1), (0.1, 0.2, 0.2))),
        Vary(what="light_position", on="*", add=(-0.3, 0.3)),
        Vary(what="camera_position", on="rail/eye", add=(-0.03, 0.03)),
    )
)


class Meet(Task):
    """The cart is to stand beside the ball."""

    space_mode = "dict"
    observations = ("qpos",)
    cameras = ("rail/eye",)
    n_substeps = 80
    max_episode_steps = ACTIONS

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """Put cart and ball anywhere on their rails."""
        start.qpos[:] = rng.uniform(-0.9, 0.9, 2)

    def reward(self, states: States, actions: Any) -> Any:
        """Return how far the cart is from the ball, metres, negated."""
        return -np.abs(states.qpos[:, 0] - states.qpos[:, 1])


def seen(tree: Any) -> Any:
    """Return the pictures in an observation, or their space."""
    return tree["cameras"]["rail/eye"]


class OnlyPictures(VecEnvWrapper):
    """Observations without numbers, and actions as an array: what `CnnPolicy` takes."""

    def __init__(self, envs: Sb3VecEnv) -> None:
        spaces: Any = envs
        super().__init__(spaces, seen(spaces.observation_space), spaces.action_space["rail"])

    def reset(self) -> Any:
        """Start an episode in all environments."""
        return seen(self.venv.reset())

    def step_async(self, actions: Any) -> None:
        """Keep the actions for `step_wait`."""
        self.venv.step_async({"rail": actions})  # type: ignore[arg-type]  # as the environment's space has them

    def step_wait(self) -> Any:
        """Apply the actions."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = seen(info["terminal_observation"])
        return seen(observations), rewards, dones, infos


@contextmanager
def sight(copies: int) -> Iterator[VecMonitor]:
    """Lend a batch of which Stable-Baselines3 sees the pictures only."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rail.xml")
        path.write_text(MODEL, encoding="utf-8")
        batch = URLabBatchEnv(
            f"sim://{path}?camera-size=36x36&render-quality=fast",
            copies,
            task=Meet(),
            randomise=LOOKS,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
    envs = VecMonitor(OnlyPictures(Sb3VecEnv(batch)))
    try:
        yield envs
    finally:
        envs.close()


def main(steps: int = 12_000, seed: int = 1) -> tuple[float, float]:
    """Train, and return the mean distance from the ball before and after, metres."""
    with sight(8) as envs:
        model = PPO(
            "CnnPolicy",
            envs,
            n_steps=64,
            batch_size=128,
            n_epochs=6,
            gamma=0.0,
            learning_rate=5e-4,
            seed=seed,
            device="cpu",
        )
        distances: list[float] = []
        for learn in (0, steps):
            if learn:
                model.learn(learn)
            mean, _ = evaluate_policy(model, envs, n_eval_episodes=40)
            distances.append(-float(np.mean(mean)) / ACTIONS)
    print(f"mean distance from the ball: {distances[0]:.2f} m before, {distances[1]:.2f} m after {steps} steps")
    return distances[0], distances[1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=12_000, help="actions of all copies together (%(default)s)")
    main(parser.parse_args().steps)
