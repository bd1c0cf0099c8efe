"""Models that viewers send: an MJCF file, or a ZIP archive of an MJCF file and its meshes.

What viewers send is unpacked and compiled in a confined process only. The server gets what that made of it.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

import anyio.to_thread

from urlab_client.aio.model.compilation import flatten_confined
from urlab_client.aio.model.upload import FlatModel, upload
from urlab_client.console.file_jobs import run_job, write_chunks
from urlab_client.errors import ImportFailed
from urlab_client.protocol.instances import import_directory
from urlab_client.values.names import is_file_name
from urlab_client.values.scene_types import URLabBlueprint

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient

_LARGEST_FILE = 256 << 20
_NAME_CHARACTERS: Final = 64
_PREFIX: Final = "urlab-model-"
_LEFT_S: Final = 3600.0
_UPLOADED: Final = "model"
"""What servers call the blueprint of every upload: the wire has no name for it."""


class WouldReplace(Exception):
    """A model was not imported because another blueprint would be lost.

    Attributes:
        name: The blueprint.
    """

    def __init__(self, name: str) -> None:
        super().__init__(f"There is already a blueprint {name!r}, which importing this model would replace.")
        self.name = name


async def receive_model(name: str, chunks: AsyncIterator[bytes]) -> FlatModel:
    """Receive a model, and check and compile it in a confined process."""
    if not is_file_name(name) or PurePosixPath(name).suffix.lower() not in {".xml", ".zip"}:
        raise ValueError(f"{name!r} is not the name of a model: send an .xml file, or a .zip archive with one")
    with tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True) as folder:
        file = Path(folder) / name
        await write_chunks(file, chunks, _LARGEST_FILE, "a model")
        return await run_job(lambda told: flatten_confined(file, told))


async def make_blueprint(client: URLabClient, name: str, model: FlatModel, replace: str) -> URLabBlueprint:
    """Make a blueprint of a model.

    A server of this user on this machine imports it from the disk, under the name of its file. Another one receives it
    over the wire, if it accepts uploads.
    """
    stem = re.sub(r"\W", "_", PurePosixPath(name).stem)[:_NAME_CHARACTERS]
    with tempfile.TemporaryDirectory(prefix=_PREFIX, dir=_import_folder(), ignore_cleanup_errors=True) as folder:
        file = Path(folder) / f"{stem}.xml"
        await anyio.to_thread.run_sync(_write, model, file)
        try:
            made = await client.scene.import_xml(str(file), force_reimport=replace.casefold() == stem.casefold())
        except ImportFailed as refusal:
            if not client.server.features.uploads:
                said = refusal.message.replace(f"{file.parent}{os.sep}", "")  # where the console keeps its files
                raise ImportFailed(refusal.code, said, op=refusal.op, hint=refusal.hint) from None
        else:
            if not made.imported_now:
                raise WouldReplace(made.short_name)
            return made
    known = [one.short_name for one in await client.outliner.list_blueprints()]
    there = next((one for one in known if one.casefold() == _UPLOADED), None)
    if there is not None and replace != there:
        raise WouldReplace(there)
    reply = await upload(model, client.call, None)
    return URLabBlueprint(
        class_path=reply.blueprint_class_path, short_name=reply.blueprint_short_name, imported_now=reply.imported
    )


def _import_folder() -> Path | None:
    """Return the folder from which servers on this machine import; None for any, where that cannot be used."""
    folder = import_directory()
    try:
        if folder is not None:
            folder = folder.resolve()  # as servers name it
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            for left in folder.glob(f"{_PREFIX}*"):  # by a console that was killed
                if left.stat().st_mtime < time.time() - _LEFT_S:
                    shutil.rmtree(left, ignore_errors=True)
    except OSError:
        return None  # the plugin reads from anywhere
    return folder


def _write(model: FlatModel, document: Path) -> None:
    for name, data in model.files.items():
        if not is_file_name(name) or name.casefold() == document.name.casefold():
            raise ValueError(f"the model has a file {name[:80]!r}; call it otherwise")
        document.with_name(name).write_bytes(data)
    document.write_bytes(model.xml)
