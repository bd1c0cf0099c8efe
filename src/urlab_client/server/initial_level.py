"""The initial level of a server: a saved one, or models placed side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from urlab_client.errors import URLabError
from urlab_client.server.assets.bundled_robots import bundled_models, unknown_model
from urlab_client.server.editor.world import EditorWorld

GAP_M: Final = 1.0
"""Free space between the models placed side by side, metres."""


class ModelError(URLabError, ValueError):
    """A model or level given at the start is missing or cannot be used."""


def is_level(model: str) -> bool:
    """Whether a name given at the start is that of a saved level."""
    return model.lower().endswith(".json")


def populate(world: EditorWorld, models: Sequence[str]) -> None:
    """Open the level among `models`, place the other models, and add a manager if there is none."""
    for level in filter(is_level, models):
        world.levels.load_file(Path(level))
    names = [row.name for row in world.list_actors()]
    edge: float | None = None
    sources: dict[str, str] = {}
    for model in models:
        if is_level(model):
            continue
        for name in names:  # only if another model follows, because the bounding box may require compilation
            edge = _beyond(world, name, edge)
        names = [_place(world, model, sources, edge)]
    world.ensure_manager()


def _place(world: EditorWorld, model: str, sources: dict[str, str], edge: float | None) -> str:
    """Import a model, place it beyond `edge`, the largest y in use, if any, and return the actor's name.

    `sources` holds the files imported so far by blueprint.
    """
    bundled = bundled_models()
    if not Path(model).suffix and not Path(model).is_file() and model not in bundled:
        raise ModelError(unknown_model(model))
    path = model if model in bundled and not Path(model).is_file() else str(Path(model).absolute())
    # Files named on the command line are imported anew, even if an earlier run imported them.
    blueprint, _ = world.blueprints.import_xml(path, force_reimport=path not in sources.values(), trusted=True)
    other = sources.setdefault(blueprint.stem, path)
    if other != path:
        raise ModelError(f"{model} and {other} would both become blueprint '{blueprint.stem}': rename one of the files")
    actor = world.spawn_actor(blueprint.class_path, world.unused_id(Path(path).stem)).actor
    if edge is not None:
        bounds = world.get_actor_bounds(actor.name, components_only=True)
        if bounds.extents != (0.0, 0.0, 0.0):
            world.set_actor_transform(actor.name, location=(0.0, edge + GAP_M - bounds.min[1], 0.0))
    return actor.name


def _beyond(world: EditorWorld, actor_name: str, edge: float | None) -> float | None:
    """Return the larger of `edge` and the actor's largest y; an actor without a bounding box has none."""
    bounds = world.get_actor_bounds(actor_name, components_only=True)
    if bounds.extents == (0.0, 0.0, 0.0):
        return edge
    return bounds.max[1] if edge is None else max(edge, bounds.max[1])
