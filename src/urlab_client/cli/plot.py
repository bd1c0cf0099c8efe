"""`urlab plot`: draw curves of a recording as a picture; `plot_curves` also draws those of `urlab demo`.

Draw joint positions, or other values, of a recording over simulation time. Needs the extras 'urlab-client[mcap]' and
'urlab-client[demo]'.
"""

from __future__ import annotations

import math
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client._platform.files import replaced
from urlab_client.cli._arguments import RECORDING
from urlab_client.cli._common import CommandError, check_ending, counted, progress_bar
from urlab_client.values.names import did_you_mean

if TYPE_CHECKING:
    from urlab_client.integrations.record import Table

_PER_PANEL = 6  # more lines in one panel cannot be told apart
_DPI = 150
_COVERS = 0.003  # of the axis: less than the width of a line
_NOISE = 1e-6  # range of an axis that shows rounding noise, in the unit of its values, or as a part of large ones
_CONSTANT = 0.1  # range of the axis instead, likewise
_PERIOD = 18.0  # of a dashed line, in line widths
_FIELDS = ("qpos", "qvel", "ctrl", "set_points", "act", "sensors", "pose")

USAGE = f"""
{RECORDING}
--joints NAME+  names, with or without ARTICULATION/ before them; * matches anything (default: all but free bases)
--field qpos|qvel|ctrl|set_points|act|sensors|pose=qpos  which values to draw
-o --output FILE  a .png, .pdf or .svg file (default: RECORDING with .png)
examples:
urlab plot run.mcap  all joint positions; the picture is run.png
urlab plot run.mcap --joints 'shoulder_*' elbow --field qvel -o fast.png  velocities of some joints
urlab plot run.mcap --field sensors --joints 'imu*'  readings of some sensors
"""


def run(arguments: Namespace) -> int:
    """Draw."""
    need("matplotlib", extra="demo")
    from urlab_client.integrations.record import read_run

    target = arguments.output or arguments.recording.with_suffix(".png")
    check_ending(target, ".png", ".pdf", ".svg")
    recording = read_run(arguments.recording)
    with progress_bar(arguments.recording.name, recording.path.stat().st_size) as progress:
        table = recording.table(progress, fields=[arguments.field])
    curves: list[Curves] = []
    for key, names in _chosen(table, arguments).items():
        owner, column = key.rpartition("/")[0], table.columns[key]
        places: dict[str, list[int]] = {}  # one axis per unit
        for place in map(column.names.index, names):
            places.setdefault(column.quantities[place], []).append(place)
        for quantity, chosen in places.items():
            labels = [column.labels[place] for place in chosen]
            curves.append(Curves(f"{owner}\n{quantity}", labels, column.values[:, chosen]))
    replaces = ", instead of the file that was there" if target.exists() else ""
    plot_curves(arguments.recording.name, table.time, curves, target)
    drawn = sum(len(one.names) for one in curves)
    print(f"{target}  {counted(drawn, 'curve')}, {counted(len(table), 'state')}{replaces}")
    return 0


def _chosen(table: Table, arguments: Namespace) -> dict[str, list[str]]:
    from urlab_client.integrations._feed.scene import component

    chosen: dict[str, list[str]] = {}
    there: list[str] = []
    for key, column in table.columns.items():
        owner, field = key.split("/")[0], key.rpartition("/")[2]
        if field != arguments.field:
            continue
        there += [f"{owner}/{name}" for name in column.names]
        plain = arguments.joints is None and field in {"qpos", "qvel"}
        every = frozenset(column.names)
        names = [name for name in column.names if not (plain and component(name, every))]
        labels = dict(zip(column.names, column.labels, strict=True))
        found = [
            name
            for name in names
            if any(
                fnmatchcase(spelled, want)
                for want in arguments.joints or ["*"]
                for spelled in (name, f"{owner}/{name}", labels[name], f"{owner}/{labels[name]}")
            )
        ]
        if found:
            chosen[key] = found
    if not len(table):
        raise CommandError(f"{arguments.recording} has no states")
    if not chosen:
        wanted = arguments.joints or ["*"]
        close = did_you_mean(wanted[0], [*there, *(name.rpartition("/")[2] for name in there)])
        raise CommandError(
            f"{arguments.recording}: no {arguments.field} named {' '.join(wanted)}.{close} "
            f"There are: {', '.join(there) or 'none'}"
        )
    return chosen


@dataclass(frozen=True)
class Curves:
    """Curves that share an axis, whose label has the unit; `values` has the shape (samples, curves)."""

    label: str
    names: Sequence[str]
    values: NDArray[np.float64]


def plot_curves(title: str, time: NDArray[np.float64], curves: Sequence[Curves], path: Path) -> None:
    """Draw curves over simulation time, seconds."""
    # The figure's own canvas, not pyplot: no display, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [panel for some in curves for panel in _panels(some)]
    figure: Any = Figure(figsize=(10, 0.9 + 2.3 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        twins = _twins(panel.values)
        for index, (name, (first, place, count)) in enumerate(zip(panel.names, twins, strict=True)):
            label = name if first == index else f"{name} (like {panel.names[first]})"
            axis.plot(time, panel.values[:, index], label=label, color=f"C{index}", **_style(place, count))
        axis.set_ylabel(panel.label)
        axis.grid(visible=True, alpha=0.3)
        axis.margins(x=0.01)
        low, high = axis.get_ylim()
        if high - low < _NOISE * (size := _size(panel.values)):
            axis.set_ylim((low + high - _CONSTANT * size) / 2, (low + high + _CONSTANT * size) / 2)
        legend = axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
        for handle in legend.legend_handles:
            handle.set_linestyle("-")  # it is shorter than the gap of a dashed one
    figure.align_ylabels(axes)
    axes[-1].set_xlabel("simulation time (s)")
    with replaced(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def _twins(values: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Return, per column, the first column that it covers, its place among those that do, and their number."""
    near = _COVERS * max(np.ptp(np.nan_to_num(values)), _NOISE * _size(values)) if values.size else 0.0
    firsts = [
        next(
            other
            for other in range(index + 1)
            if np.allclose(values[:, other], values[:, index], rtol=0, atol=near, equal_nan=True)
        )
        for index in range(values.shape[1])
    ]
    return [(first, firsts[:index].count(first), firsts.count(first)) for index, first in enumerate(firsts)]


def _size(values: NDArray[np.float64]) -> float:
    """Return the largest value without its sign, but at least one."""
    return max(1.0, float(np.abs(np.nan_to_num(values)).max(initial=0.0)))


def _style(place: int, count: int) -> dict[str, Any]:
    """Return the line style of one of several coinciding curves: later ones leave gaps that show the others."""
    if place == 0:
        return {"linewidth": 1.4}
    dash = _PERIOD / count
    return {"linewidth": 1.4, "linestyle": (place * dash, (dash, _PERIOD - dash))}


def _panels(curves: Curves) -> list[Curves]:
    """Split curves into panels of about equal size."""
    total = len(curves.names)
    size = math.ceil(total / math.ceil(total / _PER_PANEL)) if total else 1
    return [
        Curves(curves.label, curves.names[start : start + size], curves.values[:, start : start + size])
        for start in range(0, total, size)
    ]
