"""Reuse of picture memory."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

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
