"""The messages of a recording: one struct per schema, as JSON for Foxglove. No I/O.

Messages named `foxglove.*` have the fields of Foxglove's own schemas, so its panels show them without configuration;
those named `urlab.*` are specific to this project and can be plotted there.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

from urlab_client.protocol.base import Floats

_NAN, _PLUS, _MINUS = "NaN", "Infinity", "-Infinity"  # as in protobuf's JSON


Count: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""A number of things, or a number in a row."""


class Time(Struct, frozen=True):
    """A time on the recording's clock."""

    sec: Count
    nsec: Count

    @classmethod
    def of(cls, nanoseconds: int) -> Time:
        return cls(*divmod(nanoseconds, 1_000_000_000))


class Vector3(Struct, frozen=True):
    """Metres, or newtons."""

    x: float
    y: float
    z: float


class Quaternion(Struct, frozen=True):
    """A rotation, scalar last as Foxglove orders it."""

    x: float
    y: float
    z: float
    w: float


EpisodeOutcome = Literal["success", "failure", "discarded"]
"""Outcome of an episode."""


class ArticulationMessage(Struct, kw_only=True, omit_defaults=True):
    """State of one articulation, as the server sent it.

    Attributes:
        timestamp: Time on the recording's clock.
        sim_time: `mjData.time`, seconds.
        sample: Number of the sample; articulations and entities with the same one belong together.
        step: Step counter of the session.
        episode: Number of preceding resets.
        wall_time: The server's UTC clock.
        qpos: Joint positions; the channel's `layout` names the values.
        qvel: Joint velocities.
        set_points: Set-points of the client, before any controller.
        ctrl: `mjData.ctrl`, as applied.
        act: Activations.
        sensors: Readings by name.
    """

    timestamp: Time
    sim_time: float
    sample: Count
    step: Count
    episode: Count
    wall_time: Time
    qpos: list[float]
    qvel: list[float]
    set_points: list[float] = []
    ctrl: list[float] = []
    act: list[float] = []
    sensors: dict[str, list[float]] = {}


class EntityMessage(Struct, kw_only=True, omit_defaults=True):
    """State of one plain entity: position in metres, orientation (w, x, y, z), velocity of the free joint, if any."""

    timestamp: Time
    sim_time: float
    sample: Count
    step: Count
    episode: Count
    position: Annotated[list[float], Meta(min_length=3, max_length=3)]
    orientation: Annotated[list[float], Meta(min_length=4, max_length=4)]
    qvel: Annotated[list[float], Meta(max_length=6)] = []


class JointState(Struct, frozen=True):
    """One hinge or slide joint: radians or metres, and per second."""

    name: str
    position: float
    velocity: float


class JointStates(Struct, frozen=True):
    """All hinge and slide joints by compiled name."""

    timestamp: Time
    joints: list[JointState]


class FrameTransform(Struct, frozen=True):
    """Pose of a frame in another frame."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class FrameTransforms(Struct, frozen=True):
    """Poses of all bodies and recorded cameras in the world."""

    transforms: list[FrameTransform]


class CompressedImage(Struct, frozen=True):
    """A picture as JPEG or PNG."""

    timestamp: Time
    frame_id: str
    data: bytes
    format: str


class RawImage(Struct, frozen=True):
    """A depth picture, metres, as 32-bit floats."""

    timestamp: Time
    frame_id: str
    width: Count
    height: Count
    encoding: str
    step: Count
    data: bytes


class CameraCalibration(Struct, frozen=True):
    """Pinhole parameters of a camera."""

    timestamp: Time
    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: list[float]
    K: list[float]
    R: list[float]
    P: list[float]


class Pose(Struct, frozen=True):
    """A position and an orientation."""

    position: Vector3
    orientation: Quaternion


class Color(Struct, frozen=True):
    """Each component is 0 to 1."""

    r: float
    g: float
    b: float
    a: float


class SolidPrimitive(Struct, frozen=True):
    """A box or an ellipsoid; `size` is the length of each side or axis, metres."""

    pose: Pose
    size: Vector3
    color: Color


class CylinderPrimitive(Struct, frozen=True):
    """A cylinder along z: diameters and length, metres."""

    pose: Pose
    size: Vector3
    bottom_scale: float
    top_scale: float
    color: Color


class ArrowPrimitive(Struct, frozen=True):
    """An arrow along x of its pose: lengths and diameters, metres."""

    pose: Pose
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Color


class TriangleListPrimitive(Struct, frozen=True):
    """A mesh: each three indices of points are a triangle."""

    pose: Pose
    points: list[Vector3]
    color: Color
    colors: list[Color]
    indices: list[Count]


class SceneEntity(Struct, frozen=True):
    """The shapes of one body, in its frame."""

    timestamp: Time
    frame_id: str
    id: str
    frame_locked: bool
    cubes: list[SolidPrimitive]
    spheres: list[SolidPrimitive]
    cylinders: list[CylinderPrimitive]
    triangles: list[TriangleListPrimitive]
    arrows: list[ArrowPrimitive] = []


class SceneEntityDeletion(Struct, frozen=True):
    """Removes what was shown before; type 1 stands for everything."""

    timestamp: Time
    type: int
    id: str


class SceneUpdate(Struct, frozen=True):
    """The geometry of all bodies."""

    deletions: list[SceneEntityDeletion]
    entities: list[SceneEntity]


class ContactMessage(Struct, frozen=True):
    """One contact: metres; the force is the one on the second body, newtons, world frame."""

    body1: str
    body2: str
    geom1: str
    geom2: str
    position: Vector3
    normal: Vector3
    distance: float
    force: Vector3


class ContactsMessage(Struct, frozen=True):
    """Contacts, computed from the recorded state with the client's model."""

    timestamp: Time
    contacts: list[ContactMessage]


class VariedQuantity(Struct, frozen=True):
    """Draws for a quantity by element: factors, offsets or values, according to `by` (`scale`, `add`, `set`)."""

    what: str
    by: str
    drawn: dict[str, list[float]]


class EpisodeMessage(Struct, frozen=True):
    """Randomisation of the episode that begins, and its seed."""

    timestamp: Time
    episode: Count
    seed: Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
    varied: list[VariedQuantity]


class OutcomeMessage(Struct, frozen=True):
    """Outcome of an episode, as marked by the operator; the last message of an episode counts.

    Attributes:
        timestamp: Time on the recording's clock.
        episode: Number of preceding resets.
        outcome: `success`, `failure` or `discarded`.
        goal: Goal of the episode, by name.
    """

    timestamp: Time
    episode: Count
    outcome: EpisodeOutcome
    goal: dict[str, list[float]]


class Transition(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An action of an environment and what came of it, or the start of an episode.

    Attributes:
        actions: Number of actions of the episode so far; 0 at its start.
        action: The action as given to the environment, of all articulations together.
        chosen: Set-points that the action means, by articulation, if it takes effect late. Those applied are in the
            state.
        reward: Reward.
        terminated: Whether it ended the episode.
        truncated: Whether the episode ended for another reason.
        success: Whether the state is a success; None if the task defines none.
        goal: Goal of the episode, by name.
    """

    actions: Count
    action: list[float] = []
    chosen: dict[str, list[float]] = {}
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    success: bool | None = None
    goal: dict[str, list[float]] = {}


class TransitionMessage(Transition, frozen=True, kw_only=True, omit_defaults=True):
    """A transition, and the number of the sample that has the state to which it led."""

    timestamp: Time
    sample: Count


class GapMessage(Struct, frozen=True):
    """Losses since the previous message of this kind, because the file could not be written fast enough."""

    timestamp: Time
    states: Annotated[int, Meta(ge=0, lt=2**32)]
    frames: Annotated[int, Meta(ge=0, lt=2**32)]


_FOXGLOVE = (CameraCalibration, CompressedImage, FrameTransforms, JointStates, RawImage, SceneUpdate)
_URLAB: dict[type[Struct], str] = {
    ArticulationMessage: "urlab.ArticulationState",
    EntityMessage: "urlab.EntityState",
    ContactsMessage: "urlab.Contacts",
    EpisodeMessage: "urlab.Episode",
    GapMessage: "urlab.Gap",
    OutcomeMessage: "urlab.EpisodeOutcome",
    TransitionMessage: "urlab.Transition",
}


def schema_name(kind: type[Struct]) -> str:
    return f"foxglove.{kind.__name__}" if kind in _FOXGLOVE else _URLAB[kind]


def schema_of(kind: type[Struct]) -> bytes:
    """Return the JSON schema of a message, without references, which some readers do not resolve."""
    (whole,), definitions = msgspec.json.schema_components([kind], ref_template="{name}")
    schema = _inlined(whole, definitions)
    schema["title"] = schema_name(kind)
    return msgspec.json.encode(schema)


def _inlined(node: Any, definitions: dict[str, Any]) -> Any:
    if isinstance(node, dict):
        reference: Any = node.get("$ref")  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
        if reference is not None:
            return _inlined(definitions[reference], definitions)
        return {key: _inlined(value, definitions) for key, value in node.items()}  # pyright: ignore[reportUnknownVariableType]
    if isinstance(node, list):
        return [_inlined(item, definitions) for item in node]  # pyright: ignore[reportUnknownVariableType]
    return node


_encode = msgspec.json.Encoder().encode


def encode(message: Struct) -> bytes:
    """Return the message as JSON. Numbers keep their precision; NaN and infinities are written as text."""
    data = _encode(message)
    # msgspec writes null for numbers that JSON cannot represent. A name that contains the word only costs time.
    return _encode(_spelled_out(msgspec.to_builtins(message))) if b"null" in data else data


def _spelled_out(node: Any) -> Any:
    match node:
        case float():
            return node if node - node == 0 else _NAN if node != node else _PLUS if node > 0 else _MINUS  # noqa: PLR0124
        case dict():
            return {key: _spelled_out(value) for key, value in node.items()}  # pyright: ignore[reportUnknownVariableType]
        case list():
            return [_spelled_out(value) for value in node]  # pyright: ignore[reportUnknownVariableType]
        case _:
            return node


def values(array: Floats | None) -> list[float]:
    """Return the numbers of an array; empty for None."""
    return [] if array is None else array.tolist()
