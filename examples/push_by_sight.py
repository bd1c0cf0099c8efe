"""A policy that pushes a block it sees only in pictures, cloned from a script that knows the block's position.

    pip install -e '.[gym,onnx,train,demo]' torch onnxscript
    python examples/push_by_sight.py            # sight/push.{onnx,json,png}
    urlab evaluate sight/push.onnx --task urlab/PushPictures-v0

This is imitation, not reinforcement learning. A script that reads the block's position from the simulation
demonstrates pushing. One part of the network learns in a batch, without pictures, to act like the script for a given
block position: the network controls the arm, and the script labels each visited state with its own action (DAgger:
Ross, Gordon and Bagnell, 2011). The other part learns on servers to locate the block in pictures. The complete network
uses joint positions, the target and a picture.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import onnx
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

from urlab_client.integrations.gym import Push, PushPictures, URLabBatchEnv, URLabVectorEnv
from urlab_client.integrations.policy import OnnxDictNetwork, evaluate_in

__all__ = ["main"]

MOVING = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
CAMERA = "arm/overview"
ROWS, COLUMNS = slice(20, 68), slice(32, 88)
"""The part of a picture of 72 by 96 pixels in which the block can be."""

OPEN_M = 0.02
"""Opening of each finger; the block fits between the fingers in any orientation."""

HEIGHT_M, CLEAR_M, DONE_M, STEP_M = 0.03, 0.095, 0.012, 0.025
"""For the script: height of the hand, clearance around the block, distance at which it stops, and largest step."""

LEAD_RAD = 0.05
"""Unit of the network's output: typical distance of a set-point ahead of its joint."""

BLOCK_M = 0.05
"""Unit of the block's position in the network."""

CENTRE_M = (0.5, 0.0)

ACTIONS = 100
"""Length of a training episode: enough for the script to finish."""

BATCH = 64
FIRST_SEED = 1_000_000
"""First seed of training episodes, far from the seeds of the evaluation."""

MISJUDGED_M = 0.004
"""Standard deviation of the error added to the block's position while the acting part learns."""

SHARP = 5.0
"""Sharpness (inverse temperature) of the spatial softmax."""


class PushWithBlockState(PushPictures):
    """`PushPictures` whose observations include the block's state, for the script."""

    articulations = None


class Script:
    """Pushes a block with a known position: moves behind it, then pushes along the line to the target."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.site = model.site("arm_grip").id
        joints = [model.joint(f"arm_{name}") for name in MOVING]
        self.positions = [int(joint.qposadr[0]) for joint in joints]
        self.dofs = [int(joint.dofadr[0]) for joint in joints]

    def __call__(self, joints: np.ndarray, block: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the action, shape (7,).

        Args:
            joints: Positions of the six joints, rad.
            block: x and y of the block, metres, world frame.
            target: x and y of the target, metres, world frame.
        """
        self.data.qpos[self.positions] = joints
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        hand, axes = self.data.site_xpos[self.site], self.data.site_xmat[self.site].reshape(3, 3)
        way, beside = target - block, hand[:2] - block
        left = float(np.linalg.norm(way))
        ahead = way / max(left, 1e-6)
        at, wanted = np.arctan2(beside[1], beside[0]), np.arctan2(-ahead[1], -ahead[0])
        turn = (wanted - at + np.pi) % (2 * np.pi) - np.pi
        yaw = float(np.clip(np.arctan2(ahead[1], ahead[0]), -1.2, 1.2))
        if left < DONE_M:
            move, yaw = np.zeros(2), float(np.arctan2(axes[1, 0], axes[0, 0]))
        elif abs(turn) > 0.3:  # not behind the block yet
            on = at + np.clip(turn, -0.5, 0.5)
            move = -beside + CLEAR_M * np.array([np.cos(on), np.sin(on)])
        else:
            move = ahead * min(0.03, left + 0.005) - 1.5 * (beside - (beside @ ahead) * ahead)
        move *= min(1.0, STEP_M / max(float(np.linalg.norm(move)), 1e-9))
        upright = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]) @ axes.T
        turned = 0.5 * np.array(
            [upright[2, 1] - upright[1, 2], upright[0, 2] - upright[2, 0], upright[1, 0] - upright[0, 1]]
        )
        twist = np.concatenate([move, [np.clip(HEIGHT_M - hand[2], -0.02, 0.02)], np.clip(turned, -0.1, 0.1)])
        jacobian = np.zeros((6, self.model.nv))
        mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self.site)
        used = jacobian[:, self.dofs]
        lead = used.T @ np.linalg.solve(used @ used.T + 1e-4 * np.eye(6), twist)
        return np.concatenate([joints + lead, [OPEN_M]])


class Sight(nn.Module):
    """Network from a picture, joint positions and target to set-points. In between, it estimates the block's position.

    The convolutions end in the mean position of each channel (a spatial softmax: Finn et al., 2016). A `blind` network
    uses a learned constant instead of the picture.
    """

    def __init__(self, *, blind: bool) -> None:
        super().__init__()
        self.blind = blind
        self.look = nn.Sequential(
            nn.Conv2d(3, 8, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(8, 12, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(12, 8, 3, padding=1),
        )
        self.where = nn.Sequential(nn.Linear(16, 48), nn.ReLU(), nn.Linear(48, 2))
        self.guess = nn.Parameter(torch.zeros(2))
        self.act = nn.Sequential(nn.Linear(23, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, 6))
        rows, columns = torch.linspace(-1, 1, 24), torch.linspace(-1, 1, 28)
        self.register_buffer("grid", torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2))
        self.register_buffer("centre", torch.tensor(CENTRE_M))

    def located(self, part: torch.Tensor) -> torch.Tensor:
        """Return the block's position, in units of `BLOCK_M` from `CENTRE_M`, given the result of `pixels`."""
        if self.blind:
            return self.guess.expand(part.shape[0], 2)
        weights = torch.softmax(SHARP * self.look(part).flatten(2), -1)
        return self.where((weights @ self.grid).flatten(1))

    def leads(self, joints: torch.Tensor, target: torch.Tensor, block: torch.Tensor) -> torch.Tensor:
        """Return how far set-points are ahead, in units of `LEAD_RAD`, given a block position as from `located`."""
        hand, turned = hand_of(joints)
        at = BLOCK_M * block + self.centre
        beside, way = (hand[:, :2] - at) / BLOCK_M, (target - at) / BLOCK_M
        apart, left = (beside.square().sum(1, True) + 1e-4).sqrt(), (way.square().sum(1, True) + 1e-4).sqrt()
        axes = turned[:, :, 0], turned[:, :, 2]
        seen = [joints, hand[:, 2:] / BLOCK_M, beside, way, beside / apart, way / left, apart, left, *axes]
        return self.act(torch.cat(seen, 1))

    def forward(self, qpos: torch.Tensor, task: torch.Tensor, picture: torch.Tensor | None = None) -> torch.Tensor:
        """Return actions, shape (n, 7), for the task's observations."""
        joints = qpos[:, : len(MOVING)]
        part = joints if picture is None else pixels(picture[:, ROWS, COLUMNS])
        lead = LEAD_RAD * self.leads(joints, task, self.located(part))
        return torch.cat([joints + lead, torch.full_like(joints[:, :1], OPEN_M)], 1)


def hand_of(joints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the hand's position, metres, shape (n, 3), and rotation, shape (n, 3, 3), from the arm's kinematics."""

    def along(x: float, z: float) -> torch.Tensor:
        return torch.tensor([[x], [0.0], [z]])

    def about(axis: int, angle: torch.Tensor) -> torch.Tensor:
        sine, cosine, none = torch.sin(angle), torch.cos(angle), torch.zeros_like(angle)
        one = none + 1.0
        rows = {
            0: [one, none, none, none, cosine, -sine, none, sine, cosine],
            1: [cosine, none, sine, none, one, none, -sine, none, cosine],
            2: [cosine, -sine, none, sine, cosine, none, none, none, one],
        }[axis]
        return torch.stack(rows, -1).reshape(-1, 3, 3)

    pan, lift, elbow, roll, pitch, yaw = joints.unbind(1)
    place, turned = along(0.0, 0.134), about(2, pan)
    for offset, turn in (
        (along(0.0, 0.11), about(1, lift)),
        (along(0.0, 0.4), about(1, elbow)),
        (along(0.3, 0.0), about(0, roll)),
        (along(0.14, 0.0), about(1, pitch)),
        (along(0.0, -0.055), about(2, -yaw)),
    ):
        place, turned = place + turned @ offset, turned @ turn
    return (place + turned @ along(0.0, -0.125))[:, :, 0], turned


@dataclass
class Samples:
    """States and the script's action in each, as lists of arrays with one row per episode."""

    joints: list[np.ndarray] = field(default_factory=list)
    target: list[np.ndarray] = field(default_factory=list)
    block: list[np.ndarray] = field(default_factory=list)
    lead: list[np.ndarray] = field(default_factory=list)
    part: list[np.ndarray] = field(default_factory=list)

    def add(self, **rows: np.ndarray) -> None:
        """Add rows of entries."""
        for name, values in rows.items():
            getattr(self, name).append(np.array(values))

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the entries, shape (n, …), in the network's units; pictures stay bytes."""
        found = {name: np.concatenate(values) for name, values in vars(self).items() if values}
        found["block"] = (found["block"] - CENTRE_M) / BLOCK_M
        found["lead"] = found["lead"] / LEAD_RAD
        return {name: torch.tensor(v if name == "part" else np.float32(v)) for name, v in found.items()}


def collect(envs: Any, script: Script, samples: Samples, *, seed: int, driver: Sight | None, rng: Any) -> float:
    """Run an episode in each environment and store the script's action for each state; return the success rate.

    The `driver` acts, given the block's position with a small error; without a driver, the script acts with added
    noise. Pictures are stored if the environments have them.
    """
    seen, _ = envs.reset(seed=seed)
    wander, misjudged = np.zeros((envs.num_envs, 6)), rng.normal(scale=MISJUDGED_M, size=(envs.num_envs, 2))
    space, success = envs.single_action_space["arm"], np.zeros(envs.num_envs, bool)
    for _ in range(ACTIONS):
        joints, block, target = seen["arm"]["qpos"][:, :6], seen["block"]["qpos"][:, :2], seen["task"]
        wanted = np.array([script(*each) for each in zip(joints, block, target, strict=True)])
        pictures = {}
        if "cameras" in seen:
            pictures["part"] = seen["cameras"][CAMERA][:, ROWS, COLUMNS]
        samples.add(joints=joints, target=target, block=block, lead=wanted[:, :6] - joints, **pictures)
        wander = 0.8 * wander + rng.normal(scale=0.012, size=wander.shape)
        driven = wanted[:, :6] + wander
        if driver is not None:
            at = (block + misjudged - CENTRE_M) / BLOCK_M
            with torch.no_grad():
                leads = driver.leads(*(torch.tensor(np.float32(each)) for each in (joints, target, at)))
            driven = joints + LEAD_RAD * leads.numpy()
        actions = np.hstack([driven, np.full((envs.num_envs, 1), OPEN_M)])
        seen, _, _, _, infos = envs.step({"arm": np.clip(actions, space.low, space.high).astype(np.float32)})
        success = infos["success"]
    return float(success.mean())


def learn_to_act(network: Sight, data: dict[str, torch.Tensor], *, updates: int) -> float:
    """Fit the acting part to the script, with a small error in the block's position; return the error, rad."""

    def error(rows: torch.Tensor) -> torch.Tensor:
        block = data["block"][rows]
        block = (
            network.guess.expand(len(rows), 2)
            if network.blind
            else block + MISJUDGED_M / BLOCK_M * torch.randn_like(block)
        )
        return network.leads(data["joints"][rows], data["target"][rows], block) - data["lead"][rows]

    return LEAD_RAD * fit(error, [*network.act.parameters(), network.guess], len(data["block"]), updates)


def learn_to_look(network: Sight, data: dict[str, torch.Tensor], *, updates: int) -> float:
    """Fit the locating part to the block's position; return the error, metres."""

    def error(rows: torch.Tensor) -> torch.Tensor:
        return network.located(pixels(data["part"][rows])) - data["block"][rows]

    eyes = [*network.look.parameters(), *network.where.parameters()]
    return BLOCK_M * fit(error, eyes, len(data["block"]), updates)


def fit(
    error: Callable[[torch.Tensor], torch.Tensor], parameters: list[nn.Parameter], count: int, updates: int
) -> float:
    """Minimise the squared error by AdamW with a one-cycle learning rate; return the final root mean square error."""
    optimiser = torch.optim.AdamW(parameters, lr=3e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=updates)
    last: list[float] = []
    for _ in range(updates):
        square = error(torch.randint(count, (BATCH,))).square().mean()
        optimiser.zero_grad()
        square.backward()
        optimiser.step()
        schedule.step()
        last.append(float(square.detach()))
    return float(np.mean(last[-100:])) ** 0.5


def pixels(part: torch.Tensor) -> torch.Tensor:
    """Convert parts of pictures, bytes of shape (n, rows, columns, 3), to the input of the convolutions."""
    return part.permute(0, 3, 1, 2).float() / 255.0 - 0.5


def save(network: Sight, file: Path) -> None:
    """Write the network as ONNX; its inputs are named after the entries of the task's observations."""
    seen = {
        "arm/qpos": torch.zeros(2, 8),
        "task": torch.zeros(2, 2),
        f"cameras/{CAMERA}": torch.zeros(2, 72, 96, 3, dtype=torch.uint8),
    }
    if network.blind:
        del seen[f"cameras/{CAMERA}"]
    torch.onnx.export(
        network.eval(),
        tuple(seen.values()),
        file,
        input_names=list(seen),
        output_names=["arm"],
        dynamic_shapes=tuple({0: torch.export.Dim("batch")} for _ in seen),
        dynamo=True,
        external_data=False,
        verbose=False,
    )
    model = onnx.load(file)
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info, *model.graph.initializer):
        del part.metadata_props[:]  # paths and line numbers on this machine
        part.doc_string = ""
    onnx.save(model, file)


def evaluated(envs: URLabVectorEnv | URLabBatchEnv, network: Any, episodes: int) -> dict[str, Any]:
    """Evaluate a network in episodes outside the training, as `urlab evaluate` does."""
    found = evaluate_in(envs, network, episodes=episodes, seed=0)
    rate = found.success_rate
    return {
        "episodes": episodes,
        "success_rate": None if rate is None else {name: round(value, 4) for name, value in rate.to_dict().items()},
        "mean_return": {name: round(value, 2) for name, value in found.mean_return.to_dict().items()},
    }


def draw(envs: URLabVectorEnv, network: OnnxDictNetwork, rounds: list[dict[str, float]], file: Path) -> None:
    """Plot the pictures that the network sees in an episode, and its success rate during training."""
    seen, _ = envs.reset(seed=0)
    strip = []
    for step in range(61):
        if step % 20 == 0:
            strip.append(seen["cameras"][CAMERA][0])
        one = {
            "arm": {"qpos": seen["arm"]["qpos"][0]},
            "task": seen["task"][0],
            "cameras": {CAMERA: seen["cameras"][CAMERA][0]},
        }
        seen, *_ = envs.step({"arm": np.tile(np.float32(network(one)), (envs.num_envs, 1))})
    figure, (pictures, curve) = plt.subplots(1, 2, figsize=(10, 2.4), width_ratios=[3, 1], layout="constrained")
    pictures.imshow(np.hstack([picture[ROWS, COLUMNS] for picture in strip]), interpolation="nearest")
    pictures.set_axis_off()
    pictures.set_title("what it sees, every 0.8 s", fontsize=9)
    curve.plot([100 * each["success_rate"] for each in rounds][1:], marker=".")
    curve.set(xlabel="round", ylim=(0, 100))
    curve.set_title("success while it learns, %", fontsize=9)
    figure.savefig(file, dpi=120)
    plt.close(figure)


class Options(argparse.Namespace):
    """Command-line options."""

    output: Path
    rounds: int
    episodes: int
    evaluated: int
    looks: int
    updates: int
    servers: int
    seed: int


def parsed(arguments: list[str] | None) -> Options:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description="Clone a scripted pusher with a network that sees pictures.")
    parser.add_argument("--output", type=Path, default=Path("sight"), help="output folder (default: sight)")
    parser.add_argument("--rounds", type=int, default=8, help="training rounds in a batch (default: 8)")
    parser.add_argument("--episodes", type=int, default=50, help="episodes per round (default: 50)")
    parser.add_argument("--looks", type=int, default=50, help="episodes with pictures (default: 50)")
    parser.add_argument("--updates", type=int, default=1500, help="updates per round and for locating (default: 1500)")
    parser.add_argument("--evaluated", type=int, default=100, help="episodes per evaluation (default: 100)")
    parser.add_argument("--servers", type=int, default=2, help="simulated servers (default: 2)")
    parser.add_argument("--seed", type=int, default=1, help="seed of starts, targets and networks (default: 1)")
    return parser.parse_args(arguments, namespace=Options())


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Demonstrate, train and evaluate; print and return the figures."""
    options = parsed(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(options.seed)
    disabled = AutoresetMode.DISABLED
    batch = URLabBatchEnv(
        Push.scene_address, options.episodes, task=Push(), space_mode="dict", autoreset_mode=disabled
    )  # same physics as on servers, bit for bit, but faster because it draws no pictures
    script = Script(batch.model)
    figures: dict[str, Any] = {"rounds": []}
    seeing, blind = Sight(blind=False), Sight(blind=True)
    samples, began = Samples(), time.perf_counter()
    for number in range(options.rounds):
        seed = FIRST_SEED * options.seed + 1000 * number
        rate = collect(batch, script, samples, seed=seed, driver=seeing if number else None, rng=rng)
        error = learn_to_act(seeing, samples.tensors(), updates=options.updates)
        figures["rounds"].append({"success_rate": round(rate, 3), "error_rad": round(error, 5)})
        print(figures["rounds"][-1], flush=True)
    learn_to_act(seeing, samples.tensors(), updates=4 * options.updates)
    learn_to_act(blind, samples.tensors(), updates=2 * options.updates)
    figures["practising_s"] = round(time.perf_counter() - began)

    began = time.perf_counter()
    envs = URLabVectorEnv(
        PushWithBlockState.scene_address,
        options.servers,
        task=PushWithBlockState(),
        autoreset_mode=disabled,
        step_timeout=60.0,  # with software rendering the first picture is slow
    )
    picture_samples = Samples()
    for first in range(0, options.looks, options.servers):
        seed = FIRST_SEED * options.seed + 500_000 + first
        driver = None if first < options.looks // 3 else seeing
        collect(envs, script, picture_samples, seed=seed, driver=driver, rng=rng)
    figures["pictures"] = len(picture_samples.part) * options.servers
    figures["drawing_s"] = round(time.perf_counter() - began)
    began = time.perf_counter()
    figures["error_of_sight_m"] = round(learn_to_look(seeing, picture_samples.tensors(), updates=options.updates), 5)
    figures["learning_to_look_s"] = round(time.perf_counter() - began)
    for name, network in {"push": seeing, "blind": blind}.items():
        save(network, options.output / f"{name}.onnx")

    def scripted(seen: dict[str, Any]) -> np.ndarray:
        return script(seen["arm"]["qpos"][:6], seen["block"]["qpos"][:2], seen["task"])

    unseeing = OnnxDictNetwork(options.output / "blind.onnx", batch.single_observation_space, 7)
    seeing_now = OnnxDictNetwork(options.output / "push.onnx", envs.single_observation_space, 7)
    figures["script"] = evaluated(batch, scripted, options.evaluated)
    figures["without pictures"] = evaluated(batch, unseeing, options.evaluated)
    batch.close()
    figures["policy"] = evaluated(envs, seeing_now, options.evaluated)
    draw(envs, seeing_now, figures["rounds"], options.output / "push.png")
    envs.close()
    (options.output / "push.json").write_text(json.dumps(figures, indent=2), encoding="utf-8")
    for name, value in figures.items():
        print(f"{name}: {value}")
    return figures


if __name__ == "__main__":
    main()
