"""A table of states as pairs of an observation and the action taken at it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from urlab_client.integrations._feed.messages import OutcomeMessage
from urlab_client.integrations.record.contents import CHOSEN, Column, Table
from urlab_client.integrations.record.reader import Run
from urlab_client.integrations.record.writer import GOAL, TASK

Episodes = Literal["kept", "success", "all"]
"""Selection of episodes: those not discarded, only successes, or all."""

_SET_POINTS = "/set_points"
_ACTIONS, _SUCCESS = f"{TASK}/actions", f"{TASK}/success"
_OF_ACTION = tuple(f"{TASK}/{name}" for name in ("action", "reward", "terminated", "truncated", "success"))


class Pairs(NamedTuple):
    """Rows of a table at which an action was taken, and the rows with the states that these actions led to."""

    rows: NDArray[np.intp]
    led: NDArray[np.intp]

    def part(self, which: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Pairs:
        """Return some of them."""
        return Pairs(self.rows[which], self.led[which])


def transitions_of(run: Run, *, only: Episodes = "kept", progress: Callable[[int], None] | None = None) -> Table:
    """Return the pairs of a recording, as in `transitions`, for a selection of episodes.

    If episodes are marked, `kept` omits discarded ones and those without a mark, which were aborted; `success` also
    omits failures. Without marks, an episode of an environment is a success if its last state is. The goal of an
    episode is in columns `goal/NAME`, constant over its rows.

    Args:
        run: The recording.
        only: The selection.
        progress: Called occasionally with the number of bytes read so far.

    Raises:
        ValueError: `only` is not a valid selection.
        RecordingError: The file is not a recording.
    """
    table, outcomes = run.table(progress), run.outcomes()
    return with_goals(pairs_at(table, selected_pairs(table, outcomes, only)), outcomes)


def selected_pairs(
    table: Table,
    outcomes: Sequence[OutcomeMessage] = (),
    only: Episodes = "all",
    left_out: Counter[str] | None = None,
) -> Pairs:
    """Return the pairs in a selection of episodes; count in `left_out` the others, by reason.

    Raises:
        ValueError: `only` is not a valid selection.
    """
    check_episodes(only)
    pairs = _pairs(table)
    known: dict[int, str] = {mark.episode: mark.outcome for mark in outcomes}
    if not known and only == "success":
        known = _judged(table)
    if only == "all" or not known:
        return pairs
    wanted = {"success"} if only == "success" else {"success", "failure"}
    episodes, which, counts = np.unique(table.episode[pairs.rows], return_inverse=True, return_counts=True)
    found = [known.get(episode, "no outcome") for episode in episodes.tolist()]
    for outcome, count in zip(found, counts.tolist(), strict=True):
        if left_out is not None and outcome not in wanted:
            left_out[f"of episodes with {outcome}"] += count
    return pairs.part(np.array([outcome in wanted for outcome in found], dtype=np.bool_)[which])


def _pairs(table: Table) -> Pairs:
    rows = np.arange(len(table))
    if not _acting(table):
        return Pairs(rows, rows)
    acting = np.append((np.diff(table.episode) == 0) & (np.diff(table.sim_time) > 0), False)[: len(rows)]
    led = rows + 1
    if (column := table.columns.get(_ACTIONS)) is not None:
        # Between the states of an environment there may be others, such as those while an action is late.
        counts = column.values[:, 0]
        told = np.flatnonzero(np.isfinite(counts))
        first, then = told[:-1], told[1:]
        one = (counts[then] == counts[first] + 1) & (table.episode[first] == table.episode[then])
        first, then = first[one], then[one]
        change = np.zeros(len(rows) + 1, dtype=np.int8)
        change[first] += 1
        change[then] -= 1
        acting &= np.cumsum(change[:-1], dtype=np.int8) == 0
        acting[first], led[first] = True, then
    rows = np.flatnonzero(acting)
    return Pairs(rows, led[rows])


def _judged(table: Table) -> dict[int, str]:
    """Return the outcomes of the episodes of an environment whose task says what success is."""
    if (column := table.columns.get(_SUCCESS)) is None:
        return {}
    success = column.values[:, 0]
    told = np.flatnonzero(np.isfinite(success))
    episodes, last = np.unique(table.episode[told][::-1], return_index=True)
    outcomes = np.where(success[told[::-1][last]] > 0, "success", "failure")
    return dict(zip(episodes.tolist(), outcomes.tolist(), strict=True))


def pairs_at(table: Table, pairs: Pairs) -> Table:
    """Return these pairs of a table, with the actions and what came of them."""
    rows, led = pairs
    columns = {
        key: replace(column, values=column.values[led if key in _OF_ACTION else rows])
        for key, column in table.columns.items()
        if key != _ACTIONS and not key.startswith(f"{TASK}/{CHOSEN}/")
    }
    for key in _acting(table):
        applied = replace(table.columns[key + _SET_POINTS], values=table.columns[key + _SET_POINTS].values[led])
        chosen = table.columns.get(f"{TASK}/{CHOSEN}/{key}")
        columns[f"{key}/action"] = applied
        if chosen is not None:
            meant = chosen.values[led]
            columns[f"{key}/action"] = replace(applied, values=np.where(np.isfinite(meant), meant, applied.values))
            columns[f"{key}/applied"] = applied
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
    """Return a table with the goals of its episodes as marked, or else as an environment told them; NaN if unknown."""
    goals = {mark.episode: mark.goal for mark in outcomes}
    widths: dict[str, int] = {}
    for goal in goals.values():
        widths |= {name: max(len(values), widths.get(name, 0)) for name, values in goal.items()}
    columns = dict(table.columns)
    for name, width in widths.items():
        told = columns.get(f"{GOAL}/{name}")
        values = np.full((len(table), width), np.nan)
        if told is not None and told.values.shape == values.shape:
            values[:] = told.values
        for episode, goal in goals.items():
            if name in goal or told is None:
                values[table.episode == episode, : len(goal.get(name, ()))] = goal.get(name, np.nan)
        names = [str(i) for i in range(width)]
        columns[f"{GOAL}/{name}"] = Column(names, values, [""] * width, names)
    return replace(table, columns=columns)


def transitions(table: Table) -> Table:
    """Return the states that are followed by an action, with the action, one row per pair, in order.

    A state is recorded with the set-points that led to it, so the action taken at a state is in the row of the next
    one. Of several states at the same time, which resets produce, the last one is used. The last state of an episode
    has no action and is omitted. A run without set-points is returned unchanged.

    An environment tells which states are its own, so states in the middle of an action are omitted. What it told about
    the action is in `task/action`, `reward`, `terminated`, `truncated` and `success`.

    Returns:
        A table with columns `ARTICULATION/action`, named as `ARTICULATION/set_points`, after all others: the action as
        chosen. If actions were delayed, `ARTICULATION/applied` has the set-points that were in force.
    """
    return pairs_at(table, _pairs(table)) if _acting(table) else table


def _acting(table: Table) -> list[str]:
    return [key.removesuffix(_SET_POINTS) for key in table.columns if key.endswith(_SET_POINTS)]
