"""A Gymnasium environment over a simulated server: the arm moves to a joint target, and a picture shows the result."""

import gymnasium
import numpy as np
from PIL import Image

import urlab_client.integrations.gym  # registers the environments  # noqa: F401

env = gymnasium.make("urlab/Arm-v0", render_mode="rgb_array", render_camera="arm/overview")
observation, info = env.reset(seed=1)
arm = env.unwrapped.articulations["arm"]
target = np.array([0.52, -0.1, 0.15, 0.0, -0.05, 0.0, 0.04], dtype=np.float32)
score = 0.0
for _ in range(env.spec.max_episode_steps):
    observation, reward, terminated, truncated, info = env.step(target)
    score += reward
    if terminated or truncated:
        break
print(f"score {score:.1f} after {info['sim_time']:.1f} s, hand at {np.round(arm.get_sensors()['grip_position'], 2)}")
Image.fromarray(env.render()).save("arm.png")
env.close()
