"""The blueprints of the editor: importing them, listing them, and deleting unused ones."""

from __future__ import annotations

from pathlib import Path

from urlab_client.server.assets.blueprint import PARENT_CLASS, Blueprint
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.editor import checks
from urlab_client.server.editor.level_actors import LevelActors
from urlab_client.server.editor.levels import Levels
from urlab_client.server.refusal import Refusal
from urlab_client.values.scene_types import BlueprintInfo


class Blueprints:
    """The imported blueprints, and the actors of the open level that use them."""

    def __init__(self, content: ContentRoot, actors: LevelActors, levels: Levels) -> None:
        """Manage the assets of a content root."""
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
        checks.require(asset_path, "asset_path")
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
