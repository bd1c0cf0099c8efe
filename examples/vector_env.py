"""The same task on a batch of 64 without a wire and on two servers in lockstep: random shooting for the best target."""

import gymnasium
import numpy as np

import urlab_client.integrations.gym  # registers the environments  # noqa: F401


def scores(envs: gymnasium.vector.VectorEnv, targets: np.ndarray, steps: int = 20) -> np.ndarray:
    """Hold the target of each environment and return the sum of its rewards."""
    envs.reset(seed=0)
    return sum(envs.step(targets)[1] for _ in range(steps))


batch = gymnasium.make_vec("urlab/Arm-v0", num_envs=64, backend="batch", reset_noise=0.0)
batch.action_space.seed(0)
targets = batch.action_space.sample()
found = scores(batch, targets)
batch.close()

best = np.argsort(found)[-2:]
servers = gymnasium.make_vec("urlab/Arm-v0", num_envs=2, reset_noise=0.0)
again = scores(servers, targets[best])
servers.close()
print(f"best two of 64 in the batch: {found[best]}; the same over the wire: {again}")
