"""Conversion of recorded pictures for other formats: RGB, with even sizes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.pixels import Pixels, without_alpha

__all__ = ["even", "farthest", "visible"]


def farthest(pixels: Pixels) -> float:
    """Return the largest finite depth of a depth picture, metres; 1 for other pictures, and without any depth."""
    depths = pixels[np.isfinite(pixels)] if pixels.dtype == np.float32 else np.zeros(0)
    return float(depths.max(initial=0.0)) or 1.0


def visible(pixels: Pixels, far: float) -> NDArray[np.uint8]:
    """Return pixels as RGB: depths in grey, from bright (near) to black (`far` and beyond)."""
    if pixels.dtype == np.float32:
        grey = 1.0 - np.clip(np.nan_to_num(pixels, nan=far), 0.0, far) / far
        return np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    return without_alpha(pixels)


def even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row and column if their number is odd, which H.264 and AV1 with 4:2:0 do not support."""
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else pixels
