"""Unpacking a ZIP archive with a model that a stranger has sent.

For the compiling process, which bounds its memory and time. What systems would unpack differently is refused.
"""

from __future__ import annotations

import stat
import unicodedata
import zipfile
from pathlib import Path
from typing import Final

from urlab_client.protocol.messages.uploads import MAX_ASSETS
from urlab_client.values.names import is_file_name

_MAX_BYTES: Final = 1 << 30
_MAX_PATH_BYTES: Final = 1000
_CHUNK_BYTES: Final = 1 << 20
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_OTHER_METHODS: Final = {9: "deflate64", zipfile.ZIP_BZIP2: "bzip2", zipfile.ZIP_LZMA: "lzma", 93: "zstandard"}
_ENCRYPTED: Final = 0x1 | 0x40
_FILE_KINDS: Final = (0, stat.S_IFREG, stat.S_IFDIR)


def unpacked(archive: Path, folder: Path) -> Path:
    """Unpack an archive and return its MJCF file: the one at the top, of several the one called like the archive.

    Args:
        archive: The archive.
        folder: Folder for its files, which must not exist.

    Raises:
        ValueError: The archive is damaged, has entries that are refused, or has no MJCF file to begin with.
    """
    try:
        with zipfile.ZipFile(archive) as packed:
            entries = packed.infolist()
            _check(entries)
            folder.mkdir()
            for entry in entries:
                _extract(packed, entry, folder)
    except _Refused as refused:
        raise ValueError(f"{archive.name} {refused}") from None
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - zipfile raises ten kinds of exceptions for damaged archives
        raise ValueError(
            f"{archive.name} is not a ZIP archive, or is damaged: {error or type(error).__name__}"
        ) from None
    found = sorted(folder.rglob("*.xml"), key=lambda file: len(file.parts))
    top = [file for file in found if len(file.parts) == len(found[0].parts)]
    like = [file for file in top if file.stem in {archive.stem, "scene"}]
    if len(like or top) == 1:
        return (like or top)[0]
    names = ", ".join(file.name for file in top) or "none"
    raise ValueError(f"{archive.name} must have one .xml file at its top, or one called {archive.stem}.xml: {names}")


class _Refused(Exception):
    """An archive that is not unpacked; the text continues its name."""


def _check(entries: list[zipfile.ZipInfo]) -> None:
    """Look at all entries before the first is unpacked."""
    if len(entries) > MAX_ASSETS:
        raise _Refused(f"has {len(entries)} entries, more than {MAX_ASSETS}")
    if sum(entry.file_size for entry in entries) > _MAX_BYTES:
        raise _Refused(f"unpacks to more than {_MAX_BYTES} bytes")
    names: set[str] = set()
    for entry in entries:
        _check_one(entry)
        alike = unicodedata.normalize("NFC", entry.filename).casefold()
        if alike in names and not entry.is_dir():
            raise _Refused(f"has two files that are one on some systems: {entry.filename[:80]!r}")
        names.add(alike)


def _check_one(entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename  # `filename` ends at a null byte
    said = repr(name[:80])
    if not all(map(is_file_name, name.removesuffix("/").split("/"))) or len(name.encode()) > _MAX_PATH_BYTES:
        raise _Refused(f"has files outside its own folder, or names that are not valid everywhere: {said}")
    if entry.flag_bits & _ENCRYPTED:
        raise _Refused(f"is encrypted, see {said}; pack it without a password")
    if entry.compress_type not in _METHODS:
        how = _OTHER_METHODS.get(entry.compress_type, f"method {entry.compress_type}")
        raise _Refused(f"has {said}, compressed by {how}; pack it by deflate, as most programs do")
    if stat.S_IFMT(entry.external_attr >> 16) not in _FILE_KINDS:
        raise _Refused(f"has {said}, which is a link or the like; pack the file itself")


def _extract(packed: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path) -> None:
    target = folder / entry.filename
    if entry.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with packed.open(entry) as source, target.open("xb") as file:  # no entry replaces another
        while chunk := source.read(_CHUNK_BYTES):  # no more than the declared size, whatever is packed
            file.write(chunk)
        if file.tell() != entry.file_size:
            raise _Refused(f"is damaged: {entry.filename[:80]!r} ends early")
