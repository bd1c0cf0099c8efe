"""A table of states as pairs of an observation and the action taken at it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.messages import OutcomeMessage
from urlab_client.integrations.record.contents import Column, Table
from urlab_client.integrations.record.reader import Run

Episodes = Literal["kept", "success", "all"]
"""Selection of episodes: those not discarded, only successes, or all."""

GOAL = "goal"
"""Name of the columns with an episode's goal: `goal/NAME`."""

_SET_POINTS = "/set_points"


def transitions_of(run: Run, *, only: Episodes = "kept", progress: Callable[[int], None] | None = None) -> Table:
    """Return the pairs of a recording, as in `transitions`, for a selection of episodes.

    If episodes are marked, `kept` omits discarded ones and those without a mark, which were aborted; `success` also
    omits failures. The goal of an episode is in columns `goal/NAME`, constant over its rows.

    Args:
        run: The recording.
        only: The selection.
        progress: Called occasionally with the number of bytes read so far.

    Raises:
        ValueError: `only` is not a valid selection.
        RecordingError: The file is not a recording.
    """
    table, outcomes = run.table(progress), run.outcomes()
    return with_goals(pairs_at(table, pair_rows(table, outcomes, only)), outcomes)


def pair_rows(table: Table, outcomes: Sequence[OutcomeMessage] = (), only: Episodes = "all") -> NDArray[np.intp]:
    """Return the rows of a table that are followed by an action, in a selection of episodes.

    Raises:
        ValueError: `only` is not a valid selection.
    """
    check_episodes(only)
    rows = np.arange(len(table))
    if _acting(table):
        rows = np.flatnonzero((np.diff(table.episode) == 0) & (np.diff(table.sim_time) > 0))
    if only != "all" and outcomes:
        wanted = {"success"} if only == "success" else {"success", "failure"}
        kept = [mark.episode for mark in outcomes if mark.outcome in wanted]
        rows = rows[np.isin(table.episode[rows], kept)]
    return rows


def pairs_at(table: Table, rows: NDArray[np.intp]) -> Table:
    """Return these rows of a table, of those in `pair_rows`, with the actions."""
    columns = {key: replace(column, values=column.values[rows]) for key, column in table.columns.items()}
    for key in _acting(table):
        led = table.columns[key + _SET_POINTS]
        columns[f"{key}/action"] = replace(led, values=led.values[rows + 1])
    return Table(
        table.time[rows], table.sim_time[rows], table.wall_ns[rows], table.step[rows], table.episode[rows], columns
    )


def check_episodes(only: Episodes) -> None:
    """Check a selection of episodes.

    Raises:
        ValueError: `only` is not a valid selection.
    """
    if only not in ("kept", "success", "all"):
        raise ValueError(f"only must be kept, success or all, not {only!r}")


def with_goals(table: Table, outcomes: Iterable[OutcomeMessage]) -> Table:
    """Return a table with the goals of its episodes; NaN if unknown."""
    goals = {mark.episode: mark.goal for mark in outcomes}
    widths: dict[str, int] = {}
    for goal in goals.values():
        widths |= {name: max(len(values), widths.get(name, 0)) for name, values in goal.items()}
    columns = dict(table.columns)
    for name, width in widths.items():
        values = np.full((len(table), width), np.nan)
        for episode, goal in goals.items():
            values[table.episode == episode, : len(goal.get(name, ()))] = goal.get(name, np.nan)
        names = [str(i) for i in range(width)]
        columns[f"{GOAL}/{name}"] = Column(names, values, [""] * width, names)
    return replace(table, columns=columns)


def transitions(table: Table) -> Table:
    """Return the states that are followed by an action, with the action, one row per pair, in order.

    A state is recorded with the set-points that led to it, so the action taken at a state is in the row of the next
    one. Of several states at the same time, which resets produce, the last one is used. The last state of an episode
    has no action and is omitted. A run without set-points is returned unchanged.

    Returns:
        A table with columns `ARTICULATION/action`, named as `ARTICULATION/set_points`, after all others.
    """
    return pairs_at(table, pair_rows(table)) if _acting(table) else table


def _acting(table: Table) -> list[str]:
    return [key.removesuffix(_SET_POINTS) for key in table.columns if key.endswith(_SET_POINTS)]
