"""The files that the text of an MJCF makes MuJoCo open. For client and server, before compiling an untrusted model."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
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

_DOCUMENT_SUFFIXES: Final = (".xml", ".mjcf", ".urdf")
_ARCHIVE_SUFFIXES: Final = (".mjz", ".zip")
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
