"""The network that ships, through the command line and a real server; and the script that trains it."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.cli import main as urlab
from urlab_client.integrations.policy import OnnxNetwork, PolicyFileError, load, run_blocking
from urlab_client.server import ControllerConfig

ROOT = Path(__file__).parents[2]
NETWORK = ROOT / "examples/policies/quadruped.onnx"
SECONDS = 4.0
PD = {"quadruped": ControllerConfig()}


def run_policy(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """Return what `urlab run-policy --json` says."""
    code = urlab(["run-policy", str(NETWORK), "--robot", "quadruped", "--json", f"--seconds={SECONDS}", *arguments])
    said = capsys.readouterr()
    assert (code, said.err) == (0, "")
    return json.loads(said.out)


@pytest.mark.long
def test_the_trained_network_walks_where_zero_and_random_outputs_do_not(capsys: pytest.CaptureFixture[str]) -> None:
    found = run_policy(capsys, "--command", "0.5", "0", "0", "--compare")
    zero, random, policy = found["zero"], found["random"], found["policy"]
    assert policy["falls"] == 0
    assert policy["forward"] > 0.8 * 0.5 * SECONDS
    assert policy["reward"] > zero["reward"] + 0.5
    assert policy["reward"] > random["reward"] + 1.0
    assert policy["velocity_error"] < 0.12
    assert max(abs(zero["forward"]), abs(random["forward"])) < 1.0

    again = run_policy(capsys, "--command", "0.5", "0", "0")["policy"]
    assert {**again, "wall_time": 0} == {**policy, "wall_time": 0}


@pytest.mark.parametrize(("yaw_rate", "vx"), [(0.4, 0.3), (-0.4, 0.3), (0.0, 0.0)])
def test_the_trained_network_does_what_it_is_told(yaw_rate: float, vx: float, serving: Callable[..., str]) -> None:
    policy = load(NETWORK)
    policy.command = [vx, 0.0, yaw_rate]
    headings: list[float] = []
    with URLabClient(serving("quadruped", controllers=PD), step_mode="direct") as client:
        client.discover()
        robot = client.articulations["quadruped"]

        def note(_: object) -> None:
            w, x, y, z = robot.root_quat_w
            headings.append(float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))

        found = run_blocking(client, policy, seconds=SECONDS, on_action=note)
    assert found.falls == 0
    turned = np.unwrap(headings)[-1]
    assert turned == pytest.approx(yaw_rate * SECONDS, abs=0.25 * 0.4 * SECONDS)
    assert found.velocity_error < 0.12


@pytest.mark.long
def test_the_figures_beside_the_network_are_true(capsys: pytest.CaptureFixture[str]) -> None:
    figures = json.loads(NETWORK.with_suffix(".json").read_text())
    evaluation = figures["evaluation"]
    told = [0.4, 0.0, 0.0]
    shown = {name: next(row for row in evaluation[name] if row["command"] == told) for name in evaluation}
    found = run_policy(capsys, "--command", *map(str, told), "--compare")
    assert NETWORK.stat().st_size < 200_000
    assert shown["trained"]["falls"] == 0
    for ours, theirs in (("policy", "trained"), ("zero", "zero"), ("random", "random")):
        # Episodes of the evaluation start from noisy poses, and last as long as its options say.
        assert found[ours]["reward"] == pytest.approx(shown[theirs]["reward"], abs=0.15)
    curve = [row["reward"] for row in figures["curve"]]
    assert curve[-1] > curve[0] + 0.3


def test_another_robot_or_another_size_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, serving: Callable[..., str]
) -> None:
    assert urlab(["run-policy", str(NETWORK), serving("quadruped")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("urlab run-policy: ")
    assert "requires a PD controller. Serve it with --controller quadruped=pd" in said
    live = ["--step-mode", "live", "--command", "9", "0", "0"]
    assert urlab(["run-policy", str(NETWORK), serving("quadruped", controllers=PD, step_mode="auto"), *live]) == 2
    assert "--command: a command must be vx, vy, yaw rate from" in capsys.readouterr().err

    declaration = tmp_path / "smaller.toml"
    text = NETWORK.with_suffix(".toml").read_text()
    declaration.write_text(text.replace('[[observation]]\nterm = "gravity"\n', ""))
    assert urlab(["run-policy", str(NETWORK), "--declaration", str(declaration)]) == 2
    assert f"quadruped.onnx has 38 inputs, but {declaration} declares 35" in capsys.readouterr().err

    declaration.write_text(
        'robot = "quadruped"\nstep_modes = ["direct"]\ntimestep = 0.002\ndecimation = 10\nhistory = 19\n'
        '[[observation]]\nterm = "clock"\nhz = 2.0\n'
        '[action]\nvia = "actuators"\njoints = ["FL_thigh", "FR_thigh"]\n'
    )
    assert urlab(["run-policy", str(NETWORK), serving("quadruped"), "--declaration", str(declaration)]) == 2
    said = capsys.readouterr().err
    assert f"quadruped.onnx has 12 outputs, but {declaration} declares 2 (action.joints)" in said


def test_a_run_is_recorded_and_told_as_a_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from urlab_client.integrations.record import read_run

    arguments = ["run-policy", str(NETWORK), "--seconds", "1", "--record", str(tmp_path / "walk.mcap")]
    assert urlab(arguments) == 0
    said = capsys.readouterr().out
    assert "quadruped, direct mode, 1.0 s of simulation" in said
    assert "steps/s" in said
    table = read_run(tmp_path / "walk.mcap").table()
    assert table.columns["quadruped/qpos"].values[-1][0] > 0.1
    assert urlab(arguments) == 2
    assert "--overwrite replaces it" in capsys.readouterr().err


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("train_policy", ROOT / "tools/train_policy.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["train_policy"] = module  # its dataclass looks itself up
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
def test_eight_rounds_of_training_already_move_the_robot(script: ModuleType, tmp_path: Path) -> None:
    options = ["--iterations=8", "--pairs=12", "--commands=1", "--rate=0.05", "--seed=1", "--threads=1"]
    assert script.main([*options, "--seconds=1.2", "--evaluate=1.2", "-o", str(tmp_path)]) == 0
    path = tmp_path / "quadruped.onnx"
    figures = json.loads(path.with_suffix(".json").read_text())
    network = OnnxNetwork(path)
    assert (network.inputs, network.outputs) == (38, 12)
    rewards = [row["reward"] for row in figures["curve"]]
    assert rewards[-1] > rewards[0] + 0.1
    forward = {name: rows[0]["forward_m"] for name, rows in figures["evaluation"].items()}
    assert forward["trained"] > 0.2 > abs(forward["zero"])


@pytest.fixture(scope="module")
def arena(script: ModuleType) -> Any:
    """Twenty-four copies of the robot."""
    return script.Arena(script.read_spec(script.DECLARATION), 24, 1)


def test_training_repeats_itself(script: ModuleType, arena: Any) -> None:
    options = script.parse(["--iterations=2", "--pairs=12", "--commands=1", "--seconds=0.2", "--evaluate=0.1"])
    network = script.LegNetwork(arena.mapping)
    (one, _), (two, _) = (script.train(arena, network, options) for _ in range(2))
    assert np.array_equal(one, two)
    assert not np.array_equal(one, network.initial(np.random.default_rng(options.seed)))


def test_the_unrolled_network_is_the_one_that_was_trained(script: ModuleType, arena: Any, tmp_path: Path) -> None:
    legs = script.LegNetwork(arena.mapping)
    rng = np.random.default_rng(0)
    parameters = rng.normal(size=legs.size)
    path = tmp_path / "it.onnx"
    path.write_bytes(script.to_onnx(legs.unrolled(parameters)))
    seen = rng.normal(size=(2, 38))
    expected = legs.act(np.stack([parameters, parameters]))(seen)
    network = OnnxNetwork(path)
    np.testing.assert_allclose([network(row) for row in seen], expected, rtol=1e-4, atol=1e-5)
    # A robot seen in a mirror moves as the mirror shows it, its left legs as the right ones.
    mirrored, legs_swapped = mirror(seen[0]), np.array([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
    flipped = np.tile([-1.0, 1.0, 1.0], 4)
    np.testing.assert_allclose(network(mirrored), network(seen[0])[legs_swapped] * flipped, rtol=1e-4, atol=1e-5)


def mirror(observation: Any) -> Any:
    """Return what a robot mirrored left to right sees, half a stride later."""
    swapped = np.array([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
    flipped = np.tile([-1.0, 1.0, 1.0], 4)
    signs = [1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, -1, -1, -1]
    return np.concatenate(
        [observation[:14] * signs, observation[14:26][swapped] * flipped, observation[26:][swapped] * flipped]
    )


def test_a_network_with_two_inputs_is_refused(tmp_path: Path) -> None:
    import onnx

    number, path = onnx.TensorProto.FLOAT, tmp_path / "two.onnx"
    ends = [onnx.helper.make_tensor_value_info(name, number, ["n", 3]) for name in ("a", "b", "c")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Add", ["a", "b"], ["c"])], "it", ends[:2], ends[2:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    path.with_suffix(".toml").write_text(NETWORK.with_suffix(".toml").read_text())
    with pytest.raises(PolicyFileError, match=r"two.onnx: it needs one input, float32 .*; it has: a tensor"):
        load(path)
