"""The contents of a level: actors and their settings, as plain values.

For `World`, which edits them, `level`, which stores them, and `compile_scene`, which turns them into a model. Positions
are metres and rotations quaternions (x, y, z, w), both in MuJoCo's world frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from typing import Final, Literal

from msgspec import Struct

from urlab_client.server.assets.blueprint import PARENT_CLASS, Blueprint
from urlab_client.server.limits import Limits
from urlab_client.values.rotation import IDENTITY, Quat, Vec3

ORIGIN: Final[Vec3] = (0.0, 0.0, 0.0)
UNIT_SCALE: Final[Vec3] = (1.0, 1.0, 1.0)


class ActorKind(StrEnum):
    """What an actor is."""

    ARTICULATION = "articulation"
    LIGHT = "light"
    STATIC_MESH = "static_mesh"
    MANAGER = "manager"
    REPLAY_MANAGER = "replay_manager"


class Light(Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a light; it shines along the actor's +x.

    Attributes:
        kind: `directional`, `point` or `spot`.
        intensity: In Unreal's unit for that kind; only its ratio to 5000 is used here.
        color: Red, green, blue, linear.
    """

    kind: Literal["directional", "point", "spot"] = "directional"
    intensity: float = 5000.0
    color: Vec3 = (1.0, 1.0, 1.0)


class Mesh(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Shape of a static mesh actor.

    Attributes:
        shape: A primitive of MuJoCo, or `file`.
        size: Half sizes of the primitive, metres, as MJCF's `size`: 3 for box and ellipsoid, radius for sphere,
            radius and half length for capsule and cylinder, half extents in x and y for plane.
        file: Mesh file (STL, OBJ, MSH); absolute in memory, relative to the level file on disk where possible.
        rgba: Colour.
    """

    shape: Literal["box", "sphere", "capsule", "cylinder", "ellipsoid", "plane", "file"]
    size: tuple[float, ...] = ()
    file: str = ""
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.6, 1.0)


class ConversionSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """How a static mesh becomes a MuJoCo body."""

    static: bool = False
    complex_mesh: bool = False
    coacd_threshold: float = 0.05
    driven_by_unreal: bool = False
    friction: Vec3 = (1.0, 1.0, 1.0)


_CLASSES: Final = {
    ActorKind.STATIC_MESH: "StaticMeshActor",
    ActorKind.MANAGER: "AMjManager",
    ActorKind.REPLAY_MANAGER: "MjReplayManager",
}
_LIGHT_CLASSES: Final = {"directional": "DirectionalLight", "point": "PointLight", "spot": "SpotLight"}
_ID_TAG: Final = "URLab.ActorId="


class ActorSettings(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an actor and its entry in a level file have in common.

    Attributes:
        name: Object name, unique in the level; an articulation's key.
        actor_id: Stable id given by the client; may be empty.
        location: Position, metres.
        scale: Factors; 1 for articulations.
        quick_convert: Settings that make a static mesh a body, or None.
        parent: Name of the actor this one is attached to; may be empty.
        controller: An articulation's controller as text, `pd,kp=80`; empty for that of its MJCF.
    """

    name: str
    kind: ActorKind
    label: str = ""
    actor_id: str = ""
    location: Vec3 = ORIGIN
    scale: Vec3 = UNIT_SCALE
    light: Light | None = None
    mesh: Mesh | None = None
    quick_convert: ConversionSettings | None = None
    parent: str = ""
    controller: str = ""


class Actor(ActorSettings, frozen=True, kw_only=True):
    """One actor of a level.

    Attributes:
        rotation: Unit quaternion (x, y, z, w).
        own_tags: Tags besides the one that carries the id.
        blueprint: What an articulation is an instance of.
    """

    rotation: Quat = IDENTITY
    own_tags: tuple[str, ...] = ()
    blueprint: Blueprint | None = None

    @property
    def prefix(self) -> str:
        """Prefix of an articulation's compiled names."""
        return f"{self.name}_"

    @property
    def class_name(self) -> str:
        """Short class name, for example `robot_C` or `PointLight`."""
        if self.blueprint is not None:
            return self.blueprint.class_name
        if self.light is not None:
            return _LIGHT_CLASSES[self.light.kind]
        return _CLASSES[self.kind]

    @property
    def class_path(self) -> str:
        """Class path; of an articulation the one that spawns another instance."""
        return self.blueprint.class_path if self.blueprint is not None else f"/Script/Engine.{self.class_name}"

    @property
    def class_chain(self) -> tuple[str, ...]:
        """The class and its parents."""
        if self.kind is ActorKind.ARTICULATION:
            return (self.class_name, PARENT_CLASS, "Pawn", "Actor", "Object")
        if self.kind is ActorKind.LIGHT:
            return (self.class_name, "Light", "Actor", "Object")
        return (self.class_name, "Actor", "Object")

    @property
    def tags(self) -> tuple[str, ...]:
        """Tags; the id of anything but an articulation is one of them."""
        if self.actor_id and self.kind is not ActorKind.ARTICULATION:
            return (*self.own_tags, f"{_ID_TAG}{self.actor_id}")
        return self.own_tags

    def has_id(self, actor_id: str) -> bool:
        """Whether the actor has this id. Letter case does not count for ids kept as tags, as for Unreal's names."""
        if self.kind is ActorKind.ARTICULATION:
            return self.actor_id == actor_id
        return self.actor_id.casefold() == actor_id.casefold()


def scene_problem(actors: Iterable[Actor], limits: Limits) -> str:
    """Return which limit of a level these actors exceed together, or nothing."""
    blueprints = [actor.blueprint for actor in actors if actor.blueprint is not None]
    n_bytes = sum(blueprint.n_bytes - blueprint.n_asset_bytes + blueprint.n_data_bytes for blueprint in blueprints)
    shared = {blueprint.folder: blueprint.n_asset_bytes for blueprint in blueprints}
    n_bytes += sum(shared.values())
    if n_bytes > limits.scene_bytes:
        return (
            f"the models of the level take {n_bytes} bytes together, more than the limit scene_bytes, "
            f"{limits.scene_bytes} (urlab serve --scene-mib, sim://MODEL?scene-mib=N)"
        )
    n_values = sum(blueprint.n_sensor_values for blueprint in blueprints)
    if n_values > limits.sensor_values:
        return (
            f"the sensors of the level give {n_values} numbers together, more than the limit sensor_values, "
            f"{limits.sensor_values}"
        )
    return ""
