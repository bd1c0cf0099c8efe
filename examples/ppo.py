"""PPO in one file: learn a task on a batch of copies of its robot, and write the policy as a file that runs.

    pip install -e '.[gym,onnx,train]' torch
    python examples/ppo.py                              # reach.onnx and reach.toml, some minutes
    urlab evaluate reach.toml --episodes 200

Needs PyTorch and no learning library. The settings are for `urlab/Reach-v0`; change what you like.
"""

from __future__ import annotations

import argparse
import time

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

import urlab_client.integrations.gym  # registers the tasks  # noqa: F401
from urlab_client.integrations.policy import export_policy

COPIES, STEPS, EPOCHS, MINIBATCHES = 64, 50, 5, 4
GAMMA, LAMBDA, CLIP, RATE = 0.97, 0.95, 0.2, 1e-3


class Normaliser(nn.Module):
    """Subtracts the mean of all that it has seen, and divides by the standard deviation."""

    eps = 1e-4

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.tensor(1e-4))

    @property
    def std(self) -> torch.Tensor:
        return self.var.sqrt()

    def see(self, batch: torch.Tensor) -> None:
        total = self.count + len(batch)
        difference = batch.mean(0) - self.mean
        self.var += (
            len(batch) * (batch.var(0, correction=0) - self.var) + difference**2 * self.count * len(batch) / total
        ) / total
        self.mean += difference * len(batch) / total
        self.count.copy_(total)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - self.mean) / (self.std + self.eps)


def network(normaliser: Normaliser, inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)]
    nn.init.orthogonal_(layers[-1].weight, gain)
    return nn.Sequential(normaliser, *layers)


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))


parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
parser.add_argument("--task", default="urlab/Reach-v0")
parser.add_argument("--steps", type=int, default=400_000, help="steps of all copies together (default: %(default)s)")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("-o", "--output", default="reach.onnx", metavar="FILE")
arguments = parser.parse_args()

torch.manual_seed(arguments.seed)
torch.set_num_threads(1)
envs = gymnasium.make_vec(arguments.task, num_envs=COPIES, backend="batch", autoreset_mode=AutoresetMode.SAME_STEP)
size, n_actions = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
normaliser = Normaliser(size)
actor, critic = network(normaliser, size, n_actions, 0.01), network(normaliser, size, 1, 1.0)
log_std = nn.Parameter(torch.full((n_actions,), -1.5))  # these actions are set-points: small changes are enough
parameters = [*actor.parameters(), *critic.parameters(), log_std]
optimizer = torch.optim.Adam(parameters, lr=RATE)

observation = tensor(envs.reset(seed=arguments.seed)[0])
iterations = max(1, arguments.steps // (COPIES * STEPS))
started = time.perf_counter()
for iteration in range(iterations):
    optimizer.param_groups[0]["lr"] = RATE * (1 - iteration / iterations)
    seen, acted, logs, rewards, ends, values = [], [], [], [], [], []
    successes: list[bool] = []
    for _ in range(STEPS):
        with torch.no_grad():
            policy = torch.distributions.Normal(actor(observation), log_std.exp())
            action = policy.sample()
            values.append(critic(observation)[:, 0])
        following, reward, terminated, truncated, infos = envs.step(action.numpy())
        reward = tensor(reward)
        if truncated.any():  # time ran out, but the future did not: add what the last state is worth
            last = tensor(np.stack([*infos["final_obs"][truncated]]))
            with torch.no_grad():
                reward[torch.from_numpy(truncated)] += GAMMA * critic(last)[:, 0]
            successes += infos["final_info"]["success"][truncated].tolist()
        seen.append(observation)
        acted.append(action)
        logs.append(policy.log_prob(action).sum(1))
        rewards.append(reward)
        ends.append(tensor(terminated | truncated))
        observation = tensor(following)

    advantage, advantages = torch.zeros(COPIES), []
    with torch.no_grad():
        next_value = critic(observation)[:, 0]
    for step in reversed(range(STEPS)):  # generalised advantage estimation
        going = 1 - ends[step]
        advantage = rewards[step] + GAMMA * going * next_value - values[step] + GAMMA * LAMBDA * going * advantage
        advantages.insert(0, advantage)
        next_value = values[step]
    flat = [torch.cat(each) for each in (seen, acted, logs, advantages)]
    returns = flat[3] + torch.cat(values)

    for _ in range(EPOCHS):
        for rows in torch.randperm(COPIES * STEPS).chunk(MINIBATCHES):
            observations, actions, old, gains = (each[rows] for each in flat)
            gains = (gains - gains.mean()) / (gains.std() + 1e-8)
            new = torch.distributions.Normal(actor(observations), log_std.exp()).log_prob(actions).sum(1)
            ratio = (new - old).exp()
            loss = -torch.min(ratio * gains, ratio.clamp(1 - CLIP, 1 + CLIP) * gains).mean()
            loss = loss + 0.5 * (critic(observations)[:, 0] - returns[rows]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 0.5)
            optimizer.step()
    normaliser.see(flat[0])  # only now: the ratios above compare equal observations
    if iteration % 10 == 9 or iteration == iterations - 1:
        reward, share = float(torch.stack(rewards).mean()), f"{np.mean(successes):.0%}" if successes else "-"
        print(f"{(iteration + 1) * COPIES * STEPS} steps: mean reward {reward:.3f}, {share} of the ends a success")
envs.close()
print(f"{time.perf_counter() - started:.0f} s")
export_policy(actor, arguments.task, arguments.output)
