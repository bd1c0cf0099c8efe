"""Train the quadruped's policy by evolution strategies, and write it as ONNX.

    python tools/train_policy.py                       examples/policies/quadruped.{onnx,json}
    python tools/train_policy.py --iterations 5 -o .   a short run somewhere else

What the network sees and does is declared in examples/policies/quadruped.toml, which also holds the reward. Rollouts
are those of `URLabBatchEnv`: the scene that a server compiles, its PD controller before each physics step. Needs the
extra `train`. The same seed and options give the same network, on the same builds of MuJoCo and NumPy.

One small network moves every leg: it sees the leg's own joints, the body mirrored to the leg's side, and the clock
shifted by half a stride for one diagonal. The file holds it unrolled, as an ordinary network of two layers.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client import URLabClient
from urlab_client.integrations.gym import URLabBatchEnv
from urlab_client.integrations.policy import Policy, PolicyMapping, PolicySpec, RobotState, read_spec
from urlab_client.integrations.policy.network import Layer, onnx_network

Floats = NDArray[np.float64]
Act = Callable[[Floats], Floats]
"""Observations, shape (n, observation_size), to outputs, shape (n, action_size)."""

DECLARATION = Path(__file__).parents[1] / "examples/policies/quadruped.toml"

LEGS = 4
SIDE = np.array([1.0, -1.0, 1.0, -1.0])  # left and right, in the order of the declaration's joints
FRONT = np.array([1.0, 1.0, -1.0, -1.0])
DIAGONAL = np.array([1.0, -1.0, -1.0, 1.0])
HIDDEN = 16

EVALUATED = np.array(
    [
        [0.4, 0.0, 0.0], [0.2, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.0, 0.0],
        [0.3, 0.0, 0.4], [0.3, 0.0, -0.4], [0.3, 0.1, 0.0], [0.3, -0.1, 0.0],
    ]
)  # fmt: skip


class LegNetwork:
    """The network of one leg, as a vector of parameters, for many such vectors at once."""

    def __init__(self, mapping: PolicyMapping) -> None:
        self.views = _leg_views(mapping)
        self.inputs = self.views.shape[1] + 1  # and whether the leg is a front one
        self._first = self.inputs * HIDDEN
        self._shapes = [(self.inputs, HIDDEN), (HIDDEN,), (HIDDEN, 3), (3,)]
        self.size = sum(int(np.prod(shape)) for shape in self._shapes)

    def initial(self, rng: np.random.Generator) -> Floats:
        """Return parameters whose outputs are all zero: the robot stands."""
        parameters = np.zeros(self.size)
        parameters[: self._first] = 0.3 * rng.normal(size=self._first)
        return parameters

    def act(self, parameters: Floats) -> Act:
        """Return the outputs of n networks, one for each row of observations."""
        w1, b1, w2, b2 = self._split(parameters)

        def outputs(observations: Floats) -> Floats:
            seen = np.einsum("lfo,no->nlf", self.views, observations)
            front = np.broadcast_to(FRONT[:, None], (*seen.shape[:2], 1))
            hidden = np.tanh(np.concatenate([seen, front], axis=-1) @ w1 + b1[:, None])
            joints = hidden @ w2 + b2[:, None]
            joints[:, :, 0] *= SIDE
            return joints.reshape(len(observations), -1)

        return outputs

    def unrolled(self, parameters: Floats) -> list[Floats]:
        """Return weights and biases of the whole robot's network: (n_in, n_hidden), (n_hidden,), and again."""
        w1, b1, w2, b2 = (part[0] for part in self._split(parameters[None]))
        first = np.concatenate([view.T @ w1[:-1] for view in self.views], axis=1)
        first_bias = np.concatenate([b1 + front * w1[-1] for front in FRONT])
        second = np.zeros((LEGS * HIDDEN, LEGS * 3))
        second_bias = np.zeros(LEGS * 3)
        for leg, side in enumerate(SIDE):
            sign = np.array([side, 1.0, 1.0])
            second[leg * HIDDEN : (leg + 1) * HIDDEN, leg * 3 : (leg + 1) * 3] = w2 * sign
            second_bias[leg * 3 : (leg + 1) * 3] = b2 * sign
        return [first, first_bias, second, second_bias]

    def _split(self, parameters: Floats) -> list[Floats]:
        parts: list[Floats] = []
        at = 0
        for shape in self._shapes:
            size = int(np.prod(shape))
            parts.append(parameters[:, at : at + size].reshape(-1, *shape))
            at += size
        return parts


def _leg_views(mapping: PolicyMapping) -> Floats:
    """Return what each leg sees of an observation, shape (legs, n_seen, observation_size): signs and a choice.

    Mirroring the robot left to right turns vectors' y, and the x and z of angular velocities, into their negatives.
    """
    signs = {
        "linear_velocity": [1, -1, 1],
        "angular_velocity": [-1, 1, -1],
        "gravity": [1, -1, 1],
        "command": [1, -1, -1],
    }
    views: list[Floats] = []
    for leg in range(LEGS):
        rows: list[Floats] = []
        at = 0
        for term in mapping.spec.observation:
            name = str(term.__struct_config__.tag)
            size = {"clock": 2, "joint_position": 12, "joint_velocity": 12}.get(name, 3)
            if name == "clock":
                chosen, sign = range(2), np.full(2, DIAGONAL[leg])
            elif size == 3:
                chosen, sign = range(3), np.where(SIDE[leg] > 0, 1, signs[name])
            else:
                chosen, sign = range(3 * leg, 3 * leg + 3), np.array([SIDE[leg], 1.0, 1.0])
            for index, factor in zip(chosen, sign, strict=True):
                row = np.zeros(mapping.observation_size)
                row[at + index] = factor
                rows.append(row)
            at += size
        views.append(np.stack(rows))
    return np.stack(views)


@dataclass
class Rollouts:
    """What n robots did, arrays of shape (n,).

    Attributes:
        reward: Mean over all actions, 0 after a fall.
        seconds: Until the fall, or all.
        forward: Metres along x until the fall.
        speed: Mean velocity until the fall, shape (n, 3): vx, vy (m/s, base frame), yaw rate (rad/s).
    """

    reward: Floats
    seconds: Floats
    forward: Floats
    speed: Floats


class Arena:
    """Copies of the robot, and what the declaration says about them."""

    def __init__(self, spec: PolicySpec, copies: int, threads: int) -> None:
        gains = spec.gains
        if gains is None:
            raise ValueError("the declaration has no gains")
        controller = f"{spec.robot}=pd,kp={gains.kp},kv={gains.kv},torque_limit={gains.torque_limit}"
        address = f"sim://{spec.robot}?controller={controller}"
        with URLabClient(address, step_mode="direct") as client:
            client.discover()
            robot = client.articulations[spec.robot]
            self.mapping = Policy(spec, lambda observation: observation, source=DECLARATION.name).bind(robot)
            self.key = robot.prefix
        self.copies = copies
        self.spec = spec
        self.env = URLabBatchEnv(
            address,
            copies,
            observations=["qpos", "qvel"],
            n_substeps=spec.decimation,
            reset_noise=0.1,
            n_threads=threads,
        )

    def roll(self, act: Act, commands: Floats, seeds: list[int], seconds: float) -> Rollouts:
        """Let every copy act for some seconds."""
        mapping, n = self.mapping, self.copies
        state = self._state(self.env.reset(seed=[*seeds], options={"keyframe": self.spec.keyframe})[0])
        start = state.qpos[:, 0].copy()
        alive = np.ones(n, dtype=bool)
        reward, lived, forward = np.zeros(n), np.zeros(n), np.zeros(n)
        speed = np.zeros((n, 3))
        last = np.zeros((n, mapping.action_size))
        actions = round(seconds / self.spec.period)
        for index in range(actions):
            action = mapping.clipped(act(mapping.observe(state, commands, last, index * self.spec.period)))
            state = self._state(self.env.step(mapping.targets(action))[0])
            alive &= ~mapping.fallen(state)
            reward += alive * mapping.reward(state, commands, action, last)
            lived += alive
            forward = np.where(alive, state.qpos[:, 0] - start, forward)
            speed += alive[:, None] * np.column_stack([state.linear_velocity[:, :2], state.angular_velocity[:, 2]])
            last = action
        return Rollouts(reward / actions, lived * self.spec.period, forward, speed / np.maximum(lived, 1)[:, None])

    def evaluate(self, act: Act, seconds: float) -> list[dict[str, Any]]:
        """Return how well something follows each of `EVALUATED`, over all copies."""
        commands = np.resize(EVALUATED, (self.copies, 3))
        found = self.roll(act, commands, [*range(self.copies)], seconds)
        rows: list[dict[str, Any]] = []
        for index, command in enumerate(EVALUATED):
            mine = np.arange(index, self.copies, len(EVALUATED))
            rows.append(
                {
                    "command": command.tolist(),
                    "episodes": len(mine),
                    "reward": round(float(found.reward[mine].mean()), 3),
                    "falls": int((found.seconds[mine] < seconds - self.spec.period / 2).sum()),
                    "forward_m": round(float(found.forward[mine].mean()), 2),
                    "speed": [round(float(value), 3) for value in found.speed[mine].mean(axis=0)],
                }
            )
        return rows

    def _state(self, observation: Floats) -> RobotState:
        field = self.env.mapping.field
        return RobotState(field(observation, self.key, "qpos"), field(observation, self.key, "qvel"))


class Adam:
    """Ascends a gradient."""

    def __init__(self, size: int) -> None:
        self._mean, self._square, self._count = np.zeros(size), np.zeros(size), 0

    def step(self, gradient: Floats, rate: float) -> Floats:
        """Return what to add."""
        self._count += 1
        self._mean = 0.9 * self._mean + 0.1 * gradient
        self._square = 0.99 * self._square + 0.01 * gradient**2
        mean, square = self._mean / (1 - 0.9**self._count), self._square / (1 - 0.99**self._count)
        return rate * mean / (np.sqrt(square) + 1e-8)


def train(arena: Arena, network: LegNetwork, options: Options) -> tuple[Floats, list[dict[str, float]]]:
    """Return the parameters found, and the curve."""
    rng = np.random.default_rng(options.seed)
    centre, adam = network.initial(rng), Adam(network.size)
    command = arena.spec.command
    if command is None:
        raise ValueError("the declaration takes no commands")
    curve: list[dict[str, float]] = []
    started = time.perf_counter()
    for iteration in range(options.iterations):
        left = 1 - iteration / options.iterations
        spread, rate = options.spread * (0.3 + 0.7 * left), options.rate * (0.2 + 0.8 * left)
        noise = rng.normal(size=(options.pairs, network.size))
        tried = np.concatenate([centre + spread * noise, centre - spread * noise])
        commands = rng.uniform(command.low, command.high, (options.commands, 3))
        commands[0] = command.default
        seeds = rng.integers(1 << 30, size=options.commands).tolist()
        # Everyone meets the same commands and the same starts.
        found = arena.roll(
            network.act(np.repeat(tried, options.commands, axis=0)),
            np.tile(commands, (len(tried), 1)),
            seeds * len(tried),
            options.seconds,
        )
        rewards = found.reward.reshape(len(tried), -1).mean(axis=1)
        ranks = rewards.argsort().argsort() / (len(tried) - 1) - 0.5
        gradient = (ranks[: options.pairs] - ranks[options.pairs :]) @ noise / (options.pairs * spread)
        centre = centre + adam.step(gradient, rate)
        if iteration % options.report == 0 or iteration == options.iterations - 1:
            rows = arena.evaluate(network.act(np.tile(centre, (arena.copies, 1))), options.evaluate)
            row = {
                "iteration": iteration + 1,
                "minutes": round((time.perf_counter() - started) / 60, 2),
                "reward_tried": round(float(rewards.mean()), 3),
                "reward": round(float(np.mean([row["reward"] for row in rows])), 3),
                "falls": sum(row["falls"] for row in rows),
            }
            curve.append(row)
            print(json.dumps({**row, "speeds": [row["speed"] for row in rows]}), flush=True)
    return centre, curve


def to_onnx(weights: list[Floats]) -> bytes:
    """Return an ONNX file of a network with one hidden layer of tanh."""
    first, first_bias, second, second_bias = weights
    layers: list[Layer] = [("Gemm", [first, first_bias], {}), ("Tanh", [], {}), ("Gemm", [second, second_bias], {})]
    return onnx_network(layers, len(first))


class Options(argparse.Namespace):
    """What the command line says."""

    iterations: int
    pairs: int
    commands: int
    seconds: float
    spread: float
    rate: float
    seed: int
    threads: int
    evaluate: float
    report: int
    output: Path


def parse(argv: list[str] | None) -> Options:
    parser = argparse.ArgumentParser(description="Train the quadruped's policy.")
    parser.add_argument("--iterations", type=int, default=240)
    parser.add_argument("--pairs", type=int, default=24, help="directions tried both ways (default: %(default)s)")
    parser.add_argument("--commands", type=int, default=3, help="commands each is tried with (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=2.4, help="of each trial (default: %(default)s)")
    parser.add_argument("--spread", type=float, default=0.06, help="of what is tried (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=0.03, help="of learning (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0, help="0: one per processor")
    parser.add_argument(
        "--evaluate", type=float, default=5.0, metavar="S", help="seconds of each evaluation (default: %(default)s)"
    )
    parser.add_argument("--report", type=int, default=20, metavar="N", help="evaluate every N iterations")
    parser.add_argument("-o", "--output", type=Path, default=DECLARATION.parent, metavar="DIR")
    return parser.parse_args(argv, Options())


def main(argv: list[str] | None = None) -> int:
    options = parse(argv)
    arena = Arena(read_spec(DECLARATION), 2 * options.pairs * options.commands, options.threads)
    network = LegNetwork(arena.mapping)
    rng, size = np.random.default_rng(options.seed), arena.mapping.action_size
    baselines = {
        "zero": arena.evaluate(lambda seen: np.zeros((len(seen), size)), options.evaluate),
        "random": arena.evaluate(lambda seen: rng.uniform(-1, 1, (len(seen), size)), options.evaluate),
    }
    parameters, curve = train(arena, network, options)
    trained = arena.evaluate(network.act(np.tile(parameters, (arena.copies, 1))), options.evaluate)
    record = {
        "options": {name: value for name, value in vars(options).items() if name not in ("output", "threads")},
        "parameters": network.size,
        "physics_steps": round(options.seconds / arena.spec.timestep) * arena.copies * options.iterations,
        "curve": curve,
        "evaluation": {**baselines, "trained": trained},
    }
    path = options.output / DECLARATION.with_suffix(".onnx").name
    path.write_bytes(to_onnx(network.unrolled(parameters)))
    path.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(f"{path}: {path.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
