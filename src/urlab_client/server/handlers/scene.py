"""Handlers of the `scene` ops: authoring levels and actors."""

# ruff: noqa: D103 - what an op does stands once, on its request struct

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
from urlab_client.protocol.types import ActorHierarchyNode
from urlab_client.server.core import ServerCore
from urlab_client.server.editor.world import ActorRow, HierarchyNode
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


@handles(ImportXml)
def import_xml(server: ServerCore, request: ImportXml) -> ImportXmlOk:
    blueprint, imported_now = server.world.import_xml(
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
    created = server.world.create_level(name, force_overwrite=request.force_overwrite)
    server.drawings.clear(in_play=False)  # what is drawn into a level goes with it
    return CreateLevelOk(level_path=created)


class LoadLevelByName(LoadLevel, tag="load_level", kw_only=True):
    """Reads the second name of the level, which counts when the first one is there and empty."""

    name: str = ""


@handles(LoadLevelByName)
def load_level(server: ServerCore, request: LoadLevelByName) -> LoadLevelOk:
    level = need(request, usable(request.name_or_path, "") or request.name, "level_path")
    server.world.load_level(level)
    server.drawings.clear(in_play=False)
    # As the plugin: expanded, but otherwise as it was asked for, so an object path stays one.
    return LoadLevelOk(level_path=level if level.startswith("/") else f"/Game/Levels/{level}")


@handles(SaveLevel)
def save_level(server: ServerCore, request: SaveLevel) -> SaveLevelOk:
    del request
    return SaveLevelOk(level_path=server.world.save_level())


@handles(CurrentLevel)
def current_level(server: ServerCore, request: CurrentLevel) -> CurrentLevelOk:
    del request
    return CurrentLevelOk(level_path=server.world.current_level())


@handles(EnsureManager)
def ensure_manager(server: ServerCore, request: EnsureManager) -> EnsureManagerOk:
    del request
    actor, was_existing = server.world.ensure_manager()
    return EnsureManagerOk(actor_name=actor.name, actor_path=server.world.actor_path(actor), was_existing=was_existing)


@handles(SpawnActor)
def spawn_actor(server: ServerCore, request: SpawnActor) -> SpawnActorOk:
    placed = server.world.spawn_actor(
        need(request, request.blueprint, "blueprint"),
        request.actor_id,
        location=request.location,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
        scale=request.scale,
    )
    return SpawnActorOk(
        actor_id=placed.actor_id,
        actor_name=placed.actor_name,
        actor_path=placed.actor_path,
        blueprint_class_path=placed.blueprint_class_path,
        location=placed.location,
        rotation_quat=placed.rotation_quat,
        was_existing=placed.was_existing,
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
        blueprint_class_path=cells[0].blueprint_class_path,
        actors=[
            GridCell(
                actor_id=cell.actor_id,
                actor_name=cell.actor_name,
                actor_path=cell.actor_path,
                was_existing=cell.was_existing,
                location=cell.location,
            )
            for cell in cells
        ],
        requires_pie_restart=server.world.pie_running,
    )


@handles(SpawnLight)
def spawn_light(server: ServerCore, request: SpawnLight) -> SpawnLightOk:
    placed = server.world.spawn_light(
        request.kind,
        request.actor_id,
        location=request.location,
        rotation_euler=request.rotation_euler,
        intensity=request.intensity,
        color=request.color,
    )
    return SpawnLightOk(
        actor_id=placed.actor_id,
        actor_name=placed.actor_name,
        actor_path=placed.actor_path,
        kind=placed.kind,
        intensity=placed.intensity,
        color=placed.color,
        location=placed.location,
        rotation_euler=placed.rotation_euler,
        requires_pie_restart=server.world.pie_running,
    )


@handles(DestroyActor)
def destroy_actor(server: ServerCore, request: DestroyActor) -> DestroyActorOk:
    server.world.destroy_actor(need(request, request.target, "target"))
    return DestroyActorOk(requires_pie_restart=server.world.pie_running)


@handles(DestroyAsset)
def destroy_asset(server: ServerCore, request: DestroyAsset) -> DestroyAssetOk:
    path = need(request, request.asset_path, "asset_path")
    return DestroyAssetOk(asset_path=path, was_found=server.world.destroy_asset(path))


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
    copy = server.world.duplicate_actor(
        need(request, request.target, "target"),
        need(request, request.new_actor_id, "new_actor_id"),
        location=request.location,
    )
    return DuplicateActorOk(
        actor_id=copy.actor_id,
        actor_name=copy.actor_name,
        actor_path=copy.actor_path,
        blueprint_class_path=copy.blueprint_class_path,
    )


@handles(ActorHierarchy)
def actor_hierarchy(server: ServerCore, request: ActorHierarchy) -> ActorHierarchyOk:
    return ActorHierarchyOk(root=_node(server.world.actor_hierarchy(need(request, request.target, "target"))))


def _node(node: HierarchyNode) -> ActorHierarchyNode:
    return ActorHierarchyNode(
        name=node.name,
        actor_class=node.class_name,
        location=node.location,
        children=[_node(child) for child in node.children],
    )


@handles(Snapshot)
def snapshot(server: ServerCore, request: Snapshot) -> SnapshotOk:
    del request
    world = server.world
    return SnapshotOk(
        actors=[_row(row) for row in world.snapshot()], in_pie=world.pie_running, level_path=world.shown_level()
    )


def _row(row: ActorRow) -> SnapshotRow:
    names = row.names
    return SnapshotRow(
        name=row.name,
        label=row.label,
        actor_class=row.class_name,
        actor_id=row.actor_id,
        location=row.location,
        rotation_quat=row.rotation_quat,
        tags=list(row.tags),
        urlab=None
        if names is None
        else UrlabBlock(
            mj_class="articulation",
            joints=list(names.joints),
            actuators=list(names.actuators),
            sensors=list(names.sensors),
            cameras=list(names.cameras),
        ),
    )
