"""Handlers of the `scene` and `outliner` ops: authoring levels and actors, looking at them, and uploading models."""

from __future__ import annotations

from typing import Any

import msgspec

from urlab_client.protocol.messages import outliner, scene, uploads
from urlab_client.server.assets.actors import Actor, ActorKind, ConversionSettings
from urlab_client.server.core import ServerCore
from urlab_client.server.refusal import Refusal
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need, usable


@handles(scene.ImportXml)
def import_xml(server: ServerCore, request: scene.ImportXml) -> scene.ImportXmlOk:
    blueprint, imported_now = server.world.blueprints.import_xml(
        need(request, request.path, "path"), force_reimport=request.force_reimport
    )
    return scene.ImportXmlOk(
        blueprint_class_path=blueprint.class_path,
        blueprint_short_name=blueprint.short_name,
        imported_now=imported_now,
    )


@handles(scene.CreateLevel)
def create_level(server: ServerCore, request: scene.CreateLevel) -> scene.CreateLevelOk:
    name = need(request, request.name, "name")
    created = server.world.levels.create(name, force_overwrite=request.force_overwrite)
    server.drawings.clear(in_play=False)  # drawings belong to their level
    return scene.CreateLevelOk(level_path=created)


class LoadLevelByName(scene.LoadLevel, tag="load_level", kw_only=True):
    """Reads the alternative name of the level, which is used if the first one is present and empty."""

    name: str = ""


@handles(LoadLevelByName)
def load_level(server: ServerCore, request: LoadLevelByName) -> scene.LoadLevelOk:
    level = need(request, usable(request.name_or_path, "") or request.name, "level_path")
    server.world.levels.load(level)
    server.drawings.clear(in_play=False)
    # As in the plugin: expanded, but otherwise as requested, so an object path stays one.
    return scene.LoadLevelOk(level_path=level if level.startswith("/") else f"/Game/Levels/{level}")


@handles(scene.SaveLevel)
def save_level(server: ServerCore, _: scene.SaveLevel) -> scene.SaveLevelOk:
    return scene.SaveLevelOk(level_path=server.world.levels.save())


@handles(scene.CurrentLevel)
def current_level(server: ServerCore, _: scene.CurrentLevel) -> scene.CurrentLevelOk:
    return scene.CurrentLevelOk(level_path=server.world.levels.package)


@handles(scene.EnsureManager)
def ensure_manager(server: ServerCore, _: scene.EnsureManager) -> scene.EnsureManagerOk:
    actor, was_existing = server.world.ensure_manager()
    return scene.EnsureManagerOk(
        actor_name=actor.name, actor_path=server.world.actor_path(actor), was_existing=was_existing
    )


@handles(scene.SpawnActor)
def spawn_actor(server: ServerCore, request: scene.SpawnActor) -> scene.SpawnActorOk:
    actor, rotation_quat, was_existing = server.world.spawn_actor(
        need(request, request.blueprint, "blueprint"),
        request.actor_id,
        location=request.location,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
        scale=request.scale,
    )
    return scene.SpawnActorOk(
        **_placed(server, actor),
        blueprint_class_path=actor.class_path,
        location=actor.location,
        rotation_quat=rotation_quat,
        was_existing=was_existing,
        requires_pie_restart=server.world.pie_running,
    )


@handles(scene.SpawnGrid)
def spawn_grid(server: ServerCore, request: scene.SpawnGrid) -> scene.SpawnGridOk:
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
    return scene.SpawnGridOk(
        count=len(cells),
        blueprint_class_path=cells[0].actor.class_path,
        actors=[
            scene.GridCell(
                **_placed(server, actor),
                was_existing=was_existing,
                location=actor.location,
            )
            for actor, _, was_existing in cells
        ],
        requires_pie_restart=server.world.pie_running,
    )


@handles(scene.SpawnLight)
def spawn_light(server: ServerCore, request: scene.SpawnLight) -> scene.SpawnLightOk:
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
    return scene.SpawnLightOk(
        **_placed(server, actor),
        kind=light.kind,
        intensity=request.intensity,
        color=light.color,
        location=request.location,
        rotation_euler=request.rotation_euler,
        requires_pie_restart=server.world.pie_running,
    )


@handles(scene.DestroyActor)
def destroy_actor(server: ServerCore, request: scene.DestroyActor) -> scene.DestroyActorOk:
    server.world.destroy_actor(need(request, request.target, "target"))
    return scene.DestroyActorOk(requires_pie_restart=server.world.pie_running)


@handles(scene.RemoveActor)
def remove_actor(server: ServerCore, request: scene.RemoveActor) -> scene.RemoveActorOk:
    server.world.destroy_actor(need(request, request.target, "target"))
    return scene.RemoveActorOk(requires_pie_restart=server.world.pie_running)


@handles(scene.DestroyAsset)
def destroy_asset(server: ServerCore, request: scene.DestroyAsset) -> scene.DestroyAssetOk:
    path = need(request, request.asset_path, "asset_path")
    return scene.DestroyAssetOk(asset_path=path, was_found=server.world.blueprints.destroy_asset(path))


@handles(scene.SetActorTransform)
def set_actor_transform(server: ServerCore, request: scene.SetActorTransform) -> scene.SetActorTransformOk:
    actor = server.world.set_actor_transform(
        need(request, request.target, "target"),
        location=request.location,
        rotation_quat=request.rotation_quat,
        rotation_euler=request.rotation_euler,
    )
    return scene.SetActorTransformOk(actor_name=actor.name, requires_pie_restart=server.world.pie_running)


@handles(scene.DuplicateActor)
def duplicate_actor(server: ServerCore, request: scene.DuplicateActor) -> scene.DuplicateActorOk:
    copy, _, _ = server.world.duplicate_actor(
        need(request, request.target, "target"),
        need(request, request.new_actor_id, "new_actor_id"),
        location=request.location,
    )
    return scene.DuplicateActorOk(
        **_placed(server, copy) | {"actor_id": request.new_actor_id},
        blueprint_class_path=copy.class_path,
    )


@handles(scene.ActorHierarchy)
def actor_hierarchy(server: ServerCore, request: scene.ActorHierarchy) -> scene.ActorHierarchyOk:
    return scene.ActorHierarchyOk(root=server.world.actor_hierarchy(need(request, request.target, "target")))


@handles(scene.Snapshot)
def snapshot(server: ServerCore, _: scene.Snapshot) -> scene.SnapshotOk:
    world = server.world
    rows = [_row(actor, compiled=world.pie_running) for actor in world.snapshot()]
    return scene.SnapshotOk(actors=rows, in_pie=world.pie_running, level_path=world.levels.shown())


def _identity(actor: Actor) -> dict[str, Any]:
    """Return what all rows say of an actor."""
    return {
        "name": actor.name,
        "label": actor.label,
        "actor_class": actor.class_name,
        "actor_id": actor.actor_id,
        "location": actor.location,
        "rotation_quat": actor.rotation,
    }


def _placed(server: ServerCore, actor: Actor) -> dict[str, Any]:
    """Return what the replies about a placed actor share."""
    return {"actor_id": actor.actor_id, "actor_name": actor.name, "actor_path": server.world.actor_path(actor)}


def _row(actor: Actor, *, compiled: bool) -> scene.SnapshotRow:
    """Describe an actor; in play the names of its elements are the compiled ones, except those of cameras."""
    blueprint, prefix = actor.blueprint, actor.prefix if compiled else ""
    return scene.SnapshotRow(
        **_identity(actor),
        tags=list(actor.tags),
        urlab=None
        if blueprint is None
        else scene.UrlabBlock(
            mj_class="articulation",
            joints=[f"{prefix}{name}" for name in blueprint.joints],
            actuators=[f"{prefix}{name}" for name in blueprint.actuators],
            sensors=[f"{prefix}{name}" for name in blueprint.sensors],
            cameras=list(blueprint.cameras),
        ),
    )


@handles(outliner.ListActors)
def list_actors(server: ServerCore, _: outliner.ListActors) -> outliner.ListActorsOk:
    rows = [
        outliner.ActorRow(
            **_identity(actor),
            is_articulation=actor.kind is ActorKind.ARTICULATION,
            is_static_mesh_actor=actor.kind is ActorKind.STATIC_MESH,
            is_light=actor.kind is ActorKind.LIGHT,
            has_quick_convert=actor.quick_convert is not None,
            quick_convert=None
            if actor.quick_convert is None
            else outliner.QuickConvert(**msgspec.structs.asdict(actor.quick_convert)),
        )
        for actor in list(server.world.actors)
    ]
    return outliner.ListActorsOk(actors=rows, in_pie=server.world.pie_running)


@handles(outliner.FindActors)
def find_actors(server: ServerCore, request: outliner.FindActors) -> outliner.FindActorsOk:
    found, in_pie = server.world.find_actors(
        class_filter=request.class_filter or "",
        tag=request.tag or "",
        name_prefix=request.name_prefix or "",
        in_pie=request.in_pie,
    )
    rows = [
        outliner.ActorRow(
            **_identity(actor),
            tags=list(actor.tags),
        )
        for actor in found
    ]
    return outliner.FindActorsOk(actors=rows, in_pie=in_pie)


@handles(outliner.ListBlueprints)
def list_blueprints(server: ServerCore, _: outliner.ListBlueprints) -> outliner.ListBlueprintsOk:
    return outliner.ListBlueprintsOk(blueprints=server.world.blueprints.list_blueprints())


@handles(outliner.GetActorBounds)
def get_actor_bounds(server: ServerCore, request: outliner.GetActorBounds) -> outliner.GetActorBoundsOk:
    bounds = server.world.get_actor_bounds(
        need(request, request.target, "target"), components_only=request.components_only
    )
    return outliner.GetActorBoundsOk(**msgspec.structs.asdict(bounds))


@handles(outliner.SelectActor)
def select_actor(server: ServerCore, request: outliner.SelectActor) -> outliner.SelectActorOk:
    return outliner.SelectActorOk(actor_name=server.world.select_actor(need(request, request.target, "target")).name)


@handles(outliner.AddQuickConvert)
def add_quick_convert(server: ServerCore, request: outliner.AddQuickConvert) -> outliner.AddQuickConvertOk:
    settings = ConversionSettings(**{name: getattr(request, name) for name in ConversionSettings.__struct_fields__})
    actor = server.world.quick_convert.add(need(request, request.target, "target"), settings)
    return outliner.AddQuickConvertOk(
        actor_name=actor.name,
        static=request.static,
        complex_mesh=request.complex_mesh,
        coacd_threshold=request.coacd_threshold,
        driven_by_unreal=request.driven_by_unreal,
        requires_pie_restart=server.world.pie_running,
    )


@handles(outliner.RemoveQuickConvert)
def remove_quick_convert(server: ServerCore, request: outliner.RemoveQuickConvert) -> outliner.RemoveQuickConvertOk:
    actor = server.world.quick_convert.remove(need(request, request.target, "target"))
    return outliner.RemoveQuickConvertOk(actor_name=actor.name, requires_pie_restart=server.world.pie_running)


@handles(uploads.UploadModelManifest)
def upload_model_manifest(server: ServerCore, request: uploads.UploadModelManifest) -> uploads.UploadModelManifestOk:
    request.xml_sha256 = usable(request.xml_sha256, "")
    for asset in request.assets:
        asset.name, asset.sha256 = usable(asset.name, ""), usable(asset.sha256, "")
        asset.size = usable(asset.size, -1)
    upload_id, need_xml, need_assets = server.uploads.begin(request)
    return uploads.UploadModelManifestOk(upload_id=upload_id, need_xml=need_xml, need_assets=need_assets)


@handles(uploads.UploadModelChunk)
def upload_model_chunk(server: ServerCore, request: uploads.UploadModelChunk) -> uploads.UploadModelChunkOk:
    need(request, request.upload_id, "upload_id")
    request.kind, request.data = usable(request.kind, ""), usable(request.data, b"")
    name, received, complete = server.uploads.receive(request)
    return uploads.UploadModelChunkOk(name=name, received=received, complete=complete)


@handles(uploads.UploadModelCommit)
def upload_model_commit(server: ServerCore, request: uploads.UploadModelCommit) -> uploads.UploadModelCommitOk:
    with server.uploads.committed(usable(request.upload_id, "")) as (document, step_mode):
        try:
            blueprint = server.world.blueprints.import_uploaded(document)
        except Refusal as refusal:
            raise Refusal("import_failed", refusal.message) from None
    reply = uploads.UploadModelCommitOk(
        imported=True,
        blueprint_class_path=blueprint.class_path,
        blueprint_short_name=blueprint.short_name,
        warnings=[],
    )
    running = server.play.current
    if running is not None:
        if step_mode is not None:
            running.engine.set_mode(step_mode)
        with running.engine.lock:
            model = running.scene.model
            reply.nq, reply.nv, reply.nu = model.nq, model.nv, model.nu
            reply.nbody, reply.ngeom = model.nbody, model.ngeom
            reply.mjb = running.mjb()
    return reply
