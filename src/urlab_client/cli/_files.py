"""Files that commands write: with the right ending, and complete or absent."""

from __future__ import annotations

from pathlib import Path

from urlab_client._whole_files import replaced
from urlab_client.cli._failure import CommandError

__all__ = ["check_ending", "replaced"]


def check_ending(path: Path, *endings: str) -> None:
    """Check the ending of an output file.

    Raises:
        CommandError: The name has another ending.
    """
    if path.suffix.lower() not in endings:
        better = path.with_suffix(endings[0]).name if path.name else f"FILE{endings[0]}"
        raise CommandError(f"{path}: write a file that ends in {' or '.join(endings)}, for example {better}")
