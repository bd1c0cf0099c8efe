"""Tasks on the bundled robots: reach a target, push a block, follow a velocity, and two tasks with a fixed goal.

They are registered with Gymnasium under `urlab/`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, ClassVar, Final, Literal, TypeGuard

import gymnasium
import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations.gym.batch import URLabBatchEnv
from urlab_client.integrations.gym.env import URLabEnv
from urlab_client.integrations.gym.spaces import Actions, SpaceMode
from urlab_client.integrations.gym.task import ResetNoise, Start, States, Task
from urlab_client.integrations.gym.vector import URLabVectorEnv
from urlab_client.integrations.policy.mapping import RobotState
from urlab_client.protocol.base import Floats
from urlab_client.values.names import did_you_mean

Bools = NDArray[np.bool_]


class FixedReach(Task):
    """The arm holds its hand at the fixed target `TARGET_M`. The reward is the negative distance in metres."""

    TARGET_M: Final = np.array([0.35, 0.2, 0.4])

    scene_address: ClassVar[str] = "sim://arm"
    observations: ClassVar[str | Sequence[str]] = "standard"
    reset_noise: ClassVar[float | ResetNoise] = 0.05

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        return -np.linalg.norm(states.site_position("arm/grip") - self.TARGET_M, axis=1)


class _Quadruped(Task):
    """An episode of at most ten seconds, which terminates when the quadruped falls: low, or tilted by 60 degrees."""

    FALLEN_M: Final = 0.15
    max_episode_steps: ClassVar[int | None] = 500

    def terminated(self, states: States) -> Bools:
        """See `Task.terminated`."""
        robot = _robot(states)
        return (robot.qpos[:, 2] < self.FALLEN_M) | (robot.gravity[:, 2] > -0.5)


class Run(_Quadruped):
    """The torque-controlled quadruped runs along +x as fast as it can. The episode terminates when it falls.

    The reward is the speed of the trunk in m/s, plus 0.5 while standing, minus a penalty on the torques.
    """

    scene_address: ClassVar[str] = "sim://quadruped"
    observations: ClassVar[str | Sequence[str]] = "standard"
    reset_noise: ClassVar[float | ResetNoise] = 0.05

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        torques = self.scene.mapping.set_points(actions)["quadruped"]
        return states.velocities("quadruped")[:, 0] + 0.5 - 2e-4 * np.sum(torques**2, axis=1)


class Reach(Task):
    """The arm holds its hand at a target, drawn for each episode from a box in front of the arm.

    Observations add to the arm's positions and velocities the target and the vector from the hand to it, metres, world
    frame. The reward is the negative distance, plus 1 within `CLOSE_M`, which is success.
    """

    LOW_M: Final = np.array([0.25, -0.25, 0.25])
    HIGH_M: Final = np.array([0.45, 0.25, 0.5])
    CLOSE_M: Final = 0.03

    scene_address: ClassVar[str] = "sim://arm"
    n_observed: ClassVar[int] = 6
    max_episode_steps: ClassVar[int | None] = 100

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """See `Task.reset`."""
        start.noise(rng, "arm", ResetNoise(hinge=0.05, slide=0.005))
        start.goal["target"] = rng.uniform(self.LOW_M, self.HIGH_M)

    def observe(self, states: States) -> Floats:
        """See `Task.observe`."""
        target = states.goal["target"]
        return np.concatenate([target, target - self._hand(states)], axis=1)

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        distance = self._distance(states)
        return -distance + (distance < self.CLOSE_M)

    def success(self, states: States) -> Bools:
        """See `Task.success`."""
        return self._distance(states) < self.CLOSE_M

    def _hand(self, states: States) -> Floats:
        return states.site_position("arm/grip")

    def _distance(self, states: States) -> Floats:
        return np.linalg.norm(states.goal["target"] - self._hand(states), axis=1)


class Push(Task):
    """The arm pushes a block on the floor to a target, drawn for each episode.

    Observations add to the positions and velocities of arm and block the target, x and y in metres, world frame. The
    reward is minus the block's distance from the target, minus a fifth of the hand's distance from the block, plus 1
    within `CLOSE_M`, which is success.
    """

    CLOSE_M: Final = 0.04
    BEHIND: Final = {"shoulder_lift": 0.364, "elbow": 0.792, "wrist_pitch": -1.156}
    """Joint positions with the fingers just above the floor, between the arm's base and the block, rad."""

    scene_address: ClassVar[str] = "sim://arm?model=block&model=floor"
    n_observed: ClassVar[int] = 2
    n_substeps: ClassVar[int] = 20
    max_episode_steps: ClassVar[int | None] = 150

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """See `Task.reset`."""
        for joint, position in self.BEHIND.items():
            start.joint(f"arm/{joint}", position + rng.uniform(-0.02, 0.02))
        turn = rng.uniform(-np.pi, np.pi)
        upright = (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
        start.place("block/block", [rng.uniform(0.42, 0.46), rng.uniform(-0.05, 0.05), 0.03], upright)
        start.goal["target"] = rng.uniform([0.52, -0.12], [0.6, 0.12])

    def observe(self, states: States) -> Floats:
        """See `Task.observe`."""
        return states.goal["target"]

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        distance = self._distance(states)
        hand = states.site_position("arm/grip") - states.body_position("block/block")
        return -distance - 0.2 * np.linalg.norm(hand, axis=1) + (distance < self.CLOSE_M)

    def success(self, states: States) -> Bools:
        """See `Task.success`."""
        return self._distance(states) < self.CLOSE_M

    def _distance(self, states: States) -> Floats:
        return np.linalg.norm(states.body_position("block/block")[:, :2] - states.goal["target"], axis=1)


class PushPictures(Push):
    """`Push` by sight: only the pictures of the camera `arm/overview` show the block."""

    scene_address: ClassVar[str] = f"{Push.scene_address}&camera-size=96x72"
    space_mode: ClassVar[SpaceMode] = "dict"
    cameras: ClassVar[Sequence[str]] = ("arm/overview",)
    articulations: ClassVar[Sequence[str] | None] = ("arm",)


class Walk(_Quadruped):
    """The quadruped trots with a commanded velocity (forward, left and yaw rate), drawn for each episode.

    Actions from -1 to 1 move the joint targets of its PD controller around the standing pose. Its 50 observations, in
    the base frame: linear velocity (times 2), angular velocity (0.5), direction of gravity (5), joint positions (3),
    joint velocities (0.1), last action, sine and cosine of the stride's phase, and the command (3), m/s and rad/s.
    The reward, between 0 and 2, measures how closely the robot follows the command (up to 1.5) and its feet the stride
    (up to 0.5), minus penalties for swaying and abrupt actions. Success means that the velocity, averaged over about a
    stride, differs from the command by less than `CLOSE`. One episode in ten is about standing still.
    """

    LOW: Final = np.array([-0.3, -0.15, -0.5])
    HIGH: Final = np.array([0.8, 0.15, 0.5])
    CLOSE: Final = 0.2
    STRIDES_PER_S: Final = 2.0
    LIFT_M: Final = 0.06
    SHIN_M: Final = 0.2
    PHASES: Final = {"FL": 0.0, "FR": 0.5, "RL": 0.5, "RR": 0.0}

    scene_address: ClassVar[str] = "sim://quadruped?controller=quadruped=pd,kp=60,kv=2"
    n_observed: ClassVar[int] = 50
    articulations: ClassVar[Sequence[str] | None] = ()  # what a policy needs to know is in `observe`
    actions: ClassVar[Actions | Mapping[str, Actions] | None] = Actions(scale=(0.3, 0.6, 0.8) * 4)  # rad
    memory: ClassVar[Mapping[str, tuple[int, ...]]] = {"velocity": (3,)}

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """See `Task.reset`."""
        start.noise(rng, "quadruped", ResetNoise(hinge=0.05))
        turn = rng.uniform(-np.pi, np.pi)
        start.place("quadruped/trunk", [0.0, 0.0, 0.3], (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)))
        start.goal["command"] = rng.uniform(self.LOW, self.HIGH) * (rng.random() > 0.1)

    def update(self, states: States) -> None:
        """See `Task.update`."""
        mean = states.memory["velocity"]
        mean += 0.04 * (_velocity(_robot(states)) - mean)

    def observe(self, states: States) -> Floats:
        """See `Task.observe`."""
        robot, phase = _robot(states), 2.0 * np.pi * self.STRIDES_PER_S * states.time
        base = [2.0 * robot.linear_velocity, 0.5 * robot.angular_velocity, 5.0 * robot.gravity]
        joints = [3.0 * robot.qpos[:, 7:], 0.1 * robot.qvel[:, 6:], states.last_action]
        clock = np.stack([np.sin(phase), np.cos(phase)], axis=1)
        return np.concatenate([*base, *joints, clock, 3.0 * states.goal["command"]], axis=1)

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        robot, command = _robot(states), states.goal["command"]
        error = _velocity(robot) - command
        followed = np.exp(-_squares(error[:, :2]) / 0.05) + 0.5 * np.exp(-(error[:, 2] ** 2) / 0.1)
        cycle = 2.0 * np.pi * (self.STRIDES_PER_S * states.time[:, None] + np.array([*self.PHASES.values()]))
        lift = self.LIFT_M * np.maximum(np.sin(cycle), 0.0) * command.any(axis=1, keepdims=True)
        strode = 0.5 * np.exp(-_squares(self._feet(states) - lift) / 0.005)
        sway = 1.0 * robot.linear_velocity[:, 2] ** 2 + 0.03 * _squares(robot.angular_velocity[:, :2])
        sway += 2.0 * _squares(robot.gravity[:, :2]) + 0.2 * _squares(robot.qpos[:, 7::3])  # tilt; hips
        change = 0.02 * _squares(states.last_action - states.previous_action)
        return np.where(self.terminated(states), 0.0, np.maximum(followed + strode - sway - change, 0.0))

    def success(self, states: States) -> Bools:
        """See `Task.success`."""
        return np.sqrt(_squares(states.memory["velocity"] - states.goal["command"])) < self.CLOSE

    def _feet(self, states: States) -> Floats:
        """Return how high the feet are above the ground, metres, shape (n, 4)."""
        shins = [f"quadruped/{leg}_calf" for leg in self.PHASES]
        knee = np.stack([states.body_position(shin)[:, 2] for shin in shins], axis=1)
        _, x, y, _ = np.stack([states.body_quaternion(shin) for shin in shins], axis=1).transpose(2, 0, 1)
        return knee - self.SHIN_M * (1.0 - 2.0 * (x**2 + y**2)) - 0.022


def _robot(states: States) -> RobotState:
    return RobotState(states.positions("quadruped"), states.velocities("quadruped"))


def _velocity(robot: RobotState) -> Floats:
    """Return the forward and leftward velocity and the yaw rate, base frame, shape (n, 3)."""
    return np.column_stack([robot.linear_velocity[:, :2], robot.angular_velocity[:, 2]])


def _squares(values: Floats) -> Floats:
    return np.sum(values**2, axis=1)


TASKS: Final[dict[str, type[Task]]] = {
    "urlab/Arm-v0": FixedReach,
    "urlab/Quadruped-v0": Run,
    "urlab/Push-v0": Push,
    "urlab/PushPictures-v0": PushPictures,
    "urlab/Reach-v0": Reach,
    "urlab/Walk-v0": Walk,
}
"""Tasks by their Gymnasium id."""


def register_task(task_id: str, task: type[Task]) -> None:
    """Register a task with Gymnasium, for single, vector and batch environments.

    After `register_task("me/Go-v0", Go)`, there are `gymnasium.make("me/Go-v0")`, `gymnasium.make_vec("me/Go-v0", n)`,
    which starts a server for each environment, and `gymnasium.make_vec("me/Go-v0", n, backend="batch")`.

    Args:
        task_id: The id, such as `me/Go-v0`.
        task: The class, with a `scene_address`; it is made without arguments.

    Raises:
        ValueError: The class is not a task, lacks a scene, or the id already names another one.
        gymnasium.error.Error: The id has another form.
    """
    if not _is_task(task) or not hasattr(task, "scene_address"):
        raise ValueError(f"{task.__name__} must be a subclass of Task with a scene_address")
    if TASKS.get(task_id, task) is not task:
        raise ValueError(f"{task_id!r} already names {TASKS[task_id].__name__}")
    if task_id not in gymnasium.registry:
        gymnasium.register(  # pyright: ignore[reportUnknownMemberType]  # its kwargs are a bare dict
            task_id,
            # A string, so that the specification can be serialised: Minari stores it with its datasets.
            entry_point=f"{__name__}:{make_endless.__name__}",
            vector_entry_point=f"{__name__}:{make_vec.__name__}",
            max_episode_steps=task.max_episode_steps,
            kwargs={"task_id": task_id},
        )
    TASKS[task_id] = task


def task_named(name: str) -> type[Task]:
    """Return a task by its id, or any class by `module:Class`.

    Raises:
        ValueError: There is no such task.
    """
    if name in TASKS:
        return TASKS[name]
    module, colon, attribute = name.partition(":")
    if not colon:
        known = f"There are: {', '.join(TASKS)}; name one of your own as module:Class"
        raise ValueError(f"{name!r} is not a task.{did_you_mean(name, TASKS)} {known}")
    try:
        found = getattr(import_module(module), attribute, None)
    except ImportError as error:
        raise ValueError(f"the module of the task {name!r} cannot be imported: {error}") from error
    if not _is_task(found):
        raise ValueError(f"{attribute!r} in module {module!r} is not a subclass of Task")
    return found


def _is_task(found: object) -> TypeGuard[type[Task]]:
    return isinstance(found, type) and issubclass(found, Task)


def make(task_id: str, address: str | None = None, **options: Any) -> URLabEnv:
    """Make the environment of a task. It creates its own client and closes it.

    Args:
        task_id: Id of the task, or `module:Class`.
        address: Address of the server; by default, a simulated server is started.
        options: Further arguments of `URLabEnv`.

    Raises:
        URLabError: The server cannot be reached or has no articulation.
    """
    task = task_named(task_id)()
    return URLabEnv.connect(address or task.scene_address, task=task, **options)


def make_endless(task_id: str, **options: Any) -> URLabEnv:
    """Make an environment that leaves truncation to Gymnasium: `gymnasium.make(…, max_episode_steps=…)`."""
    return make(task_id, max_episode_steps=sys.maxsize, **options)


def make_vec(
    task_id: str, num_envs: int = 1, backend: Literal["servers", "batch"] = "servers", **options: Any
) -> URLabVectorEnv | URLabBatchEnv:
    """Make the vector environment of a task.

    Args:
        task_id: Id of the task, or `module:Class`.
        num_envs: Number of environments.
        backend: `servers` for one simulated server per environment, `batch` for physics in this process without a
            wire.
        options: Further arguments of `URLabVectorEnv` or `URLabBatchEnv`.

    Raises:
        ValueError: The backend is unknown.
        URLabError: A server cannot be started.
    """
    if backend not in ("servers", "batch"):
        raise ValueError(f"backend must be 'servers' or 'batch', not {backend!r}")
    kind = URLabVectorEnv if backend == "servers" else URLabBatchEnv
    task = task_named(task_id)()
    return kind(task.scene_address, num_envs, task=task, **options)


for _id, _task in [*TASKS.items()]:
    register_task(_id, _task)
