"""Handlers of the `outliner` ops: looking at the world."""

# ruff: noqa: D103 - what an op does stands once, on its request struct

from __future__ import annotations

from urlab_client.protocol.messages.outliner import (
    ActorRow,
    AddQuickConvert,
    AddQuickConvertOk,
    FindActors,
    FindActorsOk,
    GetActorBounds,
    GetActorBoundsOk,
    ListActors,
    ListActorsOk,
    ListBlueprints,
    ListBlueprintsOk,
    QuickConvert,
    RemoveQuickConvert,
    RemoveQuickConvertOk,
    SelectActor,
    SelectActorOk,
)
from urlab_client.protocol.types import BlueprintInfo
from urlab_client.server.assets.actors import ConversionSettings as QuickConvertSettings
from urlab_client.server.core import ServerCore
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need


@handles(ListActors)
def list_actors(server: ServerCore, request: ListActors) -> ListActorsOk:
    del request
    rows = [
        ActorRow(
            name=row.name,
            label=row.label,
            actor_class=row.class_name,
            actor_id=row.actor_id,
            location=row.location,
            rotation_quat=row.rotation_quat,
            is_articulation=row.is_articulation,
            is_static_mesh_actor=row.is_static_mesh_actor,
            is_light=row.is_light,
            has_quick_convert=row.quick_convert is not None,
            quick_convert=None if row.quick_convert is None else _settings(row.quick_convert),
        )
        for row in server.world.list_actors()
    ]
    return ListActorsOk(actors=rows, in_pie=server.world.pie_running)


def _settings(settings: QuickConvertSettings) -> QuickConvert:
    return QuickConvert(
        static=settings.static,
        complex_mesh=settings.complex_mesh,
        coacd_threshold=settings.coacd_threshold,
        driven_by_unreal=settings.driven_by_unreal,
        friction=settings.friction,
    )


@handles(FindActors)
def find_actors(server: ServerCore, request: FindActors) -> FindActorsOk:
    found, in_pie = server.world.find_actors(
        class_filter=request.class_filter or "",
        tag=request.tag or "",
        name_prefix=request.name_prefix or "",
        in_pie=request.in_pie,
    )
    rows = [
        ActorRow(
            name=row.name,
            label=row.label,
            actor_class=row.class_name,
            actor_id=row.actor_id,
            location=row.location,
            rotation_quat=row.rotation_quat,
            tags=list(row.tags),
        )
        for row in found
    ]
    return FindActorsOk(actors=rows, in_pie=in_pie)


@handles(ListBlueprints)
def list_blueprints(server: ServerCore, request: ListBlueprints) -> ListBlueprintsOk:
    del request
    return ListBlueprintsOk(
        blueprints=[
            BlueprintInfo(
                class_path=row.class_path,
                short_name=row.short_name,
                package_path=row.package_path,
                parent_class=row.parent_class,
            )
            for row in server.world.list_blueprints()
        ]
    )


@handles(GetActorBounds)
def get_actor_bounds(server: ServerCore, request: GetActorBounds) -> GetActorBoundsOk:
    bounds = server.world.get_actor_bounds(
        need(request, request.target, "target"), components_only=request.components_only
    )
    return GetActorBoundsOk(
        actor_name=bounds.actor_name,
        min=bounds.min,
        max=bounds.max,
        center=bounds.center,
        extents=bounds.extents,
    )


@handles(SelectActor)
def select_actor(server: ServerCore, request: SelectActor) -> SelectActorOk:
    return SelectActorOk(actor_name=server.world.select_actor(need(request, request.target, "target")).name)


@handles(AddQuickConvert)
def add_quick_convert(server: ServerCore, request: AddQuickConvert) -> AddQuickConvertOk:
    actor = server.world.add_quick_convert(
        need(request, request.target, "target"),
        static=request.static,
        complex_mesh=request.complex_mesh,
        coacd_threshold=request.coacd_threshold,
        driven_by_unreal=request.driven_by_unreal,
        friction=request.friction,
    )
    return AddQuickConvertOk(
        actor_name=actor.name,
        static=request.static,
        complex_mesh=request.complex_mesh,
        coacd_threshold=request.coacd_threshold,
        driven_by_unreal=request.driven_by_unreal,
        requires_pie_restart=server.world.pie_running,
    )


@handles(RemoveQuickConvert)
def remove_quick_convert(server: ServerCore, request: RemoveQuickConvert) -> RemoveQuickConvertOk:
    actor = server.world.remove_quick_convert(need(request, request.target, "target"))
    return RemoveQuickConvertOk(actor_name=actor.name, requires_pie_restart=server.world.pie_running)
