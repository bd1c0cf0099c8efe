"""The robots that ship with the server, usable by name: `urlab serve arm`, `sim://quadruped`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

__all__ = ["BUNDLED_PREFIX", "bundled_models", "bundled_root"]

BUNDLED_PREFIX: Final = "bundled:"
"""How a saved level names a bundled model, whose path differs from machine to machine."""


def bundled_root() -> Path:
    """Return the folder of the bundled models."""
    # MuJoCo opens the files itself, so they must be on disk: the package is not zip-safe.
    return Path(str(resources.files("urlab_client.server") / "robots")).resolve()


def bundled_models() -> dict[str, Path]:
    """Return the bundled MJCF files by name, sorted: `arm`, `ball`, `floor`, `pallet`, `quadruped`."""
    return {file.stem: file for file in sorted(bundled_root().glob("*.xml"))}
