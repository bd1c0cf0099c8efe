"""Model uploads in the HTTP API: an MJCF file, or a ZIP archive of an MJCF file and its meshes."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import AsyncIterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import anyio.to_thread
from starlette.requests import Request
from starlette.responses import Response

from urlab_client.protocol.errors import RPC_ERRORS
from urlab_client.web.ops import encode
from urlab_client.web.route_group import JOB, Handler, RouteGroup
from urlab_client.web.stoppable import Progress, stoppable

if TYPE_CHECKING:
    from urlab_client.aio import URLabClient
    from urlab_client.protocol.scene_types import URLabBlueprint

__all__ = ["ModelRoutes", "take_model"]

_LARGEST_FILE = 256 << 20
_LARGEST_CONTENT = 1 << 30


class ModelRoutes(RouteGroup):
    """Handler of `/api/models`."""

    def routes(self) -> list[tuple[str, Handler, list[str]]]:
        """Return path, handler and methods of each route."""
        return [("/api/models/{name}", self._take, ["PUT"])]

    async def _take(self, request: Request) -> Response:
        viewer, name = self._viewer(request), request.path_params["name"]
        request.scope[JOB] = f"the import of {name}"
        async with self._console.lease.hold(viewer):  # large models take longer than the controls are kept
            made = await take_model(self._console.client, name, request.stream())
        self._console.note("call", viewer.name, "import model", name)
        return Response(encode({"blueprint": made.class_path, "name": made.short_name}), media_type="application/json")


async def take_model(client: URLabClient, name: str, chunks: AsyncIterator[bytes]) -> URLabBlueprint:
    """Receive a model and make a blueprint of it.

    Servers that accept uploads receive it over the wire; others read it from this machine's disk, if they run here.

    Args:
        client: The client.
        name: The file's name, which ends with `.xml` or `.zip`.
        chunks: Its bytes.

    Raises:
        ValueError: It is neither, is too large, or the archive has no MJCF file to begin with.
        URLabError: The server rejects it.
    """
    ending = PurePosixPath(name).suffix.lower()
    if ending not in {".xml", ".zip"} or PurePosixPath(name).name != name or "\\" in name:
        raise ValueError(f"{name!r} is not the name of a model: send an .xml file, or a .zip archive with one")
    with tempfile.TemporaryDirectory(prefix="urlab-model-", ignore_cleanup_errors=True) as folder:
        file = Path(folder) / name
        size = 0
        with file.open("wb") as target:
            async for chunk in chunks:
                size += len(chunk)
                if size > _LARGEST_FILE:
                    raise ValueError(f"a model is at most {_LARGEST_FILE} bytes")
                await anyio.to_thread.run_sync(target.write, chunk)
        if ending == ".zip":
            archive, content = file, Path(folder) / "content"
            file = await stoppable(lambda told: _unpacked(archive, content, told))
        try:
            return await client.scene.upload_model(file)
        except RPC_ERRORS["unknown_op"]:
            return await client.scene.import_xml(str(file))


def _unpacked(archive: Path, folder: Path, progress: Progress) -> Path:
    """Unpack an archive and return its MJCF file: the one at the top, of several the one called like it."""
    try:
        with zipfile.ZipFile(archive) as packed:
            names = [PurePosixPath(info.filename) for info in packed.infolist()]
            if any(name.is_absolute() or ".." in name.parts for name in names):
                raise ValueError(f"{archive.name} has files outside its own folder")
            if sum(info.file_size for info in packed.infolist()) > _LARGEST_CONTENT:
                raise ValueError(f"{archive.name} unpacks to more than {_LARGEST_CONTENT} bytes")
            for number, info in enumerate(packed.infolist()):
                progress(number)
                packed.extract(info, folder)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{archive.name} is not a ZIP archive: {error}") from None
    found = sorted(folder.rglob("*.xml"), key=lambda file: len(file.parts))
    top = [file for file in found if len(file.parts) == len(found[0].parts)]
    like = [file for file in top if file.stem in {archive.stem, "scene"}]
    if len(like or top) == 1:
        return (like or top)[0]
    names = ", ".join(file.name for file in top) or "none"
    raise ValueError(f"{archive.name} must have one .xml file at its top, or one called {archive.stem}.xml: {names}")
