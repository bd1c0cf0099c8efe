"""Building a table from successive states, of which an overnight recording has millions: in memory, or in a file.

Its columns have the quantity and unit of each value, for axis labels.
"""

from __future__ import annotations

import io
import math
import tempfile
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from urlab_client.integrations._feed.scene import SceneLayout, component
from urlab_client.integrations.record.contents import Column, Table
from urlab_client.protocol.base import Floats

PIECE_VALUES = 1 << 20
"""Approximate number of values that are handled at once: 8 MiB."""

_MOST_COLUMNS = 1_000_000
_NS = 1e9

_SENSORS: dict[str, str] = {
    "touch": "contact force (N)",
    "accelerometer": "linear acceleration (m/s²)",
    "velocimeter": "linear velocity (m/s)",
    "gyro": "angular velocity (rad/s)",
    "force": "force (N)",
    "torque": "torque (N m)",
    "magnetometer": "magnetic flux",
    "rangefinder": "distance (m)",
    "camprojection": "image position (pixels)",
    "jointpos": "joint position (rad, m)",
    "jointvel": "joint velocity (rad/s, m/s)",
    "tendonpos": "tendon length (m)",
    "tendonvel": "tendon velocity (m/s)",
    "actuatorpos": "actuator length",
    "actuatorvel": "actuator velocity",
    "actuatorfrc": "actuator force (N, N m)",
    "jointactfrc": "joint force (N m, N)",
    "tendonactfrc": "tendon force (N)",
    "ballquat": "orientation (w, x, y, z)",
    "ballangvel": "angular velocity (rad/s)",
    "jointlimitpos": "distance to limit (rad, m)",
    "jointlimitvel": "velocity to limit (rad/s, m/s)",
    "jointlimitfrc": "limit force (N m, N)",
    "tendonlimitpos": "distance to limit (m)",
    "tendonlimitvel": "velocity to limit (m/s)",
    "tendonlimitfrc": "limit force (N)",
    "framepos": "position (m)",
    "framequat": "orientation (w, x, y, z)",
    "framexaxis": "x axis",
    "frameyaxis": "y axis",
    "framezaxis": "z axis",
    "framelinvel": "linear velocity (m/s)",
    "frameangvel": "angular velocity (rad/s)",
    "framelinacc": "linear acceleration (m/s²)",
    "frameangacc": "angular acceleration (rad/s²)",
    "subtreecom": "centre of mass (m)",
    "subtreelinvel": "linear velocity (m/s)",
    "subtreeangmom": "angular momentum (kg m²/s)",
    "geomdist": "distance (m)",
    "geomnormal": "normal",
    "geomfromto": "segment (m)",
    "e_potential": "potential energy (J)",
    "e_kinetic": "kinetic energy (J)",
    "clock": "time (s)",
}
_QUATERNIONS = frozenset({"ballquat", "framequat"})


class SampleTimes(NamedTuple):
    """Time of a sample: see `Table`, in nanoseconds and seconds."""

    log_ns: int
    sim_time: float
    wall_ns: int
    step: int
    episode: int


_TIMES = len(SampleTimes._fields)


@dataclass(slots=True)
class _Field:
    """Places of the values of one field of an articulation or entity in a row, in two parts if it has become wider."""

    source: Source
    name: str
    parts: list[range] = field(default_factory=list[range])

    @property
    def width(self) -> int:
        return sum(map(len, self.parts))


@dataclass(frozen=True, slots=True)
class Source:
    """One articulation or entity: its key, its layout, and names of the values of fields that the layout lacks."""

    key: str
    layout: SceneLayout
    names: dict[str, list[str]] = field(default_factory=dict[str, list[str]])


class TableBuilder:
    """Builds one table. Samples arrive in order, with one part for each articulation and entity.

    Each sample is written as one row. Columns keep their places while the table grows to the right; if it has grown,
    or a field has become wider, the rows are written once more at the end, with the columns of each field together.

    Args:
        folder: Folder of a temporary file for the values, which the table then maps; None keeps them in memory. If the
            system supports it, the file has no name, so a crash leaves nothing behind.
        most: Largest number of values of the whole table, missing ones included.
    """

    def __init__(self, folder: Path | None, *, most: int) -> None:
        self._folder = folder
        self._most = most
        self._file = self._opened()
        self._row = array("d")
        self._width = _TIMES
        self._rows: list[tuple[int, int]] = []  # widths, each with the number of successive rows
        self._fields: dict[str, _Field] = {}
        self._sources: dict[str, Source] = {}
        self.sample: int = -1
        self._count = 0
        self._present = set[str]()
        self._present_before = set[str]()

    def source(self, key: str, layout: SceneLayout) -> Source:
        """Return the articulation or entity of a key, which is new if it has had no samples so far."""
        return self._sources.setdefault(key, Source(key, layout))

    def add(self, source: Source, sample: int, times: SampleTimes, **fields: Sequence[float]) -> None:
        """Add a part of a sample."""
        if sample < self.sample or (sample == self.sample and source.key in self._present):
            raise ValueError(f"sample {sample} comes after sample {self.sample}")
        known = self._known(source, fields, new=sample > self.sample)
        if sample > self.sample:
            self._write_row()
            self.sample, self._present_before, self._present = sample, self._present, set[str]()
            self._row = array("d", (times.log_ns / _NS, times.sim_time))
            self._row.frombytes(array("q", times[2:]).tobytes())  # the bits of integers
            self._row.extend([math.nan] * (self._width - _TIMES))
            self._count += 1
        self._present.add(source.key)
        for into, values in known:
            self._put(into, values)

    def add_to_last(self, source: Source, /, **fields: Sequence[float]) -> None:
        """Add to the last sample what may be missing from it."""
        for into, values in self._known(source, fields, new=False):
            self._put(into, values)

    def _known(
        self, source: Source, fields: Mapping[str, Sequence[float]], *, new: bool
    ) -> list[tuple[_Field, Sequence[float]]]:
        """Return the fields that have values, which must fit; `new` means that they begin a sample."""
        known = [
            (self._fields.get(f"{source.key}/{name}") or _Field(source, name), values)
            for name, values in fields.items()
            if values
        ]
        width = self._width + sum(max(0, len(values) - into.width) for into, values in known)
        count = self._count + new
        if width > _MOST_COLUMNS or count * width > self._most:
            raise ValueError(f"{count} samples of {width} values are too many for the size of the file")
        return known

    def _put(self, into: _Field, values: Sequence[float]) -> None:
        more = len(values) - into.width
        if more > 0:
            self._fields[f"{into.source.key}/{into.name}"] = into
            into.parts.append(range(self._width, self._width + more))
            self._width += more
            self._row.extend([math.nan] * more)
        taken = 0
        for part in into.parts:
            some = values[taken : taken + len(part)]
            self._row[part.start : part.start + len(some)] = array("d", some)
            taken += len(part)

    def finish(self, *, broken_off: bool) -> Table:
        """Return the table. If the recording broke off, and an articulation or entity of the sample before the last one
        is missing in that, the last sample is left out."""
        self._write_row()
        order = [place for one in self._fields.values() for part in one.parts for place in part]
        if len(self._rows) > 1 or order != sorted(order):
            self._write_again([*range(_TIMES), *order])
        partial = broken_off and not self._present_before <= self._present
        rows = self._values()[: self._count - partial]
        whole = rows.view(np.int64)
        columns: dict[str, Column] = {}
        at = _TIMES
        for key, one in self._fields.items():
            columns[key] = _column(one.source, one.name, rows[:, at : at + one.width])
            at += one.width
        return Table(rows[:, 0], rows[:, 1], whole[:, 2], whole[:, 3], whole[:, 4], columns)

    def close(self) -> None:
        """Close the temporary file; the table stays valid."""
        if self._folder is not None:
            self._file.close()

    def _opened(self) -> IO[bytes]:
        return io.BytesIO() if self._folder is None else tempfile.TemporaryFile(dir=self._folder, prefix=".urlab-")

    def _write_row(self) -> None:
        if self._row:
            width, count = (
                self._rows.pop() if self._rows and self._rows[-1][0] == len(self._row) else (len(self._row), 0)
            )
            self._rows.append((width, count + 1))
            self._file.write(self._row)

    def _write_again(self, order: list[int]) -> None:
        """Write the rows with the same columns for all, in an order."""
        before, self._file = self._file, self._opened()
        before.seek(0)
        for width, count in self._rows:
            for part in np.array_split(np.empty((count, 0)), 1 + count * width // PIECE_VALUES):
                rows = np.full((len(part), self._width), np.nan)
                rows[:, :width] = np.frombuffer(before.read(8 * len(part) * width)).reshape(len(part), width)
                self._file.write(np.ascontiguousarray(rows[:, order]).data)
        before.close()

    def _values(self) -> Floats:
        """Return all rows, shape (n, width), without a copy in memory."""
        if not self._count:
            return np.zeros((0, self._width))
        if isinstance(self._file, io.BytesIO):
            flat = np.frombuffer(self._file.getbuffer(), np.float64)
        else:
            # It looks for the end of the file, which also writes what is buffered.
            flat = np.asarray(np.memmap(self._file, np.float64, "r"))
        return flat.reshape(self._count, self._width)


def _column(source: Source, name: str, values: Floats) -> Column:
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


def quantities(layout: SceneLayout, field: str, names: list[str]) -> list[str]:
    """Return quantity and unit of each value of a field, as axis labels."""
    every = frozenset(names)
    match field:
        case "qpos":
            return [_position(layout, name, component(name, every)) for name in names]
        case "qvel":
            return [_velocity(layout, name, component(name, every)) for name in names]
        case "sensors":
            return [_SENSORS.get(_kind(layout, name), _kind(layout, name) or "reading") for name in names]
        case "pose":
            return ["position (m)" if name in "xyz" else "orientation (w, x, y, z)" for name in names]
        case "ctrl" | "set_points":
            return ["control" if field == "ctrl" else "set-point"] * len(names)
        case _:
            return [field] * len(names)


def component_name(layout: SceneLayout, name: str) -> str:
    """Return the name of a sensor's value with its axis, `imu.x` for `imu.0`, if sensors of its kind have axes."""
    sensor, dot, index = name.rpartition(".")
    kind = layout.sensors.get(sensor, "")
    if not dot or not index.isdecimal() or not kind:
        return name
    axes = "wxyz" if kind in _QUATERNIONS else "xyz"
    return f"{sensor}.{axes[int(index)]}" if int(index) < len(axes) and kind in _SENSORS else name


def _kind(layout: SceneLayout, name: str) -> str:
    return layout.sensors.get(name) or layout.sensors.get(name.rpartition(".")[0], "")


def _position(layout: SceneLayout, name: str, part: str) -> str:
    if part:
        return "orientation (w, x, y, z)" if part.startswith("q") else "position (m)"
    if layout.slides is None:
        return "position (rad, m)"
    return "position (m)" if name in layout.slides else "angle (rad)"


def _velocity(layout: SceneLayout, name: str, part: str) -> str:
    if part:
        return "angular velocity (rad/s)" if part.startswith("w") else "velocity (m/s)"
    if layout.slides is None:
        return "velocity (rad/s, m/s)"
    return "velocity (m/s)" if name in layout.slides else "angular velocity (rad/s)"
