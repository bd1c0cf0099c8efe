"""Memory of pictures that is used again for later ones."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["PictureMemory"]

# Of a stream's reader: one picture is looked at, one is the stream's last, one is being made.
_KEPT = 2


class PictureMemory:
    """Memory of one camera's pictures, used again once nobody has a view of the picture in it any more.

    Memory that is fresh from the system is cleared page by page, which takes as long as copying a picture. What the
    user keeps stays the user's: only memory whose last view is gone comes back, and of that no more than two pictures
    are kept. From any thread.
    """

    def __init__(self) -> None:
        self._unused: deque[NDArray[np.uint32]] = deque(maxlen=_KEPT)

    def words(self, count: int) -> NDArray[np.uint32]:
        """Return an array of so many words, whatever is in them."""
        try:
            block = self._unused.pop()
        except IndexError:
            block = None
        if block is None or block.size != count:
            block = np.empty(count, "<u4")
        return np.asarray(_Loan(block, self._unused))


class _Loan:
    """What every view of a block holds, and nobody else: NumPy takes it for the owner of the memory."""

    def __init__(self, block: NDArray[np.uint32], unused: deque[NDArray[np.uint32]]) -> None:
        self.__array_interface__ = block.__array_interface__
        self._block = block
        self._unused = unused

    def __del__(self) -> None:
        self._unused.append(self._block)
