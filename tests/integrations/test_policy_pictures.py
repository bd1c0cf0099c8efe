"""Policies that see: pictures in a declaration."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.cli import main
from urlab_client.enums import CameraMode
from urlab_client.integrations.gym import PushPictures, URLabEnv
from urlab_client.integrations.policy import (
    OnnxDictNetwork,
    Policy,
    PolicyFileError,
    PolicyMismatch,
    load,
    parse_spec,
    run_blocking,
)
from urlab_client.server import SimulatedServer

PUSH = Path(__file__).parents[2] / "examples" / "policies" / "push.onnx"

LOOKS = """
robot = "arm"
step_modes = ["direct"]
timestep = 0.002
decimation = 50

[[observation]]
term = "clock"
input = "numbers"
hz = 1.0

[[observation]]
term = "picture"
input = "eye"
camera = "overview"
size = [48, 32]

[[observation]]
term = "joint_position"
input = "numbers"

[[observation]]
term = "picture"
input = "depth"
camera = "wrist"
size = [48, 32]
mode = "depth"

[action]
via = "actuators"
joints = ["elbow"]
"""


def looks(*changes: tuple[str, str]) -> str:
    text = LOOKS
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def policy_of(text: str, network: Callable[[Any], Any]) -> Policy:
    return Policy(parse_spec(text, "it.toml"), network, source="it.toml")


@pytest.fixture(scope="module")
def arm(opengl: None) -> Iterator[URLabClient]:
    modes = {"arm/wrist": CameraMode.DEPTH}
    with (
        SimulatedServer("arm", play=True, camera_size=(48, 32), camera_modes=modes) as server,
        URLabClient(f"{server.address}:{server.step_port}", step_mode="direct") as client,
    ):
        client.discover()
        yield client


def test_a_network_sees_each_state_that_it_acts_on(arm: URLabClient) -> None:
    seen: list[dict[str, Any]] = []

    def network(inputs: dict[str, Any]) -> Any:
        seen.append({name: np.array(value) for name, value in inputs.items()})
        return np.array([0.5])

    shown: list[Any] = []
    overview = arm.articulations["arm"].cameras["overview"]
    run_blocking(
        arm, policy_of(LOOKS, network), seconds=0.3, on_action=lambda _: shown.append(overview.latest_frame[..., :3])
    )
    assert [{name: (value.shape, value.dtype) for name, value in each.items()} for each in seen] == [
        {
            "numbers": ((3,), np.dtype(np.float64)),
            "eye": ((32, 48, 3), np.dtype(np.uint8)),
            "depth": ((32, 48), np.dtype(np.float32)),
        }
    ] * 3
    assert seen[0]["numbers"].tolist() == [0.0, 1.0, 0.0], "sine, cosine, elbow"
    arm.reset()
    assert np.array_equal(seen[0]["eye"], arm.capture(["arm/overview"])["arm/overview"].pixels[..., :3]), "the start"
    assert np.array_equal(seen[1]["eye"], shown[0])
    assert np.array_equal(seen[2]["eye"], shown[1]), "the state that the action before led to"
    for one, other in itertools.pairwise(seen):
        assert not np.array_equal(one["eye"], other["eye"])
        assert not np.array_equal(one["depth"], other["depth"])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            'camera = "overview"',
            'camera = "nose"',
            r"observation\[1\].camera: 'arm' has no camera 'nose'; it has",
        ),
        ("size = [48, 32]", "size = [96, 72]", r"observation\[1\].size: 'overview' has 48x32 pixels, not 96x72"),
        ('mode = "depth"', 'mode = "real"', r"observation\[3\].mode: 'wrist' shows 'depth', not 'real'"),
    ],
)
def test_a_camera_that_does_not_fit_is_refused(old: str, new: str, said: str, arm: URLabClient) -> None:
    with pytest.raises(PolicyMismatch, match=said):
        run_blocking(arm, policy_of(looks((old, new)), lambda _: np.zeros(1)))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('input = "numbers"\n', "", "either every term of the observation has an `input`"),
        ('input = "numbers"', 'input = "eye"', "a picture needs its own input, but several terms use 'eye'"),
        ("decimation = 50", "decimation = 50\nhistory = 2", "history must be 1 with the term 'picture'"),
        ("size = [48, 32]", "size = [48, 0]", r"observation\[1\].size\[1\]: Expected `int` >= 1"),
        (
            'input = "eye"\n',
            "",
            r"observation\[1\]: .*missing required field `input`. Its keys are term, camera",
        ),
    ],
)
def test_a_declaration_that_cannot_work_is_refused(old: str, new: str, said: str) -> None:
    with pytest.raises(PolicyFileError, match=said):
        parse_spec(looks((old, new)), "it.toml")


@pytest.mark.usefixtures("opengl")
def test_the_published_declaration_says_what_the_task_shows_the_network(tmp_path: Path) -> None:
    """Described and in its task the network gets the same numbers and pictures, and does the same."""
    policy = load(PUSH)
    with SimulatedServer("arm", "block", "floor", play=True, camera_size=(96, 72)) as server:
        env = URLabEnv.connect(f"{server.address}:{server.step_port}", task=PushPictures())
        network = OnnxDictNetwork(PUSH, env.observation_space, 7)
        observation, _ = env.reset(seed=3)
        policy.goal = observation["task"]
        robot = env.client.articulations["arm"]
        for _ in range(3):
            action = network(observation)
            assert np.array_equal(policy.act(robot), action)
            observation, *_ = env.step({"arm": action.astype(np.float32)})
        declared = PUSH.with_suffix(".toml").read_text(encoding="utf-8")
        for old, new, said in (
            ("cameras/arm/overview", "eye", "its input 'cameras/arm/overview' is not an entry of the observation"),
            (
                'input = "task"',
                'input = "arm/qpos"',
                r"its input 'arm/qpos' must be tensor\(float\) of shape",
            ),
            (
                '[[observation]]\nterm = "goal"',
                _EXTRA,
                r"has no input 'more', which .* declares; it has: arm/qpos",
            ),
        ):
            assert old in declared
            (tmp_path / "other.toml").write_text(declared.replace(old, new), encoding="utf-8")
            with pytest.raises(PolicyFileError, match=said):
                load(PUSH, tmp_path / "other.toml").bind(robot)
        env.close()


_EXTRA = '[[observation]]\nterm = "clock"\nhz = 1.0\ninput = "more"\n\n[[observation]]\nterm = "goal"'


def test_a_simulated_server_gets_the_cameras_that_are_declared() -> None:
    spec = parse_spec(looks(('mode = "depth"', 'mode = "semantic"')), "it.toml")
    wanted = "sim://a/arm.xml?camera-size=48x32&camera-mode=arm%2Foverview%3Dreal&camera-mode=arm%2Fwrist%3Dsemantic"
    assert spec.simulated("a/arm.xml", "arm") == wanted


@pytest.mark.opengl
@pytest.mark.long
def test_the_command_runs_a_network_that_sees(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run-policy", str(PUSH), "--seconds", "0.2", "--compare", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {name: found["actions"] for name, found in said.items()} == {"zero": 5, "random": 5, "policy": 5}
