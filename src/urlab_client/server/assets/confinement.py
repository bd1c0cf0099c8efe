"""Which files a model would make MuJoCo read, and whether all of them lie where a client may read.

For the sandbox, before MuJoCo sees the model. MuJoCo joins file names with folders named elsewhere in the model; this
looks for names and folders wherever they stand and tries all combinations. What it finds may be too much, never too
little.
"""

from __future__ import annotations

import os
from pathlib import Path

from urlab_client._confined import named_files
from urlab_client.server.limits import Limits

__all__ = ["Outside", "check_references"]

_MAX_COMBINATIONS = 1_000_000


class Outside(Exception):
    """A model names what it must not.

    Attributes:
        message: What, in one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


def check_references(file: Path, roots: tuple[Path, ...], limits: Limits) -> None:
    """Look at an XML model and, again and again, at whatever XML it names.

    Args:
        file: The model; resolved.
        roots: Folders below which files may be read; resolved.
        limits: Sizes and numbers of files.

    Raises:
        Outside: A file that exists lies elsewhere, a file is no XML, or a limit is exceeded.
        OSError: The model cannot be read.
    """
    waiting, seen = [file], {file}
    names: set[str] = set()
    folders: set[str] = {""}
    bases: set[Path] = set()
    tried = 0
    tested: set[Path] = set()
    while waiting:
        for path in waiting:
            text = _text(path, limits, must=path == file)
            bases.add(path.parent)
            try:
                found_names, found_folders = named_files(text)
            except ValueError as error:
                raise Outside(str(error)) from None
            names |= found_names
            folders |= found_folders
        waiting = list[Path]()
        variants = names | {name.rpartition("/")[2] for name in names}
        tried += len(bases) * len(folders) * len(variants)
        if tried > _MAX_COMBINATIONS:
            raise Outside("it names too many files")
        for candidate in {base / folder / name for base in bases for folder in folders for name in variants}:
            if candidate in tested:
                continue
            tested.add(candidate)
            found = _inside(candidate, roots)
            if found is None or found in seen:
                continue
            seen.add(found)
            if len(seen) > limits.model_files:
                raise Outside(f"it consists of more files than the limit model_files, {limits.model_files}")
            if _is_xml(found):
                waiting.append(found)


def _inside(candidate: Path, roots: tuple[Path, ...]) -> Path | None:
    """Return the real file; None if there is none.

    Raises:
        Outside: It is elsewhere.
    """
    try:
        if not os.path.lexists(candidate):
            return None
        real = candidate.resolve()
        is_folder = real.is_dir()
    except (OSError, ValueError, RuntimeError):  # too long, a null byte, a loop of links: not for MuJoCo either
        return None
    if not any(real.is_relative_to(root) for root in roots) and not is_folder:
        raise Outside(
            f"it names {candidate}, which lies outside the folders this server may read models from "
            f"({', '.join(map(str, roots))})"
        )
    return None if is_folder else real


def _is_xml(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(256).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"<"


def _text(path: Path, limits: Limits, *, must: bool) -> str:
    if path.stat().st_size > limits.model_file_bytes:
        raise Outside(f"{path} is larger than the limit model_file_bytes, {limits.model_file_bytes}")
    if must and not _is_xml(path):
        raise Outside("it is empty, or no XML")
    return path.read_bytes().decode("utf-8", errors="replace")
