"""Return types of the tools for which the client has no type, and the names that agents see."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

from urlab_client.console.messages import LogEntry
from urlab_client.values.descriptions import ArticulationDescription, Pose
from urlab_client.values.names import owner_of
from urlab_client.values.rotation import Vec3

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient

UNITS = "World frame, z up; metres, seconds, rad, N; quaternions (w, x, y, z)."


def label(client: URLabClient, body: str, geom: str = "") -> str:
    """Return what agents call a compiled body: `ID/BODY`, or the id alone if there is no more than one body.

    Args:
        client: The client.
        body: Compiled name of the body.
        geom: Compiled name of a geom of it, which tells whose it is if the body is the world.
    """
    prefixes = {art.compiled_prefix: art for art in client.articulations.values()}
    name = body if body not in {"", "world"} else geom
    owner = owner_of(name, frozenset(prefixes))
    if owner is None:
        return name or "world"
    art = prefixes[owner]
    return f"{art.actor_id or art.name}/{name[len(owner) + 1 :]}" if len(art.bodies) > 1 else art.actor_id or art.name


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


class HandPose(Struct):
    """A robot's hand: the site or body that `move_hand` moves.

    Attributes:
        robot: Name of the robot.
        hand: Name of the site or body.
        position: Metres.
        quaternion: Orientation (w, x, y, z).
        gripper: Set-point of the gripper, or None if there is none.
        gripper_limits: Range of that set-point.
    """

    robot: str
    hand: str
    position: list[float]
    quaternion: list[float]
    gripper: float | None
    gripper_limits: tuple[float, float] | None


class HandMoved(Struct):
    """A hand after a movement.

    Attributes:
        pose: Its pose.
        error: Distance from the last pose that was asked for, metres.
        reached: Poses reached.
        passed: Simulation time that passed, seconds.
    """

    pose: HandPose
    error: float
    reached: int
    passed: float


class Object(Struct):
    """A body or thing that is not a robot.

    Attributes:
        name: Its id.
        pose: Its pose.
        fixed: Whether it cannot move.
    """

    name: str
    pose: Pose | None
    fixed: bool


class World(Struct):
    """The world.

    Attributes:
        connection: `connected`, or what is missing; then the rest is what was last known.
        units: Frame and units of all poses.
        playing: Whether a play session is running.
        robots: Robots with joints, actuators, sensors and cameras.
        hands: Hands of the robots.
        objects: Everything else that was placed or can move.
        cameras: Names for `picture`.
        models: What `apply_scene` can place.
        keyframes: What `reset` can start from.
        driver: Holder of the controls: `you`, another name, or None.
    """

    connection: str
    units: str
    playing: bool
    robots: list[ArticulationDescription]
    hands: list[HandPose]
    objects: list[Object]
    cameras: list[str]
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


class Touch(Struct):
    """Two bodies that touch.

    Attributes:
        between: Their names.
        position: Metres.
        distance: Metres; negative if they penetrate.
        force: Normal force, N.
    """

    between: tuple[str, str]
    position: Vec3
    distance: float
    force: float


class Contacts(Struct):
    """Bodies that touch.

    Attributes:
        contacts: Where and how they touch.
        truncated: Whether there are more.
    """

    contacts: list[Touch]
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
        objects: Other things in the scene.
    """

    done: str
    robots: list[str]
    objects: list[str]
