"""A table of states larger than memory: its pieces are stored in a temporary file."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations.record.contents import Table

__all__ = ["StoredTable"]


class _Place(NamedTuple):
    """Location of an array in the file."""

    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


class StoredTable:
    """The states of a recording in pieces. If the system supports it, the file has no name, so a crash leaves nothing
    behind.

    Attributes:
        last: The last piece, which stays in memory. Its columns are those of the table.

    Args:
        folder: Folder of the file.

    Raises:
        OSError: The file cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        none, nothing = np.zeros(0), np.zeros(0, np.int64)
        self.last = Table(none, none, nothing, nothing, nothing, {})
        self._file: IO[bytes] = tempfile.TemporaryFile(dir=folder, prefix=".urlab-")  # noqa: SIM115  # see __exit__
        self._places: list[dict[str, _Place]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def __len__(self) -> int:
        return sum(places["time"].shape[0] for places in self._places) + len(self.last)

    def keep(self, piece: Table) -> None:
        """Write the next piece to the file.

        Raises:
            OSError: The file cannot be written.
        """
        places: dict[str, _Place] = {}
        for name, values in piece.arrays().items():
            places[name] = _Place(self._file.tell(), values.shape, values.dtype)
            self._file.write(np.ascontiguousarray(values).data)
        self._places.append(places)

    def pieces(self) -> Iterator[Table]:
        """Iterate over the pieces, all with the same columns; missing values are NaN."""
        for places in self._places:
            arrays = {name: self._read(places, name, values.shape[1:]) for name, values in self.last.arrays().items()}
            yield self.last.with_arrays(arrays)
        yield self.last

    def parts(self, name: str) -> Iterator[NDArray[Any]]:
        """Iterate over the pieces of one array of the table."""
        values = self.last.arrays()[name]
        for places in self._places:
            yield self._read(places, name, values.shape[1:])
        yield values

    def _read(self, places: dict[str, _Place], name: str, width: tuple[int, ...]) -> NDArray[Any]:
        place = places.get(name)
        if place is None:
            return np.full((*places["time"].shape, *width), np.nan)
        self._file.seek(place.offset)
        found = np.frombuffer(self._file.read(_size(place)), place.dtype).reshape(place.shape)
        if place.shape[1:] == width:
            return found
        wider = np.full((len(found), *width), np.nan)
        wider[:, : found.shape[1]] = found
        return wider


def _size(place: _Place) -> int:
    return math.prod(place.shape) * place.dtype.itemsize
