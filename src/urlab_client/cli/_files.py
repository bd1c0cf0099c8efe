"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Generator
from pathlib import Path

from urlab_client.cli._failure import CommandError

__all__ = ["check_ending", "replaced"]


def check_ending(path: Path, *endings: str) -> None:
    """Check that a file to write is called what it will be.

    Raises:
        CommandError: Its name ends differently.
    """
    if path.suffix.lower() not in endings:
        better = path.with_suffix(endings[0]).name if path.name else f"FILE{endings[0]}"
        raise CommandError(f"{path}: write a file that ends in {' or '.join(endings)}, for example {better}")


@contextlib.contextmanager
def replaced(path: Path) -> Generator[Path]:
    """Give a temporary file beside `path` to write to, and move it there when the block ends well.

    A reader, or a crash, sees the old file or the whole new one.
    """
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
