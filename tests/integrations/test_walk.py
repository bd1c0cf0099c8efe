"""The network of `examples/train_walk.py` that ships: over the wire it beats zero output and the trot of the demo."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.cli.demo import Trot
from urlab_client.integrations.gym import URLabEnv, Walk
from urlab_client.integrations.policy import OnnxNetwork, RobotState, load, run_blocking
from urlab_client.randomise.declaration import MODEST
from urlab_client.server import ControllerConfig, SimulatedServer

ROOT = Path(__file__).parents[2]
NETWORK = ROOT / "examples/policies/walk.onnx"
PD = ControllerConfig(kp=60.0, kv=2.0)
DIALECTS = ["alpha", "beta"]


@pytest.fixture(scope="module")
def figures() -> ModuleType:
    """The script that evaluates networks for the documentation."""
    spec = importlib.util.spec_from_file_location("walk_figures", ROOT / "tools/walk_figures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["walk_figures"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(params=DIALECTS)
def serving(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Start randomised servers of a dialect whose quadruped has these gains, and return their addresses."""
    with ExitStack() as servers:

        def served(gains: ControllerConfig, n: int = 2) -> list[str]:
            options: dict[str, Any] = {"dialect": request.param, "play": True, "randomise": MODEST}
            options |= {"step_mode": "direct", "mjcf_options": True, "controllers": {"quadruped": gains}}
            made = [servers.enter_context(SimulatedServer("quadruped", **options)) for _ in range(n)]
            return [f"{server.address}:{server.step_port}" for server in made]

        yield served


@pytest.mark.parametrize("serving", ["alpha", pytest.param("beta", marks=pytest.mark.long)], indirect=True)
def test_it_follows_commands_better_than_zero_output_and_the_trot(serving: Any, figures: ModuleType) -> None:
    given: dict[str, Any] = {"episodes": 2, "max_episode_steps": 150}
    own = serving(PD)
    walked = figures.evaluate(OnnxNetwork(NETWORK), own, **given)
    stood = figures.evaluate(figures.still, own, **given)
    trotted = figures.evaluate(figures.trot, serving(ControllerConfig(kp=Trot.KP, kv=Trot.KD)), **given)
    assert walked["falls"] == 0
    assert walked["return"] > 1.2 * max(stood["return"], trotted["return"])
    assert walked["error"] < 0.7 * min(stood["error"], trotted["error"])


@pytest.mark.parametrize("command", [(0.5, 0.0, 0.0), (0.3, 0.0, 0.4), (-0.2, 0.0, 0.0)])
def test_it_does_what_it_is_told(command: tuple[float, float, float], serving: Any) -> None:
    policy, seconds = load(NETWORK), 3.0
    policy.command = command
    headings: list[float] = []
    with URLabClient(serving(PD, 1)[0], step_mode="direct") as client:
        client.discover()
        robot = client.articulations["quadruped"]

        def note(_: object) -> None:
            w, _, _, z = robot.root_quat_w
            headings.append(2.0 * float(np.arctan2(z, w)))

        found = run_blocking(client, policy, seconds=seconds, on_action=note)
    assert found.falls == 0
    assert found.velocity_error < 0.12
    assert np.unwrap(headings)[-1] == pytest.approx(command[2] * seconds, abs=0.25)


def test_its_declaration_shows_it_what_the_task_observes() -> None:
    network = load(NETWORK)
    env = URLabEnv.connect(Walk.scene_address, task=Walk())
    robot, rng = env.articulations["quadruped"], np.random.default_rng(0)
    mapping = network.bind(robot)
    observation, info = env.reset(seed=3)
    command = observation[-3:] / 3.0
    action = np.zeros(12)
    for _ in range(5):
        seen = mapping.observe(RobotState.of(robot), command, action, info["sim_time"])
        np.testing.assert_allclose(seen, observation, atol=1e-6)
        action = rng.uniform(-1.0, 1.0, 12)
        targets = mapping.targets(mapping.clipped(action))
        np.testing.assert_allclose(env.mapping.set_points(action)["quadruped"][mapping.ctrl], targets)
        observation, *_, info = env.step(action)
    env.close()
    assert NETWORK.stat().st_size < 300_000


def test_a_robot_in_the_mirror_walks_like_the_robot_half_a_stride_later() -> None:
    network, rng = OnnxNetwork(NETWORK), np.random.default_rng(0)
    seen = rng.normal(size=50)
    swapped, flipped = np.r_[3:6, 0:3, 9:12, 6:9], np.tile([-1.0, 1.0, 1.0], 4)
    base = seen[:9] * [1, -1, 1, -1, 1, -1, 1, -1, 1]
    joints = [seen[first : first + 12][swapped] * flipped for first in (9, 21, 33)]
    mirrored = np.concatenate([base, *joints, seen[45:] * [-1, -1, 1, -1, -1]])
    np.testing.assert_allclose(network(mirrored), network(seen)[swapped] * flipped, atol=1e-5)
