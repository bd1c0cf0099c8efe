"""Convex decomposition of meshes with the optional CoACD library, for Quick Convert's `complex_mesh`."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import install_command

Part = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices, shape (n, 3), and triangles, shape (m, 3), of one convex part, in the frame of the file."""

_REMEMBERED: Final = 64


def advice() -> str:
    """Return the error message for a missing CoACD."""
    return f"complex_mesh needs convex decomposition; install it on the server: {install_command('coacd')}"


def is_available() -> bool:
    """Whether CoACD is installed."""
    return importlib.util.find_spec("coacd") is not None


def convex_parts(file: Path, threshold: float) -> tuple[Part, ...]:
    """Return the parts of a mesh. Results are cached by content and threshold.

    Args:
        threshold: Concavity that a part may keep; CoACD takes 0.01 to 1.

    Raises:
        ValueError: The file is not a mesh, CoACD is not installed, or it finds no parts.
        OSError: The file cannot be read.
    """
    if not is_available():
        raise ValueError(advice())
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return _decompose(digest, min(max(threshold, 0.01), 1.0), str(file))


@lru_cache(maxsize=_REMEMBERED)
def _decompose(digest: str, threshold: float, file: str) -> tuple[Part, ...]:
    coacd: Any = importlib.import_module("coacd")
    coacd.set_log_level("error")
    vertices, faces = _triangles(file)
    parts: list[Any] = coacd.run_coacd(coacd.Mesh(vertices, faces), threshold=threshold, seed=0)
    if not parts:
        raise ValueError(f"{file}: CoACD finds no convex parts in it")
    return tuple((np.asarray(v, dtype=np.float64), np.asarray(f, dtype=np.int32)) for v, f in parts)


def _triangles(file: str) -> Part:
    """Read a mesh as MuJoCo does, but in the frame of the file: MuJoCo moves meshes into their inertial frames."""
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="mesh", file=file)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
    model = spec.compile()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    vertices = model.mesh_vert.astype(np.float64) @ turn.reshape(3, 3).T + model.mesh_pos[0]
    return vertices, model.mesh_face.copy()
