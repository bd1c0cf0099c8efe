"""Pictures as files: PNG and JPEG. Requires Pillow, which is imported on first use."""

from __future__ import annotations

import io
import os
import sys
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from urlab_client._extras import need
from urlab_client.enums import CameraMode
from urlab_client.values.pixels import Pixels, grey

if TYPE_CHECKING:
    from PIL import Image

JPEG_QUALITY: Final = 85
"""Default quality of a JPEG, of 100."""

_MILLIMETRES: Final = 1000.0
_DEEPEST: Final = 65_535


def png(pixels: Pixels, mode: CameraMode | str) -> bytes:
    """Return a picture as lossless PNG: colours as RGB, depth as 16-bit grey in millimetres.

    Depths of 65.535 m and more, and NaN, become 0, which depth cameras use for "no measurement".

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    if mode != CameraMode.DEPTH:
        return encoded(pillow_image(pixels, mode), "PNG")
    with np.errstate(invalid="ignore"):
        depth = np.rint(np.asarray(pixels, np.float64) * _MILLIMETRES)
        within = (depth >= 0) & (depth < _DEEPEST)
    return encoded(_image(np.where(within, depth, 0).astype(np.uint16)), "PNG")


def jpeg(pixels: Pixels, mode: CameraMode | str, quality: int = JPEG_QUALITY, *, max_size: int | None = None) -> bytes:
    """Return a picture as JPEG for display: colours, or depth as grey, with near pixels bright.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
        quality: 1 to 100.
        max_size: Longest side of the result, pixels; None keeps the size.

    Raises:
        MissingExtra: Pillow is not installed.
        ValueError: Quality or size is out of range.
    """
    if not 1 <= quality <= 100:
        raise ValueError(f"the quality of a JPEG is 1 to 100, got {quality}")
    if max_size is not None and max_size < 1:
        raise ValueError(f"max_size is at least 1 pixel, got {max_size}")
    if mode == CameraMode.REAL and max_size is None:
        return encoded(_in_place(pixels), "JPEG", quality=quality)
    image = _image(grey(pixels)) if mode == CameraMode.DEPTH else pillow_image(pixels, mode)
    if max_size is not None:
        image.thumbnail((max_size, max_size))
    return encoded(image, "JPEG", quality=quality)


def pillow_image(pixels: Pixels, mode: CameraMode | str, *, alpha: bool = False) -> Image.Image:
    """Return a colour or segmentation picture as a Pillow image, RGB or RGBA.

    Pillow selects the channels while it copies the picture, in a tenth of the time of NumPy.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
        alpha: Whether to keep the alpha channel.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    need("PIL", extra="pillow")
    from PIL import Image

    height, width = pixels.shape[:2]
    channels = "RGB" if mode == CameraMode.REAL else "BGR"
    kind, raw = ("RGBA", f"{channels}A") if alpha else ("RGB", f"{channels}X")
    return Image.frombytes(kind, (width, height), np.ascontiguousarray(pixels).data, "raw", raw)


def _in_place(pixels: Pixels) -> Image.Image:
    """Return a colour picture as a Pillow image that shares its memory. JPEG supports this; PNG does not."""
    need("PIL", extra="pillow")
    from PIL import Image

    height, width, channels = pixels.shape
    kind = "RGB" if channels == 3 else "RGBX"
    return Image.frombuffer(kind, (width, height), np.ascontiguousarray(pixels), "raw", kind, 0, 1)


def _image(array: NDArray[Any]) -> Image.Image:
    need("PIL", extra="pillow")
    from PIL import Image

    return Image.fromarray(array)


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    """Return a Pillow image as the bytes of a file.

    Args:
        image: The picture.
        kind: Format name of Pillow.
        options: Options of the format.
    """
    with _target() as target:
        image.save(target, kind, **options)
        target.seek(0)
        return target.read()


def _target() -> IO[bytes]:
    # Pillow releases the interpreter lock while it encodes a JPEG only if it writes to a file descriptor.
    if sys.platform == "linux":
        return os.fdopen(os.memfd_create("urlab-picture"), "w+b")
    return io.BytesIO()
