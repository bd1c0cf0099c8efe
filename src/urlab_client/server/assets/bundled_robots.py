"""The robots that ship with the server, usable by name: `urlab serve arm`, `sim://quadruped`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

from urlab_client.values.names import did_you_mean

BUNDLED_PREFIX: Final = "bundled:"
"""How a saved level names a bundled model, whose path differs from machine to machine."""


def bundled_root() -> Path:
    """Return the folder of the bundled models."""
    # MuJoCo opens the files itself, so they must be on disk: the package is not zip-safe.
    return Path(str(resources.files("urlab_client.server") / "robots")).resolve()


def bundled_models() -> dict[str, Path]:
    """Return the bundled MJCF files by name, sorted: `arm`, `ball`, `block`, `floor`, `pallet`, `quadruped`."""
    return {file.stem: file for file in sorted(bundled_root().glob("*.xml"))}


def unknown_model(name: str) -> str:
    """Return the error message for a name that is neither a file nor a bundled robot."""
    known = bundled_models()
    return f"{name} is neither a file nor a bundled robot.{did_you_mean(name, known)} Bundled: {', '.join(known)}."
