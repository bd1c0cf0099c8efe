"""Exports what learning libraries trained for a task: a network in an ONNX file, and its declaration beside it.

The layers are written one by one. So neither PyTorch's exporter nor its dependencies are needed, and a network holds
nothing that is not named here. Needs the extras `onnx` and `train`.
"""

from __future__ import annotations

import copy
import importlib
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np

from urlab_client._installation import need
from urlab_client.enums import ActuatorType, ControlMode, StepMode
from urlab_client.errors import URLabError
from urlab_client.integrations.policy.mapping import PolicyMapping, RobotState
from urlab_client.integrations.policy.network import OnnxNetwork
from urlab_client.integrations.policy.policy import Policy
from urlab_client.integrations.policy.runner import require
from urlab_client.integrations.policy.spec import (
    Action,
    Command,
    CommandTerm,
    FieldTerm,
    Gains,
    Goal,
    GoalTerm,
    Numbers,
    NumberTerm,
    PolicySpec,
    Term,
)
from urlab_client.protocol.base import Floats
from urlab_client.sync._facade import aio_of
from urlab_client.sync.articulation import URLabArticulation

if TYPE_CHECKING:
    from urlab_client.integrations.gym import Start, Task, URLabBatchEnv, URLabEnv, URLabVectorEnv

EPISODES: Final = 4
STEPS: Final = 25
DRAWN: Final = 256
"""Number of starts that are drawn for the limits of the goal, and of random observations."""

Layer: TypeAlias = tuple[str, Sequence[Any], Mapping[str, Any]]
"""An ONNX operator, the constants that it takes after the value, and its attributes."""

AnyGoal = TypeVar("AnyGoal", bound=Goal)

_Act = Callable[[Floats], Floats]

_ACTIVATIONS: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "ELU": ("Elu", {"alpha": "alpha"}),
    "GELU": ("Gelu", {"approximate": "approximate"}),
    "LeakyReLU": ("LeakyRelu", {"alpha": "negative_slope"}),
    "Mish": ("Mish", {}),
    "ReLU": ("Relu", {}),
    "SELU": ("Selu", {}),
    "SiLU": ("Swish", {}),
    "Sigmoid": ("Sigmoid", {}),
    "Softplus": ("Softplus", {}),
    "Softsign": ("Softsign", {}),
    "Tanh": ("Tanh", {}),
}
"""Operators of PyTorch's activations, and PyTorch's names of their attributes."""

_NOTHING: Final = ("Dropout", "Flatten", "FlattenExtractor", "Identity", "Unflatten", "_IdentityDeterministicOutput")
"""Modules that do not change a flat observation."""


class PolicyExportError(URLabError, ValueError):
    """A model cannot be exported, or its files give other numbers. The message says which, where and by how much."""


class _Trained(NamedTuple):
    """A model.

    Attributes:
        layers: The layers of its network, from observations of the task to actions of the task.
        act: The model's own actions, shape (n, n_actions), for inputs, shape (n, n_inputs).
        history: Number of observations in an input.
    """

    layers: list[Layer]
    act: _Act
    history: int


class _Moment(NamedTuple):
    """A moment of an episode: what the task shows, and what a declaration can refer to."""

    observed: Floats
    seen: Floats
    state: RobotState
    last_action: Floats
    time: float
    goal: Floats


def export_policy(
    model: Any,
    task: Task | type[Task] | str | URLabEnv | URLabBatchEnv | URLabVectorEnv,
    path: str | PathLike[str],
    *,
    terms: Sequence[NumberTerm] | None = None,
    env: Any = None,
    tolerance: float = 1e-4,
) -> PolicySpec:
    """Write a trained model as a network in an ONNX file, with its declaration in a TOML file beside it.

    The network contains the normalisation of observations, and the squashing, scaling and clipping of actions. It
    returns actions of the task, which the declaration turns into set-points. If the declaration can also describe the
    observations, the policy drives the robot anywhere; otherwise it runs in the task, which the file names.

    Before anything is written, the files are checked on a simulated server: in episodes of the task, and on random
    observations, the network acts like the model, and the declaration gives the task's observations and set-points.

    Args:
        model: A model of Stable-Baselines3 with continuous actions, a runner of RSL-RL, or a PyTorch module of linear
            layers, activations and layer normalisations.
        task: The task: an object, a class, an id, `module:Class`, or an environment that was made for it. Observations
            are flat.
        path: The ONNX file.
        terms: What `Task.observe` returns, as terms of the declaration. By default `GoalTerm()`, if it returns the
            goal.
        env: The training's environments, whose wrappers hold the normalisation; those of the model by default. If the
            bounds of the model's actions differ from the task's, they mean the same, as with `RescaleAction`.
        tolerance: Largest accepted difference, relative to 1 plus the size of the number.

    Returns:
        The declaration.

    Raises:
        PolicyExportError: The model has a layer or wrapper that cannot be exported, or does not fit the task, or the
            largest difference exceeds the tolerance.
        PolicyMismatch: A policy cannot control the robot of the task.
        MissingExtra: The extra `train` or `onnx` is not installed.
    """
    need("gymnasium", "onnx", extra="train")
    need("onnxruntime", extra="onnx")
    from urlab_client.integrations.gym import URLabEnv

    path, own = Path(path), _own_task(task)
    goals = _noted_goals(own)
    connected = URLabEnv.connect(own.scene_address, task=own, observations="standard")
    with closing(connected) as served, tempfile.TemporaryDirectory() as folder:
        rehearsal = _Rehearsal(served, own, goals)
        if (given := getattr(task, "unwrapped", None)) is not None:
            rehearsal.require_same(given)
        trained = _trained(model, env, rehearsal.size, served.action_space)
        written = Path(folder) / path.name
        written.write_bytes(onnx_network(trained.layers, rehearsal.size * trained.history))
        network, moments = OnnxNetwork(written), rehearsal.moments(trained)
        _check_network(network, trained, np.array([moment.seen for moment in moments]), tolerance)
        spec = rehearsal.declared(trained.history, rehearsal.terms(moments, terms))
        rehearsal.check(Policy(spec, network, source=path.with_suffix(".toml").name), moments, tolerance)
        path.write_bytes(written.read_bytes())
    path.with_suffix(".toml").write_text(f"# Inputs and outputs of {path.name}.\n\n{spec.to_toml()}", encoding="utf-8")
    return spec


def onnx_network(layers: Sequence[Layer], inputs: int) -> bytes:
    """Return an ONNX file of a network that maps observations, shape (batch, inputs), to actions.

    Args:
        layers: What happens to an observation, in order. Besides ONNX's operators there is `Swish`.
        inputs: Length of an observation.

    Raises:
        MissingExtra: The extra `train` is not installed.
    """
    need("onnx", extra="train")
    onnx: Any = importlib.import_module("onnx")
    nodes: list[Any] = []
    constants: list[Any] = []
    for index, (operator, arrays, attributes) in enumerate(layers):
        value = nodes[-1].output[0] if nodes else "observation"
        result = "action" if index == len(layers) - 1 else f"value{index}"
        if operator == "Swish":
            nodes.append(onnx.helper.make_node("Sigmoid", [value], [f"gate{index}"]))
            nodes.append(onnx.helper.make_node("Mul", [value, f"gate{index}"], [result]))
            continue
        names = [f"{operator}{index}_{number}" for number in range(len(arrays))]
        for name, array in zip(names, map(np.asarray, arrays), strict=True):
            exact = array if array.dtype.kind == "i" else array.astype(np.float32)
            constants.append(onnx.numpy_helper.from_array(exact, name))
        nodes.append(onnx.helper.make_node(operator, [value, *names], [result], **attributes))
    ends = [
        onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", width])
        for name, width in (("observation", inputs), ("action", None))
    ]
    graph = onnx.helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants)
    opsets = [onnx.helper.make_opsetid("", 20)]
    made = onnx.helper.make_model(graph, producer_name="urlab_client", opset_imports=opsets, ir_version=9)
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()


def _own_task(given: Any) -> Task:
    """Return the task as an object that serves no environment."""
    from urlab_client.integrations.gym import Task, task_named

    if isinstance(given, str | type):
        return (task_named(given) if isinstance(given, str) else given)()
    found = given if isinstance(given, Task) else given.unwrapped.task
    if found is None:
        raise PolicyExportError("The environment has no task.", hint="Give the task itself.")
    return copy.copy(found)


def _name(task: Task) -> str:
    """Return the name of a task's class for other programs: its id if this package defines it, or `module:Class`."""
    from urlab_client.integrations.gym import TASKS

    kind = type(task)
    if kind.__module__.startswith("urlab_client.") and kind in TASKS.values():
        return next(name for name, each in TASKS.items() if each is kind)
    script = getattr(sys.modules["__main__"], "__file__", None)
    return f"{Path(script).stem if kind.__module__ == '__main__' and script else kind.__module__}:{kind.__qualname__}"


def _noted_goals(task: Task) -> list[Floats]:
    """Return a list to which each reset of this task adds the goal, as one array."""
    goals: list[Floats] = []
    reset = task.reset

    def noting(rng: np.random.Generator, start: Start) -> None:
        reset(rng, start)
        goals.append(np.concatenate([np.zeros(0), *map(np.ravel, start.goal.values())]))

    vars(task)["reset"] = noting
    return goals


class _Rehearsal:
    """A task in an environment of its own, in which a model acts.

    Attributes:
        size: Length of an observation of the task.
    """

    def __init__(self, env: URLabEnv, task: Task, goals: list[Floats]) -> None:
        """Take an environment that observes all fields: terms may refer to those that the task does not observe."""
        from urlab_client.integrations.gym.spaces import fields_of

        self._env, self._mapping, self._task, self._goals = env, env.mapping, task, goals
        self._fields: tuple[Any, ...] = fields_of(task.observations)
        driven = [*self._mapping.split(np.zeros(self._mapping.n_actions))]
        if task.space_mode == "dict" or len(driven) != 1:
            raise PolicyExportError(
                f"{_name(task)} must have flat observations, and actions of one articulation.",
                hint="Other networks can be exported with torch.onnx.export: see task_network().",
            )
        self._robot: URLabArticulation = env.articulations[driven[0]]
        self.size: int = len(self._observed(env.reset(seed=0)[0]))

    def require_same(self, env: Any) -> None:
        """Refuse an environment whose options override the task's attributes: the file can only name the task."""
        ours = self._mapping
        same = (env.n_substeps, env.mapping.mode, env.mapping.fields) == (self._env.n_substeps, "flat", self._fields)
        if not same or any(env.mapping.actions(key) != ours.actions(key) for key in ours.keys):
            raise PolicyExportError(
                f"The environment overrides attributes of {_name(self._task)}, but the file can only name the task.",
                hint="Set them in a class that derives from the task.",
            )

    def moments(self, trained: _Trained) -> list[_Moment]:
        """Return the moments of some episodes in which a model acts."""
        found: list[_Moment] = []
        for episode in range(EPISODES):
            everything, info = self._env.reset(seed=episode)
            seen, began = [self._observed(everything)] * trained.history, info["sim_time"]
            last = np.zeros(self._mapping.n_actions)
            for _ in range(STEPS):
                state = copy.deepcopy(RobotState.of(self._robot))
                time, goal = info["sim_time"] - began, self._goals[-1]
                found.append(_Moment(seen[-1], np.concatenate(seen), state, last, time, goal))
                last = trained.act(found[-1].seen[None])[0]
                everything, _, terminated, truncated, info = self._env.step(last)
                seen = [*seen[1:], self._observed(everything)]
                if terminated or truncated:
                    break
        return found

    def terms(self, moments: Sequence[_Moment], given: Sequence[NumberTerm] | None) -> list[Term]:
        """Return the terms of one observation; none if a declaration cannot describe it."""
        observed, goals = self._mapping.observed, np.array([each.goal for each in moments])
        if len(observed) > 1 and given:
            raise PolicyExportError(f"Terms describe one robot, but {', '.join(observed)} are observed.")
        if given is None and goals.shape[1] == self._task.n_observed:
            shown = np.array([each.observed for each in moments])[:, self.size - goals.shape[1] :]
            given = [GoalTerm()] * bool(goals.shape[1]) if np.array_equal(shown, goals) else None
        return [] if given is None or len(observed) > 1 else [*(FieldTerm(field=name) for name in self._fields), *given]

    def declared(self, history: int, observation: list[Term]) -> PolicySpec:
        """Return the declaration."""
        robot, task, actions = self._robot, self._task, self._mapping.actions(self._robot.prefix)
        actuators, controller = [*robot.actuators.values()], robot.controller
        gains = None
        if controller is not None and robot.control_mode is not ControlMode.RAW:
            params: Any = controller.params
            gains = Gains(
                **{
                    name: _number([params[name][each.name] for each in actuators])
                    for name in ("kp", "kv", "torque_limit")
                }
            )
        servo = gains is not None or any(actuator.type == ActuatorType.POSITION for actuator in actuators)
        kinds = {type(term) for term in observation}
        low, high = _bounds(self._env.action_space)
        return PolicySpec(
            robot=robot.prefix,
            step_modes=[StepMode.DIRECT, StepMode.LIVE],
            timestep=float(task.scene.model.opt.timestep),
            decimation=self._env.n_substeps,
            task=_name(task),
            keyframe=task.keyframe,
            history=history,
            observation=observation,
            action=Action(
                kind="joint_position" if servo else "torque",
                via="actuators" if gains is None else "controller",
                joints=[actuator.joint or "" for actuator in actuators],
                scale=_number(actions.scale),
                offset=_number(actions.offset),
                clip=(float(low.min()), float(high.max())),
            ),
            gains=gains,
            command=self._limits(Command) if CommandTerm in kinds else None,
            goal=self._limits(Goal) if GoalTerm in kinds else None,
        )

    def check(self, policy: Policy, moments: Sequence[_Moment], tolerance: float) -> None:
        """Check that a policy's declaration gives the observations and set-points of the task."""
        mapping = PolicyMapping(policy.spec, self._robot, policy.source)
        if policy.spec.observation:
            require(aio_of(self._env.client), policy, self._robot.prefix)
            found = [
                mapping.observe(each.state, each.goal, mapping.clipped(each.last_action), each.time, each.goal)
                for each in moments
            ]
            observed = [each.observed for each in moments]
            _require_equal(policy.source, "observation", np.array(found), np.array(observed), tolerance)
        actions = np.array([each.last_action for each in moments])
        expected = self._mapping.set_points(actions)[self._robot.prefix][:, mapping.ctrl]
        _require_equal(policy.source, "set-points", mapping.targets(mapping.clipped(actions)), expected, tolerance)

    def _observed(self, everything: Floats) -> Floats:
        """Return the observation of the task, given one of all fields."""
        fields = ((key, field) for key in self._mapping.observed for field in self._fields)
        parts = [self._mapping.field(everything, *each) for each in fields]
        return np.concatenate([*parts, everything[len(everything) - self._task.n_observed :]])

    def _limits(self, table: type[AnyGoal]) -> AnyGoal:
        """Return the table of the goal, with the limits of many goals that the task draws."""
        from urlab_client.integrations.gym import Start

        task, rng = self._task, np.random.default_rng(0)
        for _ in range(DRAWN):
            memory = {name: np.zeros(shape) for name, shape in task.memory.items()}
            model = task.scene.model
            task.reset(rng, Start(task.scene, np.array(model.qpos0), np.zeros(int(model.nv)), memory=memory))
        drawn = np.round(self._goals, 4)
        low, high = drawn.min(axis=0), drawn.max(axis=0)
        limits: dict[str, Floats] = {"default": np.round((low + high) / 2, 4), "low": low, "high": high}
        return msgspec.convert({name: values.tolist() for name, values in limits.items()}, table)


def _trained(model: Any, env: Any, size: int, space: Any) -> _Trained:
    """Return a model for a task with observations of this size and this action space."""
    ours = theirs = _bounds(space)
    if hasattr(model, "policy") and hasattr(model, "predict"):
        given, (layers, answer), theirs = model.get_env(), _stable_baselines(model), _bounds(model.action_space)
    elif hasattr(model, "alg"):
        given, (layers, answer) = model.env, _rsl_rl(model)
    else:
        given, layers, answer = None, [*_layers(model)], _inferred(model, lambda tensor: tensor)
    wrappers = [*_wrappers(given if env is None else env)]
    history = math.prod(each.stacked_obs.n_stack for each in wrappers if type(each).__name__ == "VecFrameStack")
    inputs = size * history
    wide = next((len(arrays[0].T) for operator, arrays, _ in layers if operator == "Gemm"), inputs)
    if wide != inputs or theirs.shape != ours.shape:
        raise PolicyExportError(
            f"The model maps {wide} numbers to actions of {theirs.shape[1]}, but the task has observations of {inputs} "
            f"numbers and actions of {ours.shape[1]}."
        )
    steps: list[Callable[[Floats], Floats]] = []
    before: list[Layer] = []
    for *moments, limit in filter(None, map(_statistics, reversed(wrappers))):
        mean, deviation = (np.tile(values, history) for values in moments)
        before += [("Sub", [mean], {}), ("Div", [deviation], {}), *_clipped(-limit, limit)]
        steps.append(partial(_normalised, mean, deviation, limit))
    after: list[Layer] = []
    factor, offset = np.ones(len(ours.T)), np.zeros(len(ours.T))
    if not np.array_equal(ours, theirs):
        if not np.isfinite([ours, theirs]).all():
            raise PolicyExportError("The bounds of the model's actions differ from the task's, and are not finite.")
        factor = (ours[1] - ours[0]) / (theirs[1] - theirs[0])
        offset = ours[0] - factor * theirs[0]
        after = [("Mul", [factor], {}), ("Add", [offset], {})]

    def act(inputs: Floats) -> Floats:
        for step in steps:
            inputs = step(inputs)
        return np.clip(offset + factor * np.asarray(answer(inputs), dtype=np.float64), *ours)

    return _Trained([*before, *layers, *after, *_clipped(*ours)], act, history)


def _bounds(space: Any) -> Floats:
    """Return the lowest and highest values of a space, shape (2, n)."""
    return np.array([space.low, space.high], dtype=np.float64)


def _clipped(low: Floats | float, high: Floats | float) -> list[Layer]:
    return [("Max", [low], {}), ("Min", [high], {})]


def _normalised(mean: Floats, deviation: Floats, limit: float, inputs: Floats) -> Floats:
    return np.clip((inputs - mean) / deviation, -limit, limit)


def _wrappers(env: Any) -> Iterator[Any]:
    """Yield environments from the outermost wrapper inwards."""
    while env is not None:
        yield env
        env = getattr(env, "venv", None) or getattr(env, "env", None)


def _statistics(wrapper: Any) -> tuple[Floats, Floats, float] | None:
    """Return mean, standard deviation and limit of a wrapper that normalises observations; None for others."""
    kind = type(wrapper).__name__
    if kind == "NormalizeObservation" or (kind == "VecNormalize" and wrapper.norm_obs):
        limit = float(getattr(wrapper, "clip_obs", math.inf)) if kind == "VecNormalize" else math.inf
        return wrapper.obs_rms.mean, np.sqrt(wrapper.obs_rms.var + wrapper.epsilon), limit
    if kind == "VecTransposeImage" or "VectorObservationWrapper" in _ancestors(wrapper):
        raise PolicyExportError(f"The wrapper {kind} changes observations in a way that cannot be exported.")
    return None


def _ancestors(thing: object) -> list[str]:
    return [each.__name__ for each in type(thing).__mro__]


def _stable_baselines(model: Any) -> tuple[list[Layer], _Act]:
    """Return the layers that give the deterministic actions of a model of Stable-Baselines3, and its own actions."""
    policy: Any = model.policy
    actor: Any = getattr(policy, "actor", None)
    if hasattr(actor, "mu"):  # SAC and TD3; the network of TD3 ends with its Tanh
        parts = [actor.features_extractor, *([actor.latent_pi] if hasattr(actor, "latent_pi") else []), actor.mu]
        squashes: bool = hasattr(actor, "latent_pi")
    elif hasattr(policy, "action_net") and hasattr(model.action_space, "low") and not hasattr(policy, "lstm_actor"):
        parts = [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net]  # PPO and A2C
        squashes = policy.squash_output
    else:
        raise PolicyExportError(f"{type(model).__name__} has no actor with continuous actions and without memory.")
    squashed: list[Layer] = [("Tanh", [], {})] if squashes else []
    low, high = _bounds(model.action_space)
    unscaled: list[Layer] = [("Mul", [(high - low) / 2], {}), ("Add", [(high + low) / 2], {})]
    scaled = unscaled if policy.squash_output else _clipped(low, high)
    layers = [layer for part in parts for layer in _layers(part)]
    return [*layers, *squashed, *scaled], lambda inputs: model.predict(inputs, deterministic=True)[0]


def _rsl_rl(runner: Any) -> tuple[list[Layer], _Act]:
    """Return the layers of the actor of a runner of RSL-RL, and the actor's own actions."""
    actor: Any = runner.alg.get_policy()
    if actor.is_recurrent or hasattr(actor, "cnns") or len(actor.obs_groups) != 1:
        raise PolicyExportError(
            f"The actor, a {type(actor).__name__} for the observations {', '.join(actor.obs_groups)}, must be an MLP "
            "without memory for one group of observations."
        )
    parts = [actor.obs_normalizer, actor.mlp]
    if actor.distribution is not None:
        parts.append(actor.distribution.as_deterministic_output_module())
    grouped: Any = importlib.import_module("tensordict").TensorDict
    answer = _inferred(actor, lambda tensor: grouped({actor.obs_groups[0]: tensor}, batch_size=[len(tensor)]))
    return [layer for part in parts for layer in _layers(part, runner.env.num_actions)], answer


def _inferred(module: Any, given: Callable[[Any], Any]) -> _Act:
    """Return a function that lets a PyTorch module act, given the form of its argument."""
    torch: Any = importlib.import_module("torch")

    def act(inputs: Floats) -> Floats:
        device = next(module.parameters()).device
        with torch.no_grad():
            return module(given(torch.as_tensor(inputs, dtype=torch.float32, device=device))).cpu().numpy()

    return act


def _layers(module: Any, outputs: int = 0) -> Iterator[Layer]:
    """Yield the layers of a PyTorch module for one flat observation; `outputs` is the number of actions."""
    kind = type(module).__name__
    if kind in _NOTHING:
        return
    if kind in _ACTIVATIONS:
        operator, attributes = _ACTIVATIONS[kind]
        yield operator, [], {name: getattr(module, theirs) for name, theirs in attributes.items()}
    elif kind == "Hardtanh":
        yield from _clipped(module.min_val, module.max_val)
    elif kind == "Linear":
        bias = np.zeros(module.out_features) if module.bias is None else _array(module.bias)
        yield "Gemm", [_array(module.weight), bias], {"transB": 1}
    elif kind == "LayerNorm" and module.bias is not None:
        yield "LayerNormalization", [_array(module.weight), _array(module.bias)], {"epsilon": module.eps}
    elif kind == "_FirstSliceDeterministicOutput":  # the means, which stand before the deviations
        yield "Slice", [np.array([0]), np.array([outputs]), np.array([1])], {}
    elif "Sequential" in _ancestors(module):
        for child in module:  # children() would leave out activations that are used twice
            yield from _layers(child, outputs)
    elif hasattr(module, "mean") and hasattr(module, "std") and hasattr(module, "eps"):
        yield "Sub", [_array(module.mean)], {}
        yield "Div", [_array(module.std) + module.eps], {}
    else:
        raise PolicyExportError(
            f"The layer {kind} cannot be exported; those that can are Linear, LayerNorm, {', '.join(_ACTIVATIONS)}.",
            hint="Export other networks with torch.onnx.export, and write the declaration yourself.",
        )


def _array(tensor: Any) -> Floats:
    return tensor.detach().cpu().numpy()


def _check_network(network: OnnxNetwork, trained: _Trained, seen: Floats, tolerance: float) -> None:
    """Check that a network acts like the model, in the inputs of episodes and in random ones."""
    random = np.random.default_rng(0).normal(seen.mean(axis=0), 3 * seen.std(axis=0) + 0.1, (DRAWN, seen.shape[1]))
    for kind, inputs in (("of an episode", seen), ("drawn at random", random)):
        exact = inputs.astype(np.float32).astype(np.float64)  # what a network is given
        found, who = np.array([network(each) for each in exact]), f"The network, for an observation {kind},"
        _require_equal(who, "action", found, trained.act(exact), tolerance)


def _number(values: Any) -> Numbers:
    """Return equal numbers as one number, others as a list."""
    found = [float(value) for value in values]
    return found[0] if len(set(found)) == 1 else found


def _require_equal(who: str, what: str, found: Floats, expected: Floats, tolerance: float) -> None:
    if found.shape != expected.shape:
        raise PolicyExportError(f"{who} gives {what} of {found.shape[1]} numbers, not {expected.shape[1]}.")
    error = np.nan_to_num(np.abs(found - expected) / (1.0 + np.abs(expected)), nan=np.inf)
    row, column = np.unravel_index(np.argmax(error), error.shape)
    if error[row, column] > tolerance:
        raise PolicyExportError(
            f"{who} gives {found[row, column]:.6g} as number {column} of the {what}, not {expected[row, column]:.6g}: "
            f"the largest difference of {len(found)}, beyond the tolerance of {tolerance:g}."
        )
