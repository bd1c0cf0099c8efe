"""Ops of `client.outliner`: inspecting the world."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

from msgspec import Struct, field

from urlab_client.protocol.base import (
    EDITOR_TIMEOUT_S,
    ActorId,
    ActorTarget,
    Effect,
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
from urlab_client.values.scene_types import ActorBounds, BlueprintInfo


class QuickConvert(Serializable, Struct, kw_only=True):
    """Settings that make a static mesh a MuJoCo body."""

    static: Annotated[bool, doc("No free joint: the body is fixed.")]
    complex_mesh: Annotated[bool, doc("Convex decomposition instead of one hull.")]
    coacd_threshold: Annotated[float, doc("Concavity threshold of the decomposition.")]
    driven_by_unreal: Annotated[bool, doc("Mocap body that follows the actor.")]
    friction: Annotated[Vec3, doc("Sliding, torsional, rolling.")]


class ActorRow(Serializable, Struct, kw_only=True, omit_defaults=True):
    """One actor. `list_actors` sends the flags, `find_actors` the tags."""

    name: Annotated[str, doc("Engine actor name.")]
    label: Annotated[str, doc("Display name.")]
    actor_class: Annotated[str, doc("Short class name.")] = field(name="class")
    actor_id: ActorId
    location: Location
    rotation_quat: QuatXYZW
    is_articulation: Annotated[bool | None, doc("Only from `list_actors`.")] = None
    is_static_mesh_actor: Annotated[bool | None, doc("Only from `list_actors`.")] = None
    is_light: Annotated[bool | None, doc("Only from `list_actors`.")] = None
    has_quick_convert: Annotated[bool | None, doc("Only from `list_actors`.")] = None
    quick_convert: Annotated[QuickConvert | None, doc("With `has_quick_convert`.")] = None
    tags: Annotated[list[str] | None, doc("Only from `find_actors`.")] = None


class ActorsReply(Reply, kw_only=True):
    """Rows of actors."""

    actors: Annotated[list[ActorRow], doc("One row per actor.")]
    in_pie: Annotated[bool, doc("Whether a play session is running, or was searched.")]


class ListActorsOk(ActorsReply, tag="list_actors_ok", kw_only=True):
    """Visible actors of the edited level."""


class ListActors(Request[ListActorsOk], tag="list_actors", kw_only=True):
    """List the visible actors of the edited level."""


class ListBlueprintsOk(Reply, tag="list_blueprints_ok", kw_only=True):
    """Articulation blueprints of the project."""

    blueprints: Annotated[list[BlueprintInfo], doc("Sorted by short name.")]


class ListBlueprints(Request[ListBlueprintsOk], tag="list_blueprints", kw_only=True):
    """List the articulation blueprints of the project."""


class FindActorsOk(ActorsReply, tag="find_actors_ok", kw_only=True):
    """Actors that pass every filter."""


class FindActors(Request[FindActorsOk], tag="find_actors", kw_only=True):
    """List the actors that pass every given filter."""

    class_filter: Annotated[str | None, doc("Class or parent class name, any letter case.")] = None
    tag: Annotated[str | None, doc("Whole tag, any letter case.")] = None
    name_prefix: Annotated[str | None, doc("Beginning of the engine actor name, any letter case.")] = None
    in_pie: Annotated[bool, doc("Search the play world if play is running.")] = False


class GetActorBoundsOk(Reply, tag="get_actor_bounds_ok", kw_only=True):
    """An axis-aligned box."""

    actor_name: Annotated[str, doc("Engine actor name.")]
    min: Annotated[Vec3, doc("Lower corner, metres, world frame.")]
    max: Annotated[Vec3, doc("Upper corner, metres, world frame.")]
    center: Annotated[Vec3, doc("Midpoint, metres, world frame.")]
    extents: Annotated[Vec3, doc("Half sizes, metres.")]


class GetActorBounds(Request[GetActorBoundsOk], tag="get_actor_bounds", kw_only=True):
    """Return the axis-aligned box around an actor at its authored pose."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"
    components_only: Annotated[bool, doc("Also include components without collision.")] = False


class SelectActorOk(Reply, tag="select_actor_ok", kw_only=True):
    """The selected actor."""

    actor_name: Annotated[str, doc("Engine actor name.")]


class SelectActor(Request[SelectActorOk], tag="select_actor", kw_only=True):
    """Select an actor in the editor, replacing the selection."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


class AddQuickConvertOk(Reply, tag="add_quick_convert_ok", kw_only=True):
    """The settings in force."""

    actor_name: Annotated[str, doc("Engine actor name.")]
    static: Annotated[bool, doc("As requested.")]
    complex_mesh: Annotated[bool, doc("As requested.")]
    coacd_threshold: Annotated[float, doc("As requested.")]
    driven_by_unreal: Annotated[bool, doc("As requested.")]
    requires_pie_restart: RequiresPieRestart


class AddQuickConvert(Request[AddQuickConvertOk], tag="add_quick_convert", kw_only=True):
    """Turn a static-mesh actor into a MuJoCo body, from the next play session on."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"
    static: Annotated[bool, doc("No free joint: the body is fixed.")] = False
    complex_mesh: Annotated[bool, doc("Convex decomposition (CoACD) instead of one hull.")] = False
    coacd_threshold: Annotated[float, doc("Concavity threshold of the decomposition.")] = 0.05
    driven_by_unreal: Annotated[bool, doc("Mocap body that follows the actor.")] = False
    friction: Annotated[Vec3, doc("Sliding, torsional, rolling friction of all its geoms.")] = (1.0, 1.0, 1.0)


class RemoveQuickConvertOk(Reply, tag="remove_quick_convert_ok", kw_only=True):
    """The actor is a plain mesh again."""

    actor_name: Annotated[str, doc("Engine actor name.")]
    requires_pie_restart: RequiresPieRestart


class RemoveQuickConvert(Request[RemoveQuickConvertOk], tag="remove_quick_convert", kw_only=True):
    """Undo `add_quick_convert`."""

    target: ActorTarget
    target_by: TargetBy = "actor_id"


_editor_op = partial(Op, ns="outliner", timeout=EDITOR_TIMEOUT_S)

OPS: Final = (
    _editor_op(request=ListActors, effect=Effect.READ, errors=("list_actors_failed",)),
    _editor_op(
        request=ListBlueprints,
        effect=Effect.READ,
        errors=("list_blueprints_failed",),
        generated=True,
        returns="blueprints",
    ),
    _editor_op(request=FindActors, effect=Effect.READ, errors=("find_actors_failed",)),
    _editor_op(
        request=GetActorBounds,
        effect=Effect.READ,
        errors=("get_actor_bounds_failed",),
        generated=True,
        returns=ActorBounds,
        positional=1,
    ),
    _editor_op(
        request=SelectActor,
        errors=("select_failed",),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
    _editor_op(
        request=AddQuickConvert,
        errors=("add_quick_convert_failed",),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
    _editor_op(
        request=RemoveQuickConvert,
        errors=("remove_quick_convert_failed",),
        generated=True,
        positional=1,
        declares=("op:string", "target:string"),
    ),
)
