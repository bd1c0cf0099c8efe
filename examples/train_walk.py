"""Trains the bundled quadruped to trot with a velocity that it is told, by PPO on a batch.

    pip install -e '.[gym,onnx]' torch onnx
    python examples/train_walk.py                      # walk/walk.{onnx,toml,json}, a million steps
    python examples/train_walk.py --minutes 2 --seed 1 -o other
    urlab run-policy walk/walk.onnx --robot quadruped --command 0.5 0 0.3
    urlab evaluate walk/walk.onnx --task urlab/Walk-v0 --randomise

The task is `urlab/Walk-v0`, in which masses, friction, damping and strength vary. A trot seen in a mirror is the same
trot half a stride later. So in the second half of each stride the network sees the mirrored robot, and its answer is
mirrored back: it learns from every stride twice.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import nn

from urlab_client.integrations.gym import URLabBatchEnv, Walk
from urlab_client.integrations.policy import evaluate_in
from urlab_client.randomise.declaration import MODEST

DECLARATION = Path(__file__).parent / "policies/walk.toml"
SINE = 45  # of the stride's phase, in an observation
HIDDEN = (128, 128)
GAMMA, LAMBDA = 0.99, 0.95
STEPS, EPOCHS, MINIBATCHES = 25, 5, 4  # actions per copy and update: a stride
CLIP, ENTROPY, KL, STD = 0.2, 0.002, 0.01, 0.4
RATE = (1e-5, 2e-3)  # of learning, at least and at most

Array = NDArray[Any]
Act = Callable[[Array], Array]
"""One observation, shape (50,), to an action, shape (12,)."""


def mirrored(legs: Array) -> Array:
    """Return joints, or actions, of the robot in the mirror, shape (…, 12)."""
    swapped = legs.reshape(*legs.shape[:-1], 2, 2, 3)[..., ::-1, :].reshape(legs.shape)
    return swapped * np.tile([-1.0, 1.0, 1.0], 4)


def reflection() -> tuple[Array, Array]:
    """Return the matrices that mirror a row of observations and a row of actions."""
    action = mirrored(np.eye(12))
    see = np.zeros((50, 50))
    see[:9, :9] = np.diag([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])  # velocities and gravity
    for first in (9, 21, 33):
        see[first : first + 12, first : first + 12] = action
    see[45:, 45:] = np.diag([-1.0, -1.0, 1.0, -1.0, -1.0])  # phase and command
    return see.astype(np.float32), action.astype(np.float32)


SEE, ANSWER = (torch.from_numpy(matrix) for matrix in reflection())


class Noted(Walk):
    """Walking, with a note of each episode: its return, whether it was a success, and whether the robot fell."""

    def __init__(self) -> None:
        self.episodes: list[tuple[float, bool, bool]] = []

    def ended(self, episode: Any) -> None:
        """See `Task.ended`."""
        self.episodes.append((episode.total, episode.success, episode.terminated))

    def summary(self) -> dict[str, float]:
        """Return the means over the episodes noted so far, and forget them."""
        total, success, fell = np.mean(self.episodes, axis=0).tolist() if self.episodes else [None] * 3
        found = {"episodes": len(self.episodes), "return": total, "success": success, "falls": fell}
        self.episodes.clear()
        return found


def perceptron(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network of two hidden layers whose last layer starts small."""
    layers: list[nn.Module] = []
    for a, b in zip((inputs, *HIDDEN), HIDDEN, strict=False):
        layers += [nn.Linear(a, b), nn.ELU()]
    last = nn.Linear(HIDDEN[-1], outputs)
    nn.init.orthogonal_(last.weight, gain)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)


class Agent(nn.Module):
    """Actor and critic, which see the first half of a stride."""

    def __init__(self) -> None:
        super().__init__()
        self.actor, self.critic = perceptron(50, 12, 0.01), perceptron(50, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((12,), math.log(STD)))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return the actions without exploration, for observations as the task returns them."""
        return restored(self.actor(halved(observations)), observations).clamp(-1.0, 1.0)


def halved(observations: torch.Tensor) -> torch.Tensor:
    """Return observations of the first half of a stride: those of the second are mirrored."""
    return torch.where(observations[:, SINE : SINE + 1] < 0, observations @ SEE, observations)


def restored(actions: torch.Tensor, observations: torch.Tensor) -> torch.Tensor:
    """Return the actions for the observations themselves, given those for `halved` ones."""
    return torch.where(observations[:, SINE : SINE + 1] < 0, actions @ ANSWER, actions)


def log_likelihood(actions: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Return the logarithm of a Gaussian's density, without the constant."""
    return (-0.5 * ((actions - mean) / log_std.exp()) ** 2 - log_std).sum(-1)


class Trainer:
    """PPO: rollouts of all copies, then some passes over them, at a rate that the change of the policy sets."""

    def __init__(self, env: URLabBatchEnv, seed: int) -> None:
        self.env, self.agent, self.rate = env, Agent(), 1e-3
        self.optimiser = torch.optim.Adam(self.agent.parameters(), self.rate, eps=1e-5)
        self.seen = torch.from_numpy(env.reset(seed=1000 * seed)[0].astype(np.float32))

    @torch.no_grad()
    def rollout(self) -> tuple[torch.Tensor, ...]:
        """Return observations, actions, their likelihoods and means, advantages and returns, of all copies."""
        agent, n = self.agent, self.env.num_envs
        seen, acted = torch.zeros(STEPS, n, 50), torch.zeros(STEPS, n, 12)
        means, values = torch.zeros(STEPS, n, 12), torch.zeros(STEPS + 1, n)
        rewards, lasted = torch.zeros(STEPS, n), torch.zeros(STEPS, n)
        self.reward = 0.0
        for t in range(STEPS):
            seen[t] = halved(self.seen)
            means[t], values[t] = agent.actor(seen[t]), agent.critic(seen[t])[:, 0]
            acted[t] = means[t] + agent.log_std.exp() * torch.randn(n, 12)
            actions = restored(acted[t], self.seen).clamp(-1.0, 1.0)
            observations, reward, terminated, truncated, infos = self.env.step(actions.numpy())
            self.reward += float(reward.mean()) / STEPS
            rewards[t] = (1.0 - GAMMA) * torch.from_numpy(reward)
            lasted[t] = torch.from_numpy(~(terminated | truncated))
            for i in np.flatnonzero(truncated & ~terminated):  # it would have gone on
                final = torch.from_numpy(infos["final_obs"][i].astype(np.float32))[None]
                rewards[t, i] += GAMMA * agent.critic(halved(final))[0, 0]
            self.seen = torch.from_numpy(observations.astype(np.float32))
        values[STEPS] = agent.critic(halved(self.seen))[:, 0]
        advantages, following = torch.zeros(STEPS, n), torch.zeros(n)
        for t in reversed(range(STEPS)):
            surprise = rewards[t] + GAMMA * lasted[t] * values[t + 1] - values[t]
            advantages[t] = following = surprise + GAMMA * LAMBDA * lasted[t] * following
        likelihoods = log_likelihood(acted, means, agent.log_std)
        found = (seen, acted, likelihoods, means, advantages, advantages + values[:-1])
        return tuple(each.flatten(0, 1) for each in found)

    def update(self, most: float) -> None:
        """Roll out and learn, at no more than a rate."""
        agent, data = self.agent, self.rollout()
        std = agent.log_std.detach().clone()
        for _ in range(EPOCHS):
            for chosen in torch.randperm(len(data[0])).chunk(MINIBATCHES):
                seen, acted, before, means, advantages, returns = (each[chosen] for each in data)
                mean = agent.actor(seen)
                with torch.no_grad():
                    spread = (std.exp() ** 2 + (mean - means) ** 2) / (2.0 * agent.log_std.exp() ** 2)
                    change = float((agent.log_std - std + spread - 0.5).sum(-1).mean())
                self.rate *= 1 / 1.5 if change > 2 * KL else 1.5 if change < KL / 2 else 1.0
                self.rate = min(max(self.rate, RATE[0]), most)
                self.optimiser.param_groups[0]["lr"] = self.rate
                advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                ratio = (log_likelihood(acted, mean, agent.log_std) - before).exp()
                gain = torch.minimum(ratio * advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * advantages).mean()
                miss = (agent.critic(seen)[:, 0] - returns).square().mean()
                loss = miss - gain - ENTROPY * agent.log_std.sum()
                self.optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
                self.optimiser.step()


def to_onnx(agent: Agent) -> bytes:
    """Return an ONNX file of what `Agent.forward` does."""
    arrays = {"see": SEE, "answer": ANSWER, "zero": torch.zeros(1)}
    arrays |= {"least": torch.tensor(-1.0), "most": torch.tensor(1.0)}
    make, steps = onnx.helper.make_node, []
    steps.append(make("Gather", ["observation", "place"], ["sine"], axis=1))
    steps.append(make("Less", ["sine", "zero"], ["second"]))
    steps.append(make("MatMul", ["observation", "see"], ["mirrored"]))
    steps.append(make("Where", ["second", "mirrored", "observation"], ["h0"]))
    linear = [layer for layer in agent.actor if isinstance(layer, nn.Linear)]
    for i, layer in enumerate(linear):
        arrays |= {f"w{i}": layer.weight.detach(), f"b{i}": layer.bias.detach()}
        steps.append(make("Gemm", [f"h{i}", f"w{i}", f"b{i}"], [f"z{i}"], transB=1))
        if layer is not linear[-1]:
            steps.append(make("Elu", [f"z{i}"], [f"h{i + 1}"]))
    answer = f"z{len(linear) - 1}"
    steps.append(make("MatMul", [answer, "answer"], ["back"]))
    steps.append(make("Where", ["second", "back", answer], ["chosen"]))
    steps.append(make("Clip", ["chosen", "least", "most"], ["action"]))
    ends = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])
        for name, size in (("observation", 50), ("action", 12))
    ]
    tensors = [onnx.numpy_helper.from_array(array.numpy(), name) for name, array in arrays.items()]
    tensors.append(onnx.numpy_helper.from_array(np.array([SINE]), "place"))
    graph = onnx.helper.make_graph(steps, "policy", ends[:1], ends[1:], tensors)
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, producer_name="urlab_client", opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def evaluate(act: Act, episodes: int, threads: int) -> dict[str, float]:
    """Return how well something walks in episodes that training did not see."""
    task = Noted()
    options: dict[str, Any] = {"randomise": MODEST, "autoreset_mode": AutoresetMode.DISABLED, "n_threads": threads}
    env = URLabBatchEnv(Walk.scene_address, min(episodes, 100), task=task, **options)
    evaluate_in(env, act, episodes=episodes)
    env.close()
    return task.summary()


class Options(argparse.Namespace):
    """What the command line says."""

    steps: int
    minutes: float
    copies: int
    threads: int
    seed: int
    episodes: int
    report: float
    output: Path


def parse(argv: Sequence[str] | None) -> Options:
    """Return what the command line says."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="of all copies (default: %(default)s)")
    parser.add_argument("--minutes", type=float, default=30.0, help="at most (default: %(default)g)")
    parser.add_argument("--copies", type=int, default=128, help="of the robot (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="of physics and of learning (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="of the evaluation (default: %(default)s)")
    parser.add_argument("--report", type=float, default=0.25, metavar="MINUTES", help="how often it says and saves")
    parser.add_argument("-o", "--output", type=Path, default=Path("walk"), metavar="DIR")
    return parser.parse_args(argv, Options())


def main(argv: Sequence[str] | None = None) -> int:
    """Train and evaluate; return the exit status."""
    options = parse(argv)
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    options.output.mkdir(parents=True, exist_ok=True)
    path, task = options.output / "walk.onnx", Noted()
    env = URLabBatchEnv(
        Walk.scene_address,
        options.copies,
        task=task,
        randomise=MODEST,
        autoreset_mode=AutoresetMode.SAME_STEP,
        n_threads=options.threads,
    )
    trainer = Trainer(env, options.seed)
    settings = {name: value for name, value in vars(options).items() if name != "output"}
    record: dict[str, Any] = {"options": settings, "curve": []}

    def save() -> None:
        path.write_bytes(to_onnx(trainer.agent))
        path.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    shutil.copyfile(DECLARATION, path.with_suffix(".toml"))
    started, steps, said = time.perf_counter(), 0, 0.0
    done = 0.0
    while done < 1.0:
        trainer.update(max(RATE[1] * (1.0 - done), RATE[0]))
        steps += STEPS * options.copies
        minutes = (time.perf_counter() - started) / 60.0
        done = max(steps / options.steps, minutes / options.minutes)
        if minutes - said >= options.report or done >= 1.0:
            said = minutes
            row = {"steps": steps, "minutes": round(minutes, 2), **task.summary(), "rate": trainer.rate}
            row["reward"] = round(trainer.reward, 3)
            row["spread"] = round(float(trainer.agent.log_std.detach().exp().mean()), 3)
            record["curve"].append(row)
            save()
            print(json.dumps(row), flush=True)
    env.close()

    def walk(observation: Array) -> Array:
        with torch.no_grad():
            return trainer.agent(torch.from_numpy(observation.astype(np.float32))[None])[0].numpy()

    record["evaluation"] = {
        name: evaluate(act, options.episodes, options.threads)
        for name, act in (("zero", lambda _: np.zeros(12)), ("trained", walk))
    }
    save()
    print(json.dumps(record["evaluation"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
