"""MuJoCo without its OpenGL part, which the commands do not need in their own process."""

from __future__ import annotations

import os

__all__ = ["import_mujoco"]

_VARIABLE = "MUJOCO_GL"


def import_mujoco() -> None:
    """Import MuJoCo without OpenGL.

    Importing it loads the OpenGL platform that `MUJOCO_GL` names, and fails if that is missing. A user who sets the
    variable for other programs can still serve and drive robots. Pictures are drawn in a separate process.
    """
    chosen = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "disable"
    try:
        import mujoco  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]  # for its effect
    finally:
        if chosen is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = chosen
