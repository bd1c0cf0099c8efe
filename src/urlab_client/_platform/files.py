"""Atomic replacement of files."""

from __future__ import annotations

import contextlib
import os
import secrets
import sys
from collections.abc import Generator
from pathlib import Path


@contextlib.contextmanager
def replaced(path: Path, *, ending: str | None = None, durable: bool = True) -> Generator[Path]:
    """Yield a temporary file beside `path`, and move it to `path` if the block succeeds.

    A reader sees the old file or the complete new one, even after a crash.

    Args:
        path: The file.
        ending: Ending of the temporary file's name; that of `path` by default, for libraries which go by it.
        durable: Also after a power failure, which takes the time of the disk.
    """
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix if ending is None else ending}")
    # The system applies the umask. Reading it would set it for a moment, for the files of all threads.
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    try:
        yield temporary
        if durable:
            _synchronise(temporary, os.O_RDWR)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable and sys.platform != "win32":  # which has no such thing for a folder
        _synchronise(path.parent, os.O_RDONLY)


def write_whole(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write a file as `replaced` does, and create its folder if it is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced(path, ending=".new", durable=durable) as temporary:
        temporary.write_bytes(data)


def _synchronise(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
