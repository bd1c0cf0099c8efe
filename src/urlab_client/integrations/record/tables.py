"""Building a table from successive states, of which an overnight recording has millions: in memory, or in a file.

Its columns have the quantity and unit of each value, for axis labels.
"""

from __future__ import annotations

import io
import tempfile
from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Literal, NamedTuple, TypeAlias

import numpy as np

from urlab_client.integrations._feed.scene import SceneLayout
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

Number: TypeAlias = float | Literal["NaN", "Infinity", "-Infinity"]
"""A number as decoded; numbers that JSON cannot represent are text."""


class SampleTimes(NamedTuple):
    """Time of a sample: see `Table`, in nanoseconds and seconds."""

    log_ns: int
    sim_time: float
    wall_ns: int
    step: int
    episode: int


class _Rows:
    """Rows of numbers, in memory or in a temporary file.

    If the system supports it, the file has no name, so a crash leaves nothing behind.
    """

    def __init__(self, folder: Path | None, width: int) -> None:
        self._folder = folder
        self._file = self._opened()
        self._count, self._width = 0, width

    def append(self, rows: Floats) -> None:
        """Add rows, which are as wide as `spread` says."""
        self._file.write(rows.data)
        self._count += len(rows)

    def spread(self, places: list[int], width: int) -> None:
        """Move each column to its place among more columns; new ones are NaN."""
        before = self.values()
        self.close()
        self._file, self._width = self._opened(), width
        for rows in np.array_split(before, 1 + before.size // PIECE_VALUES):
            wider = np.full((len(rows), width), np.nan)
            wider[:, places] = rows
            self._file.write(wider.data)

    def values(self) -> Floats:
        """Return all rows, shape (n, width), without a copy in memory."""
        if not self._count:
            return np.zeros((0, self._width))
        if isinstance(self._file, io.BytesIO):
            flat = np.frombuffer(self._file.getbuffer(), np.float64)
        else:
            self._file.flush()
            flat = np.asarray(np.memmap(self._file, np.float64, "r"))
        return flat.reshape(self._count, self._width)

    def close(self) -> None:
        """Close the file; arrays that are in use stay valid."""
        if self._folder is not None:
            self._file.close()

    def _opened(self) -> IO[bytes]:
        if self._folder is None:
            return io.BytesIO()
        return tempfile.TemporaryFile(dir=self._folder, prefix=".urlab-")


@dataclass(slots=True)
class _Field:
    """Rows of one field of an articulation or entity that are not stored yet, and their places among those samples."""

    width: int = 0
    places: list[int] = field(default_factory=list[int])
    rows: list[array[float]] = field(default_factory=list["array[float]"])

    def move_into(self, values: Floats) -> None:
        """Write the rows into an array, except those beyond its end, and forget them."""
        for place, row in zip(self.places, self.rows, strict=True):
            if place < len(values):
                values[place, : len(row)] = row
        self.places, self.rows = [], []


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
        folder: Folder of a temporary file for the values, which the table then maps; None keeps them in memory.
        only: Fields to keep, such as `qpos`; None keeps all.
        most: Largest number of values of the whole table, missing ones included.
    """

    def __init__(self, folder: Path | None, only: Collection[str] | None = None, *, most: int) -> None:
        self._rows = _Rows(folder, len(SampleTimes._fields))
        self._only = only
        self._most = most
        self._count = 0
        self._width = len(SampleTimes._fields)
        self._sources: dict[str, _Source] = {}
        self._sample = -1
        self._present = set[str]()
        self._present_before = set[str]()
        self._times: list[SampleTimes] = []
        self._layout: dict[str, range] = {}

    def source(self, key: str, layout: SceneLayout) -> _Source:
        """Return the samples of an articulation or entity so far."""
        return self._sources.setdefault(key, _Source(key, layout))

    def add(self, source: _Source, sample: int, times: SampleTimes, **fields: Sequence[Number]) -> None:
        """Add a part of a sample."""
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
            if len(self._times) * self._width >= PIECE_VALUES:
                self._store(len(self._times))
            self._sample, self._present_before, self._present = sample, self._present, set[str]()
            self._times.append(times)
        self._present.add(source.key)
        for name, values in kept.items():
            into = source.fields.setdefault(name, _Field())
            into.width = max(into.width, len(values))
            into.places.append(len(self._times) - 1)
            into.rows.append(array("d", map(float, values)))

    def finish(self, *, broken_off: bool) -> Table:
        """Return the table. If the recording broke off, and an articulation or entity of the sample before the last one
        is missing in that, the last sample is left out."""
        partial = broken_off and not self._present_before <= self._present
        self._store(len(self._times) - partial)
        rows = self._rows.values()
        whole = rows.view(np.int64)  # their columns hold the bits of integers
        return Table(
            time=rows[:, 0],
            sim_time=rows[:, 1],
            wall_ns=whole[:, 2],
            step=whole[:, 3],
            episode=whole[:, 4],
            columns={
                key: _column(self._sources[key.rpartition("/")[0]], key.rpartition("/")[2], rows[:, at.start : at.stop])
                for key, at in self._layout.items()
            },
        )

    def close(self) -> None:
        """Close the temporary file; the table stays valid."""
        self._rows.close()

    def _store(self, count: int) -> None:
        """Store the first of the samples that have come since the last time, and forget them."""
        width, layout = len(SampleTimes._fields), dict[str, range]()
        sources = self._sources.values()
        fields = [(f"{source.key}/{name}", one) for source in sources for name, one in source.fields.items()]
        for key, one in fields:
            layout[key] = range(width, width + one.width)
            width += one.width
        if layout != self._layout:
            kept = [place for key, before in self._layout.items() for place in layout[key][: len(before)]]
            self._rows.spread([*range(len(SampleTimes._fields)), *kept], width)
            self._layout = layout
        rows = np.full((count, width), np.nan)
        for row, times in zip(rows, self._times, strict=False):
            row[:2] = times.log_ns / _NS, times.sim_time
            row.view(np.int64)[2:5] = times.wall_ns, times.step, times.episode
        for key, one in fields:
            one.move_into(rows[:, layout[key].start : layout[key].stop])
        self._rows.append(rows)
        self._times = []


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


def quantities(layout: SceneLayout, field: str, names: list[str]) -> list[str]:
    """Return quantity and unit of each value of a field, as axis labels."""
    match field:
        case "qpos":
            return [_position(layout, name) for name in names]
        case "qvel":
            return [_velocity(layout, name) for name in names]
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


def _position(layout: SceneLayout, name: str) -> str:
    component = name.rpartition(".")[2]
    if component in ("x", "y", "z"):
        return "position (m)"
    if component in ("qw", "qx", "qy", "qz"):
        return "orientation (w, x, y, z)"
    if layout.slides is None:
        return "position (rad, m)"
    return "position (m)" if name in layout.slides else "angle (rad)"


def _velocity(layout: SceneLayout, name: str) -> str:
    component = name.rpartition(".")[2]
    if component in ("vx", "vy", "vz"):
        return "velocity (m/s)"
    if component in ("wx", "wy", "wz"):
        return "angular velocity (rad/s)"
    if layout.slides is None:
        return "velocity (rad/s, m/s)"
    return "velocity (m/s)" if name in layout.slides else "angular velocity (rad/s)"
