"""The content root of the simulated server: a folder that stands for `/Game`, with its blueprints and levels.

A blueprint is an MJCF file imported once. The content root keeps a self-contained snapshot of it (one XML plus the
files it needs), so later edits of the source change nothing until the file is imported again:

    MuJoCoImports/<stem>/blueprint.json         what was imported, from where, when
    MuJoCoImports/<stem>/<digest>/model.xml     the snapshot, with its meshes and textures beside it
    Levels/<name>.json                          a level

For `EditorWorld`, which knows what is placed where. Nothing here places, compiles scenes or talks to clients.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import stat
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Final

import msgspec
import mujoco

from urlab_client._platform.files import write_whole
from urlab_client.protocol.instances import import_directory
from urlab_client.server.assets.blueprint import IMPORTS, Blueprint, BlueprintRecord, load_blueprint, sanitized
from urlab_client.server.assets.bundled_robots import BUNDLED_PREFIX, bundled_models, bundled_root
from urlab_client.server.assets.importer import build_confined, compile_snapshot, one_line, write_snapshot
from urlab_client.server.limits import Limits
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.temporary_folder import TemporaryFolder, sweep

logger: logging.Logger = logging.getLogger("urlab_client.server")

UPLOADED: Final = "uploaded"
"""Source of a blueprint that a client has uploaded."""

_UNDER_WAY: Final = ".import-"
"""Prefix of the temporary folders in which imports are written and removed."""

_DEFAULT_LIMITS: Final = Limits()


class ContentRoot:
    """The folder that stands for `/Game`, and the folders `import_xml` may read from."""

    def __init__(self, saved_dir: Path, *, model_roots: Sequence[Path] = (), limits: Limits = _DEFAULT_LIMITS) -> None:
        """Open a content root with its earlier imports.

        Args:
            saved_dir: Folder of the content root; made when something is first written.
            model_roots: Folders below which MJCF files may be imported. The models shipped with this package, and
                those that a console hands over in `import_directory()`, may always be.
        """
        self.limits = limits
        self.root: Path = saved_dir.resolve()
        self.model_roots: tuple[Path, ...] = tuple(root.resolve() for root in model_roots)
        self._blueprints: dict[str, Blueprint] = {}
        sweep(self.root / IMPORTS, _UNDER_WAY)
        for record in sorted(self.root.glob(f"{IMPORTS}/*/blueprint.json")):
            try:
                blueprint = load_blueprint(record)
            except (OSError, ValueError) as error:
                logger.warning("%s is not usable and left out: %s", record, error)
            else:
                self._blueprints[blueprint.stem] = blueprint

    @property
    def blueprints(self) -> Mapping[str, Blueprint]:
        """The blueprints by stem."""
        return MappingProxyType(self._blueprints)

    def find_blueprint(self, path: str) -> Blueprint | None:
        """Return the blueprint of a class path, or of a package path, as `spawn_actor` takes them.

        A path that does not end in `_C` gets its last part appended, so neither a bare name nor an object path works,
        as in the plugin.
        """
        class_path = path if path[-2:].casefold() == "_c" else f"{path}.{path.rpartition('/')[2]}_C"
        wanted = class_path.casefold()
        return next((item for item in self._blueprints.values() if item.class_path.casefold() == wanted), None)

    @property
    def _import_roots(self) -> tuple[Path, ...]:
        """Folders below which clients may import; resolved."""
        handed_over = import_directory()
        return *self.model_roots, bundled_root(), *(() if handed_over is None else (handed_over.resolve(),))

    def import_xml(self, path: str, *, force_reimport: bool = False, trusted: bool = False) -> tuple[Blueprint, bool]:
        """Import an MJCF file, or return the blueprint of the same file stem.

        Args:
            path: The file: absolute, or relative to a model root, or the name of a bundled model.
            force_reimport: Import again even if the stem is known. Actors get the new model at the next play.
            trusted: The path comes from the server's operator, so it may lie anywhere.

        Returns:
            The blueprint, and whether it was imported now.
        """
        if not path:
            raise Refusal("missing_field", "path: name the MJCF file to import")
        file, source = self._locate(path, trusted=trusted)
        roots = None if trusted else self._import_roots
        return self._import_file(file, source, roots, force_reimport=force_reimport)

    def import_uploaded(self, document: Path) -> Blueprint:
        """Import a model that a client has sent. It is always imported anew, and reads only files of its own folder."""
        document = document.resolve()
        return self._import_file(document, UPLOADED, (document.parent,), force_reimport=True)[0]

    def _import_file(
        self, file: Path, source: str, roots: tuple[Path, ...] | None, *, force_reimport: bool
    ) -> tuple[Blueprint, bool]:
        """Import a file that may read others below `roots`, or anywhere if `roots` is None (operator's choice)."""
        trusted = roots is None
        stem = sanitized(file.stem)
        try:
            size = file.stat().st_size
            if size > self.limits.model_file_bytes and not trusted:
                raise Refusal(
                    "import_failed",
                    f"{file} has {size} bytes, more than the limit model_file_bytes, {self.limits.model_file_bytes}",
                )
            text = file.read_bytes()
        except OSError as error:
            raise Refusal("import_failed", f"cannot read {file}: {error.strerror or error}") from None
        known = self._blueprints.get(stem)
        if known is not None and not force_reimport:
            _warn_if_stale(known, source, text)
            return known, False
        try:
            blueprint = self._import(file, stem, source, hashlib.sha256(text).hexdigest(), roots)
        except OSError as error:
            raise Refusal("import_failed", f"cannot store the snapshot of {file} in {self.root}: {error}") from None
        finally:
            with contextlib.suppress(OSError):  # a folder with a blueprint in it stays
                (self.root / IMPORTS / stem).rmdir()
        self._blueprints[stem] = blueprint
        return blueprint, True

    def adopt(self, record: Path, digest: str) -> Blueprint | None:
        """Register the blueprint of another content root, copying its snapshot.

        Returns:
            The blueprint; None if the other content root has another snapshot by now.

        Raises:
            OSError, ValueError: It is not a usable blueprint.
        """
        other = load_blueprint(record)
        if other.digest != digest:
            return None
        home = self.root / IMPORTS / other.stem
        folder = home / other.digest
        if not _is_sound(folder):
            home.mkdir(parents=True, exist_ok=True)
            with TemporaryFolder(self.root / IMPORTS, _UNDER_WAY) as temporary_folder:
                copy = temporary_folder.path / "snapshot"
                shutil.copytree(other.folder, copy)
                _replace(copy, folder)
        return self._register(home, folder, other.record)

    def remove_blueprint(self, stem: str) -> None:
        """Forget a blueprint and delete its folder.

        Raises:
            OSError: It cannot be deleted.
        """
        with TemporaryFolder(self.root / IMPORTS, _UNDER_WAY) as removed:
            os.replace(self.root / IMPORTS / stem, removed.path / stem)  # whole, or not at all
            del self._blueprints[stem]

    def open_to_clients(self, path: Path) -> bool:
        """Whether a resolved path lies where clients may read: below the content root, a model root, or bundled."""
        return any(path.is_relative_to(root) for root in (self.root, *self.model_roots, bundled_root()))

    def level_file(self, package: str) -> Path:
        """Return the file that stands for a level's package path, as `level_package` returns it."""
        return self.root.joinpath(*package.removeprefix("/Game/").split("/")).with_suffix(".json")

    def snapshot_record(self, blueprint: Blueprint) -> Path:
        """Return the `blueprint.json` of a registered blueprint."""
        return self.root / IMPORTS / blueprint.stem / "blueprint.json"

    def _locate(self, path: str, *, trusted: bool) -> tuple[Path, str]:
        """Return the file of a request's path, and the blueprint's name for its source."""
        bundled = bundled_models()
        name = path.removeprefix(BUNDLED_PREFIX)
        if name in bundled:  # not a file: MuJoCo reads none without a suffix
            return bundled[name], f"{BUNDLED_PREFIX}{name}"
        if name != path:
            raise Refusal("import_failed", f"no bundled model is called '{name}': use {', '.join(bundled)}")
        try:
            candidates = self._candidates(path, trusted=trusted)
            file = next(filter(_is_file, candidates), None)
        except (OSError, ValueError) as error:  # too long, a null byte, a loop of links
            raise Refusal("import_failed", f"{path!r} is not a usable path: {error}") from None
        if file is not None:
            packaged = {location.resolve(): name for name, location in bundled.items()}
            return file, f"{BUNDLED_PREFIX}{packaged[file]}" if file in packaged else str(file)
        if not candidates:
            raise Refusal(
                "import_failed",
                f"{path} lies outside the folders this server may read models from ({self._roots_text()}); "
                "start it with --model-root DIR to allow another",
            )
        if any(candidate.is_dir() for candidate in candidates):
            raise Refusal("import_failed", f"{path} is a folder; name an MJCF file")
        where = f" in {self._roots_text()}" if not Path(path).is_absolute() else ""
        raise Refusal("import_failed", f"{path} does not exist{where}")

    def _candidates(self, path: str, *, trusted: bool) -> list[Path]:
        """Return the resolved files that `path` may mean; empty if all are outside the allowed folders."""
        bases = [Path.cwd()] if trusted else self.model_roots
        places = [Path(path)] if Path(path).is_absolute() else [base / path for base in bases]
        resolved = [place.resolve() for place in places]
        if trusted:
            return resolved
        return [place for place in resolved if any(place.is_relative_to(root) for root in self._import_roots)]

    def _roots_text(self) -> str:
        return ", ".join(map(str, self.model_roots)) or "none but the bundled models"

    def _import(
        self, file: Path, stem: str, source: str, source_digest: str, roots: tuple[Path, ...] | None
    ) -> Blueprint:
        home = self.root / IMPORTS / stem
        home.mkdir(parents=True, exist_ok=True)
        with (
            TemporaryFolder(self.root / IMPORTS, _UNDER_WAY) as temporary_folder,
            contextlib.ExitStack() as undo,
        ):
            snapshot = temporary_folder.path / "snapshot"

            def put_in_place() -> Path:
                """Move the snapshot to the folder that its content names, unless that is as it was written."""
                folder = home / _digest(snapshot)
                if not _is_sound(folder):
                    undo.callback(shutil.rmtree, folder, ignore_errors=True)
                    _replace(snapshot, folder)
                return folder

            try:
                if roots is None or file.is_relative_to(bundled_root()):
                    written = write_snapshot(file, snapshot)
                    folder = put_in_place()
                    compiled = compile_snapshot(*written, file, folder, self.limits)[0]
                else:
                    compiled = build_confined(file, snapshot, roots, self.limits)
                    folder = put_in_place()
            except (ValueError, mujoco.FatalError) as error:
                raise Refusal("import_failed", f"MuJoCo rejects {file}: {one_line(error)}") from None
            for message in compiled.messages:
                logger.warning("%s: %s", file, one_line(message))
            record = BlueprintRecord(
                stem=stem,
                source=source,
                source_digest=source_digest,
                imported_at=datetime.now(UTC),
                digest=folder.name,
                **compiled.facts(),
            )
            blueprint = self._register(home, folder, record)
            undo.pop_all()
        return blueprint

    def _register(self, home: Path, folder: Path, record: BlueprintRecord) -> Blueprint:
        known = self._blueprints.get(record.stem)
        write_whole(home / "blueprint.json", msgspec.json.format(msgspec.json.encode(record)))
        blueprint = Blueprint.of(folder, record)
        self._blueprints[record.stem] = blueprint
        # A play session under way may still read the model before this one; older ones are unused.
        keep = {folder, known.folder if known is not None else folder}
        for stale in home.iterdir():
            if stale.is_dir() and stale not in keep and not stale.name.startswith("."):
                shutil.rmtree(stale, ignore_errors=True)
        return blueprint


def _is_file(path: Path) -> bool:
    """Whether there is such a file; unlike `Path.is_file` of Python 3.14, a path that cannot be one is an error."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False


def _warn_if_stale(known: Blueprint, source: str, text: bytes) -> None:
    if known.source != source:
        logger.warning(
            "%s was not imported: blueprint '%s' of %s exists and is used. Rename one of the files, or import with "
            "force_reimport.",
            source,
            known.stem,
            known.source,
        )
    elif known.source_digest != hashlib.sha256(text).hexdigest():
        logger.warning(
            "%s has changed since it was imported at %s, and that import is used. Import with force_reimport to take "
            "the changes.",
            source,
            known.imported_at.isoformat(timespec="seconds"),
        )


def _is_sound(folder: Path) -> bool:
    return _digest(folder) == folder.name


def _replace(snapshot: Path, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(snapshot, folder)


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]
