"""An imported MJCF: its snapshot, and the record by which the server finds it after a restart."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

import msgspec
import mujoco

from urlab_client.server.assets.importer import mujoco_messages, named_kinds

IMPORTS: Final = "MuJoCoImports"
PARENT_CLASS: Final = "MjArticulation"


def sanitized(name: str) -> str:
    """Return `name` with every character other than letters, digits and underscore replaced by an underscore."""
    return re.sub(r"\W", "_", name)


class BlueprintRecord(msgspec.Struct, frozen=True, kw_only=True):
    """`blueprint.json`."""

    format: Literal["urlab-blueprint"] = "urlab-blueprint"
    version: Literal[1] = 1
    stem: str
    source: str
    source_digest: str
    imported_at: datetime
    digest: str
    model_name: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    actuator_types: dict[str, str]
    sensors: tuple[str, ...]
    cameras: tuple[str, ...]
    n_bytes: int = 0
    n_asset_bytes: int = 0
    n_data_bytes: int = 0
    n_sensor_values: int = 0


_RECORD: Final = msgspec.json.Decoder(BlueprintRecord)
_DIGEST: Final = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True, eq=False)
class Blueprint:
    """An imported MJCF.

    Attributes:
        stem: Sanitised file stem; identity of the blueprint.
        folder: Folder of the snapshot; holds `model.xml`.
        source: Absolute path of the imported file, or `bundled:<name>`.
        source_digest: SHA-256 of the imported file itself, without what it includes.
        imported_at: UTC.
        digest: Hash of the snapshot's content.
        model_name: The MJCF's `model` attribute; empty if it gives none.
        joints: Joint names in compiled order, without prefix. Every element has a name: see `importer`.
        actuators: Actuator names in compiled order.
        actuator_types: Actuator name to MJCF element; `motor` for `<general>`.
        sensors: Sensor names in compiled order.
        cameras: Camera names in compiled order.
        n_bytes: Memory of the compiled model; this and what follows is 0 where an older import did not note it.
        n_asset_bytes: How much of its compiled size all robots of its kind share.
        n_data_bytes: Memory of its simulation, without the arena if MuJoCo chooses its size.
        n_sensor_values: Total size of its sensor readings, in numbers.
    """

    stem: str
    folder: Path
    source: str
    source_digest: str
    imported_at: datetime
    digest: str
    model_name: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    actuator_types: Mapping[str, str]
    sensors: tuple[str, ...]
    cameras: tuple[str, ...]
    n_bytes: int = 0
    n_asset_bytes: int = 0
    n_data_bytes: int = 0
    n_sensor_values: int = 0

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
    return from_record(folder, decoded)


def from_record(folder: Path, record: BlueprintRecord) -> Blueprint:
    """Return the blueprint of a record, whose snapshot is `folder`."""
    return Blueprint(
        stem=record.stem,
        folder=folder,
        source=record.source,
        source_digest=record.source_digest,
        imported_at=record.imported_at,
        digest=record.digest,
        model_name=record.model_name,
        joints=record.joints,
        actuators=record.actuators,
        actuator_types=MappingProxyType(record.actuator_types),
        sensors=record.sensors,
        cameras=record.cameras,
        n_bytes=record.n_bytes,
        n_asset_bytes=record.n_asset_bytes,
        n_data_bytes=record.n_data_bytes,
        n_sensor_values=record.n_sensor_values,
    )


def to_record(blueprint: Blueprint) -> BlueprintRecord:
    """Return the record of a blueprint."""
    return BlueprintRecord(
        stem=blueprint.stem,
        source=blueprint.source,
        source_digest=blueprint.source_digest,
        imported_at=blueprint.imported_at,
        digest=blueprint.digest,
        model_name=blueprint.model_name,
        joints=blueprint.joints,
        actuators=blueprint.actuators,
        actuator_types=dict(blueprint.actuator_types),
        sensors=blueprint.sensors,
        cameras=blueprint.cameras,
        n_bytes=blueprint.n_bytes,
        n_asset_bytes=blueprint.n_asset_bytes,
        n_data_bytes=blueprint.n_data_bytes,
        n_sensor_values=blueprint.n_sensor_values,
    )
