"""Models that clients send in chunks: uploads in progress, and a cache of the files by their hashes.

A manifest names every file with its hash and size. Files in the cache are not sent again, whichever
client sent them. Names are bare file names and hashes are checked, so no request reaches outside the folder.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from urlab_client.enums import StepMode
from urlab_client.protocol.messages.uploads import (
    MAX_ASSETS,
    MAX_BLOB_BYTES,
    MAX_MODEL_BYTES,
    AssetDigest,
    UploadModelChunk,
    UploadModelManifest,
)
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.temporary_folder import TemporaryFolder, sweep
from urlab_client.values.names import is_file_name

DOCUMENT: Final = "model.xml"
"""Name of the document when it is imported; no other file may have it."""

UPLOADS: Final = "Uploads"
"""Folder of the content root for the cache and for open uploads; no level can have this name."""

MAX_OPEN: Final = 16
IDLE_S: Final = 300.0

_UNDER_WAY: Final = ".upload-"
"""Prefix of the folders of open uploads."""

_DOCUMENT_IN_REPLIES: Final = "<xml>"
_HASH: Final = re.compile(r"[0-9a-f]{64}")


@dataclass
class _File:
    """A file of an upload, by its hash and, unless it is the document, its size."""

    sha256: str
    size: int | None
    received: int = 0


@dataclass
class _Upload:
    """An open upload."""

    document: _File
    assets: dict[str, _File]
    step_mode: StepMode | None
    touched: float
    folder: TemporaryFolder

    def file(self, kind: str, name: str) -> tuple[str, _File]:
        """Return a file and its name in replies."""
        if kind == "xml":
            return _DOCUMENT_IN_REPLIES, self.document
        if name not in self.assets:
            raise Refusal("bad_request", f"the manifest has no asset '{name}'")
        return name, self.assets[name]


@dataclass
class Uploads:
    """The uploads of a server. For the dispatcher's thread.

    Attributes:
        root: Folder for the cache and for open uploads; created with the first upload.
        cache_bytes: Size of the cache and of open uploads; the least recently used files are removed.
        clock: Returns the time, seconds.
    """

    root: Path
    cache_bytes: int
    clock: Callable[[], float] = time.monotonic
    _open: dict[str, _Upload] = field(default_factory=dict[str, _Upload])
    _held: int = 0
    """Size of the cache, bytes: as of the last manifest, with the changes since."""

    def __post_init__(self) -> None:
        sweep(self.root, _UNDER_WAY)

    @property
    def _cache(self) -> Path:
        return self.root / "cache"

    def begin(self, manifest: UploadModelManifest) -> tuple[str, bool, list[str]]:
        """Open an upload.

        Returns:
            Its id, whether the document is needed, and the names of the assets that are.
        """
        assets, total_bytes = manifest.assets, manifest.total_bytes
        _check_hash(manifest.xml_sha256, "xml_sha256")
        if len(assets) > MAX_ASSETS:
            raise Refusal("bad_request", f"a model has at most {MAX_ASSETS} assets, not {len(assets)}")
        if not 0 <= total_bytes <= MAX_MODEL_BYTES:
            raise Refusal("payload_too_large", f"a model has at most {MAX_MODEL_BYTES} bytes, not {total_bytes}")
        for asset in assets:
            _check_name(asset.name)
            _check_hash(asset.sha256, f"the sha256 of '{asset.name}'")
            if not 0 <= asset.size <= MAX_BLOB_BYTES:
                raise Refusal(
                    "payload_too_large", f"the size of '{asset.name}' must be 0 to {MAX_BLOB_BYTES}, not {asset.size}"
                )
        first: dict[str, AssetDigest] = {}
        for asset in assets:
            other = first.setdefault(asset.name.casefold(), asset)
            if other.name != asset.name and other.sha256 != asset.sha256:
                raise Refusal("bad_request", f"'{other.name}' and '{asset.name}' are one file on some systems")
        named = {asset.name: _File(asset.sha256, asset.size) for asset in assets}
        total = sum(asset.size or 0 for asset in named.values())
        if total > MAX_MODEL_BYTES:
            raise Refusal("payload_too_large", f"the assets have {total} bytes together, more than {MAX_MODEL_BYTES}")
        self._forget_idle()
        if len(self._open) >= MAX_OPEN:
            raise Refusal(
                "bad_request", f"{MAX_OPEN} uploads are open: commit one, or wait until one is {IDLE_S:g} s idle"
            )
        document = _File(manifest.xml_sha256, None)
        with _storing("the upload"):
            self._cache.mkdir(parents=True, exist_ok=True)
            needed = [name for name, file in named.items() if not self._take(file)]
            need_xml = not self._take(document)
            self._held = sum(about.st_size for _, about in _files(self._cache.iterdir()))
            folder = TemporaryFolder(self.root, _UNDER_WAY)
        upload_id = str(uuid.uuid4()).upper()
        self._open[upload_id] = _Upload(document, named, _step_mode(manifest.step_mode), self.clock(), folder)
        return upload_id, need_xml, needed

    def receive(self, chunk: UploadModelChunk) -> tuple[str, int, bool]:
        """Store a chunk of a file.

        Returns:
            The file's name in replies, the number of bytes received, and whether it is complete.

        Raises:
            Refusal: `bad_request`, `payload_too_large`, `unknown_upload`, `hash_mismatch`; `internal_error` if the
                piece cannot be stored. Then, as with a wrong hash, the file starts again.
        """
        kind, offset, total, data = chunk.kind, chunk.offset, chunk.total, chunk.data
        if kind not in ("xml", "asset"):
            raise Refusal("bad_request", f"kind must be 'xml' or 'asset', not '{kind}'")
        if offset < 0 or total < 0:
            raise Refusal("bad_request", f"offset and total must be 0 or more, not {offset} and {total}")
        if total > MAX_BLOB_BYTES:
            raise Refusal("payload_too_large", f"a file has at most {MAX_BLOB_BYTES} bytes, not {total}")
        if not data and total:
            raise Refusal("bad_request", "the chunk holds no data")
        if offset + len(data) > total:
            raise Refusal(
                "bad_request", f"{len(data)} bytes at {offset} reach beyond the end of the file, {total} bytes"
            )
        upload = self._find(chunk.upload_id)
        label, file = upload.file(kind, chunk.name)
        partial = upload.folder.path / (DOCUMENT if kind == "xml" else chunk.name)
        if file.size is not None and total != file.size:
            raise Refusal("bad_request", f"'{label}' has {file.size} bytes in the manifest, not {total}")
        if self._cached(file):
            return label, total, True
        try:
            with _storing(f"'{label}'"):
                self._make_room(len(data))
                with partial.open("r+b" if file.received else "wb") as stream:
                    stream.seek(offset)
                    stream.write(data)
                file.received += len(data)
                if file.received < total:
                    return label, file.received, False
                self._complete(label, file, partial)
        except Refusal:
            partial.unlink(missing_ok=True)
            file.received = 0
            raise
        return label, total, True

    @contextmanager
    def committed(self, upload_id: str) -> Generator[tuple[Path, StepMode | None]]:
        """Write the files of an upload to a folder, and close the upload at the end in any case.

        Yields:
            The document, and the requested step mode.
        """
        if not upload_id:
            raise Refusal("bad_request", "upload_id is empty")
        upload = self._find(upload_id)
        missing = [] if self._take(upload.document) else [_DOCUMENT_IN_REPLIES]
        missing += [name for name, file in upload.assets.items() if not self._take(file)]
        if missing:
            raise Refusal("bad_request", f"the upload is incomplete: {', '.join(missing[:5])} must be sent first")
        try:
            laid_out = Path(tempfile.mkdtemp(dir=upload.folder.path))  # a file that is incomplete may have any name
            for name, file in {DOCUMENT: upload.document, **upload.assets}.items():
                shutil.copyfile(self._cache / file.sha256, laid_out / name)
            yield laid_out / DOCUMENT, upload.step_mode
        except OSError as error:
            raise Refusal("import_failed", f"the upload cannot be laid out: {error.strerror or error}") from None
        finally:
            self._close(upload_id)

    def close(self) -> None:
        """Discard all open uploads. Idempotent."""
        for upload_id in list(self._open):
            self._close(upload_id)

    def _close(self, upload_id: str) -> None:
        self._open.pop(upload_id).folder.close()

    def _find(self, upload_id: str) -> _Upload:
        self._forget_idle()
        upload = self._open.get(upload_id)
        if upload is None:
            raise Refusal("unknown_upload", f"no upload '{upload_id}' is open: send the manifest again")
        upload.touched = self.clock()
        return upload

    def _forget_idle(self) -> None:
        now = self.clock()
        for upload_id in [key for key, upload in self._open.items() if now - upload.touched > IDLE_S]:
            self._close(upload_id)

    def _cached(self, file: _File) -> bool:
        try:
            size = (self._cache / file.sha256).stat().st_size
        except OSError:
            return False
        return file.size is None or size == file.size

    def _take(self, file: _File) -> bool:
        """Whether the cache has a file; marks it as used, and removes a damaged one."""
        path = self._cache / file.sha256
        try:
            if _hash_of(path) == file.sha256:
                os.utime(path)
            else:
                path.unlink()
        except OSError:
            return False
        return self._cached(file)

    def _complete(self, label: str, file: _File, partial: Path) -> None:
        """Move a complete file into the cache if its hash is right."""
        found, size = _hash_of(partial), partial.stat().st_size
        if found != file.sha256:
            raise Refusal("hash_mismatch", f"'{label}' has the hash {found}, the manifest says {file.sha256}")
        os.replace(partial, self._cache / file.sha256)
        file.received = 0
        self._held += size

    def _make_room(self, n_bytes: int) -> None:
        """Remove the least recently used files to make room, but none that an open upload needs."""
        needed = [file for upload in self._open.values() for file in (upload.document, *upload.assets.values())]
        n_bytes += sum(file.received for file in needed)
        if self._held + n_bytes > self.cache_bytes:
            names = {file.sha256 for file in needed}
            for path, about in sorted(_files(self._cache.iterdir()), key=lambda item: item[1].st_mtime_ns):
                if path.name not in names and self._held + n_bytes > self.cache_bytes:
                    path.unlink(missing_ok=True)
                    self._held -= about.st_size
        if self._held + n_bytes > self.cache_bytes:
            raise Refusal(
                "payload_too_large",
                f"the files of the uploads that are open would take {self._held + n_bytes} bytes, more than the limit "
                f"upload_cache_bytes, {self.cache_bytes}",
            )


@contextmanager
def _storing(what: str) -> Generator[None]:
    try:
        yield
    except OSError as error:
        raise Refusal("internal_error", f"{what} cannot be stored: {error.strerror or error}") from None


def _hash_of(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _files(paths: Iterable[Path]) -> list[tuple[Path, os.stat_result]]:
    return [(path, path.stat()) for path in paths if path.is_file()]


def _step_mode(text: str | None) -> StepMode | None:
    """Return the requested step mode; None for an invalid one, which the plugin ignores."""
    return next((mode for mode in (StepMode.LIVE, StepMode.DIRECT, StepMode.PUPPET) if mode == text), None)


def _check_hash(text: str, what: str) -> None:
    if not _HASH.fullmatch(text):
        raise Refusal("bad_request", f"{what} must be 64 lower-case hexadecimal digits, not '{text[:80]}'")


def _check_name(name: str) -> None:
    """Refuse anything but a bare file name that is valid on every system, and the document's own name."""
    if not is_file_name(name):
        raise Refusal("bad_request", f"'{name[:80]}' is not a bare file name")
    if name.casefold() == DOCUMENT:
        raise Refusal("bad_request", f"an asset must not be called '{name}', which is what the document is called")
