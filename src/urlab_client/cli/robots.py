"""`urlab robots`: list the bundled robots."""

from __future__ import annotations

import argparse
from pathlib import Path

from msgspec import Struct

from urlab_client.cli._arguments import Commands
from urlab_client.cli._common import import_mujoco, json_line


class RobotsArguments(argparse.Namespace):
    """The parsed command line."""

    json: bool


class Robot(Struct):
    """A bundled model; `keyframes` holds their names."""

    name: str
    joints: int
    actuators: int
    sensors: int
    cameras: int
    keyframes: list[str]
    path: str


def add_parser(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "robots",
        help="list the bundled robots",
        description="List the bundled models and what each one contains. Every command that takes a model, and every "
        "sim:// address, accepts their names in place of an MJCF file.",
        examples=(
            ("urlab robots", "a table"),
            ("urlab serve arm --play", "serve one of them"),
            ("urlab robots --json", "the same for programs, with the path of each file"),
        ),
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)


def run(arguments: RobotsArguments) -> int:
    """Print the table."""
    import_mujoco()
    from urlab_client.server.assets.bundled_robots import bundled_models

    robots = [_read(name, path) for name, path in bundled_models().items()]
    print(json_line(robots) if arguments.json else _table(robots))
    return 0


def _read(name: str, path: Path) -> Robot:
    import mujoco

    from urlab_client._mujoco import actuator_count
    from urlab_client.server.assets.importer import mujoco_messages

    with mujoco_messages():
        model = mujoco.MjModel.from_xml_path(str(path))
    return Robot(
        name=name,
        joints=model.njnt,
        actuators=actuator_count(model),
        sensors=model.nsensor,
        cameras=model.ncam,
        keyframes=[model.key(i).name for i in range(model.nkey)],
        path=str(path),
    )


def _table(robots: list[Robot]) -> str:
    rows = [("name", "joints", "actuators", "sensors", "cameras", "keyframes")]
    rows += [
        (
            robot.name,
            *map(str, (robot.joints, robot.actuators, robot.sensors, robot.cameras)),
            ", ".join(robot.keyframes),
        )
        for robot in robots
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if 0 < column < len(row) - 1 else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
