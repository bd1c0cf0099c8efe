"""Tools that change the scene. Play restarts after each, because the simulation is compiled again."""

from __future__ import annotations

from typing import Annotated, Any

from msgspec import Meta

from urlab_client.errors import ImportFailed
from urlab_client.mcp.call import Call
from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.results import Edited
from urlab_client.values.names import did_you_mean

__all__: list[str] = []

Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Position = Annotated[list[Metres], Meta(description="(x, y, z) in the world, metres.", min_length=3, max_length=3)]
Actor = Annotated[str, Meta(description="Name or actor id of a robot or body, as `look` lists it.", min_length=1)]
NewId = Annotated[str, Meta(pattern=r"^[A-Za-z]\w{0,63}$")]
Degrees = Annotated[float, Meta(ge=-360, le=360)]


@tool(Needs.EDIT, play=False)
async def import_model(call: Call, model: str) -> Edited:
    """Turn a model into a blueprint, which `spawn` then places. Takes a name, never a path.

    Args:
        model: One of `models`, as `look` lists them.
    """
    if model not in call.models:
        raise LookupError(f"No model is called {model!r}.{did_you_mean(model, call.models)} See `models` in look.")
    scene, file = call.client.scene, call.models[model]
    done = "The blueprint {!r} is there; spawn places it."
    try:
        blueprint = await scene.import_xml(str(file))
    except ImportFailed:
        if not call.client.server.features.uploads:
            raise
        before = [one.short_name for one in await call.client.outliner.list_blueprints()]
        blueprint = await scene.upload_model(file)  # the server does not have the file, or may not read it
        if blueprint.short_name in before:
            done += " It has replaced the model that was sent before: this server keeps one."
    return _edited(call, done.format(blueprint.short_name))


@tool(Needs.EDIT, play=False)
async def spawn(call: Call, blueprint: str, actor_id: NewId, position: Position, yaw: Degrees = 0.0) -> Edited:
    """Place a robot or body. Restarts play: the simulation starts from the beginning, with all robots at their initial
    state.

    Args:
        blueprint: One of `blueprints`, as `look` lists them; `import_model` makes more.
        actor_id: Id of your choice for the new actor: letters, digits and `_`.
        position: Position of its origin: (x, y, z) in the world, metres.
        yaw: Rotation about the vertical axis, degrees.
    """
    known = {one.short_name: one.class_path for one in await call.client.outliner.list_blueprints()}
    if blueprint not in known:
        advice = "import_model makes one of it." if blueprint in call.models else "See `blueprints` in look."
        raise LookupError(f"No blueprint is called {blueprint!r}.{did_you_mean(blueprint, known)} {advice}")
    if any(row.actor_id == actor_id for row in await call.client.outliner.list_actors()):
        raise ValueError(f"There is already an actor {actor_id!r}: move moves it, remove removes it.")
    async with call.client.scene.edit():
        await call.client.scene.spawn_actor(
            known[blueprint], actor_id, location=position, rotation_euler=(0.0, 0.0, yaw)
        )
    placed = _edited(call, f"{actor_id} is placed.")
    if (robot := call.client.articulations.get(actor_id)) is not None:
        placed.done = f"{actor_id} is placed: it is the robot {robot.name!r}."
    return placed


@tool(Needs.EDIT, play=False, idempotent=True)
async def move(call: Call, actor: Actor, position: Position) -> Edited:
    """Move a robot or body in the level. Restarts play: the simulation starts from the beginning."""
    target = await _target(call, actor)
    async with call.client.scene.edit():
        await call.client.scene.set_actor_transform(**target, location=position)
    return _edited(call, f"{actor} is moved.")


@tool(Needs.EDIT, play=False, destructive=True, idempotent=True)
async def remove(call: Call, actor: Actor) -> Edited:
    """Remove a robot or body from the level. Restarts play: the simulation starts from the beginning."""
    target = await _target(call, actor)
    async with call.client.scene.edit():
        await call.client.scene.destroy_actor(**target)
    return _edited(call, f"{actor} is removed.")


async def _target(call: Call, named: str) -> dict[str, Any]:
    """Return what ops call an actor: its id, or otherwise the engine's name."""
    listed = await call.client.outliner.list_actors()
    rows = [row for row in listed if row.actor_id or row.is_articulation or row.has_quick_convert]
    art = call.client.articulations.get(named)
    names = {named} if art is None else {named, art.actor_id, art.compiled_prefix}
    for row in rows:
        if row.actor_id and row.actor_id in names:
            return {"target": row.actor_id, "by_name": False}
    for row in rows:
        if row.name in names:
            return {"target": row.name, "by_name": True}
    known = [row.actor_id or row.name for row in rows]
    raise LookupError(f"No actor is called {named!r}.{did_you_mean(named, known)} There are: {', '.join(known)}.")


def _edited(call: Call, done: str) -> Edited:
    robots = call.client.articulations
    return Edited(done, list(robots), [name for name in call.client.entities if name not in robots])
