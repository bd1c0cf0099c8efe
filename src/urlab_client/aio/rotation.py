"""Rotations by unit quaternions (w, x, y, z)."""

from __future__ import annotations

import numpy as np

from urlab_client.protocol.base import Floats

__all__ = ["rotate", "rotate_inverse"]


def rotate(quat: Floats, vector: Floats) -> Floats:
    """Rotate `vector` by `quat`: v + 2 w (u x v) + 2 u x (u x v) with quat = (w, u), the Euler-Rodrigues formula."""
    w, u = quat[0], quat[1:]
    t = 2.0 * np.cross(u, vector)
    return vector + w * t + np.cross(u, t)


def rotate_inverse(quat: Floats, vector: Floats) -> Floats:
    """Rotate `vector` by the inverse of `quat`."""
    return rotate(quat * np.array([1.0, -1.0, -1.0, -1.0]), vector)
