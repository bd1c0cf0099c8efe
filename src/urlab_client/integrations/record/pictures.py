"""Pictures of a recording: decoded, and converted for other formats."""

from __future__ import annotations

import io
from collections.abc import Callable

import msgspec
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from urlab_client.integrations._feed.messages import CompressedImage, RawImage
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.values.pictures import Pixels, without_alpha

_MOST_PIXELS = 8192 * 8192


class RecordedPicture(msgspec.Struct, frozen=True):
    """One encoded picture of the file.

    Attributes:
        time: Time on the recording's clock, seconds.
        mode: Mode of the camera: `real`, `depth` and so on.
        message: The encoded picture.
        unreadable: Makes the error for a picture that is not what it says.
    """

    time: float
    mode: str
    message: CompressedImage | RawImage
    unreadable: Callable[[object], RecordingError]

    def pixels(self) -> Pixels:
        """Return it as an array like `Camera.pixels`.

        Raises:
            RecordingError: It is damaged, too large, or not what the message says.
        """
        message = self.message
        try:
            return _depths(message) if isinstance(message, RawImage) else _colours(message.data)
        except Exception as error:  # Pillow raises errors of many types
            raise self.unreadable(error) from error


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


def _depths(message: RawImage) -> Pixels:
    height, width = message.height, message.width
    if message.encoding != "32FC1" or message.step != 4 * width or len(message.data) != 4 * height * width:
        raise ValueError(
            f"{len(message.data)} bytes of {message.encoding[:20]!r} in rows of {message.step} bytes "
            f"are not {width}x{height} depths"
        )
    _check_size(width, height)
    return np.frombuffer(message.data, "<f4").astype(np.float32).reshape(height, width)


def _colours(data: bytes) -> Pixels:
    with Image.open(io.BytesIO(data), formats=("JPEG", "PNG")) as image:
        _check_size(*image.size)
        return np.array(image if image.mode in {"RGB", "RGBA"} else image.convert("RGB"))


def _check_size(width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > _MOST_PIXELS:
        raise ValueError(f"a picture of {width}x{height} pixels; it can have 1 to {_MOST_PIXELS}")
