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
    """Time of a result, whose fields every result also has.

    `step` counts physics steps since the session began or the last reset, and none in `mode` `live`.
    """

    sim_time: float
    step: int
    mode: str


class HandPose(Struct):
    """A robot's hand: the site or body that `move_hand` moves. `gripper` is its set-point, None without a gripper."""

    robot: str
    hand: str
    position: list[float]
    quaternion: list[float]
    gripper: float | None
    gripper_limits: tuple[float, float] | None


class HandMoved(Struct):
    """A hand after a movement. `error` is the distance from the last pose asked for, `reached` counts poses."""

    pose: HandPose
    error: float
    reached: int
    passed: float


class Object(Struct):
    """A body or thing that is not a robot; `fixed` if it cannot move."""

    name: str
    pose: Pose | None
    fixed: bool


class World(Struct):
    """The world. Without a connection, `connection` says what is missing, and the rest is what was last known.

    `cameras` are names for `picture`, `models` what `apply_scene` can place, `keyframes` what `reset` can start from.
    `driver` has the controls: `you`, another name, or None.
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
    """One robot at one moment: hinge and slide joints in rad or m and per second; `pose` is that of its root."""

    robot: str
    pose: Pose | None
    joints: dict[str, float]
    velocities: dict[str, float]
    set_points: dict[str, float]
    sensors: dict[str, list[float]]


class Done(Struct):
    """Result of a call that changed something; `passed` is the simulation time that passed, seconds."""

    done: str
    passed: float = 0.0


class Picture(Struct):
    """Description of an image of `ROBOT/CAMERA` or a camera of the scene; its `kind` is the camera's mode."""

    camera: str
    kind: str


class Touch(Struct):
    """Two bodies that touch: `distance` is negative if they penetrate, `force` the normal force, N."""

    between: tuple[str, str]
    position: Vec3
    distance: float
    force: float


class Contacts(Struct):
    """Bodies that touch; `truncated` if there are more."""

    contacts: list[Touch]
    truncated: bool


class Log(Struct):
    """Calls, errors and events, newest last; `since=next` continues from here."""

    entries: list[LogEntry]
    next: int


class Recorded(Struct):
    """A recording, whose contents are known when it has ended. `seconds` is simulation time.

    `lost` counts states and pictures that arrived too fast to be written.
    """

    name: str
    running: bool = False
    seconds: float = 0.0
    robots: list[str] = []
    cameras: list[str] = []
    lost: int = 0


class Edited(Struct):
    """The scene after an edit, which restarted play."""

    done: str
    robots: list[str]
    objects: list[str]
