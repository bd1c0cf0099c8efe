"""Uploading a model to the server over the wire: collecting its files and sending those that the server lacks.

For `client.scene.upload_model`. Hashes identify the files, so the server requests only those that it does not have. An
interrupted upload resumes with a new manifest.
"""

from __future__ import annotations

import asyncio
import hashlib
import os
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from urlab_client.errors import OutcomeUnknown, UnknownUpload
from urlab_client.protocol.base import Request
from urlab_client.protocol.messages.uploads import (
    MAX_ASSETS,
    MAX_BLOB_BYTES,
    MAX_CHUNK_BYTES,
    MAX_MODEL_BYTES,
    AssetDigest,
    UploadModelChunk,
    UploadModelCommit,
    UploadModelCommitOk,
    UploadModelManifest,
    UploadModelManifestOk,
)
from urlab_client.values.types import UploadProgress

if TYPE_CHECKING:
    import mujoco

OnUpload = Callable[[UploadProgress], object]
"""Callback invoked with the progress of an upload on the client's event loop."""

Call = Callable[[Request[Any]], Awaitable[Any]]

_ATTEMPTS: Final = 3


@dataclass(frozen=True)
class FlatModel:
    """A model in the form in which it is sent: one document and its files under bare names.

    Attributes:
        xml: The document.
        files: Contents by name.
    """

    xml: bytes
    files: dict[str, bytes]

    @property
    def size(self) -> int:
        return len(self.xml) + sum(map(len, self.files.values()))

    @cached_property
    def manifest(self) -> UploadModelManifest:
        """The manifest that opens an upload."""
        return UploadModelManifest(
            xml_sha256=_digest(self.xml),
            total_bytes=self.size,
            assets=[AssetDigest(name=name, sha256=_digest(data), size=len(data)) for name, data in self.files.items()],
        )


def flatten(model: str | os.PathLike[str] | mujoco.MjSpec, *, scratch: Path | None = None) -> FlatModel:
    """Read a model and everything it includes, check it and convert it to the form in which it is sent. Blocks.

    Args:
        model: The model.
        scratch: Folder in which files may be written meanwhile; None for the system's temporary one.

    Raises:
        TypeError: The model is neither a path nor a spec.
        FileNotFoundError: The file does not exist.
        ValueError: MuJoCo rejects the model, or it is larger than servers accept.
    """
    import mujoco

    from urlab_client._mujoco import flat_model

    given = cast("Any", model)
    if not isinstance(model, (str, os.PathLike, mujoco.MjSpec)):
        raise TypeError(f"upload_model: model takes a path or an MjSpec, got {given!r:.80}.")
    path = None if isinstance(given, mujoco.MjSpec) else Path(given)
    if path is not None and not path.is_file():
        raise FileNotFoundError(f"upload_model: {path} does not exist or is not a file")
    source = "the spec" if path is None else str(path)
    try:
        spec: mujoco.MjSpec = given.copy() if path is None else mujoco.MjSpec.from_file(source)
        spec.compile()
        xml, files = flat_model(spec, scratch=scratch)
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"upload_model: MuJoCo rejects {source}: {' '.join(str(error).split())}") from None
    flat = FlatModel(xml.encode(), files)
    for name, data in {"the document": flat.xml, **files}.items():
        if len(data) > MAX_BLOB_BYTES:
            raise ValueError(f"upload_model: {name} of {source} has {len(data)} bytes; servers take {MAX_BLOB_BYTES}")
    if len(files) > MAX_ASSETS:
        raise ValueError(f"upload_model: {source} has {len(files)} files; servers take {MAX_ASSETS}")
    if flat.size > MAX_MODEL_BYTES:
        raise ValueError(f"upload_model: {source} has {flat.size} bytes; servers take {MAX_MODEL_BYTES}")
    return flat


async def upload(model: FlatModel, call: Call, on_progress: OnUpload | None) -> UploadModelCommitOk:
    """Send the parts of a model that the server lacks, and import the model.

    A chunk whose reply was lost is not sent again, because the server counts bytes. A new manifest then shows what is
    missing. The commit is sent once.
    """
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            upload_id = await _send_files(model, call, on_progress)
            break
        except (UnknownUpload, OutcomeUnknown):
            if attempt == _ATTEMPTS:
                raise
    else:
        raise AssertionError("the last attempt returns or raises")
    imported: UploadModelCommitOk = await call(UploadModelCommit(upload_id=upload_id))
    return imported


async def _send_files(model: FlatModel, call: Call, on_progress: OnUpload | None) -> str:
    opened: UploadModelManifestOk = await call(model.manifest)
    missing = [("asset", name, model.files[name]) for name in dict.fromkeys(opened.need_assets)]
    if opened.need_xml:
        missing.insert(0, ("xml", "", model.xml))
    total = sum(len(data) for _, _, data in missing)
    sent = 0
    for kind, name, data in missing:
        for offset in range(0, max(1, len(data)), MAX_CHUNK_BYTES):
            chunk = data[offset : offset + MAX_CHUNK_BYTES]
            request = UploadModelChunk(
                upload_id=opened.upload_id, kind=kind, name=name, offset=offset, total=len(data), data=chunk
            )
            await call(request)
            sent += len(chunk)
            if on_progress is not None:
                on_progress(UploadProgress(file=name or "model.xml", sent_bytes=sent, total_bytes=total))
            await asyncio.sleep(0)  # allows cancellation between two chunks
    return opened.upload_id


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
