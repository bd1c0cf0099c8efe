"""`urlab plot`: draw curves of a recording as a picture."""

from __future__ import annotations

import argparse
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urlab_client._installation import need
from urlab_client.cli._arguments import Commands
from urlab_client.cli._common import CommandError, check_ending, progress_bar
from urlab_client.values.names import did_you_mean

if TYPE_CHECKING:
    from urlab_client.integrations.record import Table

_FIELDS = ("qpos", "qvel", "ctrl", "set_points", "act", "sensors", "pose")


class PlotArguments(argparse.Namespace):
    """The parsed command line."""

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
        examples=(
            ("urlab plot run.mcap", "all joint positions; the picture is run.png"),
            ("urlab plot run.mcap --joints 'shoulder_*' elbow --field qvel -o fast.png", "velocities of some joints"),
            ("urlab plot run.mcap --field sensors --joints 'imu*'", "readings of some sensors"),
        ),
    )
    parser.add_argument(
        "recording",
        type=Path,
        metavar="FILE",
        help="a .mcap file, or a server's .json recording",
    )
    parser.add_argument(
        "--joints",
        nargs="+",
        default=["*"],
        metavar="NAME",
        help="names, with or without ARTICULATION/ before them; * matches anything (default: all but free bases)",
    )
    parser.add_argument("--field", choices=_FIELDS, default="qpos", help="which values to draw (default: %(default)s)")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PICTURE", help="a .png, .pdf or .svg file (default: FILE with .png)"
    )
    parser.set_defaults(run=run)


def run(arguments: PlotArguments) -> int:
    """Draw.

    Raises:
        CommandError: No joint, actuator or sensor has such a name.
        MissingExtra: A library is missing.
    """
    need("matplotlib", extra="demo")
    from urlab_client.cli.figures import Quantity, Trace, plot_trace
    from urlab_client.integrations.record import read_run

    target = arguments.output or arguments.recording.with_suffix(".png")
    check_ending(target, ".png", ".pdf", ".svg")
    recording = read_run(arguments.recording)
    with progress_bar(arguments.recording.name, recording.path.stat().st_size) as progress:
        table = recording.table(progress, fields=[arguments.field])
    quantities: list[Quantity] = []
    curves: list[np.ndarray[tuple[int], np.dtype[np.float64]]] = []
    for key, names in _chosen(table, arguments).items():
        owner, column = key.rpartition("/")[0], table.columns[key]
        places: dict[str, list[int]] = {}  # one axis per unit
        for place in map(column.names.index, names):
            places.setdefault(column.quantities[place], []).append(place)
        for quantity, chosen in places.items():
            first = len(curves)
            curves += [column.values[:, place] for place in chosen]
            labels = [column.labels[place] for place in chosen]
            quantities.append(Quantity(f"{owner}\n{quantity}", labels, range(first, len(curves))))
    title = arguments.recording.name
    plot_trace(Trace(title, table.time, np.stack(curves, axis=1), quantities), target)
    print(f"{target}  {len(curves)} curves, {len(table)} states")
    return 0


def _chosen(table: Table, arguments: PlotArguments) -> dict[str, list[str]]:
    from urlab_client.integrations._feed.scene import joint_columns

    chosen: dict[str, list[str]] = {}
    there: list[str] = []
    for key, column in table.columns.items():
        owner, field = key.split("/")[0], key.rpartition("/")[2]
        if field != arguments.field:
            continue
        there += [f"{owner}/{name}" for name in column.names]
        plain = arguments.joints == ["*"] and field in {"qpos", "qvel"}
        names = joint_columns(column.names, dof=field == "qvel") if plain else column.names
        labels = dict(zip(column.names, column.labels, strict=True))
        found = [
            name
            for name in names
            if any(
                fnmatchcase(spelled, want)
                for want in arguments.joints
                for spelled in (name, f"{owner}/{name}", labels[name], f"{owner}/{labels[name]}")
            )
        ]
        if found:
            chosen[key] = found
    if not chosen or not len(table):
        wanted = " ".join(arguments.joints)
        close = did_you_mean(arguments.joints[0], [*there, *(name.rpartition("/")[2] for name in there)])
        raise CommandError(
            f"{arguments.recording}: no {arguments.field} named {wanted}.{close} "
            f"There are: {', '.join(there) or 'none'}"
        )
    return chosen
