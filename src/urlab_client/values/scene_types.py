"""Values of authoring and of the outliner: assets, blueprints, what was spawned, actors. Positions are metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from msgspec import Struct

from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Quat, Vec3

A_co = TypeVar("A_co", covariant=True)


class HasArticulations(Protocol[A_co]):
    """A client of either flavour."""

    @property
    def articulations_by_id(self) -> Mapping[str, A_co]:
        """Articulations by id."""
        ...


class URLabAsset(Serializable, Struct):
    """One robot to place with `scene.apply_scene`.

    Attributes:
        actor_id: Stable id of the actor.
        xml: Absolute path of the MJCF file on the server's machine.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w); wins over `rotation_euler`.
        rotation_euler: (roll, pitch, yaw) in degrees, Unreal's rotator convention.
        scale: Scale factors.
    """

    actor_id: str
    xml: str
    location: Sequence[float] = (0, 0, 0)
    rotation_quat: Sequence[float] | None = None
    rotation_euler: Sequence[float] | None = None
    scale: Sequence[float] = (1, 1, 1)


class URLabBlueprint(Serializable, Struct, frozen=True):
    """An imported MJCF, ready for `scene.spawn_actor`.

    Attributes:
        class_path: Class path, for example `/Game/MuJoCoImports/robot.robot_C`.
        short_name: Asset name.
        imported_now: True if this call made it, False if it existed.
    """

    class_path: str
    short_name: str
    imported_now: bool


class URLabSpawnHandle(Serializable, Struct, frozen=True):
    """A placed actor.

    Attributes:
        actor_id: Stable id given by the client.
        actor_name: Engine actor name; the articulation key once play runs.
        actor_path: Full object path.
        blueprint_class_path: Class path it was made from.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        was_existing: True if an existing actor was moved.
        requires_pie_restart: True if the running play session does not show it yet.
    """

    actor_id: str
    actor_name: str
    actor_path: str
    blueprint_class_path: str
    location: Vec3 = (0.0, 0.0, 0.0)
    rotation_quat: Quat = (0.0, 0.0, 0.0, 1.0)
    was_existing: bool = False
    requires_pie_restart: bool = False

    def runtime(self, client: HasArticulations[A_co]) -> A_co | None:
        """Return this actor's articulation in `client`, or None before play or while it is not part of it."""
        return client.articulations_by_id.get(self.actor_id)


class URLabLightHandle(Serializable, Struct, frozen=True):
    """A placed light.

    Attributes:
        actor_id: Stable id given by the client; may be empty.
        actor_name: Engine actor name.
        actor_path: Full object path.
        kind: `directional`, `point` or `spot`.
        intensity: In Unreal's unit for that kind.
        color: Red, green, blue in [0, 1].
        location: Position in the world frame, metres.
        rotation_euler: (roll, pitch, yaw), degrees, Unreal frame.
        requires_pie_restart: True if the running play session does not show it yet.
    """

    actor_id: str
    actor_name: str
    actor_path: str
    kind: str
    intensity: float
    color: Vec3
    location: Vec3
    rotation_euler: Vec3
    requires_pie_restart: bool


class ActorInfo(Serializable, Struct, frozen=True):
    """One actor of the world.

    Attributes:
        name: Engine actor name.
        actor_class: Short class name.
        actor_id: Stable id; empty if none.
        is_articulation: True for actors made from MJCF.
        has_quick_convert: True if it becomes a MuJoCo body through Quick Convert.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        is_static_mesh_actor: True for plain meshes.
        is_light: True for lights.
        static: Quick Convert: the body is fixed.
        complex_mesh: Quick Convert: convex decomposition.
        coacd_threshold: Quick Convert: concavity threshold.
        driven_by_unreal: Quick Convert: mocap body that follows the actor.
        friction: Quick Convert: sliding, torsional, rolling.
        label: Display name.
        tags: Actor tags, where the op reports them.
    """

    name: str
    actor_class: str
    actor_id: str
    is_articulation: bool
    has_quick_convert: bool
    location: Vec3
    rotation_quat: Quat
    is_static_mesh_actor: bool = False
    is_light: bool = False
    static: bool | None = None
    complex_mesh: bool | None = None
    coacd_threshold: float | None = None
    driven_by_unreal: bool | None = None
    friction: Vec3 | None = None
    label: str = ""
    tags: tuple[str, ...] = ()


class BlueprintInfo(
    Serializable,
    Struct,
    frozen=True,
    rename={"class_path": "blueprint_class_path", "short_name": "blueprint_short_name"},
):
    """One articulation blueprint of the project.

    Attributes:
        class_path: Class path for `scene.spawn_actor`.
        short_name: Asset name.
        package_path: Package path.
        parent_class: Short name of the parent class.
    """

    class_path: str
    short_name: str
    package_path: str
    parent_class: str


class SceneActor(Serializable, Struct, frozen=True):
    """One actor of a snapshot.

    Attributes:
        name: Engine actor name.
        label: Display name.
        actor_class: Short class name.
        actor_id: Stable id; empty if none.
        location: Position in the world frame, metres.
        rotation_quat: Unit quaternion (x, y, z, w), MuJoCo's world frame.
        tags: Actor tags.
        is_articulation: True for actors made from MJCF.
        joints: Joint names; empty strings from a plugin outside play.
        actuators: Actuator names.
        sensors: Sensor names.
        cameras: Camera names.
    """

    name: str
    label: str
    actor_class: str
    actor_id: str
    location: Vec3
    rotation_quat: Quat
    tags: tuple[str, ...] = ()
    is_articulation: bool = False
    joints: tuple[str, ...] = ()
    actuators: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()


class SceneSnapshot(Serializable, Struct, frozen=True):
    """Every visible actor with articulation metadata.

    Attributes:
        actors: The actors.
        in_pie: True when they come from the play world.
        level_path: Package path of the world shown.
    """

    actors: list[SceneActor]
    in_pie: bool
    level_path: str


class ActorHierarchyNode(Serializable, Struct, frozen=True, rename={"actor_class": "class"}):
    """An actor and the actors attached to it.

    Attributes:
        name: Engine actor name.
        actor_class: Short class name.
        location: Position in the world frame, metres.
        children: Attached actors.
    """

    name: str
    actor_class: str
    location: Vec3
    children: list[ActorHierarchyNode]


class ActorBounds(Serializable, Struct, frozen=True):
    """Axis-aligned box in the world frame, metres.

    Attributes:
        actor_name: Engine actor name.
        min: Lower corner.
        max: Upper corner.
        center: Midpoint.
        extents: Half sizes.
    """

    actor_name: str
    min: Vec3
    max: Vec3
    center: Vec3
    extents: Vec3
