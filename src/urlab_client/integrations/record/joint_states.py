"""Recordings of the server: the plugin's JSON files of joint states, with the interface of our own recordings."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Generator
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np

from urlab_client.integrations._feed.messages import OutcomeMessage
from urlab_client.integrations._feed.scene import SceneLayout
from urlab_client.integrations.record.contents import (
    Column,
    RecordedArticulation,
    RecordedState,
    Summary,
    Table,
    describe_topic,
)
from urlab_client.integrations.record.index import IndexedChannel, Progress
from urlab_client.integrations.record.reader import Run
from urlab_client.integrations.record.tables import quantities
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.simulation.joint_recording import Frame, decode_json

OWNER = "joints"
"""Key of the only articulation, because the file names compiled joints and no robots."""

_NS = 1e9
_HEAD = 64
_LARGEST_FILE = 256 << 20
_LATEST_S = 2**63 / _NS
_WIDEST = 100_000
_MOST_VALUES = 8 << 20
_COORDINATES = {1: ("",), 4: (".qw", ".qx", ".qy", ".qz"), 7: (".x", ".y", ".z", ".qw", ".qx", ".qy", ".qz")}
_VELOCITIES = {1: ("",), 3: (".wx", ".wy", ".wz"), 6: (".vx", ".vy", ".vz", ".wx", ".wy", ".wz")}


def is_joint_states(path: Path) -> bool:
    """Return whether a file begins like the plugin's recordings: an object with the list `Frames`."""
    with path.open("rb") as file:
        text = file.read(_HEAD).replace(b"\0", b"").lstrip(b"\xff\xfe\xef\xbb\xbf \t\r\n")
    return text[:1] == b"{" and text[1:].lstrip()[:8].lower() == b'"frames"'


class JointStatesRun(Run):
    """A recording of joint states only, without set-points, sensors and pictures. A JSON file is read whole."""

    def summary(self, progress: Progress | None = None, *, verify: bool = False) -> Summary:
        """Return a summary of the contents. Reading the file verifies it."""
        table = self.table()
        stamps = (table.time * _NS).astype(np.int64)
        topic = f"/{OWNER}"
        made = datetime.fromtimestamp(self.path.stat().st_mtime, UTC).isoformat(timespec="seconds")
        duration = float(table.time[-1] - table.time[0]) if len(table) else 0.0
        return Summary(
            path=self.path,
            complete=True,
            damage="",
            about={"started": made, "address": "recorded by the server"},
            duration_s=duration,
            wall_s=duration,
            episodes=int(table.episode[-1]) + 1 if len(table) else 0,
            dropped_states=0,
            dropped_frames=0,
            topics={topic: describe_topic(topic, "joint states", stamps)} if len(stamps) else {},
        )

    def table(self, progress: Progress | None = None, *, fields: Collection[str] | None = None) -> Table:
        """Return all states as `joints/qpos` and `joints/qvel`; values have the names of compiled joints."""
        frames = self._frames()
        layout = frames[0].layout if frames else None
        names = dict(layout.joints) if layout else {}
        columns: dict[str, Column] = {}
        for field, kinds, place in (("qpos", _COORDINATES, 0), ("qvel", _VELOCITIES, 1)):
            labels = [f"{name}{part}" for name, slices in names.items() for part in _parts(kinds, slices[place])]
            if labels and (fields is None or field in fields):
                values = np.full((len(frames), len(labels)), np.nan)
                for row, frame in enumerate(frames):
                    given = frame.qpos if field == "qpos" else frame.qvel
                    if frame.layout is layout:
                        values[row] = given
                columns[f"{OWNER}/{field}"] = Column(labels, values, quantities(SceneLayout(), field, labels), labels)
        sim_time = np.array([frame.time for frame in frames], dtype=np.float64)
        steps = np.diff(sim_time, prepend=sim_time[:1])
        return Table(
            time=np.cumsum(np.maximum(steps, 0.0)),
            sim_time=sim_time,
            wall_ns=(sim_time * _NS).astype(np.int64),
            step=np.arange(len(frames), dtype=np.int64),
            episode=np.cumsum(steps < 0).astype(np.int64),
            columns=columns,
        )

    def _frames(self) -> list[Frame]:
        """Return the frames, after checks of what a file from anywhere may make a reader compute and allocate."""
        size = self.path.stat().st_size
        if size > _LARGEST_FILE:
            raise RecordingError(f"{self.path}: {size} bytes are too many for a recording of joint states.")
        try:
            frames = decode_json(self.path.read_bytes())
        except ValueError as error:
            raise RecordingError(f"{self.path}: {str(error).rstrip('.')}.") from error
        times = np.array([frame.time for frame in frames], dtype=np.float64).clip(-_LATEST_S, _LATEST_S)
        forward = np.maximum(np.diff(times, prepend=times[:1]), 0.0)
        if len(frames) and max(abs(times).max(), forward.sum()) >= _LATEST_S:
            raise RecordingError(f"{self.path}: its times reach {_LATEST_S:.0f} s and more.")
        width = max(len(frames[0].qpos), len(frames[0].qvel)) if frames else 0
        if width > _WIDEST or len(frames) * width > max(_MOST_VALUES, size):
            raise RecordingError(f"{self.path}: {len(frames)} frames of {width} values do not fit its size.")
        return frames

    @contextlib.contextmanager
    def stored_table(
        self, folder: Path, progress: Progress | None = None, *, fields: Collection[str] | None = None
    ) -> Generator[Table]:
        """Yield all states, in memory."""
        yield self.table(progress, fields=fields)

    def outcomes(self) -> tuple[OutcomeMessage, ...]:
        """Return no outcomes, because a server marks no episodes."""
        return ()

    @cached_property
    def whole(self) -> Table:
        """All states, read once: a JSON file has no index."""
        return self.table()

    def time_range(self) -> tuple[float, float]:
        """Return the times of the first and of the last state, seconds; 0, 0 without states."""
        times = self.whole.time
        return (float(times[0]), float(times[-1])) if len(times) else (0.0, 0.0)

    def state_at(self, time: float) -> RecordedState | None:
        """Return the newest state at or before a time, or None; all joints are one articulation."""
        if math.isnan(time):
            raise ValueError("the time is NaN")
        table = self.whole
        row = int(np.searchsorted(table.time, time, side="right")) - 1
        if row < 0:
            return None
        nothing = np.zeros(0)
        qpos, qvel = (
            table.columns[key].values[row] if key in table.columns else nothing
            for key in (f"{OWNER}/qpos", f"{OWNER}/qvel")
        )
        return RecordedState(
            time=float(table.time[row]),
            sim_time=float(table.sim_time[row]),
            wall_ns=int(table.wall_ns[row]),
            step=int(table.step[row]),
            episode=int(table.episode[row]),
            articulations={OWNER: RecordedArticulation(qpos, qvel, nothing, nothing, nothing, {})},
            entities={},
        )

    def positions(self) -> dict[str, list[str]]:
        """Return the names of the values of `qpos`, which are those of compiled joints."""
        column = self.whole.columns.get(f"{OWNER}/qpos")
        return {} if column is None else {OWNER: column.names}

    def cameras(self) -> list[str]:
        """Return no cameras, because the file contains no pictures."""
        return []

    def _camera(self, name: str) -> list[IndexedChannel]:
        raise KeyError(f"no pictures of {name!r} in {self.path}: a recording of the server contains only joint states")


def _parts(kinds: dict[int, tuple[str, ...]], where: slice) -> tuple[str, ...]:
    width = where.stop - where.start
    return kinds.get(width, tuple(f".{i}" for i in range(width)))
