"""Tools that change the scene. Play begins anew after each, as the simulation is compiled again."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated

from msgspec import Meta

from urlab_client.mcp.declaration import Needs, tool
from urlab_client.mcp.driving import Progress
from urlab_client.mcp.moving import Moving
from urlab_client.mcp.results import Edited
from urlab_client.protocol.errors import ImportFailed
from urlab_client.protocol.names import did_you_mean

__all__ = ["Tools"]

Position = Annotated[
    list[Annotated[float, Meta(ge=-1e4, le=1e4)]],
    Meta(description="(x, y, z) in the world, metres.", min_length=3, max_length=3),
]
Actor = Annotated[str, Meta(description="Name or actor id of a robot or body, as `look` lists it.", min_length=1)]


class Tools(Moving):
    """All tools."""

    @tool(Needs.EDIT)
    async def import_model(
        self, progress: Progress, model: Annotated[str, Meta(description="One of `models`, as `look` lists them.")]
    ) -> Edited:
        """Turn a model into a blueprint, which `spawn` then places. Takes a name, never a path."""
        if model not in self.models:
            raise LookupError(f"No model is called {model!r}.{did_you_mean(model, self.models)} See `models` in look.")
        file = self.models[model]

        async def work() -> str:
            scene = self.client.scene
            try:
                blueprint = await scene.import_xml(str(file))
            except ImportFailed:
                if not self.client.server.features.uploads:
                    raise
                blueprint = await scene.upload_model(file)  # the server has no such file, or may not read it
            return f"The blueprint {blueprint.short_name!r} is there."

        return self._edited(await self.driving.drive(work, progress))

    @tool(Needs.EDIT)
    async def spawn(
        self,
        progress: Progress,
        blueprint: Annotated[str, Meta(description="One of `blueprints`, as `look` lists them.")],
        actor_id: Annotated[str, Meta(description="Id of the new actor.", pattern=r"^[A-Za-z]\w{0,63}$")],
        position: Position,
        yaw: Annotated[float, Meta(description="Turn about the vertical, degrees.", ge=-360, le=360)] = 0.0,
    ) -> Edited:
        """Place a robot or body. Restarts play: the simulation begins anew, with all robots at their start."""
        known = {one.short_name: one.class_path for one in await self.client.outliner.list_blueprints()}
        if blueprint not in known:
            text = f"No blueprint is called {blueprint!r}.{did_you_mean(blueprint, known)} "
            raise LookupError(text + "See `blueprints` in look; import_model makes one.")
        if any(row.actor_id == actor_id for row in await self.client.outliner.list_actors()):
            raise ValueError(f"There is an actor {actor_id!r} already: move moves it, remove removes it.")

        async def work() -> None:
            await self.client.scene.spawn_actor(
                known[blueprint], actor_id, location=position, rotation_euler=(0.0, 0.0, yaw)
            )

        return await self._edit(work, progress, f"{actor_id} is placed.")

    @tool(Needs.EDIT, idempotent=True)
    async def move(self, progress: Progress, actor: Actor, position: Position) -> Edited:
        """Put a robot or body elsewhere in the level. Restarts play: the simulation begins anew."""
        target, by_name = await self._actor(actor)

        async def work() -> None:
            await self.client.scene.set_actor_transform(target, by_name=by_name, location=position)

        return await self._edit(work, progress, f"{actor} is moved.")

    @tool(Needs.EDIT, destructive=True, idempotent=True)
    async def remove(self, progress: Progress, actor: Actor) -> Edited:
        """Remove a robot or body from the level. Restarts play: the simulation begins anew."""
        target, by_name = await self._actor(actor)
        return await self._edit(
            lambda: self.client.scene.destroy_actor(target, by_name=by_name), progress, f"{actor} is removed."
        )

    async def _actor(self, named: str) -> tuple[str, bool]:
        """Return what ops call an actor, and whether that is the engine's name for it."""
        listed = await self.client.outliner.list_actors()
        rows = [row for row in listed if row.actor_id or row.is_articulation or row.has_quick_convert]
        art = self.client.articulations.get(named)
        for row in rows:
            if row.actor_id and row.actor_id in {named, None if art is None else art.actor_id}:
                return row.actor_id, False
        for row in rows:
            if row.name in {named, None if art is None else art.compiled_prefix}:
                return row.name, True
        known = [row.actor_id or row.name for row in rows]
        raise LookupError(f"No actor is called {named!r}.{did_you_mean(named, known)} There are: {', '.join(known)}.")

    async def _edit(self, work: Callable[[], Awaitable[None]], progress: Progress, done: str) -> Edited:
        """Change the level and let play begin anew, if it ran."""

        async def restarted() -> None:
            async with self.client.scene.edit():
                await work()

        await self.driving.drive(restarted, progress)
        return self._edited(done)

    def _edited(self, done: str) -> Edited:
        robots = list(self.client.articulations)
        bodies = [name for name in self.client.entities if name not in self.client.articulations]
        return Edited(done, robots, bodies)
