"""Exporting what learning libraries trained, with stand-ins for models; tools/check_learning.py has the libraries."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import ActionWrapper
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import (
    ClipAction,
    DiscretizeAction,
    NormalizeObservation,
    OrderEnforcing,
    RepeatAction,
    TimeLimit,
    TransformObservation,
    TransformReward,
    vector,
)

from urlab_client import URLabClient
from urlab_client.cli import main as urlab
from urlab_client.integrations.gym import Actions, Push, Reach, Start, States, Task, URLabBatchEnv, URLabEnv, Walk
from urlab_client.integrations.policy import OnnxNetwork, PolicyExportError, export_policy, load, run_blocking
from urlab_client.integrations.policy.spec import (
    AngularVelocity,
    CommandTerm,
    FieldTerm,
    GoalTerm,
    Gravity,
    JointPosition,
    JointVelocity,
    LastAction,
    LinearVelocity,
    PhaseClock,
    parse_spec,
)


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
    epsilon = 1e-8

    def __init__(self, venv: Any, size: int) -> None:
        rng = np.random.default_rng(9)
        self.venv, self.norm_obs, self.clip_obs = venv, True, 3.0
        self.obs_rms = SimpleNamespace(mean=rng.normal(size=size), var=rng.uniform(0.1, 2.0, size))

    def normalize_obs(self, x: Any) -> Any:
        return np.clip((x - self.obs_rms.mean) / np.sqrt(self.obs_rms.var + self.epsilon), -3.0, 3.0)


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


WALKING = [
    LinearVelocity(scale=2.0),
    AngularVelocity(scale=0.5),
    Gravity(scale=5.0),
    JointPosition(scale=3.0),
    JointVelocity(scale=0.1),
    LastAction(),
    PhaseClock(hz=Walk.STRIDES_PER_S),
    CommandTerm(scale=3.0),
]
"""What `Walk` observes."""

LEGS = Box(-1.0, 1.0, (12,))
ARM = Box(*np.array([[-2.9, -1.8, -2.9, -3.1, -2.9, -0.1, 0.0], [2.9, 1.8, 2.9, 0.0, 2.9, 3.7, 0.04]], np.float32))


class Follow(Walk):
    """Walking with other observations and actions: all of the robot's fields, and the command."""

    n_observed = 3
    articulations = None
    actions = Actions(scale=0.2)
    max_episode_steps = 20

    def observe(self, states: States) -> Any:
        return states.goal["command"]


def test_a_policy_of_a_task_runs_in_the_task_and_on_the_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = VecNormalize(None, 50)
    model = Model(50, LEGS, env=trained)
    path = tmp_path / "walk.onnx"
    spec = export_policy(model, "urlab/Walk-v0", path, terms=WALKING)
    assert parse_spec(path.with_suffix(".toml").read_text(), "walk.toml") == spec
    assert (spec.task, spec.robot, spec.decimation, spec.action.via) == ("urlab/Walk-v0", "quadruped", 10, "controller")
    assert spec.action.scale == [0.3, 0.6, 0.8] * 4
    assert spec.gains is not None
    assert (spec.gains.kp, spec.gains.kv) == (60.0, 2.0)
    assert spec.command is not None
    np.testing.assert_allclose([spec.command.low, spec.command.high], [Walk.LOW, Walk.HIGH], atol=0.02)

    env = URLabEnv.connect(Walk.scene_address, task=Walk())
    observation, total = env.reset(seed=0)[0], 0.0
    for _ in range(10):
        observation, reward, *_ = env.step(model.predict(trained.normalize_obs(observation[None]), True)[0][0])
        total += reward
    env.close()
    arguments = ["run-policy", str(path.with_suffix(".toml")), "--json", "--seconds=0.2"]
    assert urlab(arguments) in (0, 1)
    assert json.loads(capsys.readouterr().out)["return"] == pytest.approx(total, rel=1e-3)

    with URLabClient(Walk.scene_address, step_mode="direct") as client:
        client.discover()
        assert run_blocking(client, load(path), seconds=0.2).actions == 10
    assert urlab([*arguments, "--command", "0.2", "0", "0"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["policy"]["steps"] == 100


def test_without_terms_a_file_runs_in_its_task_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Actions that training rescaled become those of the task."""
    inner = URLabBatchEnv(Reach.scene_address, 1, task=Reach(), autoreset_mode=AutoresetMode.SAME_STEP)
    one: Any = np.float32(1.0)
    rescaled = vector.RescaleAction(inner, -one, one)
    model = Model(22, rescaled.single_action_space, env=rescaled)
    path = tmp_path / "reach.onnx"
    spec = export_policy(model, Reach, path)
    assert not spec.observation
    with pytest.raises(
        ValueError, match=r"reach.toml: it declares no observation, so .* only in the task 'urlab/Reach"
    ):
        load(path)
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


def test_earlier_observations_are_part_of_the_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The normalisation may be that of one observation, or of all that are stacked."""
    one, three = VecNormalize(None, 40), VecNormalize(VecFrameStack(None, 3), 120)
    for envs in (VecFrameStack(one, 3), three):
        path = tmp_path / "follow.onnx"
        spec = export_policy(Model(120, LEGS, env=envs), Follow, path, terms=[GoalTerm()])
        assert spec.history == 3
    assert [term.field for term in spec.observation if isinstance(term, FieldTerm)] == ["qpos", "qvel"]
    assert spec.action.scale == 0.2
    assert spec.task.endswith("test_policy_export:Follow")
    network, seen = OnnxNetwork(path), np.random.default_rng(0).normal(size=120)
    model = Model(120, LEGS)
    np.testing.assert_allclose(network(seen), model.predict(three.normalize_obs(seen[None]), True)[0][0], atol=1e-5)
    assert urlab(["run-policy", str(path), "--task", spec.task, "--json", "--seconds=0.2"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["actions"] == 10
    assert urlab(["evaluate", str(path), "--task", spec.task, "--episodes=2", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["outcomes"]) == 2


class Late(Task):
    """Starts in a keyframe whose time is not 0."""

    keyframe = "late"

    def reward(self, states: States, actions: Any) -> Any:
        return states.time


LATE = """
<mujoco>
  <worldbody><body name="rod"><joint name="hinge"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="late" time="5"/></keyframe>
</mujoco>
"""


def test_the_seconds_of_an_episode_count_from_its_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, path = tmp_path / "robot.xml", tmp_path / "late.onnx"
    robot.write_text(LATE)
    monkeypatch.setattr(Late, "scene_address", f"sim://{robot}", raising=False)
    export_policy(Model(2, Box(-1.0, 1.0, (1,))), Late, path)
    assert urlab(["run-policy", str(path), "--task", f"{__name__}:Late", "--json", "--seconds=0.2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["actions"], found["sim_time"]) == (10, pytest.approx(0.2))
    assert found["return"] > 50


def layer(kind: str, act: Callable[[Any], Any], **fields: Any) -> Any:
    """A stand-in for one of PyTorch's layers."""
    return type(kind, (), {"__call__": lambda _, x: act(x), **fields})()


def negative(curve: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda x: np.where(x < 0, curve(np.minimum(x, 0.0)), x)


def erf(x: Any) -> Any:
    return np.vectorize(math.erf)(x)


ROOT, SELU = math.sqrt(2 / math.pi), (1.0507009873554805, 1.6732632423543772)
ACTIVATIONS = [
    layer("CELU", negative(lambda x: 0.5 * np.expm1(x / 0.5)), alpha=0.5),
    layer("ELU", negative(lambda x: 0.3 * np.expm1(x)), alpha=0.3),
    layer("GELU", lambda x: x * (1 + erf(x / math.sqrt(2))) / 2, approximate="none"),
    layer("GELU", lambda x: x * (1 + np.tanh(ROOT * (x + 0.044715 * x**3))) / 2, approximate="tanh"),
    layer("LeakyReLU", negative(lambda x: 0.2 * x), negative_slope=0.2),
    layer("Mish", lambda x: x * np.tanh(np.log1p(np.exp(x)))),
    layer("ReLU", lambda x: np.maximum(x, 0.0)),
    layer("SELU", lambda x: SELU[0] * negative(lambda x: SELU[1] * np.expm1(x))(x)),
    layer("SiLU", lambda x: x / (1 + np.exp(-x))),
    layer("Sigmoid", lambda x: 1 / (1 + np.exp(-x))),
    layer("Softplus", lambda x: np.log1p(np.exp(x))),
    layer("Dropout", lambda x: x),
]


def normalised(x: Any) -> Any:
    spread = np.sqrt(x.var(axis=-1, keepdims=True) + 0.01)
    return np.asarray((x - x.mean(axis=-1, keepdims=True)) / spread * SCALE + SHIFT)


SCALE, SHIFT = np.linspace(0.5, 2.0, 16).view(Tensor), np.linspace(-1.0, 1.0, 16).view(Tensor)


def test_every_layer_that_can_be_exported_does_the_same(tmp_path: Path) -> None:
    """The exporter compares what the file gives with what the model gives."""
    space = Box(np.full(7, -0.5, np.float32), np.linspace(0.5, 2.0, 7, dtype=np.float32))
    middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
    sac = Model(22, space)  # it squashes with tanh what its last layer gives; TD3's network ends with one
    for seed, activation in enumerate(ACTIVATIONS):
        sac.net += [Linear(16, 16, 20 + seed), activation]
    without_bias = type("Linear", (Linear,), {"__call__": lambda self, x: np.asarray(x @ self.weight.T)})(16, 16, 50)
    without_bias.bias = None
    sac.net += [layer("LayerNorm", normalised, weight=SCALE, bias=SHIFT, eps=0.01), without_bias]
    flat, td3 = FlattenExtractor(), Model(22, space)
    ends = Sequential([*td3.net, td3.head, Tanh()])
    for model, actor in (
        (sac, SimpleNamespace(features_extractor=flat, latent_pi=sac.net, mu=sac.head)),
        (td3, SimpleNamespace(features_extractor=flat, mu=ends)),
    ):
        model.policy = SimpleNamespace(actor=actor, squash_output=True)
        squashed = partial(
            lambda model, x, deterministic: (middle + half * np.tanh(model.head(model.net(x))), None), model
        )
        model.predict = squashed  # type: ignore[method-assign]
        export_policy(model, Reach, tmp_path / "reach.onnx", tolerance=1e-5)
        (tmp_path / "reach.onnx").unlink()


def test_a_file_that_differs_is_not_written(tmp_path: Path) -> None:
    model = Model(50, LEGS)
    told = model.predict

    def biased(inputs: Any, deterministic: bool = False) -> Any:
        return told(inputs, deterministic)[0] * 0.9, None

    model.predict = biased  # type: ignore[method-assign]
    with pytest.raises(PolicyExportError, match=r"The network gives .* number \d+ of the action, not"):
        export_policy(model, Walk, tmp_path / "walk.onnx")
    # The sensor is read at the start of the last physics step, the task's own position after it.
    terms = [GoalTerm(), GoalTerm(relative_to="grip_position")]
    reach = Model(22, ARM)
    with pytest.raises(
        PolicyExportError, match=r"reach\.toml gives .* of the observation, not .* tolerance of 0\.0001"
    ):
        export_policy(reach, Reach, tmp_path / "reach.onnx", terms=terms)
    assert not [*tmp_path.iterdir()]
    assert len(export_policy(reach, Reach, tmp_path / "reach.onnx", terms=terms, tolerance=0.05).observation) == 4


class DummyVecEnv:
    """Stable-Baselines3's environments in one process."""

    def __init__(self, *envs: Any) -> None:
        self.envs = envs


class SubprocVecEnv:
    """Stable-Baselines3's environments in other processes."""


class Louder(ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 2.0 * action


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda model: model.net.append(Conv2d()), "The layer Conv2d cannot be exported"),
        (lambda model: delattr(model.policy, "action_net"), "Model has no actor with continuous actions"),
        (lambda model: setattr(model, "_env", VecFrameStack(None, 2)), "maps 50 numbers .* observations of 100"),
        (lambda model: setattr(model, "action_space", Box(-np.inf, np.inf, (12,))), "differ .* and are not finite"),
        (lambda model: setattr(model, "_env", SubprocVecEnv()), "SubprocVecEnv may change observations or actions"),
    ],
)
def test_what_cannot_be_exported_is_said(change: Callable[[Any], Any], said: str, tmp_path: Path) -> None:
    model = Model(50, LEGS)
    change(model)
    with pytest.raises(PolicyExportError, match=said):
        export_policy(model, Walk, tmp_path / "walk.onnx")


def test_wrappers_are_exported_or_refused_by_name(tmp_path: Path) -> None:
    """Around a batch, or around each environment that Stable-Baselines3 steps."""
    path = tmp_path / "reach.onnx"
    batch = URLabBatchEnv(Reach.scene_address, 1, task=Reach(), autoreset_mode=AutoresetMode.SAME_STEP)
    single = URLabEnv.connect(Reach.scene_address, task=Reach())

    def refused(envs: Any, said: str) -> None:
        with pytest.raises(PolicyExportError, match=said):
            export_policy(Model(22, ARM, env=envs), Reach, path)
        assert not path.exists()

    refused(vector.TransformAction(batch, np.negative), "^TransformAction may change")
    seen_space: Any = single.observation_space
    refused(DummyVecEnv(TransformObservation(single, np.negative, seen_space)), "^TransformObservation may change")
    refused(DummyVecEnv(OrderEnforcing(Louder(single))), "^Louder may change observations or actions .* not exported")
    refused(DummyVecEnv(RepeatAction(single, 2)), "^RepeatAction may change")
    refused(DummyVecEnv(DiscretizeAction(single, 3)), "^DiscretizeAction may change")
    normalised = NormalizeObservation(TimeLimit(single, 10))
    refused(DummyVecEnv(normalised, normalised), "^The 2 environments in DummyVecEnv normalise .* in its own way")

    one: Any = np.float32(1.0)
    rescaled: Any = vector.RescaleAction(batch, -one, one)
    seen = 3.0 * np.random.default_rng(1).normal(size=22)
    wrapped: list[tuple[Any, Any, Callable[[Any], Any]]] = [
        (vector.ClipAction(vector.RecordEpisodeStatistics(rescaled)), rescaled.single_action_space, rescaled.actions),
        (DummyVecEnv(ClipAction(TransformReward(single, float))), single.action_space, np.copy),
    ]
    for envs, limits, inner in wrapped:
        model = Model(22, Box(-np.inf, np.inf, (7,)), env=envs)
        export_policy(model, Reach, path)
        chosen = model.predict(seen[None], deterministic=True)[0]
        clipped = np.clip(chosen, limits.low, limits.high)
        assert not np.array_equal(clipped, chosen)
        np.testing.assert_allclose(OnnxNetwork(path)(seen), inner(clipped)[0], atol=1e-4)
    normalised.update_running_mean = True
    normalised.reset(seed=1)
    for _ in range(5):
        normalised.step(np.zeros(7, np.float32))
    model = Model(22, single.action_space, env=DummyVecEnv(normalised))
    export_policy(model, Reach, path)
    normalised.update_running_mean = False
    expected = model.predict(normalised.observation(seen)[None], deterministic=True)[0][0]
    np.testing.assert_allclose(OnnxNetwork(path)(seen), expected, atol=1e-4)
    single.close()
    batch.close()


class Further(Follow):
    """A goal of four numbers."""

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        super().reset(rng, start)
        start.goal["height"] = np.zeros(1)


@pytest.mark.parametrize(
    ("task", "model", "said"),
    [
        (Push, Model(31, ARM), "Terms describe arm, but arm, block, floor are observed"),
        (Further, Model(40, LEGS), "The goal of .*:Further has 4 numbers: not a command"),
    ],
)
def test_terms_that_do_not_fit_the_task_are_refused(task: type[Task], model: Model, said: str, tmp_path: Path) -> None:
    with pytest.raises(PolicyExportError, match=said):
        export_policy(model, task, tmp_path / "policy.onnx", terms=[CommandTerm()])
