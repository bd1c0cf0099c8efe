"""The simulated editor: an open level with its actors, and the ops that author it.

For the op handlers, which map requests to these methods and their results to replies, and for the code that starts
play. All methods run on the dispatcher's thread and return plain values; on failure they raise `Refusal` with the code
of the op. Nothing here simulates: a play session works on the copy that `EditorWorld.freeze` returns.

Positions are metres and rotations quaternions (x, y, z, w), both in MuJoCo's world frame, unless a name says `euler`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from urlab_client.server.assets.actors import (
    ORIGIN,
    UNIT_SCALE,
    Actor,
    ActorKind,
    ConversionSettings,
    Light,
    Mesh,
    scene_problem,
)
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.assets.decomposition import advice, is_available
from urlab_client.server.compile.composition import actor_bounds
from urlab_client.server.editor.level_actors import (
    ActorNames,
    LevelActors,
    checked_pose,
    checked_rotation,
    match_actor,
    refuse_infinite,
    refuse_scale,
    require,
)
from urlab_client.server.editor.levels import Blueprints, Levels
from urlab_client.server.refusal import CompileFailed, Refusal
from urlab_client.simulation.controllers import float32
from urlab_client.values.rotation import IDENTITY, Quat, Vec3, euler_to_quat, swap_frame
from urlab_client.values.scene_types import ActorBounds, ActorHierarchyNode

__all__ = ["Actor", "ActorKind", "ActorNames", "ConversionSettings", "EditorWorld", "Light", "Mesh", "Placed"]


class Placed(NamedTuple):
    """An actor that was placed or moved.

    Attributes:
        rotation_quat: Rotation from the request; not normalised.
        was_existing: True if an existing actor was moved.
    """

    actor: Actor
    rotation_quat: Quat
    was_existing: bool


class EditorWorld:
    """The open level and the imported assets.

    Attributes:
        actors: The actors of the open level, also during play.
        pie_running: Whether a play session runs; set by the code that starts and stops it. While it is true, the ops
            that look at the play world see the actors as of the last `freeze`, and levels cannot be replaced or saved.
    """

    def __init__(self, content: ContentRoot, *, actor_names: ActorNames = "model") -> None:
        """Open an empty, untitled level.

        Args:
            actor_names: How articulations are named: `model` after the MJCF's model name (`robot`, `copy1_robot`, …),
                `plugin` as the plugin does (`robot_C_0`, `robot_C_1`, …).
        """
        self.content = content
        self.pie_running = False
        self.actors: LevelActors = LevelActors(actor_names)
        self.levels: Levels = Levels(content, self.actors, lambda: self.pie_running)
        self.blueprints: Blueprints = Blueprints(content, self.actors, self.levels)
        self.quick_convert: QuickConvert = QuickConvert(self.actors)
        self._frozen: tuple[Actor, ...] = ()

    def authored(self) -> object:
        """Return a value that compares equal until a level, actor or blueprint changes."""
        return self.levels.package, tuple(self.actors), dict(self.levels.external), dict(self.content.blueprints)

    # Actors

    def ensure_manager(self) -> tuple[Actor, bool]:
        """Return the level's manager, which play needs, and whether there was one already."""
        manager = self.actors.first(ActorKind.MANAGER)
        if manager is not None:
            return manager, True
        return self.actors.add(Actor(name=self.actors.numbered("AMjManager"), kind=ActorKind.MANAGER)), False

    @property
    def has_manager(self) -> bool:
        """Whether the open level has a manager actor."""
        return self.actors.first(ActorKind.MANAGER) is not None

    def spawn_actor(
        self,
        blueprint: str,
        actor_id: str = "",
        *,
        location: Vec3 = ORIGIN,
        rotation_quat: Quat | None = None,
        rotation_euler: Vec3 | None = None,
        scale: Vec3 = UNIT_SCALE,
    ) -> Placed:
        """Place an instance of a blueprint, or move the actor that carries the id.

        Args:
            actor_id: Stable id; empty for one more actor without id.
            location: Position, metres.
            rotation_quat: Rotation; wins over `rotation_euler`.
            rotation_euler: (roll, pitch, yaw), degrees: Rz(yaw) Ry(-pitch) Rx(-roll).
            scale: Must be 1.
        """
        require(blueprint, "blueprint")
        return self._spawn(blueprint, [(actor_id, location)], rotation_quat, rotation_euler, scale)[0]

    def spawn_grid(
        self,
        blueprint: str,
        base_actor_id: str,
        count_x: int,
        count_y: int,
        *,
        spacing: Vec3 = (1.0, 1.0, 0.0),
        origin: Vec3 = ORIGIN,
        rotation_quat: Quat | None = None,
        rotation_euler: Vec3 | None = None,
        scale: Vec3 = UNIT_SCALE,
    ) -> list[Placed]:
        """Place a grid of actors, x fastest. Everything is checked before the first is placed.

        Args:
            base_actor_id: Cell (i, j) gets the id `<base>_<i>_<j>`; cells that exist are moved.
            spacing: Distance between cells, metres; z is ignored.
            origin: Position of cell (0, 0), metres.
        """
        require(blueprint, "blueprint")
        require(base_actor_id, "base_actor_id")
        if count_x <= 0 or count_y <= 0:
            raise Refusal("invalid_count", f"count_x and count_y must be above zero, not {count_x} and {count_y}")
        most = self.content.limits.grid_cells
        if count_x * count_y > most:
            raise Refusal("too_many_cells", f"{count_x} x {count_y} cells are more than the limit grid_cells, {most}")
        x, y, z = origin
        cells = [
            (f"{base_actor_id}_{i}_{j}", (x + i * spacing[0], y + j * spacing[1], z))
            for j in range(count_y)
            for i in range(count_x)
        ]
        return self._spawn(blueprint, cells, rotation_quat, rotation_euler, scale)

    def spawn_light(
        self,
        kind: str = "directional",
        actor_id: str = "",
        *,
        location: Vec3 = ORIGIN,
        rotation_euler: Vec3 = ORIGIN,
        intensity: float = 5000.0,
        color: Vec3 = UNIT_SCALE,
    ) -> Actor:
        """Place a light; each call adds one, also with an id that is used already.

        Args:
            kind: `directional`, `point` or `spot`, in any letter case.
            rotation_euler: (roll, pitch, yaw), degrees, in Unreal's frame; the light shines along its +x.
            intensity: In Unreal's unit for that kind; brightness here is relative to 5000.
        """
        code = "spawn_failed"
        name = kind.casefold()
        if name not in ("directional", "point", "spot"):
            raise Refusal(code, f"'{kind}' is not a kind of light: use directional, point or spot")
        refuse_infinite((*rotation_euler, intensity, *color), "rotation_euler, intensity and color", code)
        at, rotation = checked_pose(location, swap_frame(euler_to_quat(rotation_euler)), code)
        self._make_room(1, None, code)
        red, green, blue = (float32(channel) for channel in color)
        light = Light(kind=name, intensity=float32(intensity), color=(red, green, blue))
        draft = Actor(name="", kind=ActorKind.LIGHT, actor_id=actor_id, light=light)
        return self.actors.add(
            replace(draft, name=self.actors.numbered(draft.class_name), location=at, rotation=rotation)
        )

    def destroy_actor(self, target: str) -> None:
        """Remove an actor from the level; actors attached to it stay where they are."""
        self.actors.remove(self.actors.find(target, "destroy_failed"))

    def set_actor_transform(
        self,
        target: str,
        *,
        location: Vec3 | None = None,
        rotation_quat: Quat | None = None,
        rotation_euler: Vec3 | None = None,
    ) -> Actor:
        """Move an actor; parts left out stay."""
        code = "set_actor_transform_failed"
        actor = self.actors.find(target, code)
        rotation = checked_rotation(rotation_quat, rotation_euler, code)
        at, turned = checked_pose(
            location if location is not None else actor.location,
            rotation if rotation is not None else actor.rotation,
            code,
        )
        return self.actors.put(replace(actor, location=at, rotation=turned if rotation is not None else actor.rotation))

    def duplicate_actor(self, target: str, new_actor_id: str, *, location: Vec3 | None = None) -> Placed:
        """Place a copy of an actor, or move the actor of the same class that carries the new id.

        Args:
            location: Position of the copy, metres; by default 1 m along x from the source.
        """
        code = "duplicate_failed"
        source = self.actors.find(target, code)
        require(new_actor_id, "new_actor_id")
        if source.kind in (ActorKind.MANAGER, ActorKind.REPLAY_MANAGER):
            raise Refusal(code, f"'{source.name}' is a {source.class_name}, of which a level has one")
        x, y, z = source.location
        at, rotation = checked_pose(location if location is not None else (x + 1.0, y, z), source.rotation, code)
        existing = self.actors.of_class(new_actor_id, source.class_name, code)
        self._make_room(existing is None, source.blueprint, code)
        if existing is not None:
            copy = self.actors.put(replace(existing, location=at, rotation=rotation, scale=source.scale))
        else:
            name = (
                self.actors.articulation_name(source.blueprint)
                if source.blueprint is not None
                else self.actors.numbered(source.class_name)
            )
            copy = self.actors.add(
                replace(source, name=name, actor_id=new_actor_id, location=at, rotation=rotation, parent="")
            )
        return Placed(copy, rotation, existing is not None)

    # Looking

    def snapshot(self) -> list[Actor]:
        """Return all actors; during play, those of the play world."""
        return list(self._shown())

    def find_actors(
        self, *, class_filter: str = "", tag: str = "", name_prefix: str = "", in_pie: bool = False
    ) -> tuple[list[Actor], bool]:
        """Return the actors that match all given filters; letter case does not count.

        Args:
            class_filter: Class or parent class, with or without Unreal's leading A, U or F.
            in_pie: Look in the play world, if play runs.

        Returns:
            The actors, and whether they come from the play world.
        """
        in_play = in_pie and self.pie_running
        wanted = class_filter.casefold()
        classes = {wanted, wanted[1:]} if wanted[:1] in ("a", "u", "f") else {wanted}
        found = [
            actor
            for actor in (self._frozen if in_play else self.actors)
            if (not wanted or not classes.isdisjoint(name.casefold() for name in actor.class_chain))
            and (not tag or tag.casefold() in (own.casefold() for own in actor.tags))
            and actor.name.casefold().startswith(name_prefix.casefold())
        ]
        return found, in_play

    def actor_hierarchy(self, target: str) -> ActorHierarchyNode:
        """Return an actor and the actors attached to it, of the play world while play runs."""
        shown = self._shown()
        return _node(match_actor(shown, target, "actor_hierarchy_failed"), shown)

    def get_actor_bounds(self, target: str, *, components_only: bool = False) -> ActorBounds:
        """Return the box around an actor at its authored pose."""
        code = "get_actor_bounds_failed"
        actor = self.actors.find(target, code)
        try:
            corners = actor_bounds(actor, every_geom=components_only)
        except CompileFailed as error:
            raise Refusal(code, f"the model of '{actor.name}' does not compile: {error.message}") from None
        lower, upper = corners if corners is not None else (ORIGIN, ORIGIN)
        cx, cy, cz = ((low + high) / 2.0 for low, high in zip(lower, upper, strict=True))
        ex, ey, ez = ((high - low) / 2.0 for low, high in zip(lower, upper, strict=True))
        return ActorBounds(actor_name=actor.name, min=lower, max=upper, center=(cx, cy, cz), extents=(ex, ey, ez))

    def select_actor(self, target: str) -> Actor:
        """Select one actor and return it."""
        actor = self.actors.find(target, "select_failed")
        self.actors.selected = actor.name
        return actor

    def actor_path(self, actor: Actor) -> str:
        """Return an actor's full object path."""
        return f"{self.levels.package}.{self.levels.package.rpartition('/')[2]}:PersistentLevel.{actor.name}"

    # Play

    def freeze(self) -> tuple[Actor, ...]:
        """Copy the level for a play session, so that later edits do not affect it.

        Returns:
            The actors in spawn order, and the replay manager that the plugin adds to every session.
        """
        actors = tuple(self.actors)
        if not any(actor.kind is ActorKind.REPLAY_MANAGER for actor in actors):
            name = self.actors.numbered("MjReplayManager")
            actors = (*actors, Actor(name=name, label=name, kind=ActorKind.REPLAY_MANAGER))
        self._frozen = actors
        return actors

    # Internal

    def _make_room(self, count: int, blueprint: Blueprint | None, code: str) -> None:
        """Refuse with `code` when `count` more actors of a blueprint would be too many."""
        if not count:
            return
        limits = self.content.limits
        if len(self.actors) + count > limits.actors:
            raise Refusal(code, f"a level has at most {limits.actors} actors (limit actors)")
        more = [Actor(name="", kind=ActorKind.ARTICULATION, blueprint=blueprint)] * count
        problem = scene_problem((*self.actors, *more), limits)
        if problem:
            raise Refusal(code, problem)

    def _shown(self) -> Iterable[Actor]:
        return self._frozen if self.pie_running else self.actors

    def _spawn(
        self,
        path: str,
        cells: Sequence[tuple[str, Vec3]],
        rotation_quat: Quat | None,
        rotation_euler: Vec3 | None,
        scale: Vec3,
    ) -> list[Placed]:
        """Place or move an instance of a blueprint for each id and location, after all of them were checked."""
        code = "spawn_failed"
        blueprint = self.blueprints.blueprint(path, code)
        refuse_scale(scale, code)
        rotation = checked_rotation(rotation_quat, rotation_euler, code) or IDENTITY
        poses = [checked_pose(location, rotation, code) for _, location in cells]
        existing = [self.actors.of_class(actor_id, blueprint.class_name, code) for actor_id, _ in cells]
        self._make_room(existing.count(None), blueprint, code)
        placed: list[Placed] = []
        for (actor_id, _), (at, turned), before in zip(cells, poses, existing, strict=True):
            if before is not None:
                actor = self.actors.put(replace(before, location=at, rotation=turned))
            else:
                name = self.actors.articulation_name(blueprint)
                draft = Actor(name=name, kind=ActorKind.ARTICULATION, actor_id=actor_id, blueprint=blueprint)
                actor = self.actors.add(replace(draft, location=at, rotation=turned))
            placed.append(Placed(actor, rotation, before is not None))
        return placed


def _node(actor: Actor, actors: Iterable[Actor]) -> ActorHierarchyNode:
    children = [_node(child, actors) for child in actors if child.parent == actor.name]
    return ActorHierarchyNode(name=actor.name, actor_class=actor.class_name, location=actor.location, children=children)


class QuickConvert:
    """The Quick Convert settings of the actors of the open level."""

    def __init__(self, actors: LevelActors) -> None:
        self._actors = actors

    def add(self, target: str, settings: ConversionSettings) -> Actor:
        """Make a static mesh actor a MuJoCo body from the next play on. Repeating it replaces all settings."""
        code = "add_quick_convert_failed"
        actor = self._actors.find(target, code)
        if actor.mesh is None:
            raise Refusal(code, f"'{actor.name}' is a {actor.class_name} without a mesh of its own")
        if settings.complex_mesh and not is_available():
            raise Refusal(code, advice())
        if actor.mesh.shape == "plane" and not settings.static:
            raise Refusal(code, f"'{actor.name}' is a plane, which cannot move: pass static")
        threshold = settings.coacd_threshold
        refuse_infinite((threshold, *settings.friction), "coacd_threshold and friction", code)
        kept = replace(settings, coacd_threshold=float32(threshold))
        return self._actors.put(replace(actor, quick_convert=kept))

    def remove(self, target: str) -> Actor:
        """Make a static mesh actor decoration again."""
        code = "remove_quick_convert_failed"
        actor = self._actors.find(target, code)
        if actor.quick_convert is None:
            raise Refusal(code, f"'{actor.name}' has no Quick Convert settings")
        return self._actors.put(replace(actor, quick_convert=None))
