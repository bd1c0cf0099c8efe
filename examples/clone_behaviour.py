"""From teleoperation to a policy: record reach episodes, clone their behaviour, run the network. Takes about 20 s.

    pip install -e '.[teleop,gym,onnx,train]'
    python examples/clone_behaviour.py                        # clone/reach.{mcap,onnx,toml,json}
    python examples/clone_behaviour.py --recording reach.mcap # from episodes of `urlab teleop --task urlab/Reach-v0`

The example needs no human operator: a script moves the hand unsteadily towards the target, with the same inverse
kinematics and the same kind of recording as `urlab teleop`. A small NumPy network is trained with Adam on the
observation-action pairs of the successful episodes. The example then runs it as `urlab evaluate` and
`urlab run-policy` do.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import time
from pathlib import Path

import numpy as np
import onnx
from gymnasium.vector import AutoresetMode

from urlab_client.aio import URLabClient
from urlab_client.aio.launch import with_model_options
from urlab_client.integrations.gym import Reach, States, URLabBatchEnv
from urlab_client.integrations.policy import evaluate_in, load, run
from urlab_client.integrations.policy.network import OnnxNetwork
from urlab_client.integrations.record import read_run, record, transitions_of
from urlab_client.integrations.teleop import HandControl, TeleopCommand, TeleopTally, TeleopView, teleoperate
from urlab_client.protocol.base import Floats

__all__ = ["main"]

HIDDEN = 32
MIN_SPREAD = 0.1  # rad or m: limits the influence of values that hardly vary in the demonstrations
MIN_MOVE = 1e-3  # rad or m

DECLARATION = """\
# Inputs of the network in reach.onnx: the observations of urlab/Reach-v0, in the same order.
robot = "arm"
step_modes = ["direct"]
timestep = 0.002
decimation = 10

[[observation]]
term = "joint_position"
joints = {joints}

[[observation]]
term = "joint_velocity"
joints = {joints}

[[observation]]
term = "goal"

[[observation]]
term = "goal"
relative_to = "grip_position"

[goal]
default = [0.35, 0.1, 0.4]
low = {low}
high = {high}

[action]
via = "actuators"
joints = {driven}
clip = [-3.2, 3.2]
"""


class UnsteadyOperator:
    """Moves the hand to the target with a randomly varying velocity."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.wander = np.zeros(3)

    def __call__(self, view: TeleopView) -> TeleopCommand:
        ahead = view.goal["target"] - view.position
        self.wander = 0.9 * self.wander + 0.2 * self.rng.normal(size=3)
        x, y, z = ahead / 0.08 + self.wander * min(1.0, float(np.linalg.norm(ahead)) / 0.1)
        return TeleopCommand(linear=(x, y, z))


async def demonstrate(file: Path, episodes: int, seed: int) -> TeleopTally:
    """Record episodes of two seconds; the task decides at the end whether each is a success."""
    async with URLabClient(with_model_options(Reach.scene_address), step_mode="direct") as client:
        await client.discover()
        async with record(client, file, pose_hz=0, overwrite=True) as recorder:
            hand = HandControl(client, speed=0.4)
            operator = UnsteadyOperator(seed)
            return await teleoperate(
                client, operator, hand=hand, task=Reach(), recorder=recorder, episodes=episodes, seconds=2.0, seed=seed
            )


def pairs(file: Path, task: Reach) -> tuple[Floats, Floats]:
    """Return the observation of each state of a recording, and the action that followed."""
    table = transitions_of(read_run(file), only="success")
    state = [table.columns[f"arm/{name}"].values for name in ("qpos", "qvel", "action")]
    qpos, qvel, action = state
    goal = {"target": table.columns["goal/target"].values}
    observed = task.observe(States(task.scene, qpos, qvel, table.sim_time, goal))
    return np.hstack([qpos, qvel, observed]), action


class Cloned:
    """`action = current positions + network(part of the observation)`: the network learns the movement.

    Its inputs are the positions of the joints that move the hand, and the remaining vector to the target. Velocities
    are left out: they show what the operator just did, and a network that sees them learns to repeat that.
    """

    def __init__(self, observations: Floats, actions: Floats, driven: list[int], seen: list[int], seed: int) -> None:
        self.driven, self.seen, self.size = driven, seen, observations.shape[1]
        part = observations[:, seen]
        self.mean, self.spread = part.mean(axis=0), np.maximum(part.std(axis=0), MIN_SPREAD)
        moves = actions - observations[:, driven]
        self.move_mean, self.move_spread = moves.mean(axis=0), np.maximum(moves.std(axis=0), MIN_MOVE)
        rng = np.random.default_rng(seed)
        sizes = [len(seen), HIDDEN, HIDDEN, actions.shape[1]]
        self.weights = [rng.normal(size=(a, b)) / np.sqrt(a) for a, b in itertools.pairwise(sizes)]
        self.biases = [np.zeros(b) for b in sizes[1:]]
        self.inputs = (part - self.mean) / self.spread
        self.wanted = (moves - self.move_mean) / self.move_spread
        self.rng = rng

    def train(self, epochs: int, batch: int = 64, rate: float = 2e-3) -> list[float]:
        """Minimise the mean squared error by Adam, with a learning rate that decays to 0; return each epoch's error."""
        parameters = [*self.weights, *self.biases]
        first, second = [np.zeros_like(p) for p in parameters], [np.zeros_like(p) for p in parameters]
        errors: list[float] = []
        count, total = 0, epochs * -(-len(self.inputs) // batch)
        for _ in range(epochs):
            order, squares = self.rng.permutation(len(self.inputs)), 0.0
            for at in range(0, len(order), batch):
                rows = order[at : at + batch]
                error, gradients = self._gradients(self.inputs[rows], self.wanted[rows])
                squares += error * len(rows)
                count += 1
                step = rate * 0.5 * (1.0 + np.cos(np.pi * count / total))
                for p, g, m, v in zip(parameters, gradients, first, second, strict=True):
                    m[:] += 0.1 * (g - m)
                    v[:] += 0.001 * (g * g - v)
                    p[:] -= step * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8)
            errors.append(squares / len(order))
        return errors

    def _gradients(self, inputs: Floats, wanted: Floats) -> tuple[float, list[Floats]]:
        outputs = [inputs]
        for i, (weights, biases) in enumerate(zip(self.weights, self.biases, strict=True)):
            sums = outputs[-1] @ weights + biases
            outputs.append(np.tanh(sums) if i < len(self.weights) - 1 else sums)
        off = outputs[-1] - wanted
        back = 2.0 * off / off.size
        of_weights, of_biases = [], []
        for i in reversed(range(len(self.weights))):
            of_weights.insert(0, outputs[i].T @ back)
            of_biases.insert(0, back.sum(axis=0))
            if i:
                back = (back @ self.weights[i].T) * (1.0 - outputs[i] ** 2)
        return float((off**2).mean()), [*of_weights, *of_biases]

    def to_onnx(self) -> bytes:
        """Return the network as an ONNX file."""
        helper, number = onnx.helper, onnx.TensorProto.FLOAT
        constants: dict[str, np.ndarray] = {
            "mean": self.mean.astype(np.float32),
            "spread": self.spread.astype(np.float32),
            "move_mean": self.move_mean.astype(np.float32),
            "move_spread": self.move_spread.astype(np.float32),
            "driven": np.array(self.driven, dtype=np.int64),
            "seen": np.array(self.seen, dtype=np.int64),
        }
        nodes = [
            helper.make_node("Gather", ["observation", "seen"], ["part"], axis=1),
            helper.make_node("Sub", ["part", "mean"], ["centred"]),
            helper.make_node("Div", ["centred", "spread"], ["layer0"]),
            helper.make_node("Gather", ["observation", "driven"], ["present"], axis=1),
        ]
        last = len(self.weights) - 1
        for i, (weights, biases) in enumerate(zip(self.weights, self.biases, strict=True)):
            constants |= {f"w{i}": weights.astype(np.float32), f"b{i}": biases.astype(np.float32)}
            nodes.append(helper.make_node("Gemm", [f"layer{i}", f"w{i}", f"b{i}"], [f"sum{i}"]))
            if i < last:
                nodes.append(helper.make_node("Tanh", [f"sum{i}"], [f"layer{i + 1}"]))
        nodes += [
            helper.make_node("Mul", [f"sum{last}", "move_spread"], ["scaled"]),
            helper.make_node("Add", ["scaled", "move_mean"], ["move"]),
            helper.make_node("Add", ["present", "move"], ["action"]),
        ]
        graph = helper.make_graph(
            nodes,
            "reach",
            [helper.make_tensor_value_info("observation", number, ["batch", self.size])],
            [helper.make_tensor_value_info("action", number, ["batch", len(self.driven)])],
            [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
        )
        opset = [helper.make_opsetid("", 17)]
        model = helper.make_model(graph, producer_name="urlab_client", opset_imports=opset, ir_version=8)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString()


async def distances(policy_file: Path, goals: Floats) -> list[float]:
    """Run the policy as `urlab run-policy --goal` does; return the hand's distance from each goal after 2 s, metres."""
    found: list[float] = []
    policy = load(policy_file)
    async with URLabClient(with_model_options("sim://arm"), step_mode="direct") as client:
        await client.discover()
        for goal in goals:
            policy.goal = goal
            result = await run(client, policy, seconds=2.0)
            found.append(float("nan") if result.goal_error is None else result.goal_error)
    return found


class Options(argparse.Namespace):
    """Command-line options."""

    output: Path
    recording: Path | None
    episodes: int
    evaluated: int
    epochs: int
    seed: int


def main(arguments: list[str] | None = None) -> dict[str, object]:
    """Run all stages; print and return the figures."""
    parser = argparse.ArgumentParser(description="Clone the behaviour of teleoperated reach episodes.")
    parser.add_argument("--output", type=Path, default=Path("clone"), help="output folder (default: clone)")
    parser.add_argument("--recording", type=Path, help="existing recording of episodes (default: record scripted ones)")
    parser.add_argument("--episodes", type=int, default=50, help="demonstrations (default: 50)")
    parser.add_argument("--evaluated", type=int, default=200, help="episodes in the evaluation (default: 200)")
    parser.add_argument("--epochs", type=int, default=20, help="training epochs (default: 20)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all random numbers (default: 1)")
    options = parser.parse_args(arguments, namespace=Options())
    options.output.mkdir(parents=True, exist_ok=True)
    figures: dict[str, object] = {}

    began = time.perf_counter()
    recording = options.recording or options.output / "reach.mcap"
    if options.recording is None:
        tally = asyncio.run(demonstrate(recording, options.episodes, options.seed))
        figures["demonstrations"] = {"episodes": options.episodes, "successes": tally.success}
        figures["recording_s"] = round(time.perf_counter() - began, 1)

    task = Reach()
    batch = URLabBatchEnv(
        task.scene_address, min(64, options.evaluated), task=task, autoreset_mode=AutoresetMode.DISABLED
    )
    began = time.perf_counter()
    observations, actions = pairs(recording, task)
    layout = task.scene.mapping.layout("arm")
    joints = task.scene.mapping.joint_names("arm", task.scene.model)
    driven = [_driven_by(batch, name) for name in layout.actuators]
    moving = [joints.index(name) for name in driven if not name.endswith("finger")]
    way = range(observations.shape[1] - 3, observations.shape[1])
    cloned = Cloned(observations, actions, [joints.index(name) for name in driven], [*moving, *way], options.seed)
    errors = cloned.train(options.epochs)
    network = options.output / "reach.onnx"
    network.write_bytes(cloned.to_onnx())
    text = DECLARATION.format(
        joints=json.dumps(joints),
        driven=json.dumps(driven),
        low=Reach.LOW_M.tolist(),
        high=Reach.HIGH_M.tolist(),
    )
    network.with_suffix(".toml").write_text(text, encoding="utf-8")
    figures |= {"pairs": len(actions), "error": round(errors[-1], 4)}
    figures["training_s"] = round(time.perf_counter() - began, 1)

    began = time.perf_counter()
    found = evaluate_in(batch, OnnxNetwork(network), episodes=options.evaluated, seed=options.seed + 1)
    batch.close()
    goals = np.random.default_rng(options.seed + 2).uniform(Reach.LOW_M, Reach.HIGH_M, (10, 3))
    figures["run_policy_mm"] = [round(1e3 * one, 1) for one in asyncio.run(distances(network, goals))]
    rate = {} if found.success_rate is None else found.success_rate.to_dict()
    figures["policy"] = {"episodes": options.evaluated, **{name: round(value, 3) for name, value in rate.items()}}
    figures["evaluation_s"] = round(time.perf_counter() - began, 1)
    (options.output / "reach.json").write_text(json.dumps(figures, indent=2), encoding="utf-8")
    for name, value in figures.items():
        print(f"{name}: {value}")
    return figures


def _driven_by(batch: URLabBatchEnv, actuator: str) -> str:
    """Return the short name of the joint that an actuator drives."""
    model = batch.model
    return model.joint(model.actuator(f"arm_{actuator}").trnid[0]).name.removeprefix("arm_")


if __name__ == "__main__":
    main()
