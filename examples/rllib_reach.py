"""RLlib's PPO on the reach task, with one simulated server per runner, followed by episodes of the trained policy.

Needs `pip install 'urlab-client[ray]' 'ray[rllib]' torch`. A few updates are not enough for accurate reaching; the
example shows how the parts fit together. Runners and workers share one Ray cluster, which here is only this machine.
"""

import argparse
import os
import tempfile

import gymnasium
import numpy as np

os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's future default, about which it warns
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.tune.registry import register_env

from urlab_client.cluster import WorkerPool, rollouts
from urlab_client.integrations.gym import Reach


def make(_):
    import urlab_client.integrations.gym  # also in the runner's process  # noqa: F401, PLC0415

    return gymnasium.make("urlab/Reach-v0")


class Mean:
    """The learned module without exploration, as a policy for `rollouts`."""

    def __init__(self, module):
        self.module = module

    def __call__(self, observation, rng):
        seen = torch.from_numpy(np.float32(observation))[None]
        with torch.no_grad():
            mean, _ = self.module.forward_inference({"obs": seen})["action_dist_inputs"][0].chunk(2)
        return mean.numpy()


def score(module, workers):
    """Return the mean return of eight fixed episodes."""
    options = {"task": Reach(), "n_substeps": Reach.n_substeps}
    episodes = rollouts(
        Mean(module), "sim://arm", 8, seed=1, max_episode_steps=100, env_options=options, workers=workers
    )
    return np.mean([np.sum(episode.rewards) for episode in episodes])


parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--iterations", type=int, default=5, help="updates of PPO, of 2000 steps each")
parser.add_argument("--runners", type=int, default=2, help="remote runners, each with its own server and processor")
arguments = parser.parse_args()

with tempfile.TemporaryDirectory(prefix="ray") as scratch:
    ray.init(num_cpus=arguments.runners + 1, include_dashboard=False, log_to_driver=False, _temp_dir=scratch)
    register_env("reach", make)
    algorithm = (
        PPOConfig()
        .environment("reach")
        .env_runners(num_env_runners=arguments.runners, rollout_fragment_length="auto", sample_timeout_s=600)
        .training(train_batch_size_per_learner=2000, minibatch_size=200, num_epochs=10, lr=1e-3)
        .build_algo()
    )
    with WorkerPool(1) as workers:  # stays up, with its server, between the two evaluations
        before = score(algorithm.get_module(), workers)
        for i in range(arguments.iterations):
            result = algorithm.train()["env_runners"]
            print(
                f"update {i + 1}: {result['num_env_steps_sampled_lifetime']:.0f} steps, "
                f"mean return {result['episode_return_mean']:.1f}"
            )
        after = score(algorithm.get_module(), workers)
    print(f"return without exploration: {before:.1f} before, {after:.1f} after")
    algorithm.stop()
    ray.shutdown()
