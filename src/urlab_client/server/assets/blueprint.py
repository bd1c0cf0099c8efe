"""An imported MJCF: its snapshot, and the record by which the server finds it after a restart."""

from __future__ import annotations

import re
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Final, Literal, Self

import msgspec
import mujoco

from urlab_client.server.assets.importer import ModelFacts, mujoco_messages, named_kinds

IMPORTS: Final = "MuJoCoImports"
PARENT_CLASS: Final = "MjArticulation"


def sanitized(name: str) -> str:
    """Return `name` with every character other than letters, digits and underscore replaced by an underscore."""
    return re.sub(r"\W", "_", name)


class BlueprintRecord(ModelFacts, frozen=True, kw_only=True):
    """`blueprint.json`.

    Attributes:
        stem: Sanitised file stem; identity of the blueprint.
        source: Absolute path of the imported file, or `bundled:<name>`.
        source_digest: SHA-256 of the imported file itself, without what it includes.
        imported_at: UTC.
        digest: Hash of the snapshot's content.
    """

    format: Literal["urlab-blueprint"] = "urlab-blueprint"
    version: Literal[1] = 1
    stem: str
    source: str
    source_digest: str
    imported_at: datetime
    digest: str


_RECORD: Final = msgspec.json.Decoder(BlueprintRecord)
_DIGEST: Final = re.compile(r"[0-9a-f]{16}")


class Blueprint(BlueprintRecord, frozen=True, kw_only=True, eq=False, dict=True):
    """An imported MJCF: its record, and the folder of its snapshot, which holds `model.xml`."""

    folder: Path

    @classmethod
    def of(cls, folder: Path, record: BlueprintRecord) -> Self:
        """Return the blueprint of a record."""
        return cls(folder=folder, **msgspec.structs.asdict(record))

    @property
    def record(self) -> BlueprintRecord:
        """What `blueprint.json` holds."""
        return BlueprintRecord(**{name: getattr(self, name) for name in BlueprintRecord.__struct_fields__})

    @property
    def short_name(self) -> str:
        """Asset name."""
        return self.stem

    @property
    def package_path(self) -> str:
        """For example `/Game/MuJoCoImports/robot`."""
        return f"/Game/{IMPORTS}/{self.stem}"

    @property
    def class_name(self) -> str:
        """For example `robot_C`."""
        return f"{self.stem}_C"

    @property
    def class_path(self) -> str:
        """For example `/Game/MuJoCoImports/robot.robot_C`."""
        return f"{self.package_path}.{self.class_name}"

    @cached_property
    def spec(self) -> mujoco.MjSpec:
        """The parsed snapshot. Copy it before editing or compiling.

        Raises:
            ValueError: MuJoCo cannot read it; the content root was damaged.
        """
        with mujoco_messages():
            return mujoco.MjSpec.from_file(str(self.folder / "model.xml"))

    @cached_property
    def element_names(self) -> frozenset[str]:
        """Names of all elements that get the actor's prefix, of all kinds."""
        spec = self.spec
        kinds = [
            *(elements for elements, _ in named_kinds(spec)),
            *(spec.materials, spec.flexes, spec.numerics, spec.texts, spec.tuples, spec.plugins),
        ]
        # A spec does not list its default classes.
        classes = re.findall(r'<default class="([^"]*)"', (self.folder / "model.xml").read_text("utf-8"))
        return frozenset((*classes, "main", *(element.name for elements in kinds for element in elements)))


def load_blueprint(file: Path) -> Blueprint:
    """Return the blueprint of a `blueprint.json`.

    Raises:
        OSError: It cannot be read.
        ValueError: It is not such a file, or its snapshot is gone.
    """
    try:
        decoded = _RECORD.decode(file.read_bytes())
    except RecursionError as error:
        raise ValueError(str(error)) from None
    if not decoded.stem or decoded.stem != sanitized(decoded.stem) or not _DIGEST.fullmatch(decoded.digest):
        raise ValueError(f"'{decoded.stem}' and '{decoded.digest}' cannot be the names of folders")
    folder = file.parent / decoded.digest
    if not (folder / "model.xml").is_file():
        raise ValueError(f"its snapshot {folder} is gone")
    return Blueprint.of(folder, decoded)
