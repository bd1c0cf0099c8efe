"""`urlab plot`: curves of a recording as a picture."""

from __future__ import annotations

import argparse
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urlab_client.cli._arguments import Commands
from urlab_client.cli._failure import CommandError
from urlab_client.cli._output import progress_bar
from urlab_client.integrations._extras import need

if TYPE_CHECKING:
    from urlab_client.integrations.record import Table

__all__ = ["add_parser", "run"]

_LABELS = {
    "qpos": "position\n(rad, m)",
    "qvel": "velocity\n(rad/s, m/s)",
    "ctrl": "control",
    "set_points": "set-point",
    "act": "activation",
    "sensors": "reading",
    "pose": "pose",
}


class PlotArguments(argparse.Namespace):
    """What the command line says."""

    recording: Path
    output: Path | None
    joints: list[str]
    field: str


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "plot",
        help="draw curves of a recording",
        description="Draw joint positions, or other values, of a recording over simulation time. Needs the extras "
        "'urlab-client[mcap]' and 'urlab-client[demo]'.",
    )
    parser.add_argument("recording", type=Path, metavar="FILE", help="the recording, a .mcap file")
    parser.add_argument(
        "--joints",
        nargs="+",
        default=["*"],
        metavar="NAME",
        help="names, with or without ARTICULATION/ before them; * stands for anything (default: all but free bases)",
    )
    parser.add_argument("--field", choices=_LABELS, default="qpos", help="what to draw of them (default: %(default)s)")
    parser.add_argument("-o", "--output", type=Path, metavar="PNG", help="the picture (default: FILE with .png)")
    parser.set_defaults(run=run)


def run(arguments: PlotArguments) -> int:
    """Draw.

    Raises:
        CommandError: Nothing has such a name.
        MissingExtra: A library is missing.
    """
    need("matplotlib", extra="demo")
    from urlab_client.cli.figures import Quantity, Trace, plot_trace  # noqa: PLC0415
    from urlab_client.integrations.record import read_run  # noqa: PLC0415

    recording = read_run(arguments.recording)
    with progress_bar(arguments.recording.name, recording.path.stat().st_size) as progress:
        table = recording.table(progress)
    quantities: list[Quantity] = []
    curves: list[np.ndarray[tuple[int], np.dtype[np.float64]]] = []
    for key, names in _chosen(table, arguments).items():
        owner, column = key.rpartition("/")[0], table.columns[key]
        first = len(curves)
        curves += [column.values[:, column.names.index(name)] for name in names]
        label = f"{owner}\n{_LABELS[arguments.field]}"
        quantities.append(Quantity(label, names, range(first, len(curves))))
    target = arguments.output or arguments.recording.with_suffix(".png")
    title = arguments.recording.name
    plot_trace(Trace(title, table.time, np.stack(curves, axis=1), quantities), target)
    print(f"{target}  {len(curves)} curves, {len(table)} states")
    return 0


def _chosen(table: Table, arguments: PlotArguments) -> dict[str, list[str]]:
    from urlab_client.integrations._feed.scene_messages import joint_columns  # noqa: PLC0415

    chosen: dict[str, list[str]] = {}
    there: list[str] = []
    for key, column in table.columns.items():
        owner, field = key.split("/")[0], key.rpartition("/")[2]
        if field != arguments.field:
            continue
        there += [f"{owner}/{name}" for name in column.names]
        plain = arguments.joints == ["*"] and field in {"qpos", "qvel"}
        names = joint_columns(column.names, dof=field == "qvel") if plain else column.names
        found = [
            name
            for name in names
            if any(fnmatchcase(name, want) or fnmatchcase(f"{owner}/{name}", want) for want in arguments.joints)
        ]
        if found:
            chosen[key] = found
    if not chosen or not len(table):
        wanted = " ".join(arguments.joints)
        raise CommandError(
            f"{arguments.recording}: no {arguments.field} named {wanted}; there are {', '.join(there) or 'none'}"
        )
    return chosen
