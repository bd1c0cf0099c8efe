"""Exports what learning libraries trained for a task: a network in an ONNX file, and its declaration beside it.

The layers are written one by one. So neither PyTorch's exporter nor its dependencies are needed, and a network holds
nothing that is not named here. Needs the extras `onnx` and `train`.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import msgspec
import numpy as np

from urlab_client._installation import need
from urlab_client.enums import ActuatorType, ControlMode, StepMode
from urlab_client.errors import URLabError
from urlab_client.integrations.policy.mapping import PolicyMapping, RobotState
from urlab_client.integrations.policy.network import Layer, OnnxNetwork, onnx_network
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
    from urlab_client.integrations.gym import Task, URLabEnv

EPISODES: Final = 4
STEPS: Final = 25
DRAWN: Final = 256
"""Number of starts that are drawn for the limits of the goal, and of random inputs."""

AnyGoal = TypeVar("AnyGoal", bound=Goal)

_Act = Callable[[Floats], Floats]

_ACTIVATIONS: Final[dict[str, tuple[str, dict[str, str]]]] = {
    "CELU": ("Celu", {"alpha": "alpha"}),
    "ELU": ("Elu", {"alpha": "alpha"}),
    "GELU": ("Gelu", {"approximate": "approximate"}),
    "LeakyReLU": ("LeakyRelu", {"alpha": "negative_slope"}),
    "Mish": ("Mish", {}),
    "ReLU": ("Relu", {}),
    "SELU": ("Selu", {}),
    "SiLU": ("Swish", {}),
    "Sigmoid": ("Sigmoid", {}),
    "Softplus": ("Softplus", {}),
    "Tanh": ("Tanh", {}),
}
"""Operators of PyTorch's activations, and PyTorch's names of their attributes."""

_NOTHING: Final = (
    "Dropout",
    "FlattenExtractor",
    "Identity",
    "_FirstSliceDeterministicOutput",
    "_IdentityDeterministicOutput",
)
"""Modules that do not change a flat observation. What else they may do, the check of the network notices."""

_EXPORTED: Final = ("ClipAction", "NormalizeObservation", "RescaleAction", "VecFrameStack", "VecNormalize")
_HARMLESS: Final = (
    *("Autoreset", "DummyVecEnv", "FlattenObservation", "HumanRendering", "Monitor", "NormalizeReward"),
    *("OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo", "RenderCollection"),
    *("RewardWrapper", "RslRlVecEnv", "Sb3VecEnv", "SyncVectorEnv", "TimeLimit", "VecCheckNan", "VecMonitor"),
    *("VecVideoRecorder", "VectorRewardWrapper"),
)
"""Wrappers that leave flat observations, and actions, as they are."""


class PolicyExportError(URLabError, ValueError):
    """A model cannot be exported, or its files give other numbers. The message says which, where and by how much."""


def export_policy(
    model: Any,
    task: type[Task] | str,
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
        task: The task: a class, an id or `module:Class`. Observations are flat.
        path: The ONNX file.
        terms: What `Task.observe` returns, as terms of the declaration. Without them, the declaration describes the
            observations only of a task whose `observe` returns nothing.
        env: The training's environments, whose wrappers hold the normalisation; those of the model by default. Of
            wrappers that change observations or actions, these are exported: Gymnasium's `NormalizeObservation`,
            `RescaleAction` and `ClipAction`, and Stable-Baselines3's `VecNormalize` and `VecFrameStack`. If the bounds
            of the model's actions differ from the task's, they mean the same, as with `RescaleAction`.
        tolerance: Largest accepted difference, relative to 1 plus the size of the number.

    Returns:
        The declaration.

    Raises:
        PolicyExportError: The model has a layer or wrapper that cannot be exported, or does not fit the task, or the
            largest difference exceeds the tolerance.
        PolicyMismatch: A policy cannot control the robot of the task.
        ValueError: There is no such task.
        MissingExtra: The extra `train` or `onnx` is not installed.
    """
    need("gymnasium", "onnx", extra="train")
    need("onnxruntime", extra="onnx")
    from urlab_client.integrations.gym import URLabEnv, task_named

    path, own = Path(path), (task_named(task) if isinstance(task, str) else task)()
    trained = _read(model, env)  # before a server is started
    goals = _noted_goals(own)
    vars(own)["measured"] = True  # sensors are there, too: terms may refer to them
    with closing(URLabEnv.connect(own.scene_address, task=own)) as served, tempfile.TemporaryDirectory() as folder:
        driven = [*served.mapping.split(np.zeros(served.mapping.n_actions))]
        if own.space_mode == "dict" or len(driven) != 1:
            raise PolicyExportError(
                f"{_name(type(own))} must have flat observations, and actions of one articulation.",
                hint="Other networks can be exported with torch.onnx.export: see task_network().",
            )
        seen_space: Any = served.observation_space
        size, robot = int(seen_space.shape[0]), served.articulations[driven[0]]
        layers, act, history = _fitted(model, trained, size, served.action_space)
        written = Path(folder) / path.name
        written.write_bytes(onnx_network(layers, size * history))
        network = OnnxNetwork(written)
        spec = _declared(served, robot, goals, terms, history)
        policy = Policy(spec, network, source=path.with_suffix(".toml").name)
        seen = _rehearsed(served, goals, policy, act, tolerance)
        mean, spread = np.mean(seen, axis=0), 3 * np.std(seen, axis=0) + 0.1
        unseen = np.random.default_rng(0).normal(mean, spread, (DRAWN, len(mean)))
        exact = np.concatenate([seen, unseen]).astype(np.float32)  # what a network is given
        found, expected = [network(each) for each in exact], act(exact.astype(np.float64))
        _require_equal("The network", "action", found, expected, tolerance)
        path.write_bytes(written.read_bytes())
    path.with_suffix(".toml").write_text(f"# Inputs and outputs of {path.name}.\n\n{spec.to_toml()}", encoding="utf-8")
    return spec


def _name(kind: type[Task]) -> str:
    """Return the name of a task for other programs: its id if this package defines it, or `module:Class`."""
    from urlab_client.integrations.gym import TASKS

    module, script = kind.__module__, getattr(sys.modules["__main__"], "__file__", None)
    if module.startswith("urlab_client.") and kind in TASKS.values():
        return next(name for name, each in TASKS.items() if each is kind)
    return f"{Path(script).stem if module == '__main__' and script else module}:{kind.__qualname__}"


def _noted_goals(task: Task) -> list[Floats]:
    """Return a list to which each reset of this task adds the goal, as one array."""
    goals: list[Floats] = []
    reset = task.reset

    def noting(rng: np.random.Generator, start: Any) -> None:
        reset(rng, start)
        goals.append(np.concatenate([np.zeros(0), *map(np.ravel, start.goal.values())]))

    vars(task)["reset"] = noting
    return goals


def _declared(
    env: URLabEnv, robot: URLabArticulation, goals: list[Floats], terms: Sequence[NumberTerm] | None, history: int
) -> PolicySpec:
    """Return the declaration, given the terms of what the task itself observes."""
    task: Any = env.task
    mapping, actuators, controller = env.mapping, [*robot.actuators.values()], robot.controller
    observation: list[Term] = []
    if {*mapping.observed} <= {robot.prefix} and (terms is not None or not task.n_observed):
        observation = [FieldTerm(field=name) for _ in mapping.observed for name in mapping.fields]
        observation += terms or ()
    elif terms is not None:
        raise PolicyExportError(f"Terms describe {robot.prefix}, but {', '.join(mapping.observed)} are observed.")
    kinds = {type(term) for term in observation}
    gains = None
    if controller is not None and robot.control_mode is not ControlMode.RAW:
        params: Any = controller.params
        kp, kv, limit = (
            _number([params[name][each.name] for each in actuators]) for name in ("kp", "kv", "torque_limit")
        )
        gains = Gains(kp=kp, kv=kv, torque_limit=limit)
    servo = gains is not None or any(actuator.type == ActuatorType.POSITION for actuator in actuators)
    actions, (low, high) = mapping.actions(robot.prefix), _bounds(env.action_space)
    return PolicySpec(
        robot=robot.prefix,
        step_modes=[StepMode.DIRECT, StepMode.LIVE],
        timestep=float(task.scene.model.opt.timestep),
        decimation=env.n_substeps,
        task=_name(task.__class__),
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
        command=_limits(Command, task, goals) if CommandTerm in kinds else None,
        goal=_limits(Goal, task, goals) if GoalTerm in kinds else None,
    )


def _limits(table: type[AnyGoal], task: Task, goals: list[Floats]) -> AnyGoal:
    """Return the table of the goal, with the limits of many goals that the task draws."""
    from urlab_client.integrations.gym import Start

    rng, model = np.random.default_rng(0), task.scene.model
    for _ in range(DRAWN):
        memory = {name: np.zeros(shape) for name, shape in task.memory.items()}
        task.reset(rng, Start(task.scene, np.array(model.qpos0), np.zeros(int(model.nv)), memory=memory))
    drawn = np.round(goals, 4)
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    limits: dict[str, Floats] = {"default": np.round((low + high) / 2, 4), "low": low, "high": high}
    try:
        return msgspec.convert({name: values.tolist() for name, values in limits.items()}, table)
    except msgspec.ValidationError as error:
        raise PolicyExportError(
            f"The goal of {_name(type(task))} has {len(low)} numbers: not a {table.__name__.lower()}."
        ) from error


def _rehearsed(env: URLabEnv, goals: list[Floats], policy: Policy, act: _Act, tolerance: float) -> list[Floats]:
    """Let a model act in some episodes, check what its declaration makes of them, and return the model's inputs."""
    spec, robot = policy.spec, env.articulations[policy.spec.robot]
    mapping = PolicyMapping(spec, robot, policy.source)
    if spec.observation:
        require(aio_of(env.client), policy, robot.prefix)
    seen, declared, observed, actions = (list[Floats]() for _ in range(4))
    for episode in range(EPISODES):
        observation, info = env.reset(seed=episode)
        latest, began, goal = [observation] * spec.history, info["sim_time"], goals[-1]
        action = np.zeros(mapping.action_size)
        for _ in range(STEPS):
            if spec.observation:
                last, time = mapping.clipped(action), info["sim_time"] - began
                declared.append(mapping.observe(RobotState.of(robot), goal, last, time, goal))
                observed.append(observation)
            latest = [*latest[1:], observation]
            seen.append(np.concatenate(latest))
            action = act(seen[-1][None])[0]
            actions.append(action)
            observation, _, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                break
    if declared:
        _require_equal(policy.source, "observation", declared, observed, tolerance)
    targets = mapping.targets(mapping.clipped(np.array(actions)))
    expected = env.mapping.set_points(np.array(actions))[robot.prefix][:, mapping.ctrl]
    _require_equal(policy.source, "set-points", targets, expected, tolerance)
    return seen


class _Trained(NamedTuple):
    """What a model consists of: the wrappers of its environments, the layers of its network, and its own actions."""

    wrappers: list[Any]
    layers: list[Layer]
    act: _Act


def _read(model: Any, env: Any) -> _Trained:
    """Return what a model consists of; refuse what cannot be exported."""
    of_library = hasattr(model, "policy") and hasattr(model, "predict")
    given = model.get_env() if of_library else getattr(model, "env", None)
    wrappers = [*_wrappers(given if env is None else env)]
    if of_library:
        return _Trained(wrappers, *_stable_baselines(model))
    module = model.alg.get_policy().as_jit() if hasattr(model, "alg") else model  # a runner of RSL-RL, or a module
    return _Trained(wrappers, [*_layers([module])], _inferred(module))


def _fitted(model: Any, trained: _Trained, size: int, space: Any) -> tuple[list[Layer], _Act, int]:
    """Return a model for a task with observations of this size and this action space.

    Returns:
        The layers of its network, from observations of the task to actions of the task; the model's own actions, shape
        (n, n_actions), for inputs, shape (n, n_inputs); and the number of observations in an input.
    """
    wrappers, layers, answer = trained
    clipped = [each.env for each in wrappers if type(each).__name__ == "ClipAction"]
    spaces = [_action_space(each) for each in (clipped or [model, *wrappers])]
    ours, theirs = _bounds(space), _bounds(next((each for each in spaces if each is not None), space))
    history = next((each.stacked_obs.n_stack for each in wrappers if type(each).__name__ == "VecFrameStack"), 1)
    n_inputs = size * history
    wide = next((len(arrays[0].T) for operator, arrays, _ in layers if operator == "Gemm"), n_inputs)
    if wide != n_inputs or theirs.shape != ours.shape:
        raise PolicyExportError(
            f"The model maps {wide} numbers to actions of {theirs.shape[1]}, but the task has observations of "
            f"{n_inputs} numbers and actions of {ours.shape[1]}."
        )
    before: list[Layer] = []
    normalised: list[tuple[Floats, Floats, float]] = []
    for wrapper in reversed(wrappers):
        statistics = _own(wrapper, "obs_rms")
        if statistics is not None and _own(wrapper, "norm_obs", True):  # VecNormalize, NormalizeObservation
            limit = float(_own(wrapper, "clip_obs", np.inf))
            # Statistics of one observation hold for all that are stacked.
            mean, variance = (np.resize(values, n_inputs) for values in (statistics.mean, statistics.var))
            deviation = np.sqrt(variance + wrapper.epsilon)
            normalised.append((mean, deviation, limit))
            before += [("Sub", [mean], {}), ("Div", [deviation], {}), *_clipped(-limit, limit)]
    factor, offset = np.ones(len(ours.T)), np.zeros(len(ours.T))
    if not np.array_equal(ours, theirs):
        if not np.isfinite([ours, theirs]).all():
            raise PolicyExportError("The bounds of the model's actions differ from the task's, and are not finite.")
        factor = (ours[1] - ours[0]) / (theirs[1] - theirs[0])
        offset = ours[0] - factor * theirs[0]
    after: list[Layer] = [("Mul", [factor], {}), ("Add", [offset], {}), *_clipped(*ours)]

    def act(inputs: Floats) -> Floats:
        for mean, deviation, limit in normalised:
            inputs = np.clip((inputs - mean) / deviation, -limit, limit)
        return np.clip(offset + factor * np.asarray(answer(inputs), dtype=np.float64), *ours)

    return [*before, *layers, *after], act, history


def _bounds(space: Any) -> Floats:
    """Return the lowest and highest values of a space, shape (2, n)."""
    return np.array([space.low, space.high], dtype=np.float64)


def _clipped(low: Floats | float, high: Floats | float) -> list[Layer]:
    return [("Max", [low], {}), ("Min", [high], {})]


def _action_space(env: Any) -> Any:
    """Return the space of one environment's actions, or None."""
    return getattr(env, "single_action_space", None) or getattr(env, "action_space", None)


def _wrappers(env: Any) -> Iterator[Any]:
    """Yield environments from the outermost wrapper inwards; refuse those that may change more than is exported."""
    from urlab_client.integrations.gym import URLabEnv
    from urlab_client.integrations.gym.vectorized import Vectorized

    while env is not None:
        yield env
        if isinstance(env, (URLabEnv, Vectorized)):
            return
        if not any(_is_a(name, env) for name in (*_EXPORTED, *_HARMLESS)):
            raise PolicyExportError(
                f"{type(env).__name__} may change observations or actions in a way that is not exported.",
                hint="If it does not, pass as `env` the environment inside it, or one like those of the training.",
            )
        each = getattr(env, "envs", ())
        if len(each) > 1 and any(_own(inner, "obs_rms") is not None for inner in _wrappers(each[0])):
            raise PolicyExportError(
                f"The {len(each)} environments in {type(env).__name__} normalise observations each in its own way.",
                hint="Train with one normalisation around all of them, such as VecNormalize.",
            )
        env = getattr(env, "venv", None) or getattr(env, "env", None) or next(iter(each), None)


def _own(thing: object, name: str, otherwise: Any = None) -> Any:
    """Return an attribute of an object itself: wrappers also have those of what they wrap."""
    return vars(thing).get(name, otherwise)


def _is_a(name: str, thing: object) -> bool:
    """Return whether a class of this name, of a library that is not imported, is among those of an object."""
    return any(each.__name__ == name for each in type(thing).__mro__)


def _stable_baselines(model: Any) -> tuple[list[Layer], _Act]:
    """Return the layers that give the deterministic actions of a model of Stable-Baselines3, and its own actions."""
    policy: Any = model.policy
    actor: Any = getattr(policy, "actor", None)
    if hasattr(actor, "mu"):  # SAC; TD3 and DDPG
        parts = [actor.features_extractor, *([actor.latent_pi] if hasattr(actor, "latent_pi") else []), actor.mu]
    elif hasattr(policy, "action_net"):  # PPO and A2C
        parts = [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net]
    else:
        raise PolicyExportError(f"{type(model).__name__} has no actor with continuous actions.")
    layers, (low, high) = [*_layers(parts)], _bounds(model.action_space)
    if policy.squash_output:
        squashed: list[Layer] = [] if layers[-1][0] == "Tanh" else [("Tanh", [], {})]  # TD3's network ends with its own
        layers += [*squashed, ("Mul", [(high - low) / 2], {}), ("Add", [(high + low) / 2], {})]
    else:
        layers += _clipped(low, high)
    return layers, lambda inputs: model.predict(inputs, deterministic=True)[0]


def _inferred(module: Any) -> _Act:
    """Return a function that lets a PyTorch module act."""
    torch: Any = importlib.import_module("torch")
    device = next(module.parameters()).device

    def act(inputs: Floats) -> Floats:
        with torch.no_grad():
            return module(torch.as_tensor(inputs, dtype=torch.float32, device=device)).cpu().numpy()

    return act


def _layers(modules: Iterable[Any]) -> Iterator[Layer]:
    """Yield the layers of PyTorch modules, one after the other, for one flat observation."""
    for module in modules:
        kind = type(module).__name__
        if kind in _NOTHING:
            continue
        if kind in _ACTIVATIONS:
            operator, attributes = _ACTIVATIONS[kind]
            yield operator, [], {name: getattr(module, theirs) for name, theirs in attributes.items()}
        elif kind == "Linear":
            bias = np.zeros(module.out_features) if module.bias is None else _array(module.bias)
            yield "Gemm", [_array(module.weight), bias], {"transB": 1}
        elif kind == "LayerNorm" and module.bias is not None:
            yield "LayerNormalization", [_array(module.weight), _array(module.bias)], {"epsilon": module.eps}
        elif kind == "Unflatten":  # RSL-RL's network has means, and then deviations
            yield "Slice", [np.array([0]), np.array([module.unflattened_size[-1]]), np.array([1])], {}
        elif _is_a("Sequential", module):
            yield from _layers(module)  # children() would leave out activations that are used twice
        elif hasattr(module, "obs_normalizer"):  # RSL-RL's actor
            yield from _layers(module.children())
        elif hasattr(module, "mean") and hasattr(module, "std") and hasattr(module, "eps"):
            yield "Sub", [_array(module.mean)], {}
            yield "Div", [_array(module.std) + module.eps], {}
        else:
            raise PolicyExportError(
                f"The layer {kind} cannot be exported; these can: Linear, LayerNorm, {', '.join(_ACTIVATIONS)}.",
                hint="Export other networks with torch.onnx.export, and write the declaration yourself.",
            )


def _array(tensor: Any) -> Floats:
    return tensor.detach().cpu().numpy()


def _number(values: Any) -> Numbers:
    """Return equal numbers as one number, others as a list."""
    found = [float(value) for value in values]
    return found[0] if len(set(found)) == 1 else found


def _require_equal(who: str, what: str, found: Any, expected: Any, tolerance: float) -> None:
    found, expected = np.array(found), np.array(expected)
    if found.shape != expected.shape:
        raise PolicyExportError(f"{who} gives {what} of {found.shape[1]} numbers, not {expected.shape[1]}.")
    error = np.nan_to_num(np.abs(found - expected) / (1.0 + np.abs(expected)), nan=np.inf)
    row, column = np.unravel_index(np.argmax(error), error.shape)
    if error[row, column] > tolerance:
        raise PolicyExportError(
            f"{who} gives {found[row, column]:.6g} as number {column} of the {what}, not {expected[row, column]:.6g}: "
            f"the largest difference of {len(found)}, beyond the tolerance of {tolerance:g}."
        )
