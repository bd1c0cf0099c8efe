"""The interface that a policy needs from a robot of either flavour, and the robot's state, single or batched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from urlab_client.aio.controllers import URLabController as AsyncController
from urlab_client.aio.model.elements import Actuator, Joint, Sensor
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import CameraMode, ControlMode
from urlab_client.protocol.pixels import Pixels
from urlab_client.sync.controllers import URLabController

__all__ = ["PolicyCamera", "PolicyRobot", "RobotState"]


class PolicyCamera(Protocol):
    """The interface that a policy needs from a camera of either flavour."""

    @property
    def mode(self) -> CameraMode | str:
        """Meaning of the pixels."""
        ...

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height, pixels."""
        ...

    @property
    def latest_frame(self) -> Pixels | None:
        """Newest picture."""
        ...


class PolicyRobot(Protocol):
    """The interface that a policy needs from an articulation of either flavour."""

    @property
    def prefix(self) -> str:
        """Articulation key."""
        ...

    @property
    def joints(self) -> Mapping[str, Joint]:
        """Joints by name."""
        ...

    @property
    def actuators(self) -> Mapping[str, Actuator]:
        """Actuators by name."""
        ...

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensors by name."""
        ...

    @property
    def controller(self) -> AsyncController | URLabController | None:
        """The controller, or None."""
        ...

    @property
    def control_mode(self) -> ControlMode:
        """Whether the controller is active or bypassed."""
        ...

    @property
    def has_free_base(self) -> bool:
        """Whether the root has a free joint."""
        ...

    @property
    def ctrl_array(self) -> Floats:
        """Set-points, to be written in place."""
        ...

    @property
    def qpos_array(self) -> Floats:
        """Joint positions."""
        ...

    @property
    def qvel_array(self) -> Floats:
        """Joint velocities."""
        ...

    @property
    def cameras(self) -> Mapping[str, PolicyCamera]:
        """Cameras by name."""
        ...

    def get_sensors(self) -> dict[str, Floats]:
        """Readings by sensor name."""
        ...


class RobotState(NamedTuple):
    """The state of one robot or of a batch.

    Attributes:
        qpos: Joint positions in the order of `qpos_array`, shape (…, nq).
        qvel: Joint velocities in the order of `qvel_array`, shape (…, nv).
        sensors: Readings by sensor name, shape (…, dim).
    """

    qpos: Floats
    qvel: Floats
    sensors: Mapping[str, Floats] = {}

    @classmethod
    def of(cls, robot: PolicyRobot) -> RobotState:
        """Return the current state of an articulation."""
        return cls(robot.qpos_array, robot.qvel_array, robot.get_sensors())

    @property
    def gravity(self) -> Floats:
        """Direction of gravity in the base frame, shape (…, 3)."""
        return -self._rotation()[..., 2, :]

    @property
    def linear_velocity(self) -> Floats:
        """Velocity of the base, m/s, base frame, shape (…, 3)."""
        return np.einsum("...ij,...i->...j", self._rotation(), self.qvel[..., :3])

    @property
    def angular_velocity(self) -> Floats:
        """Angular velocity of the base, rad/s, base frame, shape (…, 3)."""
        return self.qvel[..., 3:6]

    def _rotation(self) -> Floats:
        """Return the rotation from the base frame to the world frame, shape (…, 3, 3)."""
        w, x, y, z = np.moveaxis(self.qpos[..., 3:7], -1, 0)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
