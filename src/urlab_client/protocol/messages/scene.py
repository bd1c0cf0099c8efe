"""Ops of `client.scene`: editor-time authoring of levels and actors."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from msgspec import Struct, field

from urlab_client.protocol.base import (
    EDITOR_TIMEOUT_S,
    ActorId,
    ActorTarget,
    Color,
    Effect,
    EulerDeg,
    Location,
    Op,
    QuatXYZW,
    Reply,
    Request,
    RequiresPieRestart,
    TargetBy,
    doc,
)
from urlab_client.values.plain import Serializable
from urlab_client.values.rotation import Vec3
from urlab_client.values.scene_types import ActorHierarchyNode


class LevelReply(Reply, kw_only=True):
    """Reply of the ops that name a level."""

    level_path: Annotated[str, doc("Package path, for example `/Game/Levels/lab`.")]


class ImportXmlOk(Reply, tag="import_xml_ok", kw_only=True):
    """The blueprint made from the file."""

    blueprint_class_path: Annotated[str, doc("Class path for `spawn_actor`.")]
    blueprint_short_name: Annotated[str, doc("Asset name: the file's stem.")]
    imported_now: Annotated[bool, doc("False if an existing blueprint was reused.")]


class ImportXml(Request[ImportXmlOk], tag="import_xml", kw_only=True):
    """Import an MJCF file on the server's disk as an articulation blueprint."""

    path: Annotated[str, doc("MJCF file on the server's machine; absolute paths are safest.")]
    force_reimport: Annotated[bool, doc("Replace an existing blueprint of the same file stem.")] = False


class CreateLevelOk(LevelReply, tag="create_level_ok", kw_only=True):
    """The new level, open and saved."""


class CreateLevel(Request[CreateLevelOk], tag="create_level", kw_only=True):
    """Create an empty level, open it and save it.

    The level has no manager actor yet; `ensure_manager` adds the one that a play session needs.
    """

    name: Annotated[str, doc("Short name, or a package or object path that starts with `/Game/`.")]
    force_overwrite: Annotated[bool, doc("Replace an existing level of that name.")] = False


class LoadLevelOk(LevelReply, tag="load_level_ok", kw_only=True):
    """The level that was opened."""


class LoadLevel(Request[LoadLevelOk], tag="load_level", kw_only=True):
    """Open an existing level. Unsaved edits of the current level are lost."""

    name_or_path: Annotated[str, doc("Short name, or a package or object path that starts with `/Game/`.")] = field(
        name="level_path"
    )


class SaveLevelOk(LevelReply, tag="save_level_ok", kw_only=True):
    """The level that was saved."""


class SaveLevel(Request[SaveLevelOk], tag="save_level", kw_only=True):
    """Save the open level."""


class CurrentLevelOk(LevelReply, tag="current_level_ok", kw_only=True):
    """The open level."""


class CurrentLevel(Request[CurrentLevelOk], tag="current_level", kw_only=True):
    """Return the package path of the open level; during play this is still the edited level."""


class EnsureManagerOk(Reply, tag="ensure_manager_ok", kw_only=True):
    """The level's manager actor."""

    actor_name: Annotated[str, doc("Name of the manager actor.")]
    actor_path: Annotated[str, doc("Full object path.")]
    was_existing: Annotated[bool, doc("True if the level already had one.")]


class EnsureManager(Request[EnsureManagerOk], tag="ensure_manager", kw_only=True):
    """Ensure that the level has one manager actor, without which play never becomes ready.

    Returns whether the level already had one.
    """


class SpawnActorOk(Reply, tag="spawn_actor_ok", kw_only=True):
    """The placed actor."""

    actor_id: ActorId
    actor_name: Annotated[str, doc("Engine actor name; becomes the articulation key.")]
    actor_path: Annotated[str, doc("Full object path.")]
    blueprint_class_path: Annotated[str, doc("Class path after expansion.")]
    location: Annotated[Vec3, doc("Wrong in the plugin (divided by 100, y negated); use the sent location.")]
    rotation_quat: QuatXYZW
    was_existing: Annotated[bool, doc("True if an existing actor was moved.")]
    requires_pie_restart: RequiresPieRestart


class SpawnActor(Request[SpawnActorOk], tag="spawn_actor", kw_only=True):
    """Place an instance of a blueprint in the edited level, or move the actor that has the id."""

    blueprint: Annotated[str, doc("Blueprint, or its package or class path.")]
    actor_id: ActorId = ""
    location: Location = (0.0, 0.0, 0.0)
    rotation_quat: QuatXYZW | None = None
    rotation_euler: EulerDeg | None = None
    scale: Annotated[Vec3, doc("Scale factors.")] = (1.0, 1.0, 1.0)


class GridCell(Serializable, Struct, kw_only=True):
    """One actor of a grid."""

    actor_id: ActorId
    actor_name: Annotated[str, doc("Engine actor name.")]
    actor_path: Annotated[str, doc("Full object path.")]
    was_existing: Annotated[bool, doc("True if an existing actor was moved.")]
    location: Location


class SpawnGridOk(Reply, tag="spawn_grid_ok", kw_only=True):
    """The placed actors."""

    count: Annotated[int, doc("Number of actors.")]
    blueprint_class_path: Annotated[str, doc("Class path after expansion.")]
    actors: Annotated[list[GridCell], doc("One entry per cell, x fastest.")]
    requires_pie_restart: RequiresPieRestart


class SpawnGrid(Request[SpawnGridOk], tag="spawn_grid", kw_only=True):
    """Place a grid of actors in one request; at most 1024 cells."""

    blueprint: Annotated[str, doc("Blueprint, or its package or class path.")]
    base_actor_id: Annotated[str, doc("Cell (i, j) gets the id `<base>_<i>_<j>`.")]
    count_x: Annotated[int, doc("Cells along x.")]
    count_y: Annotated[int, doc("Cells along y.")]
    spacing: Annotated[Vec3, doc("Distance between cells, metres; z is ignored.")] = (1.0, 1.0, 0.0)
    origin: Annotated[Vec3, doc("Position of cell (0, 0), metres, world frame.")] = (0.0, 0.0, 0.0)
    rotation_quat: QuatXYZW | None = None
    rotation_euler: EulerDeg | None = None
    scale: Annotated[Vec3, doc("Scale factors.")] = (1.0, 1.0, 1.0)


class SpawnLightOk(Reply, tag="spawn_light_ok", kw_only=True):
    """The placed light."""

    actor_id: ActorId
    actor_name: Annotated[str, doc("Engine actor name.")]
    actor_path: Annotated[str, doc("Full object path.")]
    kind: Annotated[str, doc("`directional`, `point` or `spot`.")]
    intensity: Annotated[float, doc("As requested.")]
    color: Color
    location: Location
    rotation_euler: EulerDeg | None = None
    requires_pie_restart: RequiresPieRestart


class SpawnLight(Request[SpawnLightOk], tag="spawn_light", kw_only=True):
    """Place a light. Each call adds one."""

    kind: Annotated[str, doc("`directional`, `point` or `spot`.")] = "directional"
    actor_id: ActorId = ""
    location: Location = (0.0, 0.0, 0.0)
    rotation_euler: EulerDeg = (0.0, 0.0, 0.0)
    intensity: Annotated[float, doc("Intensity in Unreal's unit for that kind of light.")] = 5000.0
    color: Color = (1.0, 1.0, 1.0)


class DestroyActorOk(Reply, tag="destroy_actor_ok", kw_only=True):
    """The actor was removed from the edited level."""

    requires_pie_restart: RequiresPieRestart


class DestroyActor(Request[DestroyActorOk], tag="destroy_actor", kw_only=True):
    """Remove an actor from the edited level."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


class RemoveActorOk(Reply, tag="remove_actor_ok", kw_only=True):
    """The actor was removed from the edited level."""

    requires_pie_restart: RequiresPieRestart


class RemoveActor(Request[RemoveActorOk], tag="remove_actor", kw_only=True):
    """Remove an actor from the edited level; the beta's name for `destroy_actor`."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


class DestroyAssetOk(Reply, tag="destroy_asset_ok", kw_only=True):
    """The asset no longer exists."""

    asset_path: Annotated[str, doc("As requested.")]
    was_found: Annotated[bool, doc("False if the asset did not exist.")]


class DestroyAsset(Request[DestroyAssetOk], tag="destroy_asset", kw_only=True):
    """Delete an asset by object path, and return whether it existed."""

    asset_path: Annotated[str, doc("Object path with the name repeated: `/Game/Levels/lab.lab`.")]


class SetActorTransformOk(Reply, tag="set_actor_transform_ok", kw_only=True):
    """The actor was moved."""

    actor_name: Annotated[str, doc("Engine actor name.")]
    requires_pie_restart: RequiresPieRestart


class SetActorTransform(Request[SetActorTransformOk], tag="set_actor_transform", kw_only=True):
    """Move an actor of the edited level. Omitted parts of the transform do not change."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"
    location: Location | None = None
    rotation_quat: QuatXYZW | None = None
    rotation_euler: EulerDeg | None = None


class DuplicateActorOk(Reply, tag="duplicate_actor_ok", kw_only=True):
    """The copy."""

    actor_id: ActorId
    actor_name: Annotated[str, doc("Engine actor name of the copy.")]
    actor_path: Annotated[str, doc("Full object path.")]
    blueprint_class_path: Annotated[str, doc("Class path.")]


class DuplicateActor(Request[DuplicateActorOk], tag="duplicate_actor", kw_only=True):
    """Spawn another instance of an actor's class with the same rotation and scale."""

    target: ActorTarget
    new_actor_id: Annotated[str, doc("Id of the copy; an existing id moves that actor.")]
    target_by: TargetBy = "actor_id"
    location: Annotated[Vec3 | None, doc("Position of the copy, metres; default 1 m along x from the source.")] = None


class ActorHierarchyOk(Reply, tag="actor_hierarchy_ok", kw_only=True):
    """The tree."""

    root: Annotated[ActorHierarchyNode, doc("The requested actor.")]


class ActorHierarchy(Request[ActorHierarchyOk], tag="actor_hierarchy", kw_only=True):
    """Return the tree of actors attached to an actor. A robot is a single node."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


class UrlabBlock(Serializable, Struct, kw_only=True):
    """Articulation metadata of a snapshot row."""

    mj_class: Annotated[str, doc("Always `articulation`.")]
    joints: Annotated[list[str], doc("Joint names; the plugin leaves them empty outside play.")]
    actuators: Annotated[list[str], doc("Actuator names.")]
    sensors: Annotated[list[str], doc("Sensor names.")]
    cameras: Annotated[list[str], doc("Camera names.")]


class SnapshotRow(Serializable, Struct, kw_only=True, omit_defaults=True):
    """One actor of a snapshot."""

    name: Annotated[str, doc("Engine actor name.")]
    label: Annotated[str, doc("Display name.")]
    actor_class: Annotated[str, doc("Short class name.")] = field(name="class")
    actor_id: ActorId
    location: Location
    rotation_quat: QuatXYZW
    tags: Annotated[list[str], doc("Actor tags.")]
    urlab: Annotated[UrlabBlock | None, doc("Metadata, on articulations only.")] = None


class SnapshotOk(Reply, tag="snapshot_ok", kw_only=True):
    """Every visible actor."""

    actors: Annotated[list[SnapshotRow], doc("One row per actor.")]
    in_pie: Annotated[bool, doc("True if the rows are from the play world.")]
    level_path: Annotated[str, doc("Package path of the world shown.")]


class Snapshot(Request[SnapshotOk], tag="snapshot", kw_only=True):
    """Describe every visible actor with articulation metadata."""


_editor_op = partial(Op, ns="scene", timeout=EDITOR_TIMEOUT_S)

OPS: Final = (
    _editor_op(request=ImportXml, job=True, timeout=120.0, errors=("import_failed",)),
    _editor_op(request=CreateLevel, job=True, errors=("create_level_failed",), generated=True, positional=1),
    _editor_op(request=LoadLevel, job=True, errors=("load_level_failed",), generated=True, positional=1),
    _editor_op(request=SaveLevel, job=True, errors=("save_level_failed",), generated=True),
    _editor_op(
        request=CurrentLevel,
        effect=Effect.READ,
        errors=("not_in_editor", "no_world"),
        generated=True,
        returns="level_path",
    ),
    _editor_op(
        request=EnsureManager,
        errors=("not_in_editor", "no_world", "spawn_failed"),
        generated=True,
        returns="was_existing",
    ),
    _editor_op(request=SpawnActor, job=True, errors=("spawn_failed",)),
    _editor_op(request=SpawnGrid, job=True, timeout=60.0, errors=("invalid_count", "too_many_cells", "spawn_failed")),
    _editor_op(
        request=SpawnLight,
        job=True,
        errors=("spawn_failed",),
        declares=(
            "op:string",
            "actor_id:string",
            "actor_name:string",
            "actor_path:string",
            "kind:string",
            "intensity:float",
            "color:array",
            "location:array",
            "requires_pie_restart:bool",
        ),
    ),
    _editor_op(request=DestroyActor, errors=("destroy_failed",), dialects=("alpha",)),
    _editor_op(request=RemoveActor, errors=("destroy_failed",), dialects=("beta",), job=True),
    _editor_op(
        request=DestroyAsset, errors=("destroy_asset_failed",), generated=True, returns="was_found", positional=1
    ),
    _editor_op(
        request=SetActorTransform,
        errors=("set_actor_transform_failed",),
        generated=True,
        positional=1,
        declares=("op:string", "target:string", "actor_name:string", "requires_pie_restart:bool"),
    ),
    _editor_op(request=DuplicateActor, job=True, errors=("duplicate_failed",)),
    _editor_op(
        request=ActorHierarchy,
        effect=Effect.READ,
        errors=("actor_hierarchy_failed",),
        generated=True,
        returns="root",
        positional=1,
    ),
    _editor_op(request=Snapshot, effect=Effect.READ, errors=("snapshot_failed",)),
)
