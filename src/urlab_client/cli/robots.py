"""`urlab robots`: list the bundled robots.

List the bundled models and what each one contains. Every command that takes a model, and every sim:// address, accepts
their names in place of an MJCF file.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import Any

from urlab_client.cli._common import aligned, import_mujoco, json_line

USAGE = """
--json  print JSON
examples:
urlab robots  a table
urlab serve arm --play  serve one of them
urlab robots --json  the same for programs, with the path of each file
"""


def run(arguments: Namespace) -> int:
    """Print the table."""
    import_mujoco()
    from urlab_client.server.assets.bundled_robots import bundled_models

    robots = [_read(name, path) for name, path in bundled_models().items()]
    print(json_line(robots) if arguments.json else _table(robots))
    return 0


def _read(name: str, path: Path) -> dict[str, Any]:
    import mujoco

    from urlab_client._mujoco import actuator_count
    from urlab_client.server.assets.importer import mujoco_messages

    with mujoco_messages():
        model = mujoco.MjModel.from_xml_path(str(path))
    return {
        "name": name,
        "joints": model.njnt,
        "actuators": actuator_count(model),
        "sensors": model.nsensor,
        "cameras": model.ncam,
        "keyframes": [model.key(i).name for i in range(model.nkey)],
        "path": str(path),
    }


def _table(robots: list[dict[str, Any]]) -> str:
    headings = [name for name in robots[0] if name != "path"]
    rows = [[str(robot[name]) for name in headings[:-1]] + [", ".join(robot["keyframes"])] for robot in robots]
    return aligned([headings, *rows], right=range(1, len(headings) - 1))
