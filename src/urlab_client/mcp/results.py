"""Return types of the tools for which the client has no type."""

from __future__ import annotations

from msgspec import Struct

from urlab_client.console.messages import LogEntry
from urlab_client.values.descriptions import Pose, SceneDescription
from urlab_client.values.types import Contact


class Moment(Struct):
    """Time of a result; every result also has these fields.

    Attributes:
        sim_time: Simulation time, seconds.
        step: Physics steps since the session began or the last reset; not counted in mode `live`.
        mode: `direct`: time passes only while a tool steps; `live`: time passes automatically unless paused.
    """

    sim_time: float
    step: int
    mode: str


class World(Struct):
    """The world.

    Attributes:
        scene: Robots with joints, actuators, sensors and cameras, and other bodies.
        blueprints: What `spawn` can place.
        models: What `import_model` can turn into a blueprint.
        keyframes: What `reset` can start from.
        driver: Holder of the controls: `you`, another name, or None.
    """

    scene: SceneDescription
    blueprints: list[str]
    models: list[str]
    keyframes: list[str]
    driver: str | None


class RobotState(Struct):
    """One robot at one moment.

    Attributes:
        robot: Name of the robot.
        pose: Pose of its root, or None if unknown.
        joints: Positions of hinge and slide joints: rad or m.
        velocities: Velocities of these joints: rad/s or m/s.
        set_points: Set-points of its actuators.
        sensors: Readings by name.
    """

    robot: str
    pose: Pose | None
    joints: dict[str, float]
    velocities: dict[str, float]
    set_points: dict[str, float]
    sensors: dict[str, list[float]]


class Done(Struct):
    """Result of a call that changed something.

    Attributes:
        done: Description of what was done.
        passed: Simulation time that passed, seconds.
    """

    done: str
    passed: float = 0.0


class Picture(Struct):
    """Description of an image.

    Attributes:
        camera: `ROBOT/CAMERA`, or a camera of the scene.
        kind: `real`, `depth` (near is bright), `semantic` or `instance`.
    """

    camera: str
    kind: str


class Contacts(Struct):
    """Bodies that touch.

    Attributes:
        contacts: Forces are in N and N m in the contact's frame, the first along its normal.
        truncated: Whether there are more.
    """

    contacts: list[Contact]
    truncated: bool


class Log(Struct):
    """Calls, errors and events.

    Attributes:
        entries: Newest last; `at` is Unix time.
        next: Pass this as `since` to continue from here.
    """

    entries: list[LogEntry]
    next: int


class Recorded(Struct):
    """A recording. Its contents are known when it has ended.

    Attributes:
        name: Name of the MCAP file in the folder for recordings.
        running: Whether it is in progress.
        seconds: Duration in simulation time.
        robots: Robots in it.
        cameras: Cameras in it.
        lost: States and pictures that arrived too fast to be written.
    """

    name: str
    running: bool = False
    seconds: float = 0.0
    robots: list[str] = []
    cameras: list[str] = []
    lost: int = 0


class Edited(Struct):
    """The scene after an edit, which restarted play.

    Attributes:
        done: Description of what was done.
        robots: Robots in the scene.
        bodies: Other bodies in the scene.
    """

    done: str
    robots: list[str]
    bodies: list[str]
