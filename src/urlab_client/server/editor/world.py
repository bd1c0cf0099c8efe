"""The simulated editor: an open level with its actors, and the ops that author it.

For the op handlers, which map requests to these methods and their results to replies, and for whoever starts play.
All methods run on the dispatcher's thread and answer with plain values; what cannot be done raises `Refusal` with the
code of the op. Nothing here simulates: a play session works on the copy that `EditorWorld.freeze` returns.

Positions are metres and rotations quaternions (x, y, z, w), both in MuJoCo's world frame, unless a name says `euler`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

from urlab_client.protocol.base import Quat, Vec3
from urlab_client.protocol.rotation import IDENTITY, euler_to_quat, swap_frame
from urlab_client.protocol.types import ActorBounds, ActorHierarchyNode, BlueprintInfo
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
from urlab_client.server.assets.blueprint import PARENT_CLASS, Blueprint, sanitized
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.assets.decomposition import advice, is_available
from urlab_client.server.assets.level import LevelError, read_level, write_level
from urlab_client.server.assets.package_names import level_package
from urlab_client.server.compile.bounds import actor_bounds
from urlab_client.server.compile.failure import CompileFailed
from urlab_client.server.editor import checks
from urlab_client.server.refusal import Refusal

__all__ = ["Actor", "ActorKind", "ActorNames", "ConversionSettings", "EditorWorld", "Light", "Mesh", "Placed"]
ActorNames = Literal["model", "plugin"]

UNTITLED: Final = "/Temp/Untitled_1"


class Placed(NamedTuple):
    """An actor that was placed or moved.

    Attributes:
        actor: The actor as it stands in the level now.
        rotation_quat: Rotation as understood from the request; not normalised.
        was_existing: True if an existing actor was moved.
    """

    actor: Actor
    rotation_quat: Quat
    was_existing: bool


class EditorWorld:
    """The open level and what was imported.

    Attributes:
        content: The content root.
        pie_running: Whether a play session runs; whoever starts and stops it sets this. While it is true, the ops that
            look at the play world see the actors as of the last `freeze`, and levels cannot be replaced or saved.
        selected: Name of the selected actor; empty without a selection.
    """

    def __init__(self, content: ContentRoot, *, actor_names: ActorNames = "model") -> None:
        """Open an empty, untitled level.

        Args:
            content: The content root.
            actor_names: How articulations are named: `model` after the MJCF's model name (`robot`, `robot_1`, …),
                `plugin` as the plugin does (`robot_C_0`, `robot_C_1`, …).
        """
        self.content = content
        self.pie_running = False
        self.selected = ""
        self._naming = actor_names
        self._actors: dict[str, Actor] = {}
        self._package = UNTITLED
        self._external: dict[str, Path] = {}
        self._frozen: tuple[Actor, ...] = ()

    # Content

    def import_xml(self, path: str, *, force_reimport: bool = False, trusted: bool = False) -> tuple[Blueprint, bool]:
        """Import an MJCF file; see `ContentRoot.import_xml`. Actors of a blueprint imported again use it at next play.

        Returns:
            The blueprint, and whether it was imported now.

        Raises:
            Refusal: `missing_field`, `import_failed`.
        """
        blueprint, imported_now = self.content.import_xml(path, force_reimport=force_reimport, trusted=trusted)
        self._refresh(blueprint)
        return blueprint, imported_now

    def import_uploaded(self, document: Path) -> Blueprint:
        """Import a model that a client has sent; see `ContentRoot.import_uploaded`.

        Raises:
            Refusal: `import_failed`.
        """
        blueprint = self.content.import_uploaded(document)
        self._refresh(blueprint)
        return blueprint

    def list_blueprints(self) -> list[BlueprintInfo]:
        """Return the imported blueprints, sorted by short name."""
        return [
            BlueprintInfo(
                class_path=item.class_path,
                short_name=item.short_name,
                package_path=item.package_path,
                parent_class=PARENT_CLASS,
            )
            for item in sorted(self.content.blueprints.values(), key=lambda item: item.short_name)
        ]

    def destroy_asset(self, asset_path: str) -> bool:
        """Delete a blueprint or a level and return whether there was one.

        Args:
            asset_path: Object path (`/Game/Levels/lab.lab`) or package path.

        Raises:
            Refusal: `missing_field`; `destroy_asset_failed` if actors of the open level use the blueprint, or the asset
                cannot be deleted.
        """
        checks.require(asset_path, "asset_path")
        package, dot, name = asset_path.rpartition(".")
        if not dot:
            package = asset_path
        elif name != package.rpartition("/")[2]:
            return False
        try:
            for blueprint in self.content.blueprints.values():
                if blueprint.package_path == package:
                    self._destroy_blueprint(blueprint)
                    return True
            return self._destroy_level(package)
        except OSError as error:
            raise Refusal("destroy_asset_failed", f"cannot delete {asset_path}: {error}") from None

    # Levels

    def create_level(self, name: str, *, force_overwrite: bool = False) -> str:
        """Create an empty level, save it, make it the open one and return its path. It has no manager yet.

        Raises:
            Refusal: `missing_field`; `create_level_failed` if play runs, the name is unusable, the level exists, or it
                cannot be written.
        """
        checks.require(name, "name")
        code = "create_level_failed"
        self._refuse_during_play(code)
        package, file = self._locate_level(name, code)
        if file.exists():
            if not force_overwrite:
                raise Refusal(code, f"{package} exists: load it, or pass force_overwrite to replace it")
            if package in self._external:
                raise Refusal(code, f"{package} is {file}, outside the content root: it is not overwritten")
        try:
            write_level(file, (), self.content)
        except OSError as error:
            raise Refusal(code, f"cannot write {file}: {error.strerror or error}") from None
        self._open(package, {})
        return package

    def load_level(self, name: str) -> str:
        """Open a level by name or path and return its path; unsaved edits of the open one are lost.

        Raises:
            Refusal: `missing_field`; `load_level_failed` if play runs, or the level is missing or unusable.
        """
        checks.require(name, "level_path")
        code = "load_level_failed"
        self._refuse_during_play(code)
        package, file = self._locate_level(name, code)
        if not file.is_file():
            raise Refusal(code, f"there is no level {package} (no file {file})")
        self._load(package, file, trusted=package in self._external)
        return package

    def load_level_file(self, path: Path) -> str:
        """Open a level file that whoever runs the server named, and return the level's path.

        It may lie anywhere; `save_level` then writes to that file. Models it names are imported from where it says.

        Raises:
            Refusal: `load_level_failed`.
        """
        code = "load_level_failed"
        self._refuse_during_play(code)
        file = path.resolve()
        if file.is_relative_to(self.content.root) and file.suffix == ".json":
            name = f"/Game/{file.relative_to(self.content.root).with_suffix('').as_posix()}"
            package, file = self._locate_level(name, code)
            self._load(package, file, trusted=True)
            return package
        package = f"/Game/Levels/{sanitized(file.stem)}"
        self._load(package, file, trusted=True)
        self._external[package] = file
        return package

    def save_level(self) -> str:
        """Save the open level and return its path.

        Raises:
            Refusal: `save_level_failed` if play runs, the level never had a path, or it cannot be written.
        """
        code = "save_level_failed"
        self._refuse_during_play(code)
        if self._package == UNTITLED:
            raise Refusal(code, "the open level has no name yet: create one with create_level first")
        _, file = self._locate_level(self._package, code)
        try:
            write_level(file, self._actors.values(), self.content)
        except OSError as error:
            raise Refusal(code, f"cannot write {file}: {error.strerror or error}") from None
        return self._package

    def current_level(self) -> str:
        """Return the path of the open level, also during play; `/Temp/Untitled_1` before one is created or loaded."""
        return self._package

    def shown_level(self) -> str:
        """Return the path of the world that `snapshot` shows: in play the level's name has Unreal's prefix."""
        if not self.pie_running:
            return self._package
        folder, _, name = self._package.rpartition("/")
        return f"{folder}/UEDPIE_0_{name}"

    def authored(self) -> object:
        """Return something that compares equal for as long as no level, actor or blueprint was changed."""
        return self._package, tuple(self._actors.values()), dict(self._external), dict(self.content.blueprints)

    # Actors

    def ensure_manager(self) -> tuple[Actor, bool]:
        """Return the level's manager, which play needs, and whether there was one already."""
        for actor in self._actors.values():
            if actor.kind is ActorKind.MANAGER:
                return actor, True
        return self._add(Actor(name=self._numbered("AMjManager"), label="", kind=ActorKind.MANAGER)), False

    @property
    def has_manager(self) -> bool:
        """Whether the open level has a manager actor."""
        return any(actor.kind is ActorKind.MANAGER for actor in self._actors.values())

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
            blueprint: Class path or package path.
            actor_id: Stable id; empty for one more actor without id.
            location: Position, metres.
            rotation_quat: Rotation; wins over `rotation_euler`.
            rotation_euler: (roll, pitch, yaw), degrees: Rz(yaw) Ry(-pitch) Rx(-roll).
            scale: Must be 1.

        Raises:
            Refusal: `missing_field`; `spawn_failed` for an unknown blueprint, a scale, an invalid pose, or an id
                that belongs to an actor of another class.
        """
        checks.require(blueprint, "blueprint")
        code = "spawn_failed"
        found = self._blueprint(blueprint, code)
        checks.refuse_scale(scale, code)
        understood = checks.rotation(rotation_quat, rotation_euler, code)
        pose = checks.pose(location, understood if understood is not None else IDENTITY, code)
        existing = self._of_class(actor_id, found.class_name, code)
        self._make_room(existing is None, found, code)
        return self._place(found, actor_id, existing, understood=understood or IDENTITY, pose=pose)

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
        """Place a grid of actors, x fastest. All is checked before the first is placed.

        Args:
            blueprint: Class path or package path.
            base_actor_id: Cell (i, j) gets the id `<base>_<i>_<j>`; cells that exist are moved.
            count_x: Cells along x.
            count_y: Cells along y.
            spacing: Distance between cells, metres; z is ignored.
            origin: Position of cell (0, 0), metres.
            rotation_quat: Rotation of every actor; wins over `rotation_euler`.
            rotation_euler: (roll, pitch, yaw), degrees, as `spawn_actor`.
            scale: Must be 1.

        Raises:
            Refusal: `missing_field`, `invalid_count`, `too_many_cells`, `spawn_failed`.
        """
        checks.require(blueprint, "blueprint")
        checks.require(base_actor_id, "base_actor_id")
        if count_x <= 0 or count_y <= 0:
            raise Refusal("invalid_count", f"count_x and count_y must be above zero, not {count_x} and {count_y}")
        most = self.content.limits.grid_cells
        if count_x * count_y > most:
            raise Refusal("too_many_cells", f"{count_x} x {count_y} cells are more than the limit grid_cells, {most}")
        code = "spawn_failed"
        found = self._blueprint(blueprint, code)
        checks.refuse_scale(scale, code)
        understood = checks.rotation(rotation_quat, rotation_euler, code) or IDENTITY
        cells: list[tuple[str, Actor | None, tuple[Vec3, Quat]]] = []
        for j in range(count_y):
            for i in range(count_x):
                actor_id = f"{base_actor_id}_{i}_{j}"
                location = (origin[0] + i * spacing[0], origin[1] + j * spacing[1], origin[2])
                existing = self._of_class(actor_id, found.class_name, code)
                cells.append((actor_id, existing, checks.pose(location, understood, code)))
        self._make_room(sum(existing is None for _, existing, _ in cells), found, code)
        return [
            self._place(found, actor_id, existing, understood=understood, pose=pose)
            for actor_id, existing, pose in cells
        ]

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
            actor_id: Kept as a tag.
            location: Position, metres.
            rotation_euler: (roll, pitch, yaw), degrees, in Unreal's frame; the light shines along its +x.
            intensity: In Unreal's unit for that kind; brightness here is relative to 5000.
            color: Red, green, blue.

        Raises:
            Refusal: `spawn_failed` for an unknown kind or a number that is not finite.
        """
        code = "spawn_failed"
        name = kind.casefold()
        if name not in ("directional", "point", "spot"):
            raise Refusal(code, f"no kind of light is called '{kind}': use directional, point or spot")
        checks.refuse_infinite((*rotation_euler, intensity, *color), "rotation_euler, intensity and color", code)
        at, rotation = checks.pose(location, swap_frame(euler_to_quat(rotation_euler)), code)
        self._make_room(1, None, code)
        red, green, blue = (checks.float32(channel) for channel in color)
        light = Light(kind=name, intensity=checks.float32(intensity), color=(red, green, blue))
        draft = Actor(name="", label="", kind=ActorKind.LIGHT, actor_id=actor_id, light=light)
        return self._add(replace(draft, name=self._numbered(draft.class_name), location=at, rotation=rotation))

    def destroy_actor(self, target: str) -> None:
        """Remove an actor from the level; actors attached to it stay where they are.

        Raises:
            Refusal: `missing_field`, `destroy_failed`.
        """
        actor = self._find(target, "destroy_failed")
        del self._actors[actor.name]
        for child in list(self._actors.values()):
            if child.parent == actor.name:
                self._actors[child.name] = replace(child, parent="")
        if self.selected == actor.name:
            self.selected = ""

    def set_actor_transform(
        self,
        target: str,
        *,
        location: Vec3 | None = None,
        rotation_quat: Quat | None = None,
        rotation_euler: Vec3 | None = None,
    ) -> Actor:
        """Move an actor; parts left out stay.

        Args:
            target: Actor id or name.
            location: Position, metres.
            rotation_quat: Rotation; wins over `rotation_euler`.
            rotation_euler: (roll, pitch, yaw), degrees, as `spawn_actor`.

        Raises:
            Refusal: `missing_field`; `set_actor_transform_failed` for an unknown actor or an invalid pose.
        """
        code = "set_actor_transform_failed"
        actor = self._find(target, code)
        rotation = checks.rotation(rotation_quat, rotation_euler, code)
        at, turned = checks.pose(
            location if location is not None else actor.location,
            rotation if rotation is not None else actor.rotation,
            code,
        )
        return self._put(replace(actor, location=at, rotation=turned if rotation is not None else actor.rotation))

    def duplicate_actor(self, target: str, new_actor_id: str, *, location: Vec3 | None = None) -> Placed:
        """Place a copy of an actor, or move the actor of the same class that carries the new id.

        Args:
            target: Actor id or name.
            new_actor_id: Id of the copy.
            location: Position of the copy, metres; by default 1 m along x from the source.

        Raises:
            Refusal: `missing_field`; `duplicate_failed` for an unknown actor, a manager, or an id of another class.
        """
        code = "duplicate_failed"
        source = self._find(target, code)
        checks.require(new_actor_id, "new_actor_id")
        if source.kind in (ActorKind.MANAGER, ActorKind.REPLAY_MANAGER):
            raise Refusal(code, f"'{source.name}' is a {source.class_name}, of which a level has one")
        x, y, z = source.location
        at, rotation = checks.pose(location if location is not None else (x + 1.0, y, z), source.rotation, code)
        existing = self._of_class(new_actor_id, source.class_name, code)
        self._make_room(existing is None, source.blueprint, code)
        if existing is not None:
            copy = self._put(replace(existing, location=at, rotation=rotation, scale=source.scale))
        else:
            name = (
                self._articulation_name(source.blueprint)
                if source.blueprint is not None
                else self._numbered(source.class_name)
            )
            copy = self._add(
                replace(source, name=name, label="", actor_id=new_actor_id, location=at, rotation=rotation, parent="")
            )
        return Placed(copy, rotation, existing is not None)

    # Looking

    def snapshot(self) -> list[Actor]:
        """Return every actor, of the play world while play runs."""
        return list(self._shown())

    def list_actors(self) -> list[Actor]:
        """Return every actor of the open level, also during play."""
        return list(self._actors.values())

    def find_actors(
        self, *, class_filter: str = "", tag: str = "", name_prefix: str = "", in_pie: bool = False
    ) -> tuple[list[Actor], bool]:
        """Return the actors that pass every filter that is given; letter case does not count.

        Args:
            class_filter: Class or parent class, with or without Unreal's leading A, U or F.
            tag: A whole tag.
            name_prefix: Beginning of the object name.
            in_pie: Look in the play world, if play runs.

        Returns:
            The actors, and whether they come from the play world.
        """
        in_play = in_pie and self.pie_running
        wanted = class_filter.casefold()
        classes = {wanted, wanted[1:]} if wanted[:1] in ("a", "u", "f") else {wanted}
        found = [
            actor
            for actor in (self._frozen if in_play else self._actors.values())
            if (not wanted or not classes.isdisjoint(name.casefold() for name in actor.class_chain))
            and (not tag or tag.casefold() in (own.casefold() for own in actor.tags))
            and actor.name.casefold().startswith(name_prefix.casefold())
        ]
        return found, in_play

    def actor_hierarchy(self, target: str) -> ActorHierarchyNode:
        """Return an actor and the actors attached to it, of the play world while play runs.

        Raises:
            Refusal: `missing_field`, `actor_hierarchy_failed`.
        """
        shown = self._shown()
        return _node(_match(shown, target, "actor_hierarchy_failed"), shown)

    def get_actor_bounds(self, target: str, *, components_only: bool = False) -> ActorBounds:
        """Return the box around an actor at its authored pose.

        Args:
            target: Actor id or name.
            components_only: Count geoms that collide with nothing, too.

        Raises:
            Refusal: `missing_field`; `get_actor_bounds_failed` for an unknown actor or a model that does not compile.
        """
        code = "get_actor_bounds_failed"
        actor = self._find(target, code)
        try:
            corners = actor_bounds(actor, every_geom=components_only)
        except CompileFailed as error:
            raise Refusal(code, f"the model of '{actor.name}' does not compile: {error.message}") from None
        lower, upper = corners if corners is not None else (ORIGIN, ORIGIN)
        cx, cy, cz = ((low + high) / 2.0 for low, high in zip(lower, upper, strict=True))
        ex, ey, ez = ((high - low) / 2.0 for low, high in zip(lower, upper, strict=True))
        return ActorBounds(actor_name=actor.name, min=lower, max=upper, center=(cx, cy, cz), extents=(ex, ey, ez))

    def select_actor(self, target: str) -> Actor:
        """Select one actor and return it.

        Raises:
            Refusal: `missing_field`, `select_failed`.
        """
        actor = self._find(target, "select_failed")
        self.selected = actor.name
        return actor

    def actor(self, key: str, *, by_name: bool = False) -> Actor | None:
        """Return the actor of the open level with an id, or with an object name; None if there is none.

        Unlike the editing ops, which take either, ids kept as tags compare with letter case here.
        """
        if by_name:
            return self._actors.get(key)
        return next((actor for actor in self._actors.values() if key and actor.actor_id == key), None)

    def actor_path(self, actor: Actor) -> str:
        """Return an actor's full object path."""
        return f"{self._package}.{self._package.rpartition('/')[2]}:PersistentLevel.{actor.name}"

    # Quick Convert

    def add_quick_convert(
        self,
        target: str,
        *,
        static: bool = False,
        complex_mesh: bool = False,
        coacd_threshold: float = 0.05,
        driven_by_unreal: bool = False,
        friction: Vec3 = UNIT_SCALE,
    ) -> Actor:
        """Make a static mesh actor a MuJoCo body from the next play on; a repeat replaces all settings.

        Args:
            target: Actor id or name.
            static: No free joint.
            complex_mesh: Several convex parts of a mesh file instead of one hull; needs CoACD.
            coacd_threshold: Concavity that a part may keep.
            driven_by_unreal: Mocap body.
            friction: Sliding, torsional, rolling.

        Raises:
            Refusal: `missing_field`; `add_quick_convert_failed` for an unknown actor, one without a mesh, a plane that
                is not static, a number that is not finite, or `complex_mesh` without CoACD.
        """
        code = "add_quick_convert_failed"
        actor = self._find(target, code)
        if actor.mesh is None:
            raise Refusal(code, f"'{actor.name}' is a {actor.class_name} without a mesh of its own")
        if complex_mesh and not is_available():
            raise Refusal(code, advice())
        if actor.mesh.shape == "plane" and not static:
            raise Refusal(code, f"'{actor.name}' is a plane, which cannot move: pass static")
        checks.refuse_infinite((coacd_threshold, *friction), "coacd_threshold and friction", code)
        settings = ConversionSettings(
            static=static,
            complex_mesh=complex_mesh,
            coacd_threshold=checks.float32(coacd_threshold),
            driven_by_unreal=driven_by_unreal,
            friction=friction,
        )
        return self._put(replace(actor, quick_convert=settings))

    def remove_quick_convert(self, target: str) -> Actor:
        """Make a static mesh actor mere decoration again.

        Raises:
            Refusal: `missing_field`; `remove_quick_convert_failed` for an unknown actor or one without the settings.
        """
        code = "remove_quick_convert_failed"
        actor = self._find(target, code)
        if actor.quick_convert is None:
            raise Refusal(code, f"'{actor.name}' has no Quick Convert settings")
        return self._put(replace(actor, quick_convert=None))

    # Play

    def freeze(self) -> tuple[Actor, ...]:
        """Copy the level for a play session, which edits made from now on do not touch.

        Returns:
            The actors in spawn order, and the replay manager that the plugin adds to every session.
        """
        actors = tuple(self._actors.values())
        if not any(actor.kind is ActorKind.REPLAY_MANAGER for actor in actors):
            name = self._numbered("MjReplayManager")
            actors = (*actors, Actor(name=name, label=name, kind=ActorKind.REPLAY_MANAGER))
        self._frozen = actors
        return actors

    # Internal

    def _make_room(self, count: int, blueprint: Blueprint | None, code: str) -> None:
        """Refuse with `code` when `count` more actors of a blueprint would be too many."""
        if not count:
            return
        limits = self.content.limits
        if len(self._actors) + count > limits.actors:
            raise Refusal(code, f"a level has at most {limits.actors} actors (limit actors)")
        more = [Actor(name="", label="", kind=ActorKind.ARTICULATION, blueprint=blueprint)] * count
        problem = scene_problem((*self._actors.values(), *more), limits)
        if problem:
            raise Refusal(code, problem)

    def _shown(self) -> Iterable[Actor]:
        return self._frozen if self.pie_running else self._actors.values()

    def _put(self, actor: Actor) -> Actor:
        self._actors[actor.name] = actor
        return actor

    def _add(self, actor: Actor) -> Actor:
        """Add an actor with a label of its own: the short class name, numbered from the second on."""
        short = actor.class_name.removesuffix("_C")
        labels = {other.label for other in self._actors.values()}
        return self._put(replace(actor, label=next(label for label in _variants(short, "", 2) if label not in labels)))

    def _place(
        self,
        blueprint: Blueprint,
        actor_id: str,
        existing: Actor | None,
        *,
        understood: Quat,
        pose: tuple[Vec3, Quat],
    ) -> Placed:
        at, rotation = pose
        if existing is not None:
            actor = self._put(replace(existing, location=at, rotation=rotation))
        else:
            name = self._articulation_name(blueprint)
            draft = Actor(name=name, label="", kind=ActorKind.ARTICULATION, actor_id=actor_id, blueprint=blueprint)
            actor = self._add(replace(draft, location=at, rotation=rotation))
        return Placed(actor, understood, existing is not None)

    def _articulation_name(self, blueprint: Blueprint) -> str:
        if self._naming == "plugin":
            return self._numbered(blueprint.class_name)
        base = sanitized(blueprint.model_name) or blueprint.stem
        return next(
            name for name in _variants(base, "_", 1) if name not in self._actors and not self._clashes(name, blueprint)
        )

    def _clashes(self, name: str, blueprint: Blueprint) -> bool:
        """Whether compiled names would repeat: `robot` with a body `1_base` beside `robot_1` with a body `base`."""
        prefix = f"{name}_"
        for other in self._actors.values():
            if other.blueprint is None:
                continue
            if other.prefix.startswith(prefix):
                outer, inner, rest = blueprint, other.blueprint, other.prefix.removeprefix(prefix)
            elif prefix.startswith(other.prefix):
                outer, inner, rest = other.blueprint, blueprint, prefix.removeprefix(other.prefix)
            else:
                continue
            if any(
                element.startswith(rest) and element.removeprefix(rest) in inner.element_names
                for element in outer.element_names
            ):
                return True
        return False

    def _numbered(self, class_name: str) -> str:
        return next(name for name in _numbers(class_name) if name not in self._actors)

    def _find(self, target: str, code: str) -> Actor:
        return _match(self._actors.values(), target, code)

    def _of_class(self, actor_id: str, class_name: str, code: str) -> Actor | None:
        """Return the actor that carries an id, which must be of the class; None for a new or empty id."""
        if not actor_id:
            return None
        for actor in self._actors.values():
            if actor.has_id(actor_id):
                if actor.class_name != class_name:
                    raise Refusal(
                        code,
                        f"id '{actor_id}' belongs to '{actor.name}', a {actor.class_name}, not a {class_name}: "
                        "choose another id or destroy that actor",
                    )
                return actor
        return None

    def _blueprint(self, path: str, code: str) -> Blueprint:
        found = self.content.find_blueprint(path)
        if found is None:
            known = ", ".join(item.package_path for item in self.content.blueprints.values()) or "none"
            raise Refusal(code, f"no blueprint is called '{path}': import one with import_xml; there are: {known}")
        return found

    def _refresh(self, blueprint: Blueprint) -> None:
        for actor in list(self._actors.values()):
            if actor.blueprint is not None and actor.blueprint.stem == blueprint.stem:
                self._put(replace(actor, blueprint=blueprint))

    def _refuse_during_play(self, code: str) -> None:
        if self.pie_running:
            raise Refusal(code, "play is running: stop it first")

    def _locate_level(self, name: str, code: str) -> tuple[str, Path]:
        try:
            package = level_package(name)
        except ValueError as error:
            raise Refusal(code, str(error)) from None
        return package, self._external.get(package, self.content.level_file(package))

    def _load(self, package: str, file: Path, *, trusted: bool) -> None:
        try:
            actors = read_level(file, self.content, trusted=trusted)
        except LevelError as error:
            raise Refusal("load_level_failed", str(error)) from None
        self._open(package, actors)

    def _open(self, package: str, actors: Mapping[str, Actor]) -> None:
        self._package = package
        self._actors = dict(actors)
        self.selected = ""

    def _destroy_blueprint(self, blueprint: Blueprint) -> None:
        users = [
            actor.name
            for actor in self._actors.values()
            if actor.blueprint is not None and actor.blueprint.stem == blueprint.stem
        ]
        if users:
            raise Refusal(
                "destroy_asset_failed",
                f"{blueprint.package_path} is used by {', '.join(users[:5])}{' and others' if len(users) > 5 else ''}: "
                "destroy the actors first",
            )
        self.content.remove_blueprint(blueprint.stem)

    def _destroy_level(self, package: str) -> bool:
        try:
            known = level_package(package) == package
        except ValueError:
            return False
        file = self._external.get(package, self.content.level_file(package))
        if not known or not file.is_file():
            return False
        if package in self._external:
            raise Refusal("destroy_asset_failed", f"{package} is {file}, outside the content root: delete it there")
        file.unlink()
        if package == self._package:
            self._open(UNTITLED, {})
        return True


def _variants(stem: str, separator: str, first: int) -> Iterator[str]:
    """Yield `stem`, then `stem` with the numbers from `first` on."""
    yield stem
    number = first
    while True:
        yield f"{stem}{separator}{number}"
        number += 1


def _numbers(stem: str) -> Iterator[str]:
    number = 0
    while True:
        yield f"{stem}_{number}"
        number += 1


def _match(actors: Iterable[Actor], target: str, code: str) -> Actor:
    """Return the first actor whose id or object name is `target`."""
    checks.require(target, "target")
    for actor in actors:
        if actor.name == target or actor.has_id(target):
            return actor
    raise Refusal(code, f"no actor has the id or name '{target}'; list_actors names them")


def _node(actor: Actor, actors: Iterable[Actor]) -> ActorHierarchyNode:
    children = [_node(child, actors) for child in actors if child.parent == actor.name]
    return ActorHierarchyNode(name=actor.name, actor_class=actor.class_name, location=actor.location, children=children)
