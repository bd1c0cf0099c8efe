"""How much room geoms take."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["Box", "box_around"]

Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest corner of an axis-aligned box, metres, world frame."""


def box_around(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.bool_]) -> Box:
    """Return the box around the chosen geoms, of which there must be one at least; none may be a plane.

    Args:
        model: The model.
        data: Its data with positions computed.
        geoms: Mask, shape (ngeom,).
    """
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    middle = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, model.geom_aabb[geoms, :3])
    reach = np.einsum("nij,nj->ni", np.abs(rotation), model.geom_aabb[geoms, 3:])
    return (middle - reach).min(axis=0), (middle + reach).max(axis=0)
