"""Level files: JSON with a format version, the actors, and where to find the blueprints they are instances of.

For `World`. A level names files relative to itself, so a folder with the level and its models, or a whole content root,
can be moved. Besides what the ops author, a level is the way to bring in static meshes, for which no op exists.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Struct

from urlab_client._platform.files import write_whole
from urlab_client.server.assets.actors import UNIT_SCALE, Actor, ActorKind, ActorSettings, ConversionSettings, Mesh
from urlab_client.server.assets.blueprint import Blueprint, sanitized
from urlab_client.server.assets.bundled_robots import BUNDLED_PREFIX
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.assets.decomposition import advice, is_available
from urlab_client.server.refusal import Refusal
from urlab_client.simulation.controller_config import ControllerConfig
from urlab_client.values.rotation import IDENTITY, Quat, normalized

logger: logging.Logger = logging.getLogger("urlab_client.server")

FORMAT: Final = "urlab-level"
VERSION: Final = 1

_SIZES: Final = {"box": 3, "ellipsoid": 3, "sphere": 1, "capsule": 2, "cylinder": 2, "plane": 2, "file": 0}


class LevelError(Exception):
    """A level file cannot be used; the message says why, in one line."""


class _Header(Struct):
    format: str = ""
    version: int = 0


class _Blueprint(Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Where a blueprint comes from; paths are relative to the level file."""

    source: str
    digest: str = ""
    record: str = ""


class _Actor(ActorSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    rotation_quat: Quat = IDENTITY
    tags: tuple[str, ...] = ()
    blueprint: str = ""


class _Level(Struct, forbid_unknown_fields=True):
    format: str
    version: int
    blueprints: dict[str, _Blueprint]
    actors: list[_Actor]


_HEADER: Final = msgspec.json.Decoder(_Header)
_LEVEL: Final = msgspec.json.Decoder(_Level)


def write_level(path: Path, actors: Iterable[Actor], content: ContentRoot) -> None:
    """Write a level atomically.

    Raises:
        OSError: It cannot be written.
    """
    folder = path.parent.resolve()
    entries: list[_Actor] = []
    blueprints: dict[str, _Blueprint] = {}
    for actor in actors:
        blueprint, mesh = actor.blueprint, actor.mesh
        if blueprint is not None:
            blueprints[blueprint.stem] = _Blueprint(
                source=_relative(blueprint.source, folder),
                digest=blueprint.digest,
                record=_relative(str(content.snapshot_record(blueprint)), folder),
            )
        if mesh is not None and mesh.file:
            mesh = msgspec.structs.replace(mesh, file=_relative(mesh.file, folder))
        entries.append(
            _Actor(
                **_shared(actor, mesh=mesh),
                rotation_quat=actor.rotation,
                tags=actor.own_tags,
                blueprint=blueprint.stem if blueprint is not None else "",
            )
        )
    level = _Level(format=FORMAT, version=VERSION, blueprints=blueprints, actors=entries)
    write_whole(path, msgspec.json.format(msgspec.json.encode(level), indent=2) + b"\n")


def read_level(path: Path, content: ContentRoot, *, trusted: bool = False) -> dict[str, Actor]:
    """Read a level, importing the blueprints it names if the content root lacks them.

    Args:
        trusted: The server's operator named the level: its models may lie anywhere, and take
            precedence over different ones of the content root.

    Returns:
        The actors by name, in spawn order.

    Raises:
        LevelError: The file is missing, not a level, of a newer version, or refers to something unusable.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LevelError(f"cannot read {path}: {error.strerror or error}") from None
    try:
        header = _HEADER.decode(data)
        if header.format != FORMAT:
            raise LevelError(f'{path} is not a level: it lacks "format": "{FORMAT}"')
        if header.version != VERSION:
            raise LevelError(f"{path} has version {header.version} of the level format; this server reads {VERSION}")
        level = _LEVEL.decode(data)
    except (ValueError, RecursionError) as error:
        raise LevelError(f"{path} is not a level: {error}") from None
    folder = path.parent.resolve()
    blueprints: dict[str, Blueprint] = {}
    for stem in dict.fromkeys(entry.blueprint for entry in level.actors if entry.blueprint):
        blueprints[stem] = _resolve(stem, level.blueprints.get(stem), folder, content, trusted=trusted)
    actors: dict[str, Actor] = {}
    for index, entry in enumerate(level.actors):
        if entry.name in actors:
            raise LevelError(f"{path}: two actors are called '{entry.name}'")
        try:
            actors[entry.name] = _actor(entry, folder, blueprints, None if trusted else content)
        except ValueError as error:
            raise LevelError(f"{path}: actor {index} ('{entry.name}'): {error}") from None
    for actor in actors.values():
        _check_parents(path, actor, actors)
    return actors


def _shared(source: ActorSettings, **changed: Any) -> dict[str, Any]:
    return {name: getattr(source, name) for name in ActorSettings.__struct_fields__} | changed


def _relative(target: str, folder: Path) -> str:
    """Return a path relative to `folder`, with forward slashes; unchanged if that is impossible, as across drives."""
    if target.startswith(BUNDLED_PREFIX):
        return target
    try:
        return Path(os.path.relpath(target, folder)).as_posix()
    except ValueError:
        return target


def _resolve(stem: str, entry: _Blueprint | None, folder: Path, content: ContentRoot, *, trusted: bool) -> Blueprint:
    known = content.blueprints.get(stem)
    if entry is None:
        if known is None:
            raise LevelError(f"blueprint '{stem}' is not imported, and the level does not say where it comes from")
        return known
    record = (folder / entry.record).resolve()
    if entry.record and not trusted and not content.open_to_clients(record):
        raise LevelError(f"blueprint '{stem}': {record} lies outside the folders that clients may read")
    if known is not None and (not trusted or known.digest == entry.digest or record == content.snapshot_record(known)):
        return known
    try:
        # A client may have written the record, so its model is imported again, in the sandbox.
        adopt = entry.record and (trusted or record.is_relative_to(content.root))
        found = _from_record(record, entry.digest, content) if adopt else None
        if found is None:
            found = _from_source(entry.source, folder, content, trusted=trusted)
    except Refusal as error:
        if known is None:
            raise LevelError(f"blueprint '{stem}': {error.message}") from None
        logger.warning("the imported '%s' differs from the level's, which cannot be read: %s", stem, error.message)
        return known
    if found.stem != stem:
        raise LevelError(f"blueprint '{stem}' comes from {entry.source}, which makes one called '{found.stem}'")
    if entry.digest and found.digest != entry.digest:
        logger.warning("%s has changed since the level was saved; the new model is used", found.source)
    return found


def _from_record(record: Path, digest: str, content: ContentRoot) -> Blueprint | None:
    """Return the blueprint of another content root, if it exists and is still the one that the level was saved with."""
    if not record.is_file():
        return None
    try:
        return content.adopt(record, digest)
    except (OSError, ValueError) as error:
        logger.warning("%s is not usable: %s", record, error)
        return None


def _from_source(source: str, folder: Path, content: ContentRoot, *, trusted: bool) -> Blueprint:
    path = source if source.startswith(BUNDLED_PREFIX) else str(folder / source)
    return content.import_xml(path, force_reimport=True, trusted=trusted)[0]


def _actor(entry: _Actor, folder: Path, blueprints: Mapping[str, Blueprint], confined_to: ContentRoot | None) -> Actor:
    """Check an entry and return its actor."""
    if not entry.name or entry.name != sanitized(entry.name):
        raise ValueError("a name has letters, digits and underscores only")
    _check_settings(entry)
    mesh = entry.mesh
    if mesh is not None:
        _check_mesh(mesh, entry.quick_convert)
        if mesh.file:
            file = (folder / mesh.file).resolve()
            if confined_to is not None and not confined_to.open_to_clients(file):
                raise ValueError(f"mesh {file} lies outside the folders that clients may read")
            mesh = msgspec.structs.replace(mesh, file=str(file))
    return Actor(
        **_shared(entry, mesh=mesh, label=entry.label or entry.name),
        rotation=normalized(entry.rotation_quat),
        own_tags=entry.tags,
        blueprint=blueprints[entry.blueprint] if entry.blueprint else None,
    )


def _check_settings(entry: _Actor) -> None:
    needs = {
        ActorKind.ARTICULATION: "blueprint",
        ActorKind.LIGHT: "light",
        ActorKind.STATIC_MESH: "mesh",
    }
    present: dict[str, Any] = {"blueprint": entry.blueprint, "light": entry.light, "mesh": entry.mesh}
    for name, value in present.items():
        if bool(value) != (needs.get(entry.kind) == name):
            verb = "needs" if not value else "cannot have"
            raise ValueError(f"kind '{entry.kind}' {verb} a '{name}'")
    if entry.quick_convert is not None and entry.kind is not ActorKind.STATIC_MESH:
        raise ValueError("only a static mesh can have 'quick_convert'")
    if entry.controller:
        if entry.kind is not ActorKind.ARTICULATION:
            raise ValueError("only an articulation can have a 'controller'")
        ControllerConfig.parse(entry.controller)
    if entry.kind is ActorKind.ARTICULATION and entry.scale != UNIT_SCALE:
        raise ValueError("an articulation cannot be scaled")
    if 0.0 in entry.scale:
        raise ValueError("no component of scale can be zero")


def _check_mesh(mesh: Mesh, convert: ConversionSettings | None) -> None:
    if len(mesh.size) != _SIZES[mesh.shape] or min(mesh.size, default=1.0) <= 0:
        raise ValueError(f"shape '{mesh.shape}' takes {_SIZES[mesh.shape]} positive numbers as 'size'")
    if bool(mesh.file) != (mesh.shape == "file"):
        raise ValueError("shape 'file', and no other, takes a 'file'")
    if mesh.shape == "plane" and convert is not None and not convert.static:
        raise ValueError("a plane cannot move: its 'quick_convert' must be static")
    if convert is not None and convert.complex_mesh and not is_available():
        raise ValueError(advice())


def _check_parents(path: Path, actor: Actor, actors: Mapping[str, Actor]) -> None:
    seen = {actor.name}
    above = actor
    while above.parent:
        if above.parent not in actors:
            raise LevelError(f"{path}: actor '{above.name}' is attached to '{above.parent}', which is not in the level")
        above = actors[above.parent]
        if above.name in seen:
            raise LevelError(f"{path}: actor '{actor.name}' is attached to itself")
        seen.add(above.name)
