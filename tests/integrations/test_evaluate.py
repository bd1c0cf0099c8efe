"""Evaluations: intervals against published values, outcomes against episodes run one by one, and the command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from gymnasium.vector import AutoresetMode

from urlab_client.cli import main
from urlab_client.errors import URLabError
from urlab_client.integrations.gym import PushPictures, Reach, URLabBatchEnv, URLabEnv, URLabVectorEnv
from urlab_client.integrations.policy import OnnxDictNetwork, PolicyFileError, bootstrap_mean, evaluate_in, wilson
from urlab_client.integrations.policy.evaluation import Evaluation, Outcome, episode_seeds
from urlab_client.randomise import Noise, Randomisation, Vary
from urlab_client.server import SimulatedServer

NETWORK = Path(__file__).parents[2] / "examples/policies/quadruped.onnx"


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_the_score_interval_is_the_published_one(successes: int, n: int, low: float, high: float) -> None:
    """R. G. Newcombe, Statistics in Medicine 17 (1998), table I, method 3."""
    found = wilson(successes, n)
    assert (round(found.low, 4), round(found.high, 4)) == (low, high)
    assert found.value == successes / n
    assert wilson(successes, n, 0.99).high > found.high


def test_a_bootstrap_interval_covers_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(5.0, 2.0, 400).tolist()
    found = bootstrap_mean(values)
    assert found.value == pytest.approx(np.mean(values))
    assert found.high - found.low == pytest.approx(2 * 1.96 * np.std(values) / 20, rel=0.05)
    assert bootstrap_mean(values) == found
    assert bootstrap_mean([3.0]) == bootstrap_mean([3.0, 3.0])


def test_what_cannot_be_evaluated_is_refused() -> None:
    episode = Outcome(seed=1, total=2.0, actions=3, success=None)
    with pytest.raises(ValueError, match="no episodes to evaluate"):
        Evaluation.of([], 0.95)
    for confidence in (0.0, 1.0):
        with pytest.raises(ValueError, match=f"confidence must be between 0 and 1, not {confidence}"):
            Evaluation.of([episode], confidence)
    for seed, episodes in ((0, 0), (-1, 1)):
        with pytest.raises(ValueError, match=f"at least 1 and the seed at least 0, not {episodes} and {seed}"):
            episode_seeds(seed, episodes)
    assert episode_seeds(0, 2)[:1] == episode_seeds(0, 1)


def test_outcomes_are_those_of_single_episodes_whatever_the_batch() -> None:
    varied = Randomisation(
        vary=(Vary(what="mass", scale=(0.5, 2.0)),), noise=(Noise(field="qpos", std=0.01, bias=0.02),)
    )

    def network(observation: Any) -> Any:
        return 2.0 * observation[:7] + observation[-3:].sum()

    with SimulatedServer("arm", play=True, randomise=varied) as server:
        address = f"{server.address}:{server.step_port}"
        options: Any = {"task": Reach(), "max_episode_steps": 4, "autoreset_mode": AutoresetMode.DISABLED}
        found: list[Any] = []
        for size in (2, 5):
            batch = URLabBatchEnv(address, size, **{**options, "task": Reach()})
            seen: list[Any] = []
            found.append(evaluate_in(batch, network, episodes=5, seed=9, on_episode=seen.append))
            assert {outcome.seed for outcome in seen} == {outcome.seed for outcome in found[-1].outcomes}
            assert evaluate_in(batch, network, episodes=3, seed=9).outcomes == found[-1].outcomes[:3]
        assert found[0] == found[1]
        unused = URLabBatchEnv(address, 3, **{**options, "task": Reach()})
        assert evaluate_in(unused, network, episodes=1, seed=9).outcomes == found[0].outcomes[:1]
        with pytest.raises(ValueError, match="the network returned 2 numbers, but an action has 7"):
            evaluate_in(batch, lambda _: np.zeros(2), episodes=1)
        endless = URLabBatchEnv(address, 1, autoreset_mode=AutoresetMode.DISABLED)
        with pytest.raises(ValueError, match="needs a batch with"):
            evaluate_in(endless, network, episodes=1)
        env = URLabEnv.connect(address, task=Reach(), max_episode_steps=4)
        space: Any = env.action_space
        for outcome in found[0].outcomes[:2]:
            observation, _ = env.reset(seed=outcome.seed)
            total, over, info = 0.0, False, dict[str, Any]()
            for _ in range(4):
                action = np.clip(network(observation), space.low, space.high).astype(np.float32)
                observation, reward, _, over, info = env.step(action)
                total += reward
            assert (over, total, info["success"], 4) == (True, outcome.total, outcome.success, outcome.actions)
        env.close()
    assert found[0].success_rate == wilson(sum(outcome.success for outcome in found[0].outcomes), 5)


@pytest.mark.opengl
@pytest.mark.long
def test_a_network_that_sees_pictures_is_evaluated_on_servers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its inputs are told apart by name; what it makes of them moves the arm."""

    def saved(picture: str, kind: int = onnx.TensorProto.UINT8, width: int = 96) -> Path:
        helper, number = onnx.helper, onnx.TensorProto.FLOAT
        graph = helper.make_graph(
            [
                helper.make_node("Cast", [picture], ["bytes"], to=number),
                helper.make_node("ReduceMean", ["bytes"], ["bright"], axes=[1, 2, 3], keepdims=0),
                helper.make_node("Unsqueeze", ["bright", "last"], ["column"]),
                helper.make_node("Mul", ["column", "share"], ["turn"]),
                helper.make_node("Slice", ["arm/qpos", "from", "to", "last"], ["joints"]),
                helper.make_node("Add", ["joints", "turn"], ["arm"]),
            ],
            "sees",
            [
                helper.make_tensor_value_info(picture, kind, ["batch", 72, width, 3]),
                helper.make_tensor_value_info("arm/qpos", number, ["batch", 8]),
            ],
            [helper.make_tensor_value_info("arm", number, ["batch", 7])],
            [
                onnx.numpy_helper.from_array(np.array(value, dtype), name)
                for name, value, dtype in (
                    ("share", [[0.001] * 7], np.float32),
                    ("last", [1], np.int64),
                    ("from", [0], np.int64),
                    ("to", [7], np.int64),
                )
            ],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        path = tmp_path / f"{picture.replace('/', '_')}{width}{kind}.onnx"
        path.write_bytes(model.SerializeToString())
        return path

    with SimulatedServer("arm", "block", "floor", play=True, camera_size=(96, 72)) as server:
        address = f"{server.address}:{server.step_port}"
        options: Any = {"max_episode_steps": 2, "autoreset_mode": AutoresetMode.DISABLED}
        env = URLabVectorEnv([address], task=PushPictures(), **options)
        space = env.single_observation_space
        network = OnnxDictNetwork(saved("cameras/arm/overview"), space, 7)
        assert network.inputs == ("cameras/arm/overview", "arm/qpos")
        seen = env.reset(seed=1)[0]
        one = {"arm": {"qpos": seen["arm"]["qpos"][0]}, "cameras": {"arm/overview": seen["cameras"]["arm/overview"][0]}}
        bright = float(one["cameras"]["arm/overview"].mean())
        np.testing.assert_allclose(network(one), one["arm"]["qpos"][:7] + 0.001 * bright, rtol=1e-4)
        found = evaluate_in(env, network, episodes=2, seed=3)
        assert [outcome.actions for outcome in found.outcomes] == [2, 2]
        assert found.success_rate == wilson(0, 2)
        still = evaluate_in(env, lambda _: np.zeros(7), episodes=2, seed=3)
        assert still.mean_return != found.mean_return, "what it says moves the arm"
        for path, size, reason in (
            (
                saved("arm/overview"),
                7,
                "its input 'arm/overview' is not an entry of the observation; the entries are: arm/qpos",
            ),
            (saved("cameras/arm/overview", width=64), 7, "must be tensor(uint8) of shape ['batch', 72, 96, 3]"),
            (saved("cameras/arm/overview", onnx.TensorProto.FLOAT), 7, "must be tensor(uint8) of shape"),
            (saved("cameras/arm/overview"), 6, "it needs one output, float32 of shape ['batch', 6]; it has: arm"),
        ):
            with pytest.raises(PolicyFileError, match=re.escape(reason)):
                OnnxDictNetwork(path, space, size)
        server.close()
        with pytest.raises(Exception, match=re.escape("environment 0")) as failed:
            evaluate_in(env, network, episodes=1)
        assert isinstance(failed.value, (URLabError, TimeoutError))
        env.close()
    assert main(["evaluate", str(NETWORK), "--episodes=1", "--task", "urlab/PushPictures-v0"]) == 2
    assert (
        "its input 'observation' is not an entry of the observation; the entries are: arm/qpos"
        in capsys.readouterr().err
    )


def test_the_command_states_rates_and_every_episode(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", str(NETWORK), "--robot=quadruped", "--seconds=0.2", "--randomise", "--episodes=3", "--json"]
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert len({outcome["total"] for outcome in said["outcomes"]}) == 3, "the robot varies"
    assert said["success_rate"]["value"] == 1.0
    assert said["mean_actions"]["value"] == 10
    for arguments, reason in (
        (["--task", "urlab/Swim-v0"], "--task: 'urlab/Swim-v0' is not a task. Did you mean 'urlab/Arm-v0'"),
        (["--task", "urlab/Reach-v0"], "quadruped.onnx has 38 inputs, but the task has 22"),
        (["--task", "urlab/Reach-v0", "--seconds", "3"], "--seconds cannot be combined with --task"),
        (["--randomise", "nope.toml"], "--randomise: "),
        (["--confidence", "95"], "--confidence must be between 0 and 1"),
    ):
        assert main(["evaluate", str(NETWORK), "--episodes=1", *arguments]) == 2
        assert reason in capsys.readouterr().err
