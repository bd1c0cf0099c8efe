"""Handlers of the `outliner` ops: inspecting the world."""

from __future__ import annotations

import msgspec

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
from urlab_client.server.assets.actors import ActorKind, ConversionSettings
from urlab_client.server.core import ServerCore
from urlab_client.server.rpc.dispatch import handles
from urlab_client.server.rpc.requests import need


@handles(ListActors)
def list_actors(server: ServerCore, request: ListActors) -> ListActorsOk:
    del request
    rows = [
        ActorRow(
            name=actor.name,
            label=actor.label,
            actor_class=actor.class_name,
            actor_id=actor.actor_id,
            location=actor.location,
            rotation_quat=actor.rotation,
            is_articulation=actor.kind is ActorKind.ARTICULATION,
            is_static_mesh_actor=actor.kind is ActorKind.STATIC_MESH,
            is_light=actor.kind is ActorKind.LIGHT,
            has_quick_convert=actor.quick_convert is not None,
            quick_convert=None if actor.quick_convert is None else _settings(actor.quick_convert),
        )
        for actor in server.world.list_actors()
    ]
    return ListActorsOk(actors=rows, in_pie=server.world.pie_running)


def _settings(settings: ConversionSettings) -> QuickConvert:
    return QuickConvert(**msgspec.structs.asdict(settings))


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
            name=actor.name,
            label=actor.label,
            actor_class=actor.class_name,
            actor_id=actor.actor_id,
            location=actor.location,
            rotation_quat=actor.rotation,
            tags=list(actor.tags),
        )
        for actor in found
    ]
    return FindActorsOk(actors=rows, in_pie=in_pie)


@handles(ListBlueprints)
def list_blueprints(server: ServerCore, request: ListBlueprints) -> ListBlueprintsOk:
    del request
    return ListBlueprintsOk(blueprints=server.world.blueprints.list_blueprints())


@handles(GetActorBounds)
def get_actor_bounds(server: ServerCore, request: GetActorBounds) -> GetActorBoundsOk:
    bounds = server.world.get_actor_bounds(
        need(request, request.target, "target"), components_only=request.components_only
    )
    return GetActorBoundsOk(**msgspec.structs.asdict(bounds))


@handles(SelectActor)
def select_actor(server: ServerCore, request: SelectActor) -> SelectActorOk:
    return SelectActorOk(actor_name=server.world.select_actor(need(request, request.target, "target")).name)


@handles(AddQuickConvert)
def add_quick_convert(server: ServerCore, request: AddQuickConvert) -> AddQuickConvertOk:
    actor = server.world.quick_convert.add(
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
    actor = server.world.quick_convert.remove(need(request, request.target, "target"))
    return RemoveQuickConvertOk(actor_name=actor.name, requires_pie_restart=server.world.pie_running)
