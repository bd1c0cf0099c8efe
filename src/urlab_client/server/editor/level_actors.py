"""The actors of the open level by their names, and the checks of what requests say of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Literal

from msgspec.structs import replace

from urlab_client.server.assets.actors import UNIT_SCALE, Actor, ActorKind
from urlab_client.server.assets.blueprint import Blueprint, sanitized
from urlab_client.server.refusal import Refusal
from urlab_client.values.rotation import Quat, Vec3, euler_to_quat, normalized


def require(value: str, name: str) -> None:
    """Refuse with `missing_field` if a name is empty."""
    if not value:
        raise Refusal("missing_field", f"{name} must not be empty")


def refuse_infinite(values: Iterable[float], names: str, code: str) -> None:
    """Refuse with `code` unless all numbers are finite."""
    if not all(math.isfinite(value) for value in values):
        raise Refusal(code, f"{names} must be finite numbers")


def refuse_scale(scale: Vec3, code: str) -> None:
    """Refuse with `code` unless the scale is 1."""
    if scale != UNIT_SCALE:
        raise Refusal(
            code,
            f"an articulation cannot be scaled by {list(scale)}: MuJoCo has no scale for a placed model; "
            "change the sizes in the MJCF",
        )


def checked_rotation(quat: Quat | None, euler: Vec3 | None, code: str) -> Quat | None:
    """Return the rotation in a spawn request, unnormalised; None if it contains none."""
    if quat is not None or euler is None:
        return quat
    refuse_infinite(euler, "rotation_euler", code)
    return euler_to_quat(euler)


def checked_pose(location: Vec3, rotation: Quat, code: str) -> tuple[Vec3, Quat]:
    """Return position and unit quaternion; refuse an invalid pose with `code`."""
    refuse_infinite(location, "location", code)
    try:
        return location, normalized(rotation)
    except ValueError as error:
        raise Refusal(code, f"rotation_quat: {error}") from None


ActorNames = Literal["model", "plugin"]


class LevelActors:
    """The actors of a level in spawn order, and which of them is selected.

    Attributes:
        selected: Name of the selected actor; empty without a selection.
    """

    def __init__(self, naming: ActorNames) -> None:
        self.selected: str = ""
        self._naming = naming
        self._actors: dict[str, Actor] = {}

    def __iter__(self) -> Iterator[Actor]:
        return iter(self._actors.values())

    def __len__(self) -> int:
        return len(self._actors)

    def replace_all(self, actors: Mapping[str, Actor]) -> None:
        """Replace all actors; none is selected afterwards."""
        self._actors = dict(actors)
        self.selected = ""

    def remove(self, actor: Actor) -> None:
        """Remove an actor; actors attached to it stay where they are."""
        del self._actors[actor.name]
        for child in list(self):
            if child.parent == actor.name:
                self.put(replace(child, parent=""))
        if self.selected == actor.name:
            self.selected = ""

    def put(self, actor: Actor) -> Actor:
        """Replace the actor of the same name and return the new one."""
        self._actors[actor.name] = actor
        return actor

    def add(self, actor: Actor) -> Actor:
        """Add an actor with a label of its own: the short class name, numbered from the second on."""
        short = actor.class_name.removesuffix("_C")
        labels = {other.label for other in self}
        numbered = itertools.chain([short], (f"{short}{number}" for number in itertools.count(2)))
        return self.put(replace(actor, label=next(label for label in numbered if label not in labels)))

    def get(self, key: str, *, by_name: bool = False) -> Actor | None:
        """Return the actor with an id, or with an object name; None if there is none.

        Unlike in the editing ops, letter case counts here for ids kept as tags.
        """
        if by_name:
            return self._actors.get(key)
        return next((actor for actor in self if key and actor.actor_id == key), None)

    def first(self, kind: ActorKind) -> Actor | None:
        """Return the first actor of a kind; None if there is none."""
        return next((actor for actor in self if actor.kind is kind), None)

    def users(self, blueprint: Blueprint) -> list[Actor]:
        """Return the actors that are made from a blueprint."""
        return [actor for actor in self if actor.blueprint is not None and actor.blueprint.stem == blueprint.stem]

    def find(self, target: str, code: str) -> Actor:
        """Return the actor with an id or name."""
        return match_actor(self, target, code)

    def of_class(self, actor_id: str, class_name: str, code: str) -> Actor | None:
        """Return the actor that carries an id, which must be of the class; None for a new or empty id."""
        if not actor_id:
            return None
        for actor in self:
            if actor.has_id(actor_id):
                if actor.class_name != class_name:
                    raise Refusal(
                        code,
                        f"id '{actor_id}' belongs to '{actor.name}', a {actor.class_name}, not a {class_name}: "
                        "choose another id or destroy that actor",
                    )
                return actor
        return None

    def refresh(self, blueprint: Blueprint) -> None:
        """Give a blueprint that was imported again to the actors that use it."""
        for actor in self.users(blueprint):
            self.put(replace(actor, blueprint=blueprint))

    def articulation_name(self, blueprint: Blueprint) -> str:
        """Return a name for one more articulation of a blueprint."""
        if self._naming == "plugin":
            return self.numbered(blueprint.class_name)
        base = sanitized(blueprint.model_name) or blueprint.stem
        return next(
            name for name in self._copies(base) if name not in self._actors and not self._clashes(name, blueprint)
        )

    def unused_id(self, stem: str) -> str:
        """Return `stem`, or an id derived from it if an actor has that."""
        ids = {actor.actor_id for actor in self}
        return next(name for name in self._copies(stem) if name not in ids)

    def _copies(self, stem: str) -> Iterator[str]:
        """Yield `stem`, then names like `copy1_STEM`, so that no actor's name is the beginning of another's.

        Clients identify the robot of a compiled name by its beginning, and some take the first match.
        """
        yield stem
        taken = {known for actor in self for known in (actor.name, actor.actor_id) if known}
        for copy in (f"copy{number}_{stem}" for number in itertools.count(1)):
            if copy not in taken and not any(copy.startswith(known) or known.startswith(copy) for known in taken):
                yield copy

    def numbered(self, class_name: str) -> str:
        """Return the first free name of a class, numbered from 0."""
        names = (f"{class_name}_{number}" for number in itertools.count())
        return next(name for name in names if name not in self._actors)

    def _clashes(self, name: str, blueprint: Blueprint) -> bool:
        """Whether compiled names would collide: `robot` with a body `1_base` beside `robot_1` with a body `base`."""
        prefix = f"{name}_"
        for other in self:
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


def match_actor(actors: Iterable[Actor], target: str, code: str) -> Actor:
    """Return the first actor whose id or object name is `target`."""
    require(target, "target")
    for actor in actors:
        if actor.name == target or actor.has_id(target):
            return actor
    raise Refusal(code, f"no actor has the id or name '{target}'; list_actors names them")
