"""Curves over simulation time as a picture, for `urlab demo` and `urlab plot`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client._platform.files import replaced

_PER_PANEL = 6  # more lines in one panel cannot be told apart
_DPI = 150
_COVERS = 0.003  # of the axis: less than the width of a line
_PERIOD = 18.0  # of a dashed line, in line widths


@dataclass(frozen=True)
class Quantity:
    """Columns that share panels.

    Attributes:
        label: Axis label with the unit.
        names: Names of the lines.
        columns: Columns of the trace's values.
    """

    label: str
    names: Sequence[str]
    columns: Sequence[int]


@dataclass(frozen=True)
class Trace:
    """Values over simulation time.

    Attributes:
        title: Title of the plot.
        time: Simulation time, seconds, shape (samples,).
        values: Shape (samples, columns).
        quantities: Names and units of the columns.
    """

    title: str
    time: NDArray[np.float64]
    values: NDArray[np.float64]
    quantities: Sequence[Quantity]


def plot_trace(trace: Trace, path: Path) -> None:
    """Write the plot as PNG."""
    # The figure's own canvas, not pyplot: no display, no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = [panel for quantity in trace.quantities for panel in _panels(quantity)]
    figure: Any = Figure(figsize=(10, 0.9 + 2.3 * len(panels)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(trace.title)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, panel in zip(axes, panels, strict=True):
        twins = _twins(trace.values[:, list(panel.columns)])
        for index, (name, column) in enumerate(zip(panel.names, panel.columns, strict=True)):
            first, place, count = twins[index]
            label = name if first == index else f"{name} (like {panel.names[first]})"
            axis.plot(trace.time, trace.values[:, column], label=label, color=f"C{index}", **_style(place, count))
        axis.set_ylabel(panel.label)
        axis.grid(visible=True, alpha=0.3)
        axis.margins(x=0.01)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
    figure.align_ylabels(axes)
    axes[-1].set_xlabel("simulation time (s)")
    with replaced(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)


def _twins(values: NDArray[np.float64]) -> list[tuple[int, int, int]]:
    """Return, per column, the first column that it covers, its place among those that do, and their number."""
    near = _COVERS * np.ptp(np.nan_to_num(values)) if values.size else 0.0
    firsts = [
        next(
            other
            for other in range(index + 1)
            if np.allclose(values[:, other], values[:, index], rtol=0, atol=near, equal_nan=True)
        )
        for index in range(values.shape[1])
    ]
    return [(first, firsts[:index].count(first), firsts.count(first)) for index, first in enumerate(firsts)]


def _style(place: int, count: int) -> dict[str, Any]:
    """Return the line style of one of several coinciding curves: later ones leave gaps that show the others."""
    if place == 0:
        return {"linewidth": 1.4}
    dash = _PERIOD / count
    return {"linewidth": 1.4, "linestyle": (place * dash, (dash, _PERIOD - dash))}


def _panels(quantity: Quantity) -> list[Quantity]:
    """Split a quantity into panels of about equal size."""
    total = len(quantity.names)
    count = math.ceil(total / _PER_PANEL)
    size = math.ceil(total / count) if count else 0
    return [
        Quantity(quantity.label, quantity.names[start : start + size], quantity.columns[start : start + size])
        for start in range(0, total, size or 1)
    ]
