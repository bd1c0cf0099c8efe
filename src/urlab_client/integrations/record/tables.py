"""Tables of states, of which an overnight recording has millions: built and stored in pieces."""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.quantities import component_name, quantities
from urlab_client.integrations._feed.scene_messages import SceneLayout
from urlab_client.integrations.record.contents import Column, Table
from urlab_client.protocol.base import Floats

__all__ = ["PIECE_VALUES", "Number", "SampleTimes", "StoredTable", "TableBuilder"]

PIECE_VALUES = 1 << 21
"""Approximate number of values in a piece of a table: 16 MiB."""

_MOST_COLUMNS = 1_000_000

Number: TypeAlias = float | Literal["NaN", "Infinity", "-Infinity"]
"""A number as decoded; numbers that JSON cannot represent are text."""


class SampleTimes(NamedTuple):
    """Time of a sample: see `Table`, in nanoseconds and seconds."""

    log_ns: int
    sim_time: float
    wall_ns: int
    step: int
    episode: int


class StoredTable:
    """The states of a recording in pieces, whose columns may appear late or get wider from piece to piece.

    Not a memory map, because the number and the width of the columns are known only at the end.

    Attributes:
        last: The last piece, which stays in memory. Its columns are those of the table.

    Args:
        folder: Folder of a temporary file for the other pieces; None keeps them in memory. If the system supports it,
            the file has no name, so a crash leaves nothing behind.

    Raises:
        OSError: The file cannot be created.
    """

    def __init__(self, folder: Path | None) -> None:
        none, nothing = np.zeros(0), np.zeros(0, np.int64)
        self.last = Table(none, none, nothing, nothing, nothing, {})
        self._file: IO[bytes] | None = None
        if folder is not None:
            self._file = tempfile.TemporaryFile(dir=folder, prefix=".urlab-")  # noqa: SIM115  # see __exit__
        self._lengths: list[int] = []
        self._pieces: list[dict[str, Callable[[], NDArray[Any]]]] = []  # what loads each array

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def __len__(self) -> int:
        return sum(self._lengths) + len(self.last)

    def keep(self, piece: Table) -> None:
        """Store the next piece.

        Raises:
            OSError: The file cannot be written.
        """
        self._lengths.append(len(piece))
        self._pieces.append({name: self._stored(values) for name, values in piece.arrays().items()})

    def pieces(self) -> Iterator[Table]:
        """Iterate over the pieces, all with the same columns; missing values are NaN."""
        for number in range(len(self._pieces)):
            arrays = {name: self._read(number, name, values) for name, values in self.last.arrays().items()}
            yield self.last.with_arrays(arrays)
        yield self.last

    def parts(self, name: str) -> Iterator[NDArray[Any]]:
        """Iterate over the pieces of one array of the table."""
        values = self.last.arrays()[name]
        for number in range(len(self._pieces)):
            yield self._read(number, name, values)
        yield values

    def join(self) -> Table:
        """Return the whole table, and forget the pieces."""
        arrays: dict[str, NDArray[Any]] = {}
        for name in self.last.arrays():
            arrays[name] = np.concatenate([*self.parts(name)])
            for piece in self._pieces:  # so that memory holds only one array twice
                piece.pop(name, None)
        return self.last.with_arrays(arrays)

    def _stored(self, values: NDArray[Any]) -> Callable[[], NDArray[Any]]:
        file = self._file
        if file is None:
            return lambda: values
        offset = file.tell()
        np.save(file, values, allow_pickle=False)
        return partial(_loaded, file, offset)

    def _read(self, number: int, name: str, like: NDArray[Any]) -> NDArray[Any]:
        """Return an array of a piece, with as many columns as the last one."""
        load = self._pieces[number].get(name)
        found = np.zeros((0, 0)) if load is None else load()
        if found.shape[1:] == like.shape[1:]:
            return found
        wider = np.full((self._lengths[number], *like.shape[1:]), np.nan)
        wider[: len(found), : found.shape[1]] = found
        return wider


def _loaded(file: IO[bytes], offset: int) -> NDArray[Any]:
    file.seek(offset)
    return np.load(file, allow_pickle=False)


@dataclass(slots=True)
class _Field:
    """Rows of one field of an articulation or entity in the current piece, and their places in it."""

    width: int = 0
    places: list[int] = field(default_factory=list[int])
    rows: list[array[float]] = field(default_factory=list["array[float]"])

    def values(self, count: int) -> Floats:
        """Return the first rows of the piece as an array; missing values are NaN."""
        values = np.full((count, self.width), np.nan)
        for place, row in zip(self.places, self.rows, strict=True):
            if place < count:
                values[place, : len(row)] = row
        return values


@dataclass(slots=True)
class _Source:
    """Samples of one articulation or entity."""

    key: str
    layout: SceneLayout
    fields: dict[str, _Field] = field(default_factory=dict[str, _Field])
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])


class TableBuilder:
    """Builds one table. Samples arrive in order, with one part for each articulation and entity.

    Args:
        table: Receives the pieces of the table.
        only: Fields to keep, such as `qpos`; None keeps all.
        most: Largest number of values of the whole table, missing ones included.
    """

    def __init__(self, table: StoredTable, only: Collection[str] | None = None, *, most: int) -> None:
        self._table = table
        self._only = only
        self._most = most
        self._count = 0
        self._width = len(SampleTimes._fields)
        self._sources: dict[str, _Source] = {}
        self._sample = -1
        self._present = set[str]()
        self._present_before = set[str]()
        self._begin()

    def _begin(self) -> None:
        self._times: tuple[array[float], ...] = tuple(array(kind) for kind in ("q", "d", "q", "q", "q"))
        for source in self._sources.values():
            source.fields = {name: _Field(one.width) for name, one in source.fields.items()}

    def source(self, key: str, layout: SceneLayout) -> _Source:
        """Return the samples of an articulation or entity so far."""
        return self._sources.setdefault(key, _Source(key, layout))

    def add(self, source: _Source, sample: int, times: SampleTimes, **fields: Sequence[Number]) -> None:
        """Add a part of a sample.

        Raises:
            ValueError: It is not the next one, or the table becomes too large.
        """
        new = sample > self._sample
        if sample < self._sample or (not new and source.key in self._present):
            raise ValueError(f"sample {sample} comes after sample {self._sample}")
        kept = {name: row for name, row in fields.items() if row and (self._only is None or name in self._only)}
        widths = {name: source.fields[name].width if name in source.fields else 0 for name in kept}
        self._width += sum(max(0, len(row) - widths[name]) for name, row in kept.items())
        self._count += new
        if self._width > _MOST_COLUMNS or self._count * self._width > self._most:
            raise ValueError(f"{self._count} samples of {self._width} values are too many for the size of the file")
        if new:
            if len(self._times[0]) * self._width >= PIECE_VALUES:
                self._table.keep(self._piece(len(self._times[0])))
                self._begin()
            self._sample, self._present_before, self._present = sample, self._present, set[str]()
            for column, value in zip(self._times, times, strict=True):
                column.append(value)
        self._present.add(source.key)
        for name, values in kept.items():
            into = source.fields.setdefault(name, _Field())
            into.width = max(into.width, len(values))
            into.places.append(len(self._times[0]) - 1)
            into.rows.append(array("d", map(float, values)))

    def finish(self, *, broken_off: bool) -> None:
        """Pass on the last piece; if the recording broke off, without the last sample if an articulation or entity of
        the previous one is missing in it."""
        partial = broken_off and not self._present_before <= self._present
        self._table.last = self._piece(len(self._times[0]) - partial)

    def _piece(self, count: int) -> Table:
        log_ns, sim_time, wall_ns, step, episode = (np.array(column[:count]) for column in self._times)
        return Table(
            time=log_ns.astype(np.int64) / 1e9,
            sim_time=sim_time.astype(np.float64),
            wall_ns=wall_ns.astype(np.int64),
            step=step.astype(np.int64),
            episode=episode.astype(np.int64),
            columns={
                f"{source.key}/{name}": _column(source, name, one.values(count))
                for source in self._sources.values()
                for name, one in source.fields.items()
            },
        )


def _column(source: _Source, name: str, values: Floats) -> Column:
    layout = source.layout
    known = {
        "qpos": layout.qpos,
        "qvel": layout.qvel,
        "ctrl": layout.ctrl,
        "set_points": layout.ctrl,
        "act": layout.act,
        **source.names,
    }
    names = known.get(name, [])
    if len(names) != values.shape[1]:
        names = [str(i) for i in range(values.shape[1])]
    labels = [component_name(layout, value) for value in names] if name == "sensors" else names
    return Column(names, values, quantities(layout, name, names), labels)
