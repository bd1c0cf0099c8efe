"""What `client.describe()` and `articulation.describe()` return: robots as typed, JSON-compatible values."""

from __future__ import annotations

from typing import Literal

from msgspec import Struct

from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Quat, Vec3

JointKind = Literal["free", "ball", "slide", "hinge"]
"""Kind of a joint: six degrees of freedom, three rotations, one translation, or one rotation."""

SetPointMeaning = Literal["force", "position", "velocity", ""]
"""What a set-point of an actuator means: a force, or a target to approach; empty if unknown."""


class Pose(Serializable, Struct, frozen=True, kw_only=True):
    """Pose in the world frame.

    Attributes:
        position: Metres.
        quaternion: Orientation (w, x, y, z).
    """

    position: Vec3
    quaternion: Quat


class JointDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One joint and its state.

    Attributes:
        name: Short name, without the articulation's prefix.
        kind: `hinge`, `slide`, `ball` or `free`.
        unit: `rad` or `m`; empty for joints whose position is not one number.
        limits: (low, high) in that unit, or None if unlimited.
        position: One number; a ball joint has the quaternion (w, x, y, z), a free joint (x, y, z) before it.
        velocity: In the unit per second: one number, three for a ball joint, six for a free joint.
    """

    name: str
    kind: JointKind
    unit: str
    limits: tuple[float, float] | None
    position: float | list[float]
    velocity: float | list[float]


class ActuatorDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One actuator and its set-point.

    Attributes:
        name: Short name, without the articulation's prefix.
        kind: `motor`, `position`, `velocity`, …; None if unknown.
        joint: The joint that it drives, or None for other transmissions.
        takes: What a set-point means: `force`, `position`, `velocity`, or empty if unknown. While a PD
            controller is active, every set-point is a `position`.
        unit: Unit of a set-point; empty if unknown.
        limits: (low, high) of a set-point, or None if unlimited.
        force_limits: (low, high) of the force in N or N m, or None if unlimited.
        gear: Ratio from the actuator's force to that on the joint; None for other transmissions.
        set_point: Set-point that the next step sends.
    """

    name: str
    kind: str | None
    joint: str | None
    takes: SetPointMeaning
    unit: str
    limits: tuple[float, float] | None
    force_limits: tuple[float, float] | None
    gear: float | None
    set_point: float


class SensorDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One sensor and its reading.

    Attributes:
        name: Short name, without the articulation's prefix.
        kind: MJCF element: `accelerometer`, `framepos`, ….
        unit: Unit of its reading; empty for directions, quaternions and sensors of unknown meaning.
        dim: Size of a reading.
        reading: The last reading, or None.
    """

    name: str
    kind: str
    unit: str
    dim: int
    reading: list[float] | None


class CameraDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One camera.

    Attributes:
        name: Name for `step(include_cameras=…)` and `capture()`.
        mode: `real`, `depth`, `semantic` or `instance`.
        width: Pixels.
        height: Pixels.
        fovy: Vertical field of view, degrees.
    """

    name: str
    mode: str
    width: int
    height: int
    fovy: float


class ControllerDescription(Serializable, Struct, frozen=True, kw_only=True):
    """The controller of an articulation.

    Attributes:
        kind: `pd`, or another kind from the server.
        in_force: Whether set-points pass through it, because the control mode is `ue_controller`.
    """

    kind: str
    in_force: bool


class ArticulationDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One robot: its elements, pose and set-points.

    Joints and sensors are known only with a local model.

    Attributes:
        name: Key in `client.articulations`.
        actor_id: Stable id given when it was spawned; empty if none was given.
        free_base: Whether its root has a free joint.
        pose: Pose of its root, or None without a local model.
        joints: Its joints in id order.
        actuators: Its actuators in id order.
        sensors: Its sensors in id order.
        cameras: Its cameras.
        controller: Its controller, or None.
        control_owner: Client that controls it, if known; see `URLabArticulation.control_owner`.
    """

    name: str
    actor_id: str
    free_base: bool
    pose: Pose | None
    joints: list[JointDescription]
    actuators: list[ActuatorDescription]
    sensors: list[SensorDescription]
    cameras: list[CameraDescription]
    controller: ControllerDescription | None
    control_owner: str | None


class EntityDescription(Serializable, Struct, frozen=True, kw_only=True):
    """One dynamic body that is not part of a robot.

    Attributes:
        name: Key in `client.entities`.
        free_base: Whether it has a free joint.
        pose: Its pose, or None without a local model.
    """

    name: str
    free_base: bool
    pose: Pose | None


class SceneDescription(Serializable, Struct, frozen=True, kw_only=True):
    """All robots and other dynamic bodies as of the last reply.

    Attributes:
        address: Address of the server.
        playing: Whether a play session is running, as far as this client knows.
        step_mode: `direct`, `puppet` or `live`.
        sim_time: Simulation time, seconds.
        timestep: Seconds per physics step, or None without a local model.
        articulations: The robots.
        entities: Other dynamic bodies.
        cameras: Cameras of the scene.
    """

    address: str
    playing: bool
    step_mode: str
    sim_time: float
    timestep: float | None
    articulations: list[ArticulationDescription]
    entities: list[EntityDescription]
    cameras: list[CameraDescription]
