"""Names of levels, and the package paths they stand for."""

from __future__ import annotations

import re
from typing import Final

from urlab_client.protocol.names import WINDOWS_DEVICES
from urlab_client.server.assets.blueprint import IMPORTS

__all__ = ["level_package"]
_LEVEL_SEGMENT: Final = re.compile(r"\w(?:[\w\- ]*[\w\-])?")
_MAX_SEGMENT_BYTES: Final = 240
_RESERVED: Final = {IMPORTS.casefold(): "holds blueprints", "urlab": "holds recordings", "uploads": "holds uploads"}


def level_package(name: str) -> str:
    """Expand a level's name to its package path: `lab`, `/Game/Levels/lab` and `/Game/Levels/lab.lab` are one level.

    Raises:
        ValueError: The name has a part that cannot be a file name everywhere, or leads out of the content root.
    """
    in_game = name[:6].casefold() == "/game/"
    parts = name[6:].split("/") if in_game else name.split("/")
    package, _, described = parts[-1].partition(".")
    if described.casefold() == package.casefold():  # an object path says the name again; the engine ignores case
        parts[-1] = package
    for part in parts:
        if (
            not _LEVEL_SEGMENT.fullmatch(part)
            or len(part.encode()) > _MAX_SEGMENT_BYTES
            or part.upper() in WINDOWS_DEVICES
        ):
            raise ValueError(
                f"'{name}' is not a level's name: use letters, digits, spaces, '-' and '_', "
                "or a path of such parts that begins with /Game/"
            )
    if in_game and parts[0].casefold() in _RESERVED:
        raise ValueError(f"'{name}' is not a level's name: /Game/{parts[0]} {_RESERVED[parts[0].casefold()]}")
    return f"/Game/{'/'.join(parts)}" if in_game else f"/Game/Levels/{'/'.join(parts)}"
