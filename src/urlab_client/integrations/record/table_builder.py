"""Building a table from successive states, of which an overnight recording has millions, in growing arrays.

A table that is too large for memory is passed on in pieces while it grows.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.quantities import component_name, quantities
from urlab_client.integrations._feed.scene_messages import SceneLayout
from urlab_client.integrations.record.contents import Column, Table
from urlab_client.protocol.base import Floats

__all__ = ["PIECE_VALUES", "Number", "SampleTimes", "TableBuilder"]

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


class _Values:
    """Rows of one field with a fixed width; missing rows are NaN."""

    def __init__(self) -> None:
        self.width = 0
        self._numbers = array("d")

    def put(self, row: int, values: Sequence[Number]) -> None:
        if len(values) > self.width:
            self._widen(len(values))
        numbers = array("d", map(float, values))
        self._fill(row * self.width)
        self._numbers.extend(numbers)
        self._fill((row + 1) * self.width)

    def rows(self, count: int) -> Floats:
        """Return the first rows as an array."""
        self._fill(count * self.width)
        return np.frombuffer(self._numbers, np.float64)[: count * self.width].reshape(count, self.width)

    def clear(self) -> None:
        """Start again with rows of the same width."""
        self._numbers = array("d")

    def _fill(self, size: int) -> None:
        missing = size - len(self._numbers)
        if missing > 0:
            self._numbers.extend(array("d", [np.nan]) * missing)

    def _widen(self, width: int) -> None:
        if self._numbers:
            rows = len(self._numbers) // self.width
            wider = np.full((rows, width), np.nan)
            wider[:, : self.width] = np.frombuffer(self._numbers, np.float64).reshape(rows, self.width)
            self._numbers = array("d", wider.tobytes())
        self.width = width


@dataclass(slots=True)
class _Source:
    """Samples of one articulation or entity."""

    layout: SceneLayout
    samples: array[int] = field(default_factory=lambda: array("q"))
    fields: dict[str, _Values] = field(default_factory=dict[str, _Values])
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])


class TableBuilder:
    """Builds one table. Samples arrive in order, with one part for each articulation and entity.

    Args:
        only: Fields to keep, such as `qpos`; None keeps all.
        take: Called with each full piece of the table, which is then released; None keeps all. Later pieces may have
            more and wider columns.
        most: Largest number of values of the whole table, missing ones included.
    """

    def __init__(
        self, only: Collection[str] | None = None, take: Callable[[Table], None] | None = None, *, most: int
    ) -> None:
        self._only = only
        self._take = take
        self._most = most
        self._count = 0
        self._width = len(SampleTimes._fields)
        self._sources: dict[str, _Source] = {}
        self._taken_last: frozenset[str] = frozenset()
        self._begin()

    def _begin(self) -> None:
        self._samples = array("q")
        self._times: tuple[array[float], ...] = tuple(array(kind) for kind in ("q", "d", "q", "q", "q"))

    def source(self, key: str, layout: SceneLayout) -> _Source:
        """Return the samples of an articulation or entity so far."""
        return self._sources.setdefault(key, _Source(layout))

    def add(self, source: _Source, sample: int, times: SampleTimes, **fields: Sequence[Number]) -> None:
        """Add a part of a sample.

        Raises:
            ValueError: It is not the next one, or the table becomes too large.
        """
        last = self._samples[-1] if self._samples else -1
        if sample < last or sample in source.samples[-1:]:
            raise ValueError(f"sample {sample} comes after sample {last}")
        kept = {name: row for name, row in fields.items() if row and (self._only is None or name in self._only)}
        widths = {name: source.fields[name].width if name in source.fields else 0 for name in kept}
        self._width += sum(max(0, len(row) - widths[name]) for name, row in kept.items())
        self._count += sample != last
        if self._width > _MOST_COLUMNS or self._count * self._width > self._most:
            raise ValueError(f"{self._count} samples of {self._width} values are too many for the size of the file")
        if sample != last:
            if self._take is not None and len(self._samples) * self._width >= PIECE_VALUES:
                self._give(self._take)
            self._samples.append(sample)
            for column, value in zip(self._times, times, strict=True):
                column.append(value)
        row = len(source.samples)
        source.samples.append(sample)
        for name, values in kept.items():
            source.fields.setdefault(name, _Values()).put(row, values)

    def build(self, *, broken_off: bool) -> Table:
        """Return the table, or its rest after `take`, without the last sample if that is incomplete."""
        count = len(self._samples)
        if broken_off and self._last_is_partial():
            count -= 1
        samples = np.frombuffer(self._samples, np.int64)[:count] if count else np.zeros(0, np.int64)
        log_ns, sim_time, wall_ns, step, episode = (np.array(column[:count]) for column in self._times)
        columns: dict[str, Column] = {}
        for key, source in self._sources.items():
            own = np.array(source.samples, dtype=np.int64)
            kept = int((own <= samples[-1]).sum()) if count else 0
            places = np.searchsorted(samples, own[:kept])
            for name, values in source.fields.items():
                columns[f"{key}/{name}"] = _column(source, name, values.rows(kept), places, count)
        return Table(
            time=log_ns.astype(np.int64) / 1e9,
            sim_time=sim_time.astype(np.float64),
            wall_ns=wall_ns.astype(np.int64),
            step=step.astype(np.int64),
            episode=episode.astype(np.int64),
            columns=columns,
        )

    def _give(self, take: Callable[[Table], None]) -> None:
        take(self.build(broken_off=False))
        last = self._samples[-1]
        self._taken_last = frozenset(key for key, source in self._sources.items() if last in source.samples[-1:])
        for source in self._sources.values():
            source.samples = array("q")
            for values in source.fields.values():
                values.clear()
        self._begin()

    def _last_is_partial(self) -> bool:
        """Return whether an articulation or entity of the previous sample is missing in the last one."""
        if not self._samples:
            return False
        last = self._samples[-1]
        before = self._taken_last
        if len(self._samples) > 1:
            earlier = self._samples[-2]
            before = frozenset(key for key, source in self._sources.items() if earlier in source.samples[-2:])
        return any(self._sources[key].samples[-1:] != array("q", [last]) for key in before)


def _column(source: _Source, name: str, rows: Floats, places: NDArray[np.intp], count: int) -> Column:
    width = rows.shape[1]
    if len(rows) == count:
        values = rows
    else:
        values = np.full((count, width), np.nan)
        values[places] = rows
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
    if len(names) != width:
        names = [str(i) for i in range(width)]
    labels = [component_name(layout, value) for value in names] if name == "sensors" else names
    return Column(names, values, quantities(layout, name, names), labels)
