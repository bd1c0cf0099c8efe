"""`HandControl`: converts hand velocities to set-points of the joints that move the hand."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np

from urlab_client.aio.arguments import finite
from urlab_client.aio.client import URLabClient as AsyncClient
from urlab_client.errors import URLabError
from urlab_client.integrations.ik import InverseKinematics, Vector, only_robot, own_sites, positive, vector
from urlab_client.protocol.base import Floats
from urlab_client.sync.client import URLabClient

_MAX_LEAD_M: Final = 0.1
"""Largest distance of the target from the hand, so that the target stays close when the hand meets an obstacle."""

_GRIPPER_S: Final = 0.5  # from open to closed
_TOLERANCE_M: Final = 1e-3


class HandControl:
    """Moves a site of a robot (its hand) by velocities in the world frame, and opens and closes the gripper.

    A target moves with the commanded velocity, and inverse kinematics converts its pose to set-points within all
    limits. The target stops at the edge of the workspace, and at most 0.1 m ahead of an obstructed hand. `hold` moves
    the target to the current pose of the hand; call it after a reset.

    Attributes:
        ik: The inverse kinematics.
        key: Key of the articulation.
        gripper: Name of the actuator that opens and closes the gripper, or None.
        speed: Largest speed, m/s.
        turn_speed: Largest angular speed, rad/s.
        set_points: The latest set-points, by actuator name.
        blocked: Whether the target could not follow the last command.
    """

    def __init__(
        self,
        client: URLabClient | AsyncClient,
        articulation: str | None = None,
        *,
        site: str | None = None,
        gripper: str | None = None,
        speed: float = 0.25,
        turn_speed: float = 1.0,
    ) -> None:
        """Set up the control, and hold the hand at its current pose.

        Args:
            client: A client of either flavour after `discover()`, with a local model.
            articulation: Key of the robot; optional if the scene has only one.
            site: Site of the hand; optional if the robot has only one.
            gripper: Actuator of the gripper; by default, the only actuator that does not move the hand, if any.
            speed: Largest speed, m/s.
            turn_speed: Largest angular speed, rad/s.

        Raises:
            KeyError: The articulation, site or actuator does not exist.
            ValueError: A speed is not above 0, the gripper has no range, or no position-controlled joint moves the
                hand.
            URLabError: The client has no local model, or the robot or the site must be named.
        """
        self._robot = only_robot(client, articulation)
        self.key: str = self._robot.prefix
        self.ik: InverseKinematics = InverseKinematics(client, self.key, site=site or _only_site(client, self.key))
        self.speed: float = positive("speed", speed)
        self.turn_speed: float = positive("turn_speed", turn_speed)
        self.blocked: bool = False
        self.set_points: dict[str, float] = {}
        found = self.ik.gripper if gripper is None else self._robot.actuators[gripper]
        if found is not None and found.ctrlrange is None:
            raise ValueError(f"the gripper {found.name!r} has no control range")
        self.gripper: str | None = None if found is None else found.name
        self._range = (found and found.ctrlrange) or (0.0, 0.0)
        self.hold()

    @property
    def target(self) -> tuple[Floats, Floats]:
        """Target pose of the hand: position, metres, and orientation (w, x, y, z), world frame."""
        return self._position.copy(), self._quaternion.copy()

    def hold(self) -> None:
        """Move the target to the current pose of the hand, and set the set-points that keep it there.

        The gripper keeps its set-point.
        """
        self._position, self._quaternion = self.ik.pose()
        self._joints = {name: float(self._robot.joints[name].position) for name in self.ik.joints}
        self._opening = 0.0 if self.gripper is None else self._robot.actuators[self.gripper].value
        self.blocked = False
        self._aim(self._position, self._quaternion)

    def drive(self, linear: Vector, angular: Vector = (0, 0, 0), gripper: float = 0.0, *, dt: float) -> bool:
        """Advance the target, and set the set-points. The next step sends them.

        Args:
            linear: Velocity as a fraction of `speed`, world frame, shape (3,); its length is limited to 1.
            angular: Angular velocity as a fraction of `turn_speed`, about the world axes, shape (3,); its length is
                limited to 1.
            gripper: Rate from -1 (towards the smallest set-point) to 1 (towards the largest).
            dt: Duration of the command, seconds.

        Returns:
            Whether the target could move as commanded. If not, it stays.

        Raises:
            ValueError: A number is NaN or infinite, `dt` is not above 0, or a vector has the wrong length. Nothing
                changed.
        """
        moving, turning = _within_one("linear", linear), _within_one("angular", angular)
        dt, opening = positive("dt", dt), float(np.clip(finite("gripper", gripper), -1.0, 1.0))
        low, high = self._range
        self._opening = float(np.clip(self._opening + opening * dt * (high - low) / _GRIPPER_S, low, high))
        hand, _ = self.ik.pose()
        ahead = self._position + self.speed * dt * moving - hand
        distance = float(np.linalg.norm(ahead))
        position = hand + ahead * min(1.0, _MAX_LEAD_M / distance if distance else 1.0)
        quaternion = _turned(self._quaternion, self.turn_speed * dt * turning)
        self.blocked = not self._aim(position, quaternion)
        return not self.blocked

    def _aim(self, position: Floats, quaternion: Floats) -> bool:
        """Set the set-points for a pose. If it is out of reach, keep the previous ones."""
        found = self.ik.solve(position, quaternion, start=self._joints, starts=1, tolerance=_TOLERANCE_M, nearest=True)
        if found.reached:
            self._position, self._quaternion, self._joints = position, quaternion, found.joints
            self.set_points |= found.set_points
        if self.gripper is not None:
            self.set_points[self.gripper] = self._opening
        self._robot.set_ctrl(self.set_points)
        return found.reached

    def __repr__(self) -> str:
        return f"<HandControl of {self.ik.frame!r} of {self.key!r}>"


def _only_site(client: URLabClient | AsyncClient, key: str) -> str:
    sites = [*own_sites(client, client.articulations[key])]
    if client.model is not None and len(sites) != 1:
        raise URLabError(f"Name the site of the hand of {key!r}: it has {', '.join(sites) or 'none'}.")
    return sites[0] if sites else ""


def _within_one(what: str, values: Vector) -> Floats:
    given = vector(what, values, 3)
    return given / max(1.0, float(np.linalg.norm(given)))


def _turned(quaternion: Floats, turn: Floats) -> Floats:
    """Return an orientation (w, x, y, z) after a rotation about the world axes, rad."""
    angle = float(np.linalg.norm(turn))
    if not angle:
        return quaternion
    turned, rotation = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(rotation, turn / angle, angle)
    mujoco.mju_mulQuat(turned, rotation, quaternion)
    return turned / np.linalg.norm(turned)
