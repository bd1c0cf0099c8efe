"""Controllers of the demo's robots: set-points from the simulation time and the robot's state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from urlab_client.aio.model.elements import Actuator, Joint
from urlab_client.cli.robot_file import RobotFile
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import ActuatorType
from urlab_client.server.assets.bundled_robots import bundled_models

__all__ = [
    "NOTHING_DRIVEN",
    "DemoController",
    "DemoRobot",
    "NoController",
    "SineController",
    "TrotController",
    "make_demo_controller",
]


NOTHING_DRIVEN = "0 actuators: nothing is driven"


class DemoRobot(Protocol):
    """The part of an articulation, of either flavour, that a demo controller uses."""

    @property
    def joints(self) -> Mapping[str, Joint]:
        """Joints by name."""
        ...

    @property
    def actuators(self) -> Mapping[str, Actuator]:
        """Actuators by name."""
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


class DemoController(Protocol):
    """Drives one robot."""

    @property
    def settings(self) -> dict[str, object]:
        """The controller's settings, for `run.json`."""
        ...

    def act(self, time: float) -> None:
        """Write the robot's set-points for the next step, `time` seconds into the simulation."""
        ...


def make_demo_controller(robot: RobotFile, articulation: DemoRobot, turn: float = 0.0) -> DemoController:
    """Return a controller: a trot that `turn` steers for the bundled quadruped, a gentle swing for other robots.

    A robot without actuators gets a controller that does nothing.
    """
    if not articulation.actuators:
        return NoController()
    if robot.path == bundled_models()["quadruped"]:
        return TrotController(articulation, turn)
    return SineController(articulation, robot.home_ctrl)


class NoController:
    """Leaves a robot without actuators to gravity."""

    @property
    def settings(self) -> dict[str, object]:
        """See `DemoController.settings`."""
        return {"kind": "none", "reason": NOTHING_DRIVEN}

    def act(self, time: float) -> None:
        """See `DemoController.act`."""


class TrotController:
    """Makes the bundled quadruped trot: diagonal pairs of feet take turns, and torques move the joints.

    A foot moves straight back on the ground and in an arc forward through the air; the leg's two equal links give the
    joint angles in closed form.
    """

    STRIDES_PER_S = 2.0
    STRIDE_M = 0.12
    LIFT_M = 0.05
    ON_GROUND = 0.6
    """Share of a stride that a foot is on the ground."""
    KP = 150.0
    """N m / rad."""
    KD = 4.0
    """N m s / rad."""
    RAMP_S = 0.6
    """Seconds until full stride."""

    LINK_M = 0.2
    BEND = math.pi / 4
    """Slope of both links where the joint angles are zero, radians."""
    LEGS = ("FL", "FR", "RL", "RR")
    PHASES = np.array([0.0, 0.5, 0.5, 0.0])
    SIDES = np.array([-1.0, 1.0, -1.0, 1.0])

    def __init__(self, robot: DemoRobot, turn: float = 0.0) -> None:
        """Control a standing robot.

        Args:
            robot: The bundled quadruped.
            turn: How much longer the strides of the right legs are than average, as a share; positive turns left.
        """
        self._robot = robot
        self._turn = turn
        names = [f"{leg}_{part}" for leg in self.LEGS for part in ("hip", "thigh", "calf")]
        joints = [robot.joints[name] for name in names]
        self._qpos = np.array([joint.qpos_local_offset for joint in joints])
        self._qvel = np.array([joint.qvel_local_offset for joint in joints])
        self._ctrl = np.array([robot.actuators[name].ctrl_local.start for name in names])
        self._strides = self.STRIDE_M * (1 + turn * self.SIDES)
        self._height = 2 * self.LINK_M * math.cos(self.BEND)

    @property
    def settings(self) -> dict[str, object]:
        """See `DemoController.settings`."""
        return {
            "kind": "trot",
            "strides_per_s": self.STRIDES_PER_S,
            "stride_m": self.STRIDE_M,
            "lift_m": self.LIFT_M,
            "kp": self.KP,
            "kd": self.KD,
            "turn": self._turn,
        }

    def act(self, time: float) -> None:
        """See `DemoController.act`."""
        robot = self._robot
        error = self._angles(time) - robot.qpos_array[self._qpos]
        robot.ctrl_array[self._ctrl] = self.KP * error - self.KD * robot.qvel_array[self._qvel]

    def _angles(self, time: float) -> NDArray[np.float64]:
        phase = (time * self.STRIDES_PER_S + self.PHASES) % 1
        grounded = phase < self.ON_GROUND
        # Progress through the part of the stride the leg is in; the arc starts and ends at rest.
        part = np.where(grounded, phase / self.ON_GROUND, (phase - self.ON_GROUND) / (1 - self.ON_GROUND))
        arc = part - np.sin(2 * math.pi * part) / (2 * math.pi)
        share = min(1.0, time / self.RAMP_S)
        x = share * self._strides * np.where(grounded, 0.5 - part, arc - 0.5)
        z = np.where(grounded, 0.0, share * self.LIFT_M * np.sin(math.pi * part) ** 2) - self._height
        slope = np.arctan2(-x, -z)
        bend = np.arccos(np.hypot(x, z) / (2 * self.LINK_M))
        thigh, calf = slope + bend - self.BEND, 2 * (self.BEND - bend)
        return np.column_stack([np.zeros_like(thigh), thigh, calf]).ravel()


class SineController:
    """Moves each actuator gently back and forth within its control range, each with its own phase."""

    HERTZ = 0.5
    SHARE = 0.2
    """Amplitude as a share of half the control range."""
    UNLIMITED = 0.1
    """Amplitude of an actuator without a control range."""
    RAMP_S = 1.0
    """Seconds until the full amplitude."""
    PHASE_STEP = math.pi * (3 - math.sqrt(5))
    """Golden angle: no two actuators are ever in phase."""

    def __init__(self, robot: DemoRobot, centre: Mapping[str, float]) -> None:
        """Control a robot that starts at rest.

        Args:
            robot: The robot.
            centre: Set-point to swing around by actuator name; the others swing around where the robot rests.
        """
        self._robot = robot
        qpos = robot.qpos_array
        count = len(robot.ctrl_array)
        self._centre, self._amplitude, self._phase = np.zeros(count), np.zeros(count), np.zeros(count)
        for index, (name, actuator) in enumerate(robot.actuators.items()):
            low, high = actuator.ctrlrange or (-math.inf, math.inf)
            amplitude = self.UNLIMITED if math.isinf(high - low) else self.SHARE * (high - low) / 2
            joint = robot.joints.get(actuator.joint or "") if actuator.type is ActuatorType.POSITION else None
            rest = 0.0 if joint is None else float(qpos[joint.qpos_local_offset])
            place = actuator.ctrl_local
            self._centre[place] = min(max(centre.get(name, rest), low + amplitude), high - amplitude)
            self._amplitude[place] = amplitude
            self._phase[place] = index * self.PHASE_STEP

    @property
    def settings(self) -> dict[str, object]:
        """See `DemoController.settings`."""
        return {"kind": "sine", "hertz": self.HERTZ, "share_of_range": self.SHARE, "ramp_s": self.RAMP_S}

    def act(self, time: float) -> None:
        """See `DemoController.act`."""
        swing = np.sin(2 * math.pi * self.HERTZ * time + self._phase)
        self._robot.ctrl_array[:] = self._centre + min(1.0, time / self.RAMP_S) * self._amplitude * swing
