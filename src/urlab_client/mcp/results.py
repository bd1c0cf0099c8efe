"""What the tools return, where the client has no type for it."""

from __future__ import annotations

from msgspec import Struct

from urlab_client.protocol.descriptions import Pose, SceneDescription
from urlab_client.protocol.types import Contact
from urlab_client.web.messages import LogEntry

__all__ = ["Contacts", "Done", "Edited", "Log", "Moment", "Picture", "Recorded", "RobotState", "World"]


class Moment(Struct):
    """When a result was made; every result has these fields, too.

    Attributes:
        sim_time: Simulation time, seconds.
        step: Physics steps since the session began or the last reset; not counted in mode `live`.
        mode: `direct`: time passes only while a tool lets it; `live`: time passes by itself unless paused.
    """

    sim_time: float
    step: int
    mode: str


class World(Struct):
    """Everything there is.

    Attributes:
        scene: Robots with joints, actuators, sensors and cameras, and other bodies.
        blueprints: What `spawn` can place.
        models: What `import_model` can turn into a blueprint.
        keyframes: What `reset` can start from.
        driver: Who has the controls: `you`, the name of somebody else, or None.
    """

    scene: SceneDescription
    blueprints: list[str]
    models: list[str]
    keyframes: list[str]
    driver: str | None


class RobotState(Struct):
    """One robot at one moment.

    Attributes:
        robot: Its name.
        pose: Pose of its root, or None where that is not known.
        joints: Position of each joint that has a single one: rad or m.
        velocities: Their velocities: rad/s or m/s.
        set_points: What its actuators are told.
        sensors: Readings by name.
    """

    robot: str
    pose: Pose | None
    joints: dict[str, float]
    velocities: dict[str, float]
    set_points: dict[str, float]
    sensors: dict[str, list[float]]


class Done(Struct):
    """What became of a call that changed something.

    Attributes:
        done: In words.
        passed: Simulation time that passed, seconds.
    """

    done: str
    passed: float = 0.0


class Picture(Struct):
    """What comes beside an image.

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
        next: Pass it as `since` to go on from here.
    """

    entries: list[LogEntry]
    next: int


class Recorded(Struct):
    """A recording. What is in it is known when it has ended.

    Attributes:
        name: Name of the MCAP file in the folder for recordings.
        running: Whether it goes on.
        seconds: Its length, simulation time.
        robots: Robots in it.
        cameras: Cameras in it.
        lost: States and pictures that came too fast to be written.
    """

    name: str
    running: bool = False
    seconds: float = 0.0
    robots: list[str] = []
    cameras: list[str] = []
    lost: int = 0


class Edited(Struct):
    """A scene after an edit; play began anew.

    Attributes:
        done: In words.
        robots: Robots there are now.
        bodies: Other bodies there are now.
    """

    done: str
    robots: list[str]
    bodies: list[str]
