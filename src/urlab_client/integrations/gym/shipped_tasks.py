"""Tasks on the bundled robots: reach a target, push a block, follow a velocity, and two tasks with a fixed goal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations.gym.spaces import SpaceMode
from urlab_client.integrations.gym.starts import ResetNoise
from urlab_client.integrations.gym.task import Start, States, Task
from urlab_client.protocol.base import Floats

Bools = NDArray[np.bool_]

FALLEN_M: Final = 0.15
"""Height of the trunk below which the quadruped has fallen, metres."""

UPRIGHT: Final = 0.5
"""Cosine of the tilt below which the quadruped has fallen."""


class FixedReach(Task):
    """The arm holds its hand at the fixed target `TARGET_M`. The reward is the negative distance in metres."""

    TARGET_M: Final = np.array([0.35, 0.2, 0.4])

    scene_address: ClassVar[str] = "sim://arm"
    observations: ClassVar[str | Sequence[str]] = "standard"
    reset_noise: ClassVar[float | ResetNoise] = 0.05

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        return -np.linalg.norm(states.site_position("arm/grip") - self.TARGET_M, axis=1)


class Run(Task):
    """The torque-controlled quadruped runs along +x as fast as it can. The episode terminates when it falls.

    The reward is the speed of the trunk in m/s, plus 0.5 while standing, minus a penalty on the torques.
    """

    scene_address: ClassVar[str] = "sim://quadruped"
    observations: ClassVar[str | Sequence[str]] = "standard"
    max_episode_steps: ClassVar[int | None] = 500
    reset_noise: ClassVar[float | ResetNoise] = 0.05

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        torques = self.scene.mapping.set_points(actions)["quadruped"]
        return states.velocities("quadruped")[:, 0] + 0.5 - 2e-4 * np.sum(torques**2, axis=1)

    def terminated(self, states: States) -> Bools:
        """See `Task.terminated`."""
        return _fallen(states)


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


class Walk(Task):
    """The quadruped follows a velocity command (forward, left and yaw rate), drawn for each episode.

    Actions are joint targets of its PD controller. Observations add the command, m/s and rad/s, base frame, to the
    positions and velocities. The reward, between 0 and 1.5, measures how closely the robot follows the command. The
    episode terminates when the robot falls. Success means that the velocity error is below `CLOSE`.
    """

    LOW: Final = np.array([-0.2, -0.1, -0.4])
    HIGH: Final = np.array([0.6, 0.1, 0.4])
    CLOSE: Final = 0.2

    scene_address: ClassVar[str] = "sim://quadruped?controller=quadruped=pd,kp=60,kv=2"
    n_observed: ClassVar[int] = 3
    max_episode_steps: ClassVar[int | None] = 500

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        """See `Task.reset`."""
        start.noise(rng, "quadruped", ResetNoise(hinge=0.05))
        turn = rng.uniform(-np.pi, np.pi)
        start.place("quadruped/trunk", [0.0, 0.0, 0.3], (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)))
        start.goal["command"] = rng.uniform(self.LOW, self.HIGH)

    def observe(self, states: States) -> Floats:
        """See `Task.observe`."""
        return states.goal["command"]

    def reward(self, states: States, actions: Any) -> Floats:
        """See `Task.reward`."""
        error = self._moves(states) - states.goal["command"]
        followed = np.exp(-np.sum(error[:, :2] ** 2, axis=1) / 0.1) + 0.5 * np.exp(-(error[:, 2] ** 2) / 0.1)
        return np.where(self.terminated(states), 0.0, followed)

    def terminated(self, states: States) -> Bools:
        """See `Task.terminated`."""
        return _fallen(states)

    def success(self, states: States) -> Bools:
        """See `Task.success`."""
        return np.linalg.norm(self._moves(states) - states.goal["command"], axis=1) < self.CLOSE

    def _moves(self, states: States) -> Floats:
        """Return the forward and leftward velocity and the yaw rate, base frame, shape (n, 3)."""
        w, x, y, z = states.body_quaternion("quadruped/trunk").T
        heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))
        velocity = states.velocities("quadruped")  # free joint: linear in the world frame, angular in the body frame
        ahead = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
        left = velocity[:, 1] * np.cos(heading) - velocity[:, 0] * np.sin(heading)
        return np.stack([ahead, left, velocity[:, 5]], axis=1)


def _fallen(states: States) -> Bools:
    _, x, y, _ = states.body_quaternion("quadruped/trunk").T
    height = states.body_position("quadruped/trunk")[:, 2]
    return (height < FALLEN_M) | (1.0 - 2.0 * (x**2 + y**2) < UPRIGHT)
