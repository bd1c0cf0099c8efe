"""Rollouts on a Ray cluster, here only this machine: two workers, each with its own simulated server."""

import os
import tempfile

import matplotlib.pyplot as plt
import numpy as np

os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's future default, about which it warns
import ray

from urlab_client.cluster import rollouts

TARGET = np.array([0.52, -0.1, 0.15, 0.0, -0.05, 0.0, 0.04], dtype=np.float32)


def policy(observation, rng):
    return TARGET + rng.normal(scale=0.02, size=TARGET.shape)


with tempfile.TemporaryDirectory(prefix="ray") as scratch:
    ray.init(num_cpus=2, include_dashboard=False, object_store_memory=100 << 20, log_to_driver=False, _temp_dir=scratch)
    options = {"n_substeps": 10, "reset_noise": 0.05}
    figure, axes = plt.subplots(figsize=(7, 2), layout="constrained")
    with rollouts(policy, "sim://arm", 8, max_episode_steps=50, env_options=options) as episodes:
        for episode in episodes:
            span = np.ptp(episode.observations, axis=0).max()
            bar = (f"process {episode.pid}", episode.duration - episode.setup)
            axes.barh(bar[0], episode.setup, left=episode.started, color="0.8")
            axes.barh(*bar, left=episode.started + episode.setup, color="tab:blue", edgecolor="white")
            print(f"episode {episode.id} in process {episode.pid}: {episode.sim_time:.2f} s, moved by {span:.2f}")
    ray.shutdown()
start = axes.dataLim.x0
axes.xaxis.set_major_formatter(lambda x, _: f"{x - start:.1f}")
axes.set_xlabel("seconds (grey: server and reset; blue: steps of an episode)")
figure.savefig("timeline.png", dpi=110)
