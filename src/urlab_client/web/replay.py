"""A recording played back for all viewers: states of its file in place of the server's, at the pace of its clock.

The server is not asked for anything, so that a replay works with any server and any recording, stands at any place at
once, and says where it is in seconds. If wanted, it also places the robots of the simulation, in mode puppet.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import anyio
import anyio.to_thread
import numpy as np
from msgspec import Struct

from urlab_client.aio.model.layout import articulation_layouts
from urlab_client.protocol.base import Floats
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.messages.session import ArticulationState, Clock, EntityState
from urlab_client.protocol.messages.streams import StateSnapshot
from urlab_client.web.recordings import open_run

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient
    from urlab_client.integrations.record.reader import Column, Table

__all__ = ["Replay", "ReplayView"]

_PERIOD_S = 1 / 60
_PLACED_S = 1 / 25
_FIELDS = ("qpos", "qvel", "ctrl", "set_points")


class ReplayView(Struct):
    """Where a replay is: seconds of the recording's clock. `placing`: whether the simulation's robots follow."""

    name: str
    time: float
    seconds: float
    playing: bool
    rate: float
    placing: bool


class Publisher(Protocol):
    """What a replay needs of the session that all viewers share."""

    client: URLabClient

    def show(self, snapshot: StateSnapshot, targets: Mapping[str, list[float]]) -> None:
        """Show a state to everybody in place of the server's."""
        ...

    def note(self, kind: str, who: str, what: str, text: str, ms: float | None = None) -> None:
        """Add a line to the log."""
        ...

    def tell(self) -> None:
        """Let everybody look again."""
        ...


class _Before(Struct):
    """What a simulation is put back to."""

    mode: StepMode
    qpos: Any
    qvel: Any


class Replay:
    """The replay of one console, at most one at a time.

    Args:
        console: What shows it.
    """

    def __init__(self, console: Publisher) -> None:
        self._console = console
        self._client = console.client
        self._name = ""
        self._table: Table | None = None
        self._rows: dict[str, dict[str, Floats]] = {}
        self._times: Floats = np.zeros(1)
        self._at = 0.0
        self._playing = False
        self._rate = 1.0
        self._before: _Before | None = None
        self._placed_at = 0.0
        self._shown = -1.0
        self._wake = asyncio.Event()

    @property
    def view(self) -> ReplayView | None:
        """Where it is, or None when nothing is replayed."""
        if self._table is None:
            return None
        return ReplayView(
            self._name, round(self._at, 3), self._seconds, self._playing, self._rate, self._before is not None
        )

    @property
    def open(self) -> bool:
        """Whether what is seen comes from a recording."""
        return self._table is not None

    @property
    def rate(self) -> float:
        """Seconds of the recording per second; 0 while it stands."""
        return self._rate if self._playing else 0.0

    @property
    def _seconds(self) -> float:
        return float(self._times[-1])

    async def begin(self, file: Path, *, placing: bool = False) -> None:
        """Show a recording from its start.

        Args:
            file: The recording.
            placing: Place the robots of the simulation, too: its mode is puppet meanwhile.

        Raises:
            URLabError: The file is not a recording, or not of the robots that there are; or as the client raises.
        """
        table = await anyio.to_thread.run_sync(lambda: open_run(file).table())
        if not len(table):
            raise URLabError(f"{file.name} holds no states.")
        rows = {key: found for key, art in self._client.articulations.items() if (found := _rows(table, key, art))}
        if not rows:
            there = ", ".join(self._client.articulations) or "none"
            raise URLabError(f"{file.name} is a recording of other robots than there are ({there}).")
        await self.end()
        self._name, self._table, self._rows = file.name, table, rows
        self._times = table.time - table.time[0]
        self._at, self._rate, self._shown = 0.0, 1.0, -1.0
        if placing:
            await self._take_over()
        self._playing = True
        self._wake.set()
        self._console.tell()

    async def change(
        self, *, at: float | None = None, playing: bool | None = None, rate: float | None = None
    ) -> ReplayView:
        """Go to a place, let it play or stand, set its pace; what is None stays.

        Raises:
            ValueError: Nothing is replayed, or a number makes no sense.
        """
        if self._table is None:
            raise ValueError("no recording is replayed")
        if rate is not None:
            if not 0.05 <= rate <= 20:
                raise ValueError(f"a pace is from 0.05 to 20, not {rate}")
            self._rate = rate
        if at is not None:
            self._at = min(max(at, 0.0), self._seconds)
        if playing is not None:
            if playing and at is None and self._at >= self._seconds:
                self._at = 0.0
            self._playing = playing
        self._show()
        await self._place()
        self._wake.set()
        self._console.tell()
        return cast("ReplayView", self.view)

    async def end(self) -> None:
        """Go back to what the server sends, and put the simulation back to where it was."""
        if self._table is None:
            return
        self._table, self._playing = None, False
        self._console.tell()
        before, self._before = self._before, None
        data = self._client.data
        if before is not None and data is not None and data.qpos.shape == before.qpos.shape:
            data.qpos[:], data.qvel[:] = before.qpos, before.qvel
            await self._client.step(0)
            await self._client.runtime.set_mode(before.mode)

    async def keep_playing(self) -> None:
        """Play whenever that is wanted."""
        while True:
            if not self._playing:
                self._wake.clear()
                await self._wake.wait()
                continue
            began = time.monotonic()
            await anyio.sleep(_PERIOD_S)
            if not self._playing:
                continue
            self._at = min(self._at + self._rate * (time.monotonic() - began), self._seconds)
            self._playing = self._at < self._seconds
            self._show()
            try:
                await self._place()
            except URLabError as error:
                self._before = None
                self._console.note("error", "console", "replay", str(error))

    def _show(self) -> None:
        if self._table is not None:
            row = self._row
            targets = {
                key: fields["set_points"][row].tolist() for key, fields in self._rows.items() if "set_points" in fields
            }
            self._console.show(_snapshot(self._table, self._rows, row, float(self._times[row])), targets)

    @property
    def _row(self) -> int:
        return max(0, int(np.searchsorted(self._times, self._at, side="right")) - 1)

    # The simulation

    async def _take_over(self) -> None:
        data = self._client.data
        if data is None:
            raise URLabError("There is no local model, without which no robot can be placed.")
        mode = self._client.step_mode
        await self._client.runtime.set_mode(StepMode.PUPPET)
        self._before = _Before(mode, data.qpos.copy(), data.qvel.copy())

    async def _place(self) -> None:
        """Put the simulation's robots where the recording has them."""
        model, data = self._client.model, self._client.data
        if self._before is None or model is None or data is None or time.monotonic() - self._placed_at < _PLACED_S:
            return
        self._placed_at = time.monotonic()
        prefixes = {key: art.compiled_prefix for key, art in self._client.articulations.items()}
        for key, layout in articulation_layouts(model, prefixes).items():
            fields = self._rows.get(key)
            if fields is not None and len(fields["qpos"][self._row]) == len(layout.qpos_adr):
                data.qpos[layout.qpos_adr] = fields["qpos"][self._row]
        data.qvel[:] = 0.0
        await self._client.step(0)


def _rows(table: Table, key: str, art: URLabArticulation) -> dict[str, Floats]:
    """Return the values of an articulation by field, one row per state; empty if the recording has none of them."""
    found = {field: table.columns[f"{key}/{field}"].values for field in _FIELDS if f"{key}/{field}" in table.columns}
    if "qpos" in found:
        return found if found["qpos"].shape[1] == len(art.qpos_array) else {}
    column = table.columns.get("joints/qpos")  # as a server saves it, by compiled joints
    picked = None if column is None else _joints(column, art)
    return {} if picked is None else {"qpos": picked}


def _joints(column: Column, art: URLabArticulation) -> Floats | None:
    places: list[int] = []
    for joint in sorted(art.joints.values(), key=lambda one: one.qpos_local_offset):
        name = f"{art.compiled_prefix}_{joint.name}"
        own = [i for i, given in enumerate(column.names) if given == name or given.rpartition(".")[0] == name]
        if not own:
            return None
        places += own
    return column.values[:, places] if len(places) == len(art.qpos_array) else None


def _snapshot(table: Table, rows: Mapping[str, Mapping[str, Floats]], row: int, at: float) -> StateSnapshot:
    clock = Clock(sec=int(at), nsec=int(at % 1.0 * 1e9))
    nothing = np.zeros(0)
    entities: dict[str, EntityState] = {}
    for key, column in table.columns.items():
        name, _, field = key.rpartition("/")
        if field == "pose" and np.isfinite(column.values[row]).all():
            pose = column.values[row]
            entities[name] = EntityState(xpos=tuple(pose[:3].tolist()), xquat=tuple(pose[3:].tolist()), qpos=pose)
    return StateSnapshot(
        time=at,
        step=int(table.step[row]),
        sim_time=clock,
        wall_time=Clock(sec=0, nsec=0),
        recv_wall_time_ns=time.time_ns(),
        per_articulation={
            key: ArticulationState(
                qpos=fields["qpos"][row],
                qvel=fields["qvel"][row] if "qvel" in fields else nothing,
                ctrl=fields["ctrl"][row] if "ctrl" in fields else None,
                sensors=_sensors(table.columns.get(f"{key}/sensors"), row),
            )
            for key, fields in rows.items()
        },
        entities=entities,
    )


def _sensors(column: Column | None, row: int) -> dict[str, list[float]] | None:
    if column is None:
        return None
    found: dict[str, list[float]] = {}
    for name, value in zip(column.names, column.values[row].tolist(), strict=True):
        sensor, _, index = name.rpartition(".")
        found.setdefault(sensor if index.isdecimal() and sensor else name, []).append(value)
    return found
