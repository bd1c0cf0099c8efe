"""Which files MuJoCo would read for a model, and whether all of them are in allowed folders.

For the sandbox, before MuJoCo sees the model. MuJoCo joins file names with folders named elsewhere in the model; this
looks for names and folders wherever they stand and tries all combinations. It may find too many files, but never too
few.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from urlab_client._sandbox.mjcf_files import NamedFiles, named_files
from urlab_client.server.limits import Limits

_MAX_COMBINATIONS = 1_000_000


class Outside(Exception):
    """A model refers to a file outside its allowed folders.

    Attributes:
        message: What is wrong, in one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


def check_references(file: Path, roots: tuple[Path, ...], limits: Limits) -> None:
    """Check an MJCF and, recursively, all documents that it includes.

    Args:
        file: The model; resolved.
        roots: Folders below which files may be read; resolved.
        limits: Sizes and numbers of files.

    Raises:
        Outside: A file that exists lies elsewhere, a document cannot be understood, or a limit is exceeded.
        OSError: The model cannot be read.
    """
    waiting, documents, files = [file], {file}, {file}
    named = NamedFiles(folders={""})
    bases: set[Path] = set()
    tested: set[tuple[Path, bool]] = set()
    tried = 0
    while waiting:
        for path in waiting:
            named |= _read(path, limits, is_model=path == file)
            bases.add(path.parent)
        waiting = list[Path]()
        for names, are_documents in ((named.documents, True), (named.data, False)):
            variants = names | {name.rpartition("/")[2] for name in names}
            tried += len(bases) * len(named.folders) * len(variants)
            if tried > _MAX_COMBINATIONS:
                raise Outside("it names too many files")
            for candidate in _combined(bases, named.folders, variants):
                if (candidate, are_documents) in tested:
                    continue
                tested.add((candidate, are_documents))
                found = _inside(candidate, roots)
                if found is None:
                    continue
                files.add(found)
                if len(files) > limits.model_files:
                    raise Outside(f"it consists of more files than the limit model_files, {limits.model_files}")
                if are_documents and found not in documents:
                    documents.add(found)
                    waiting.append(found)


def _combined(bases: Iterable[Path], folders: Iterable[str], names: Iterable[str]) -> set[Path]:
    return {base / folder / name for base in bases for folder in folders for name in names}


def _inside(candidate: Path, roots: tuple[Path, ...]) -> Path | None:
    """Return the resolved file; None if it does not exist.

    Raises:
        Outside: It is elsewhere, or not a file but a device or the like.
    """
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


def _read(path: Path, limits: Limits, *, is_model: bool) -> NamedFiles:
    if path.stat().st_size > limits.model_file_bytes:
        raise Outside(f"{path} is larger than the limit model_file_bytes, {limits.model_file_bytes}")
    try:
        return named_files(path.read_bytes())
    except ValueError as error:
        raise Outside(str(error) if is_model else f"it names {path}; {error}") from None
