"""The files that the text of an MJCF makes MuJoCo open, and whether a stranger's model may name them.

Checked before MuJoCo sees the model. MuJoCo joins file names with folders named elsewhere in the model; this looks for
names and folders wherever they stand and tries all combinations. It may find too many files, but never too few.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Final, Self

# The grammar is that of MuJoCo's parser, which is laxer than XML: text may precede and follow the root, blanks are
# those of C, comments may contain anything. Quantifiers are possessive, so that parsing takes linear time.
_BLANKS: Final = rb"[ \t\n\v\f\r]*+"
_NAME: Final = rb"[A-Za-z_:\x80-\xff][\w.:\-\x80-\xff]*+"
_ATTRIBUTE: Final = _BLANKS + _NAME + _BLANKS + b"=" + _BLANKS + rb"""(?:"[^"]*+"|'[^']*+')"""
_TOKEN: Final = re.compile(
    b"|".join(
        (
            rb"[^<]++",
            rb"<!--.*?-->",
            rb"<!\[CDATA\[.*?\]\]>",
            rb"<\?.*?\?>",
            b"</" + _BLANKS + _NAME + _BLANKS + b">",
            b"<(?P<element>" + _NAME + b")(?P<attributes>(?:" + _ATTRIBUTE + b")*+)" + _BLANKS + b"/?>",
        )
    ),
    re.DOTALL,
)
_PAIR: Final = re.compile(b"(" + _NAME + b")" + _BLANKS + b"=" + _BLANKS + rb"""(?:"([^"]*+)"|'([^']*+)')""")
_NAMES_FILE: Final = re.compile(b"file|dir", re.IGNORECASE)
_ENTITY: Final = re.compile(rb"&(?:#(\d{1,7})|#x([0-9a-fA-F]{1,6})|(quot|amp|apos|lt|gt));|&|[\x00-\x1f\x7f]")
_CHARACTERS: Final = {b"quot": b'"', b"amp": b"&", b"apos": b"'", b"lt": b"<", b"gt": b">"}

_ASSETS: Final = frozenset({"mesh", "hfield", "texture", "skin", "flex", "flexcomp"})
"""Elements whose files are data. A file named by any other element could be a document, which names more files."""

_ITS_OWN: Final = "a model may name only files that come with it, by relative paths"
_DOCUMENT_SUFFIXES: Final = (".xml", ".mjcf", ".urdf")
_ARCHIVE_SUFFIXES: Final = (".mjz", ".zip")
_MOST_COMBINATIONS: Final = 1_000_000
_DATA_TYPES: Final = ("image/", "model/obj", "model/stl", "model/vnd.mujoco.", "model/vnd.gmsh")


@dataclass
class NamedFiles:
    """The files that a document names, with forward slashes. It may contain too many, never too few.

    Attributes:
        documents: Files that MuJoCo may parse as further documents.
        data: Other files: meshes, textures, height fields, skins.
        folders: Folders that MuJoCo may search for files.
    """

    documents: set[str] = field(default_factory=set[str])
    data: set[str] = field(default_factory=set[str])
    folders: set[str] = field(default_factory=set[str])

    def __ior__(self, other: NamedFiles) -> Self:
        self.documents |= other.documents
        self.data |= other.data
        self.folders |= other.folders
        return self


def named_files(text: bytes) -> NamedFiles:
    """Parse a document as MuJoCo does, and return the files that it names.

    Raises:
        ValueError: The text is not XML, or could name files in a way that this module does not understand.
    """
    found = NamedFiles()
    end, elements = 0, 0
    while token := _TOKEN.match(text, end):
        end = token.end()
        if token["element"] is not None:
            elements += 1
            _read(token["element"], token["attributes"], found)
    if text.startswith(b"<!", end):
        raise ValueError("it has a document type, which no MJCF needs")
    if end < len(text):
        line = text.count(b"\n", 0, end) + 1
        raise ValueError(f"it is not XML that is understood here: see line {line}")
    if not elements:
        raise ValueError("it is empty, or not XML")
    return found


def _read(element: bytes, attributes: bytes, found: NamedFiles) -> None:
    if _NAMES_FILE.search(attributes) is None:  # nearly all elements
        return
    pairs = [(key.lower(), double or single) for key, double, single in _PAIR.findall(attributes)]
    kind = element.decode("utf-8", "replace").lower()
    types = [value for key, value in pairs if key == b"content_type"]
    is_data = kind in _ASSETS and all(value.decode("utf-8", "replace").startswith(_DATA_TYPES) for value in types)
    for key, value in pairs:
        is_folder = key.endswith(b"dir")
        if not (is_folder or b"file" in key or b"dir" in key) or not value:
            continue
        name = _decoded(value)
        for path in {name, name.replace("\\", "/")}:
            if is_folder:
                found.folders.add(path)
                continue
            parts = path.lower().split("/")
            if any(part.endswith(_ARCHIVE_SUFFIXES) for part in parts):
                raise ValueError(f"it names {path}, an archive, whose content is not looked into: unpack it")
            (found.data if is_data and not parts[-1].endswith(_DOCUMENT_SUFFIXES) else found.documents).add(path)


def _decoded(value: bytes) -> str:
    """Return the decoded value of an attribute that names a file."""

    def replaced(match: re.Match[bytes]) -> bytes:
        decimal, hexadecimal, named = match.groups()
        if named:
            return _CHARACTERS[named]
        number = int(decimal) if decimal else int(hexadecimal, 16) if hexadecimal else 0
        if not 32 <= number <= 0x10FFFF:
            raise ValueError(f"it names a file in a way that is not understood: {value[:80]!r}")
        return chr(number).encode("utf-8", "surrogatepass")

    return os.fsdecode(_ENTITY.sub(replaced, value))


class Outside(ValueError):
    """A model refers to a file outside its allowed folders, or cannot be checked."""


def check_references(file: Path, roots: tuple[Path, ...], most_bytes: int, most_files: int) -> None:
    """Check an MJCF and, recursively, all documents that it includes. All paths are resolved.

    Raises:
        Outside: A file that exists does not lie below `roots`, a document cannot be understood, or there are more than
            `most_files` files or a document has more than `most_bytes`, which the caller's users know as limits.
        OSError: The model cannot be read.
    """
    waiting, documents, files = [file], {file}, {file}
    named = NamedFiles(folders={""})
    bases: set[Path] = set()
    tested: set[tuple[Path, bool]] = set()
    tried = 0
    while waiting:
        for path in waiting:
            named |= _named_in(path, most_bytes, is_model=path == file)
            bases.add(path.parent)
        waiting = list[Path]()
        for names, are_documents in ((named.documents, True), (named.data, False)):
            variants = names | {name.rpartition("/")[2] for name in names}
            tried += len(bases) * len(named.folders) * len(variants)
            if tried > _MOST_COMBINATIONS:
                raise Outside("it names too many files")
            for candidate in _combined(bases, named.folders, variants):
                if (candidate, are_documents) in tested:
                    continue
                tested.add((candidate, are_documents))
                found = _inside(candidate, roots)
                if found is None:
                    continue
                files.add(found)
                if len(files) > most_files:
                    raise Outside(f"it consists of more files than the limit model_files, {most_files}")
                if are_documents and found not in documents:
                    documents.add(found)
                    waiting.append(found)


def _combined(bases: Iterable[Path], folders: Iterable[str], names: Iterable[str]) -> set[Path]:
    return {base / folder / name for base in bases for folder in folders for name in names}


def _inside(candidate: Path, roots: tuple[Path, ...]) -> Path | None:
    """Return the resolved file, which must be a regular one in a folder that is allowed; None if there is none."""
    try:
        if not os.path.lexists(candidate):
            return None
        real = candidate.resolve()
        is_folder, is_file = real.is_dir(), real.is_file()
    except (OSError, ValueError, RuntimeError):  # too long, a null byte, a loop of links: MuJoCo cannot open it either
        return None
    if is_folder:
        return None
    if not any(real.is_relative_to(root) for root in roots):
        raise Outside(
            f"it names {candidate}, which lies outside the folders this server may read models from "
            f"({', '.join(map(str, roots))})"
        )
    if real.exists() and not is_file:
        raise Outside(f"it names {candidate}, which is not a regular file")
    return real if is_file else None


def _named_in(path: Path, most_bytes: int, *, is_model: bool) -> NamedFiles:
    if path.stat().st_size > most_bytes:
        raise Outside(f"{path} is larger than the limit model_file_bytes, {most_bytes}")
    try:
        return named_files(path.read_bytes())
    except ValueError as error:
        raise Outside(str(error) if is_model else f"it names {path}; {error}") from None


def refuse_local_files(xml: str, assets: Mapping[str, bytes]) -> None:
    """Reject a model that names files of this machine, because MuJoCo would read them."""
    named = _named_by_all(xml.encode(), assets, assets.__getitem__)
    names = named.documents | named.data
    names |= {_last_part(name) for name in names}
    if len(names) * (len(named.folders) + 1) > _MOST_COMBINATIONS:
        raise ValueError("it names too many files")
    for path in {os.path.join(folder, name) for folder in ("", *named.folders) for name in names}:
        if os.path.lexists(path) and not os.path.isdir(path):
            raise ValueError(f"it names {path}, a file of this machine")


def refuse_outside(file: Path, content: Path) -> None:
    """Reject a model that names files outside its folder, whether they exist or not: that is not for it to know."""
    room = content.parent.parts  # one `..` too many leads to this folder, which is empty otherwise
    files = {path.as_posix(): path for path in content.rglob("*") if path.is_file()}
    named = _named_by_all(file.read_bytes(), files, lambda name: files[name].read_bytes())
    names, folders = named.documents | named.data, {"", *named.folders}
    for path in names | folders:
        if PureWindowsPath(path).anchor:  # a system's root, or a drive
            raise ValueError(f"{file.name} names {path}: {_ITS_OWN}")
    bases = {Path(name).parent.as_posix() for name in (file.as_posix(), *_alike(files, named.documents))}
    if len(names) * len(folders) * len(bases) > _MOST_COMBINATIONS:
        raise ValueError(f"{file.name} names too many files")
    for base, folder, name in itertools.product(bases, folders, names):
        if Path(os.path.normpath(f"{base}/{folder}/{name}")).parts[: len(room)] != room:
            raise ValueError(f"{file.name} names {name}, outside its folder: {_ITS_OWN}")


def _named_by_all(document: bytes, files: Iterable[str], read: Callable[[str], bytes]) -> NamedFiles:
    """Return the files named by a model and by those of its files that MuJoCo may read as documents."""
    named = named_files(document)
    unread = set(files)
    while found := _alike(unread, named.documents):
        unread -= found
        for name in found:
            try:
                named |= named_files(read(name))
            except ValueError as error:
                raise ValueError(f"it names {name}; {error}") from None
    return named


def _alike(files: Iterable[str], names: Iterable[str]) -> set[str]:
    """Return the files that one of the names may mean on some system."""
    parts = {_last_part(name).casefold() for name in names}
    return {file for file in files if _last_part(file).casefold() in parts}


def _last_part(name: str) -> str:
    return name.rpartition("/")[2]
