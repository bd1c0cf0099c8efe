"""Exporting what learning libraries trained, with stand-ins for models; tools/check_learning.py has the libraries."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RescaleAction

from urlab_client import URLabClient
from urlab_client.cli import main as urlab
from urlab_client.integrations.gym import Actions, Reach, States, Task, URLabBatchEnv, URLabEnv, Walk
from urlab_client.integrations.policy import PolicyExportError, export_policy, load, run_blocking
from urlab_client.integrations.policy.spec import CommandTerm, GoalTerm, parse_spec


class Tensor(np.ndarray[Any, Any]):
    """The methods of PyTorch's tensors in use."""

    def detach(self) -> Tensor:
        return self

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray[Any, Any]:
        return np.asarray(self)


class Linear:
    def __init__(self, inputs: int, outputs: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.out_features = outputs
        self.weight = (rng.normal(size=(outputs, inputs)) / np.sqrt(inputs)).view(Tensor)
        self.bias = rng.normal(size=outputs).view(Tensor)

    def __call__(self, x: Any) -> Any:
        return np.asarray(x @ self.weight.T + self.bias)


class Tanh:
    def __call__(self, x: Any) -> Any:
        return np.tanh(x)


class Sequential(list[Any]):
    def __call__(self, x: Any) -> Any:
        for each in self:
            x = each(x)
        return x


class FlattenExtractor(Tanh):
    pass


class Conv2d(Tanh):
    pass


class VecNormalize:
    norm_obs = True
    clip_obs = 3.0
    epsilon = 1e-8

    def __init__(self, venv: Any, size: int) -> None:
        rng = np.random.default_rng(9)
        self.venv = venv
        self.obs_rms = SimpleNamespace(mean=rng.normal(size=size), var=rng.uniform(0.1, 2.0, size))

    def normalize_obs(self, x: Any) -> Any:
        found = (x.reshape(len(x), -1, len(self.obs_rms.mean)) - self.obs_rms.mean) / np.sqrt(self.obs_rms.var + 1e-8)
        return np.clip(found, -3.0, 3.0).reshape(x.shape)


class VecFrameStack:
    def __init__(self, venv: Any, n_stack: int) -> None:
        self.venv, self.stacked_obs = venv, SimpleNamespace(n_stack=n_stack)


class Model:
    """A PPO of Stable-Baselines3, as far as it is looked at; its networks have tanh layers of 16."""

    def __init__(self, inputs: int, space: Any, env: Any = None, seed: int = 0) -> None:
        self.action_space, self._env, n = space, env, space.shape[0]
        tanh = Tanh()
        self.net = Sequential([Linear(inputs, 16, seed), tanh, Linear(16, 16, seed + 1), tanh])  # one object, twice
        self.head = Linear(16, n, seed + 2)
        self.policy = SimpleNamespace(
            pi_features_extractor=FlattenExtractor(),
            mlp_extractor=SimpleNamespace(policy_net=self.net),
            action_net=self.head,
            squash_output=False,
        )

    def get_env(self) -> Any:
        return self._env

    def predict(self, inputs: Any, deterministic: bool = False) -> tuple[Any, None]:
        assert deterministic
        return np.clip(self.head(self.net(inputs)), self.action_space.low, self.action_space.high), None


@pytest.fixture(scope="module")
def walk() -> Any:
    env = URLabBatchEnv(Walk.scene_address, 1, task=Walk())
    yield env
    env.close()


def test_a_policy_of_a_task_runs_in_the_task_and_on_the_robot(
    tmp_path: Path, walk: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    size, space = walk.single_observation_space.shape[0], walk.single_action_space
    trained = VecNormalize(None, size)
    model = Model(size, space, env=trained)
    path = tmp_path / "walk.onnx"
    spec = export_policy(model, "urlab/Walk-v0", path, terms=[CommandTerm()])
    assert parse_spec(path.with_suffix(".toml").read_text(), "walk.toml") == spec
    assert (spec.task, spec.robot, spec.decimation, spec.action.via) == ("urlab/Walk-v0", "quadruped", 10, "controller")
    assert spec.action.scale == [0.3, 0.6, 0.8] * 4
    assert spec.gains is not None
    assert (spec.gains.kp, spec.gains.kv) == (60.0, 2.0)
    assert spec.command is not None
    np.testing.assert_allclose([spec.command.low, spec.command.high], [Walk.LOW, Walk.HIGH], atol=0.02)

    env = URLabEnv.connect(Walk.scene_address, task=Walk())
    observation, total = env.reset(seed=0)[0], 0.0
    for _ in range(50):
        observation, reward, *_ = env.step(model.predict(trained.normalize_obs(observation[None]), True)[0][0])
        total += reward
    env.close()
    arguments = ["run-policy", str(path.with_suffix(".toml")), "--json", "--seconds=1"]
    assert urlab(arguments) in (0, 1)
    assert json.loads(capsys.readouterr().out)["return"] == pytest.approx(total, rel=1e-3)

    with URLabClient(Walk.scene_address, step_mode="direct") as client:
        client.discover()
        assert run_blocking(client, load(path), seconds=0.2).actions == 10
    assert urlab([*arguments, "--command", "0.2", "0", "0"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["policy"]["steps"] == 500
    assert urlab(["evaluate", str(path), "--episodes=2", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["outcomes"]) == 2


def test_earlier_observations_are_part_of_the_input(
    tmp_path: Path, walk: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    size, space = walk.single_observation_space.shape[0], walk.single_action_space
    model = Model(3 * size, space, env=VecFrameStack(VecNormalize(None, size), 3))
    spec = export_policy(model, walk, tmp_path / "walk.onnx")
    assert spec.history == 3
    assert isinstance(spec.observation[-1], GoalTerm)  # what the task observes is its goal
    assert urlab(["run-policy", str(tmp_path / "walk.onnx"), "--json", "--seconds=0.2"]) == 0
    assert json.loads(capsys.readouterr().out)["actions"] == 10
    assert urlab(["evaluate", str(tmp_path / "walk.onnx"), "--episodes=1", "--json"]) == 0


def test_rescaled_actions_become_those_of_the_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The observations are not the robot's alone, so the file runs only in its task, and says so."""
    inner = URLabBatchEnv(Reach.scene_address, 1, task=Reach(), autoreset_mode=AutoresetMode.SAME_STEP)
    rescaled = RescaleAction(inner, np.float32(-1.0), np.float32(1.0))
    model = Model(22, rescaled.single_action_space, env=rescaled)
    path = tmp_path / "reach.onnx"
    spec = export_policy(model, Reach, path)
    assert not spec.observation
    with pytest.raises(
        ValueError, match=r"reach.toml: it declares no observation, so .* only in the task 'urlab/Reach"
    ):
        load(path)
    inner.reset(seed=0)
    env = URLabEnv.connect(Reach.scene_address, task=Reach())
    observation, total = env.reset(seed=0)[0], 0.0
    for _ in range(10):
        rescaled_action = model.predict(observation[None], deterministic=True)[0]
        observation, reward, *_ = env.step(rescaled.actions(rescaled_action)[0])
        total += reward
    env.close()
    inner.close()
    assert urlab(["run-policy", str(path), "--json", "--seconds=0.2"]) == 0
    assert json.loads(capsys.readouterr().out)["return"] == pytest.approx(total, rel=1e-4)


def test_a_file_that_differs_is_not_written(tmp_path: Path, walk: Any) -> None:
    size, space = walk.single_observation_space.shape[0], walk.single_action_space
    model = Model(size, space)
    told = model.predict

    def biased(inputs: Any, deterministic: bool = False) -> Any:
        return told(inputs, deterministic)[0] * 0.9, None

    model.predict = biased  # type: ignore[method-assign]
    with pytest.raises(
        PolicyExportError, match=r"an observation of an episode, gives .* number \d+ of the action, not"
    ):
        export_policy(model, Walk, tmp_path / "walk.onnx")
    # The sensor is read at the start of the last physics step, the task's own position after it.
    terms = [GoalTerm(), GoalTerm(relative_to="grip_position")]
    arm = URLabBatchEnv(Reach.scene_address, 1, task=Reach())
    reach = Model(22, arm.single_action_space)
    arm.close()
    with pytest.raises(
        PolicyExportError, match=r"reach\.toml gives .* of the observation, not .* tolerance of 0\.0001"
    ):
        export_policy(reach, Reach, tmp_path / "reach.onnx", terms=terms)
    assert not [*tmp_path.iterdir()]
    assert len(export_policy(reach, Reach, tmp_path / "reach.onnx", terms=terms, tolerance=0.05).observation) == 4


class Tuned(Walk):
    """Walking with other actions."""

    actions = Actions(scale=0.2)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda model: model.net.append(Conv2d()), "The layer Conv2d cannot be exported"),
        (lambda model: setattr(model.policy, "lstm_actor", object()), "no actor with continuous actions and without"),
        (lambda model: setattr(model, "net", None) or delattr(model.policy, "action_net"), "no actor with continuous"),
        (lambda model: setattr(model, "_env", VecFrameStack(None, 2)), "maps 40 numbers .* observations of 80"),
        (lambda model: setattr(model, "_env", VecTransposeImage()), "wrapper VecTransposeImage changes observations"),
    ],
)
def test_what_cannot_be_exported_is_said(change: Callable[[Any], Any], said: str, tmp_path: Path, walk: Any) -> None:
    model = Model(40, walk.single_action_space)
    change(model)
    with pytest.raises(PolicyExportError, match=said):
        export_policy(model, Walk, tmp_path / "walk.onnx")


class VecTransposeImage:
    """A wrapper for pictures."""


def test_an_environment_that_overrides_its_task_is_refused(tmp_path: Path, serving: Callable[..., str]) -> None:
    env = URLabBatchEnv(Walk.scene_address, 1, task=Walk(), n_substeps=5)
    with pytest.raises(PolicyExportError, match="overrides attributes of urlab/Walk-v0"):
        export_policy(Model(40, env.single_action_space), env, tmp_path / "walk.onnx")
    env.close()
    tuned = URLabBatchEnv(Walk.scene_address, 1, task=Tuned())
    spec = export_policy(Model(40, tuned.single_action_space), tuned, tmp_path / "walk.onnx")
    tuned.close()
    assert spec.action.scale == 0.2
    assert spec.task.endswith("test_policy_export:Tuned")
    without = URLabBatchEnv(serving("arm"), 1)
    with pytest.raises(PolicyExportError, match="has no task"):
        export_policy(Model(40, without.single_action_space), without, tmp_path / "x.onnx")
    without.close()


def test_a_task_is_left_as_it_was(tmp_path: Path, walk: Any) -> None:
    """The object may serve an environment, and its curriculum does not advance."""

    class Counting(Walk):
        ends = 0

        def ended(self, episode: Any) -> None:
            self.ends += 1

    task: Task = Counting()
    env = URLabBatchEnv(Walk.scene_address, 1, task=task)
    env.reset(seed=0)
    before = {**vars(task)}
    export_policy(Model(40, walk.single_action_space), task, tmp_path / "walk.onnx")
    assert vars(task) == before
    assert isinstance(env._states(np.arange(1)), States)
    env.close()
