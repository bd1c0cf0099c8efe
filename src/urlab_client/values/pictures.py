"""Camera pictures: from the pixels on the wire to arrays, in memory that is used again, and to PNG and JPEG files.

Files require Pillow, which is imported on first use.
"""

from __future__ import annotations

import io
import os
import sys
from collections import deque
from struct import Struct as Layout
from types import ModuleType
from typing import IO, TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from urlab_client._installation import MissingExtra, need
from urlab_client.enums import CameraMode
from urlab_client.values.html import picture
from urlab_client.values.layouts import BytesLike, damaged
from urlab_client.values.plain import Serializable

if TYPE_CHECKING:
    from PIL import Image

Pixels: TypeAlias = NDArray[np.uint8] | NDArray[np.float32]

_FRAME_MAGIC = 0x314D4355
_FRAME_HEADERS = {1: Layout("<IIQdII"), 2: Layout("<IIQdIId")}
_THUMBNAIL = 240  # pixels
_MAX_SIDE = 16_384  # maximum of graphics cards
_CACHED = 65_536  # pixels that stay in a core's cache between two passes
_CENTIMETRES = np.float32(100)


class CameraImage(Serializable, Struct, frozen=True, eq=False):
    """One picture.

    Attributes:
        pixels: Top row first. Mode `real`: uint8 (H, W, 4) RGBA with alpha 255. `depth`: float32 (H, W), metres along
            the optical axis. `semantic`, `instance` and modes unknown here: uint8 (H, W, 4) BGRA as sent.
        frame_id: Frame number from the server; None if the server sends no header.
        sim_time: Simulation time of the frame, seconds; None if the server does not send it.
        capture_time: Unix time of the capture, seconds; None if the server does not send it.
    """

    pixels: Pixels
    frame_id: int | None = None
    sim_time: float | None = None
    capture_time: float | None = None


class PictureStamp(NamedTuple):
    """Header of a picture.

    Attributes:
        frame_id: Frame number from the server.
        sim_time: Simulation time of the frame, seconds.
        size: Size of the header, bytes.
    """

    frame_id: int
    sim_time: float
    size: int


def check_picture_size(width: int, height: int) -> None:
    """Check the picture size that a peer sent.

    Raises:
        ValueError: The size is impossible.
    """
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise ValueError(f"pictures of {width}x{height} pixels; each side has 1 to {_MAX_SIDE}")


def decode_camera(
    payload: BytesLike,
    mode: CameraMode | str,
    width: int,
    height: int,
    *,
    memory: PictureMemory | None = None,
    where: object = "",
) -> CameraImage:
    """Decode a picture: a camera message, a slot of a camera region or the `data` of a step reply's camera block.

    Newer servers send a header before the pixels. It is recognised by its magic number together with the length, so
    that pixels cannot be mistaken for a header.

    Args:
        payload: Pixels, with or without header.
        mode: Mode of the camera.
        width: Columns, from the handshake or the camera block.
        height: Rows.
        memory: Memory for the array; None allocates it.
        where: Name of the camera in errors.

    Raises:
        ProtocolError: If the payload does not have the size of such a picture, or the size is impossible.
    """
    try:
        check_picture_size(width, height)
    except ValueError as error:
        raise damaged("camera frame", where, str(error), payload) from None
    header = _frame_header(payload, width, height, where)
    start = header.size if header else 0
    count = width * height
    words = np.empty(count + 1, "<u4") if memory is None else memory.words(count + 1)
    pixels = _pixels(np.frombuffer(payload, ">u4", count, start), words, mode)
    pixels = pixels.reshape((height, width) if mode == CameraMode.DEPTH else (height, width, 4))
    if header is None:
        return CameraImage(pixels)
    _, _, frame_id, sim_time, _, _, *capture_time = header.unpack_from(payload)
    return CameraImage(pixels, frame_id, sim_time, *capture_time)


def picture_stamp(payload: BytesLike, width: int, height: int, *, where: object = "") -> PictureStamp | None:
    """Read the header of a picture without touching its pixels; None for bare pixels.

    Args:
        payload: Pixels, with or without header.
        width: Columns, from the handshake.
        height: Rows.
        where: Name of the camera in errors.

    Raises:
        ProtocolError: If the payload does not have the size of such a picture.
    """
    header = _frame_header(payload, width, height, where)
    if header is None:
        return None
    _, _, frame_id, sim_time, *_ = header.unpack_from(payload)
    return PictureStamp(frame_id, sim_time, header.size)


def camera_header(frame_id: int, sim_time: float, width: int, height: int, captured: float) -> bytes:
    """Return the header that newer servers send before the pixels of a streamed picture.

    Args:
        frame_id: Number of the snapshot in the picture.
        sim_time: Simulation time of the snapshot, seconds.
        width: Columns.
        height: Rows.
        captured: Capture time, Unix seconds.
    """
    return _FRAME_HEADERS[2].pack(_FRAME_MAGIC, 2, frame_id, sim_time, width, height, captured)


def _frame_header(payload: BytesLike, width: int, height: int, where: object) -> Layout | None:
    size = width * height * 4
    for version, layout in _FRAME_HEADERS.items():
        if len(payload) != size + layout.size:
            continue
        magic, said, _, _, columns, rows, *_ = layout.unpack_from(payload)
        if magic != _FRAME_MAGIC or said != version:
            continue
        if (columns, rows) != (width, height):
            problem = f"header says {columns}x{rows} pixels, the handshake {width}x{height}"
            raise damaged("camera frame", where, problem, payload)
        return layout
    if len(payload) != size:
        problem = f"{len(payload)} bytes, expected {size} ({width}x{height} pixels of 4 bytes)"
        raise damaged("camera frame", where, problem, payload)
    return None


def _pixels(source: NDArray[np.uint32], words: NDArray[np.uint32], mode: CameraMode | str) -> Pixels:
    """Fill `words`, which has one spare element; return the pixels in it, flat."""
    if mode == CameraMode.DEPTH:
        metres = words[:-1].view("<f4")
        with np.errstate(invalid="ignore"):
            return np.divide(source.view("<f4"), _CENTIMETRES, out=metres)
    if mode != CameraMode.REAL:
        words[:-1] = source.view("<u4")
        return words[:-1].view(np.uint8)
    # BGRA read as big-endian words is ARGB written as little-endian; one byte later it is RGB and the next pixel's
    # alpha.
    # This takes as long as 1.5 copies; shifting each pixel takes 4.
    for start in range(0, source.size, _CACHED):
        piece = words[start : min(start + _CACHED, source.size)]
        piece[:] = source[start : start + _CACHED]
        piece |= np.uint32(0xFF)
    words[-1] = 0xFF
    return words.view(np.uint8)[1:-3]


def without_alpha(pixels: Pixels) -> NDArray[np.uint8]:
    """Return a copy of the first three channels of pictures, shape (…, 3)."""
    opaque = np.empty((*pixels.shape[:-1], 3), np.uint8)
    for channel in range(3):  # NumPy copies a slice of three pixel by pixel, four times slower
        opaque[..., channel] = pixels[..., channel]
    return opaque


def observed_pixels(pixels: Pixels, mode: CameraMode | str) -> Pixels:
    """Return a picture as policies observe it: colours as RGB, shape (H, W, 3); other modes unchanged.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
    """
    return without_alpha(pixels) if mode == CameraMode.REAL else pixels


def grey(depth: Pixels) -> NDArray[np.uint8]:
    """Return a depth picture for display, shape (H, W), with near pixels bright."""
    seen = depth[np.isfinite(depth)]
    if not seen.size:
        return np.zeros(depth.shape, np.uint8)
    near, far = np.percentile(seen, [1, 95])
    share = np.clip((far - np.nan_to_num(depth, posinf=far, neginf=near)) / max(far - near, 1e-6), 0, 1)
    return (share * 255).astype(np.uint8)


def to_rgb(pixels: Pixels, mode: CameraMode | str) -> NDArray[np.uint8]:
    """Return a picture for display, shape (H, W, 3), RGB: colours unchanged, depths in grey.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
    """
    if mode == CameraMode.DEPTH:
        return np.repeat(grey(pixels)[..., None], 3, axis=2)
    return without_alpha(pixels if mode == CameraMode.REAL else pixels[..., 2::-1])


# For a stream's reader: one picture in use, the stream's latest, and one being converted.
_KEPT = 2


class PictureMemory:
    """Memory of one camera's pictures, reused once no view of the picture exists.

    The system clears fresh memory page by page, which takes as long as copying a picture. Pictures that the user keeps
    are never overwritten: only memory without any view is reused, and at most two pictures of it are kept. Thread-safe.
    """

    def __init__(self) -> None:
        self._unused: deque[NDArray[np.uint32]] = deque(maxlen=_KEPT)

    def words(self, count: int) -> NDArray[np.uint32]:
        """Return an uninitialised array of this many words."""
        try:
            block = self._unused.pop()
        except IndexError:
            block = None
        if block is None or block.size != count:
            block = np.empty(count, "<u4")
        return np.asarray(_Loan(block, self._unused))


class _Loan:
    """Base object of all views of a block, which NumPy treats as the owner of the memory."""

    def __init__(self, block: NDArray[np.uint32], unused: deque[NDArray[np.uint32]]) -> None:
        self.__array_interface__ = block.__array_interface__
        self._block = block
        self._unused = unused

    def __del__(self) -> None:
        self._unused.append(self._block)


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
    return encoded(_shown(pixels, mode, max_size), "JPEG", quality=quality)


def shown_png(pixels: Pixels, mode: CameraMode | str) -> bytes | None:
    """Return a picture as PNG for display, depths in grey; None without Pillow.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
    """
    try:
        return encoded(_shown(pixels, mode), "PNG")
    except MissingExtra:
        return None


def thumbnail(pixels: Pixels, mode: CameraMode | str, description: str) -> str:
    """Return a small picture for a table; without Pillow a sentence that says so.

    Args:
        pixels: As in `CameraSample`.
        mode: Meaning of the pixels.
        description: Text for those who cannot see it.
    """
    try:
        return picture(encoded(_shown(pixels, mode, _THUMBNAIL), "PNG"), "png", description)
    except MissingExtra as missing:
        return str(missing)


def _shown(pixels: Pixels, mode: CameraMode | str, max_size: int | None = None) -> Image.Image:
    """Return a picture for display as a Pillow image: colours, or depths as grey."""
    image = _image(grey(pixels)) if mode == CameraMode.DEPTH else pillow_image(pixels, mode)
    if max_size is not None:
        image.thumbnail((max_size, max_size))
    return image


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
    height, width, count = pixels.shape
    channels = "RGB" if mode == CameraMode.REAL else "BGR"
    kind, raw = ("RGBA", f"{channels}A") if alpha else ("RGB", channels if count == 3 else f"{channels}X")
    return _pillow().frombytes(kind, (width, height), np.ascontiguousarray(pixels).data, "raw", raw)


def _in_place(pixels: Pixels) -> Image.Image:
    """Return a colour picture as a Pillow image that shares its memory. JPEG supports this; PNG does not."""
    height, width, channels = pixels.shape
    kind = "RGB" if channels == 3 else "RGBX"
    return _pillow().frombuffer(kind, (width, height), np.ascontiguousarray(pixels), "raw", kind, 0, 1)


def _image(array: NDArray[Any]) -> Image.Image:
    return _pillow().fromarray(array)


def _pillow() -> ModuleType:
    need("PIL", extra="pillow")
    from PIL import Image

    return Image


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
