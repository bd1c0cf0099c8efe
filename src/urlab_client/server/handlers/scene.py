"""Handlers of the `scene` ops: authoring levels and actors."""

from __future__ import annotations

from urlab_client.protocol.messages.scene import (
    ActorHierarchy,
    ActorHierarchyOk,
    CreateLevel,
    CreateLevelOk,
    CurrentLevel,
    CurrentLevelOk,
    DestroyActor,
    DestroyActorOk,
    DestroyAsset,
    DestroyAssetOk,
    DuplicateActor,
    DuplicateActorOk,
    EnsureManager,
    EnsureManagerOk,
    GridCell,
    ImportXml,
    ImportXmlOk,
    LoadLevel,
    LoadLevelOk,
    RemoveActor,
    RemoveActorOk,
    SaveLevel,
    SaveLevelOk,
    SetActorTransform,
    SetActorTransformOk,
    Snapshot,
    SnapshotOk,
    SnapshotRow,
    SpawnActor,
    SpawnActorOk,
    SpawnGrid,
    SpawnGridOk,
    SpawnLight,
    SpawnLightOk,
    UrlabBlock,
)
from urlab_client.server.assets.actors import Actor
from urlab_client.server.core import ServerCore
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


@handles(ImportXml)
def import_xml(server: ServerCore, request: ImportXml) -> ImportXmlOk:
    blueprint, imported_now = server.world.blueprints.import_xml(
        need(request, request.path, "path"), force_reimport=request.force_reimport
    )
    return ImportXmlOk(
        blueprint_class_path=blueprint.class_path,
        blueprint_short_name=blueprint.short_name,
        imported_now=imported_now,
    )


@handles(CreateLevel)
def create_level(server: ServerCore, request: CreateLevel) -> CreateLevelOk:
    name = need(request, request.name, "name")
    created = server.world.levels.create(name, force_overwrite=request.force_overwrite)
    server.drawings.clear(in_play=False)  # drawings belong to their level
    return CreateLevelOk(level_path=created)


class LoadLevelByName(LoadLevel, tag="load_level", kw_only=True):
    """Reads the alternative name of the level, which is used if the first one is present and empty."""

    name: str = ""


@handles(LoadLevelByName)
def load_level(server: ServerCore, request: LoadLevelByName) -> LoadLevelOk:
    level = need(request, usable(request.name_or_path, "") or request.name, "level_path")
    server.world.levels.load(level)
    server.drawings.clear(in_play=False)
    # As in the plugin: expanded, but otherwise as requested, so an object path stays one.
    return LoadLevelOk(level_path=level if level.startswith("/") else f"/Game/Levels/{level}")


@handles(SaveLevel)
def save_level(server: ServerCore, request: SaveLevel) -> SaveLevelOk:
    del request
    return SaveLevelOk(level_path=server.world.levels.save())


@handles(CurrentLevel)
def current_level(server: ServerCore, request: CurrentLevel) -> CurrentLevelOk:
    del request
    return CurrentLevelOk(level_path=server.world.levels.package)


@handles(EnsureManager)
def ensure_manager(server: ServerCore, request: EnsureManager) -> EnsureManagerOk:
    del request
    actor, was_existing = server.world.ensure_manager()
    return EnsureManagerOk(actor_name=actor.name, actor_path=server.world.actor_path(actor), was_existing=was_existing)


@handles(SpawnActor)
def spawn_actor(server: ServerCore, request: SpawnActor) -> SpawnActorOk:
    actor, rotation_quat, was_existing = server.world.spawn_actor(
        need(request, request.blueprint, "blueprint"),
        request.actor_id,
        location=request.location,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
        scale=request.scale,
    )
    return SpawnActorOk(
        actor_id=actor.actor_id,
        actor_name=actor.name,
        actor_path=server.world.actor_path(actor),
        blueprint_class_path=actor.class_path,
        location=actor.location,
        rotation_quat=rotation_quat,
        was_existing=was_existing,
        requires_pie_restart=server.world.pie_running,
    )


@handles(SpawnGrid)
def spawn_grid(server: ServerCore, request: SpawnGrid) -> SpawnGridOk:
    cells = server.world.spawn_grid(
        need(request, request.blueprint, "blueprint"),
        need(request, request.base_actor_id, "base_actor_id"),
        usable(request.count_x, 0),
        usable(request.count_y, 0),
        spacing=request.spacing,
        origin=request.origin,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
        scale=request.scale,
    )
    return SpawnGridOk(
        count=len(cells),
        blueprint_class_path=cells[0].actor.class_path,
        actors=[
            GridCell(
                actor_id=actor.actor_id,
                actor_name=actor.name,
                actor_path=server.world.actor_path(actor),
                was_existing=was_existing,
                location=actor.location,
            )
            for actor, _, was_existing in cells
        ],
        requires_pie_restart=server.world.pie_running,
    )


@handles(SpawnLight)
def spawn_light(server: ServerCore, request: SpawnLight) -> SpawnLightOk:
    actor = server.world.spawn_light(
        request.kind,
        request.actor_id,
        location=request.location,
        rotation_euler=request.rotation_euler,
        intensity=request.intensity,
        color=request.color,
    )
    light = actor.light
    assert light is not None  # noqa: S101 - it was just made with one
    return SpawnLightOk(
        actor_id=actor.actor_id,
        actor_name=actor.name,
        actor_path=server.world.actor_path(actor),
        kind=light.kind,
        intensity=request.intensity,
        color=light.color,
        location=request.location,
        rotation_euler=request.rotation_euler,
        requires_pie_restart=server.world.pie_running,
    )


@handles(DestroyActor)
def destroy_actor(server: ServerCore, request: DestroyActor) -> DestroyActorOk:
    server.world.destroy_actor(need(request, request.target, "target"))
    return DestroyActorOk(requires_pie_restart=server.world.pie_running)


@handles(RemoveActor)
def remove_actor(server: ServerCore, request: RemoveActor) -> RemoveActorOk:
    server.world.destroy_actor(need(request, request.target, "target"))
    return RemoveActorOk(requires_pie_restart=server.world.pie_running)


@handles(DestroyAsset)
def destroy_asset(server: ServerCore, request: DestroyAsset) -> DestroyAssetOk:
    path = need(request, request.asset_path, "asset_path")
    return DestroyAssetOk(asset_path=path, was_found=server.world.blueprints.destroy_asset(path))


@handles(SetActorTransform)
def set_actor_transform(server: ServerCore, request: SetActorTransform) -> SetActorTransformOk:
    actor = server.world.set_actor_transform(
        need(request, request.target, "target"),
        location=request.location,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
    )
    return SetActorTransformOk(actor_name=actor.name, requires_pie_restart=server.world.pie_running)


@handles(DuplicateActor)
def duplicate_actor(server: ServerCore, request: DuplicateActor) -> DuplicateActorOk:
    copy, _, _ = server.world.duplicate_actor(
        need(request, request.target, "target"),
        need(request, request.new_actor_id, "new_actor_id"),
        location=request.location,
    )
    return DuplicateActorOk(
        actor_id=request.new_actor_id,
        actor_name=copy.name,
        actor_path=server.world.actor_path(copy),
        blueprint_class_path=copy.class_path,
    )


@handles(ActorHierarchy)
def actor_hierarchy(server: ServerCore, request: ActorHierarchy) -> ActorHierarchyOk:
    return ActorHierarchyOk(root=server.world.actor_hierarchy(need(request, request.target, "target")))


@handles(Snapshot)
def snapshot(server: ServerCore, request: Snapshot) -> SnapshotOk:
    del request
    world = server.world
    rows = [_row(actor, compiled=world.pie_running) for actor in world.snapshot()]
    return SnapshotOk(actors=rows, in_pie=world.pie_running, level_path=world.levels.shown())


def _row(actor: Actor, *, compiled: bool) -> SnapshotRow:
    """Describe an actor; in play the names of its elements are the compiled ones, except those of cameras."""
    blueprint, prefix = actor.blueprint, actor.prefix if compiled else ""
    return SnapshotRow(
        name=actor.name,
        label=actor.label,
        actor_class=actor.class_name,
        actor_id=actor.actor_id,
        location=actor.location,
        rotation_quat=actor.rotation,
        tags=list(actor.tags),
        urlab=None
        if blueprint is None
        else UrlabBlock(
            mj_class="articulation",
            joints=[f"{prefix}{name}" for name in blueprint.joints],
            actuators=[f"{prefix}{name}" for name in blueprint.actuators],
            sensors=[f"{prefix}{name}" for name in blueprint.sensors],
            cameras=list(blueprint.cameras),
        ),
    )
