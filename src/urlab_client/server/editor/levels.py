"""The assets of the content root: levels, one of which is open, and blueprints."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import IMPORTS, PARENT_CLASS, Blueprint, sanitized
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.assets.level import LevelError, read_level, write_level
from urlab_client.server.editor.level_actors import LevelActors, require
from urlab_client.server.refusal import Refusal
from urlab_client.values.names import is_file_name
from urlab_client.values.scene_types import BlueprintInfo

UNTITLED: Final = "/Temp/Untitled_1"


_LEVEL_SEGMENT: Final = re.compile(r"\w(?:[\w\- ]*[\w\-])?")
_RESERVED: Final = {IMPORTS.casefold(): "holds blueprints", "urlab": "holds recordings", "uploads": "holds uploads"}


def level_package(name: str) -> str:
    """Expand a level's name to its package path: `lab`, `/Game/Levels/lab` and `/Game/Levels/lab.lab` are one level.

    Raises:
        ValueError: A part of the name is not a portable file name, or leads out of the content root.
    """
    in_game = name[:6].casefold() == "/game/"
    parts = name[6:].split("/") if in_game else name.split("/")
    package, _, described = parts[-1].partition(".")
    if described.casefold() == package.casefold():  # an object path says the name again; the engine ignores case
        parts[-1] = package
    for part in parts:
        if not _LEVEL_SEGMENT.fullmatch(part) or not is_file_name(part):
            raise ValueError(
                f"'{name}' is not a level's name: use letters, digits, spaces, '-' and '_', "
                "or a path of such parts that begins with /Game/"
            )
    if in_game and parts[0].casefold() in _RESERVED:
        raise ValueError(f"'{name}' is not a level's name: /Game/{parts[0]} {_RESERVED[parts[0].casefold()]}")
    return f"/Game/{'/'.join(parts)}" if in_game else f"/Game/Levels/{'/'.join(parts)}"


class Levels:
    """The open level's file and those beside it. Levels cannot be replaced or saved during play.

    Attributes:
        package: Path of the open level, also during play; `/Temp/Untitled_1` before one is created or loaded.
        external: Files of levels that lie outside the content root, by path of the level.
    """

    def __init__(self, content: ContentRoot, actors: LevelActors, playing: Callable[[], bool]) -> None:
        self._content = content
        self._actors = actors
        self._playing = playing
        self.package: str = UNTITLED
        self.external: dict[str, Path] = {}

    def create(self, name: str, *, force_overwrite: bool = False) -> str:
        """Create an empty level, save it, make it the open one and return its path. It has no manager yet."""
        require(name, "name")
        code = "create_level_failed"
        self._refuse_during_play(code)
        package, file = self._locate(name, code)
        if file.exists():
            if not force_overwrite:
                raise Refusal(code, f"{package} exists: load it, or pass force_overwrite to replace it")
            if package in self.external:
                raise Refusal(code, f"{package} is {file}, outside the content root: it is not overwritten")
        try:
            write_level(file, (), self._content)
        except OSError as error:
            raise Refusal(code, f"cannot write {file}: {error.strerror or error}") from None
        self._open(package, {})
        return package

    def load(self, name: str) -> str:
        """Open a level by name or path and return its path; unsaved edits of the open one are lost."""
        require(name, "level_path")
        code = "load_level_failed"
        self._refuse_during_play(code)
        package, file = self._locate(name, code)
        if not file.is_file():
            raise Refusal(code, f"no level is called {package} (no file {file})")
        self._read(package, file, trusted=package in self.external)
        return package

    def load_file(self, path: Path) -> str:
        """Open a level file named by the server's operator, and return the level's path.

        It may lie anywhere; `save_level` then writes to that file. Its models are imported from the paths in it.
        """
        code = "load_level_failed"
        self._refuse_during_play(code)
        file = path.resolve()
        if file.is_relative_to(self._content.root) and file.suffix == ".json":
            name = f"/Game/{file.relative_to(self._content.root).with_suffix('').as_posix()}"
            package, file = self._locate(name, code)
            self._read(package, file, trusted=True)
            return package
        package = f"/Game/Levels/{sanitized(file.stem)}"
        self._read(package, file, trusted=True)
        self.external[package] = file
        return package

    def save(self) -> str:
        """Save the open level and return its path."""
        code = "save_level_failed"
        self._refuse_during_play(code)
        if self.package == UNTITLED:
            raise Refusal(code, "the open level has no name yet: create one with create_level first")
        _, file = self._locate(self.package, code)
        try:
            write_level(file, self._actors, self._content)
        except OSError as error:
            raise Refusal(code, f"cannot write {file}: {error.strerror or error}") from None
        return self.package

    def shown(self) -> str:
        """Return the path of the world that `snapshot` shows: in play the level's name has Unreal's prefix."""
        if not self._playing():
            return self.package
        folder, _, name = self.package.rpartition("/")
        return f"{folder}/UEDPIE_0_{name}"

    def destroy(self, package: str) -> bool:
        """Delete a level and return whether there was one; if it was open, an empty level takes its place.

        Raises:
            OSError: It cannot be deleted.
        """
        try:
            known = level_package(package) == package
        except ValueError:
            return False
        file = self.external.get(package, self._content.level_file(package))
        if not known or not file.is_file():
            return False
        if package in self.external:
            raise Refusal("destroy_asset_failed", f"{package} is {file}, outside the content root: delete it there")
        file.unlink()
        if package == self.package:
            self._open(UNTITLED, {})
        return True

    def _refuse_during_play(self, code: str) -> None:
        if self._playing():
            raise Refusal(code, "play is running: stop it first")

    def _locate(self, name: str, code: str) -> tuple[str, Path]:
        try:
            package = level_package(name)
        except ValueError as error:
            raise Refusal(code, str(error)) from None
        return package, self.external.get(package, self._content.level_file(package))

    def _read(self, package: str, file: Path, *, trusted: bool) -> None:
        try:
            actors = read_level(file, self._content, trusted=trusted)
        except LevelError as error:
            raise Refusal("load_level_failed", str(error)) from None
        self._open(package, actors)

    def _open(self, package: str, actors: Mapping[str, Actor]) -> None:
        self.package = package
        self._actors.replace_all(actors)


class Blueprints:
    """The imported blueprints, and the actors of the open level that use them."""

    def __init__(self, content: ContentRoot, actors: LevelActors, levels: Levels) -> None:
        self._content = content
        self._actors = actors
        self._levels = levels

    def import_xml(self, path: str, *, force_reimport: bool = False, trusted: bool = False) -> tuple[Blueprint, bool]:
        """Import an MJCF file; see `ContentRoot.import_xml`. Actors of a blueprint imported again use it at next play.

        Returns:
            The blueprint, and whether it was imported now.
        """
        blueprint, imported_now = self._content.import_xml(path, force_reimport=force_reimport, trusted=trusted)
        self._actors.refresh(blueprint)
        return blueprint, imported_now

    def import_uploaded(self, document: Path) -> Blueprint:
        """Import a model that a client has sent; see `ContentRoot.import_uploaded`."""
        blueprint = self._content.import_uploaded(document)
        self._actors.refresh(blueprint)
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
            for item in sorted(self._content.blueprints.values(), key=lambda item: item.short_name)
        ]

    def destroy_asset(self, asset_path: str) -> bool:
        """Delete a blueprint or a level and return whether there was one.

        Args:
            asset_path: Object path (`/Game/Levels/lab.lab`) or package path.
        """
        require(asset_path, "asset_path")
        package, dot, name = asset_path.rpartition(".")
        if not dot:
            package = asset_path
        elif name != package.rpartition("/")[2]:
            return False
        try:
            for blueprint in self._content.blueprints.values():
                if blueprint.package_path == package:
                    self._destroy_blueprint(blueprint)
                    return True
            return self._levels.destroy(package)
        except OSError as error:
            raise Refusal("destroy_asset_failed", f"cannot delete {asset_path}: {error}") from None

    def blueprint(self, path: str, code: str) -> Blueprint:
        """Return the blueprint of a class path or package path."""
        found = self._content.find_blueprint(path)
        if found is None:
            known = ", ".join(item.package_path for item in self._content.blueprints.values()) or "none"
            raise Refusal(code, f"no blueprint is called '{path}': import one with import_xml; there are: {known}")
        return found

    def _destroy_blueprint(self, blueprint: Blueprint) -> None:
        users = [actor.name for actor in self._actors.users(blueprint)]
        if users:
            raise Refusal(
                "destroy_asset_failed",
                f"{blueprint.package_path} is used by {', '.join(users[:5])}{' and others' if len(users) > 5 else ''}: "
                "destroy the actors first",
            )
        self._content.remove_blueprint(blueprint.stem)
