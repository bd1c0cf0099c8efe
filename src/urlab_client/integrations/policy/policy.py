"""`Policy`: a network with its declaration and its state for one robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, overload

import numpy as np

from urlab_client.integrations.policy.mapping import PolicyMapping, PolicyMismatch, PolicyRobot, RobotState
from urlab_client.integrations.policy.network import Network, OnnxInputs, OnnxNetwork, PicturesNetwork
from urlab_client.integrations.policy.spec import Command, Goal, PolicyFileError, PolicySpec, read_spec
from urlab_client.protocol.base import Floats


class Policy:
    """A policy that controls one robot at a time.

    It keeps the state that observations need: the clock, the last action and earlier observations. `reset()` clears
    this state.

    Attributes:
        spec: The declaration.
        source: Name of the declaration in errors, usually its file.
    """

    # Two overloads: with a union, type checkers cannot infer the parameter type of a lambda.
    @overload
    def __init__(self, spec: PolicySpec, network: Network, *, source: str = "policy") -> None: ...

    @overload
    def __init__(self, spec: PolicySpec, network: PicturesNetwork, *, source: str = "policy") -> None: ...

    def __init__(self, spec: PolicySpec, network: Network | PicturesNetwork, *, source: str = "policy") -> None:
        """Make a policy from a declaration and any callable that maps observations to outputs.

        Args:
            spec: The declaration.
            network: The network; `load` makes one from a file. If terms name their `input`, a `PicturesNetwork`.
            source: Name of the declaration in errors.
        """
        self.spec = spec
        self.source = source
        self._network: Any = network
        self._command: Floats = np.zeros(3) if spec.command is None else np.array(spec.command.default)
        self._goal: Floats = np.zeros(0) if spec.goal is None else np.array(spec.goal.default)
        self._robot: PolicyRobot | None = None
        self._mapping: PolicyMapping | None = None
        self._targets: Floats = np.zeros(0)
        self.reset()

    @property
    def command(self) -> Floats:
        """The command (vx, vy, yaw rate), m/s and rad/s, base frame. May be assigned at any time.

        Raises:
            ValueError: On assignment, the number of values is wrong, a value is outside the declared range, or the
                policy takes no command.
        """
        return self._command.copy()

    @command.setter
    def command(self, values: Sequence[float] | Floats) -> None:
        self._command = _within("command", self.spec.command, values, self.source)

    @property
    def goal(self) -> Floats:
        """The goal, in the units of the declared table `goal`. May be assigned at any time.

        Raises:
            ValueError: On assignment, the number of values is wrong, a value is outside the declared range, or the
                policy has no goal.
        """
        return self._goal.copy()

    @goal.setter
    def goal(self, values: Sequence[float] | Floats) -> None:
        self._goal = _within("goal", self.spec.goal, values, self.source)

    @property
    def action(self) -> Floats:
        """The last outputs after clipping, shape (n_joints,); zeros before the first."""
        return self._action.copy()

    def bind(self, robot: PolicyRobot) -> PolicyMapping:
        """Bind the policy to an articulation of a discovered client, and return the mapping.

        Raises:
            PolicyMismatch: The robot lacks an element that the declaration names.
            PolicyFileError: The sizes of the network differ from the declaration.
        """
        mapping = PolicyMapping(self.spec, robot, self.source)
        network = self._network
        if isinstance(network, OnnxNetwork):
            sizes = {
                "inputs": (network.inputs, mapping.observation_size * self.spec.history, "observation times history"),
                "outputs": (network.outputs, mapping.action_size, "action.joints"),
            }
            for kind, (there, declared, key) in sizes.items():
                if there not in (None, declared):
                    raise PolicyFileError(
                        f"{network.path} has {there} {kind}, but {self.source} declares {declared} ({key})."
                    )
        elif isinstance(network, OnnxInputs):
            network.require(mapping.inputs, mapping.action_size)
            if unseen := mapping.inputs.keys() - set(network.inputs):
                raise PolicyFileError(
                    f"{network.path} has no input {min(unseen)!r}, which {self.source} declares; it has: "
                    f"{', '.join(network.inputs)}."
                )
        self._robot, self._mapping = robot, mapping
        return mapping

    def reset(self) -> None:
        """Clear the state: the clock restarts, and the last action is zero."""
        self._acted = 0
        self._action: Floats = np.zeros(len(self.spec.action.joints))
        self._history: list[Floats] = []

    def act(self, robot: PolicyRobot, time: float | None = None) -> Floats:
        """Observe a robot, and write its set-points for the next `decimation` physics steps.

        With `via = "client"`, the set-points are torques for the current state; `hold` computes them for later states.

        Args:
            robot: The articulation.
            time: Seconds since the start; by default, the number of actions since `reset()` times their period.

        Returns:
            Joint targets or torques, shape (n_joints,).

        Raises:
            PolicyMismatch: The robot lacks an element that the declaration names.
            PolicyFileError: The sizes of the network differ from the declaration, or it returned NaN or infinity.
        """
        mapping = self._mapping if robot is self._robot and self._mapping is not None else self.bind(robot)
        now = self._acted * self.spec.period if time is None else time
        observation = mapping.observe(RobotState.of(robot), self._command, self._action, now, self._goal)
        kept = self._history or [observation] * self.spec.history
        self._history = [*kept[1:], observation]
        seen = mapping.named(self._history, robot) if self.spec.named else np.concatenate(self._history)
        output = self._network(seen)
        if output.shape != (mapping.action_size,):
            raise PolicyFileError(
                f"The network returned {output.size} numbers, but {self.source} declares {mapping.action_size} "
                "(action.joints)."
            )
        if not math.isfinite(output.sum()):
            raise PolicyFileError(f"The network of {self.source} returned NaN or infinity for {observation.tolist()}.")
        self._acted += 1
        self._action = mapping.clipped(output)
        self._targets = mapping.targets(self._action)
        if self.spec.action.via == "client":
            self.hold(robot)
        else:
            robot.ctrl_array[mapping.ctrl] = self._targets
        return self._targets

    def hold(self, robot: PolicyRobot) -> None:
        """Write the torques that move a robot from its current state towards the targets of the last action.

        For a policy with `via = "client"`, call this before each physics step between two actions.

        Raises:
            PolicyMismatch: `act` has not been called for this robot yet.
        """
        mapping = self._mapping
        if robot is not self._robot or mapping is None:
            raise PolicyMismatch(f"{self.source}: {robot.prefix!r} has had no action yet.", hint="Call act() first.")
        robot.ctrl_array[mapping.ctrl] = mapping.torques(self._targets, RobotState.of(robot))

    def __repr__(self) -> str:
        return f"<Policy {self.source} for {self.spec.robot!r}>"


def _within(what: str, known: Goal | None, values: Sequence[float] | Floats, source: str) -> Floats:
    given = np.array(values, dtype=np.float64)
    if known is None:
        raise ValueError(f"{source} takes no {what}")
    if not known.contains(given):
        of = "vx, vy, yaw rate " if isinstance(known, Command) else ""
        raise ValueError(f"a {what} must be {of}from {list(known.low)} to {list(known.high)}, not {given.tolist()}")
    return given


def policy_files(path: str | PathLike[str], toml: str | PathLike[str] | None = None) -> tuple[Path, Path]:
    """Return the files of a network and its declaration, given either; `toml` names a declaration elsewhere."""
    given = Path(path)
    return given.with_suffix(".onnx") if given.suffix == ".toml" else given, Path(toml or given.with_suffix(".toml"))


def load(onnx: str | PathLike[str], toml: str | PathLike[str] | None = None) -> Policy:
    """Load a network and its declaration.

    Args:
        onnx: The network, or the declaration beside it.
        toml: The declaration; by default, the file with the same name and the suffix `.toml`.

    Raises:
        PolicyFileError: A file is missing or invalid, or declares nothing but the task that the network runs in.
        ImportError: The extra `onnx` is not installed.
    """
    path, declared = policy_files(onnx, toml)
    spec = read_spec(declared)
    if not spec.observation:
        raise PolicyFileError(
            f"{declared}: it declares no observation, so the policy runs only in the task {spec.task!r}.",
            hint="Run it with `urlab run-policy` or `urlab evaluate`, or in an environment with task_network().",
        )
    return Policy(spec, OnnxInputs(path) if spec.named else OnnxNetwork(path), source=str(declared))
