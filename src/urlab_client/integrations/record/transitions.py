"""A table of states as pairs of an observation and the action taken at it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations.record.reader import Table

__all__ = ["transitions"]

_SET_POINTS = "/set_points"


def transitions(table: Table) -> Table:
    """Return the states that an action followed, with the action: one row per pair, in an episode's order.

    A state is recorded with the set-points that led to it, so the action taken at one state stands beside the next. Of
    several states at one time, as resets leave them, the last counts. The last state of an episode has no action, and
    goes. A run without set-points is returned as it is.

    Returns:
        A table with columns `ARTICULATION/action`, named as `ARTICULATION/set_points`, after all others.
    """
    keys = [key.removesuffix(_SET_POINTS) for key in table.columns if key.endswith(_SET_POINTS)]
    if not keys:
        return table
    acted = np.flatnonzero((np.diff(table.episode) == 0) & (np.diff(table.sim_time) > 0))
    columns = {key: replace(column, values=column.values[acted]) for key, column in table.columns.items()}
    for key in keys:
        led = table.columns[key + _SET_POINTS]
        columns[f"{key}/action"] = replace(led, values=led.values[acted + 1])
    return _rows(replace(table, columns=columns), acted)


def _rows(table: Table, rows: NDArray[np.intp]) -> Table:
    return replace(
        table,
        time=table.time[rows],
        sim_time=table.sim_time[rows],
        wall_ns=table.wall_ns[rows],
        step=table.step[rows],
        episode=table.episode[rows],
    )
