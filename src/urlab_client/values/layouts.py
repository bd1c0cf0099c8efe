"""Fixed binary layouts: sizes are checked and arrays shaped here. Numbers are little-endian."""

from __future__ import annotations

from struct import Struct as Layout
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from urlab_client.errors import ProtocolError

BytesLike: TypeAlias = bytes | bytearray | memoryview
"""A received frame; a memoryview must be one of bytes (format `B`)."""

T = TypeVar("T", bound=np.generic)


def damaged(what: str, where: object, problem: str, payload: BytesLike) -> ProtocolError:
    """Return the error for a message that does not match its layout."""
    at = f" on {str(where)!r}" if where else ""
    return ProtocolError(f"{what}{at}: {problem}.", raw=bytes(payload[:256]))


def check_size(what: str, where: object, payload: BytesLike, expected: int) -> None:
    """Raise `ProtocolError` unless a message has its layout's size."""
    if len(payload) != expected:
        raise damaged(what, where, f"{len(payload)} bytes, expected {expected}", payload)


INT32 = Layout("<i")


def floats32(values: ArrayLike) -> NDArray[np.float32]:
    """Return the values as float32, the wire's type."""
    # Values beyond float32 become infinite, as with the plugin's cast; they must not stop the stream.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values, dtype="<f4")


def vector(what: str, values: NDArray[T], size: int) -> NDArray[T]:
    """Return the array if its shape is (size,); otherwise raise `ValueError`."""
    if values.shape != (size,):
        raise ValueError(f"{what} has shape {values.shape}, expected ({size},)")
    return values
