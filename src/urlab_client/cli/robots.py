"""`urlab robots`: list the bundled robots, or what is in one.

List the bundled models and how much each one contains, or the names in one of them or in an MJCF file. Every command
that takes a model, and every sim:// address, accepts the names of bundled models in place of an MJCF file.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import Any

from urlab_client.cli._common import CommandError, aligned, import_mujoco, json_line, one_line

USAGE = """
MODEL?  a bundled robot or an MJCF file whose joints, actuators, sensors, cameras and keyframes to name
--json  print JSON
examples:
urlab robots  a table
urlab robots arm  the names in one
urlab serve arm --play  serve one of them
urlab robots --json  the same for programs, with the path of each file
"""

_COUNTED = ("joints", "actuators", "sensors", "cameras")
_UNNAMED = "(unnamed)"


def run(arguments: Namespace) -> int:
    """Print the table, or the names in one model."""
    import_mujoco()
    from urlab_client.server.assets.bundled_robots import bundled_models, unknown_model

    bundled, given = bundled_models(), arguments.model
    if given is None:
        robots = [_read(name, path) for name, path in bundled.items()]
        counted = [robot | {kind: len(robot[kind]) for kind in _COUNTED} for robot in robots]
        print(json_line(counted) if arguments.json else _table(counted))
        return 0
    path = Path(given) if Path(given).is_file() else bundled.get(given)
    if path is None:
        raise CommandError(unknown_model(given))
    robot = _read(path.stem, path)
    lines = [(name, found if isinstance(found, str) else ", ".join(found)) for name, found in robot.items()]
    print(json_line(robot) if arguments.json else aligned([(name, text or "none") for name, text in lines]))
    return 0


def _read(name: str, path: Path) -> dict[str, Any]:
    import mujoco

    from urlab_client._mujoco import actuator_count
    from urlab_client.server.assets.importer import mujoco_messages

    try:
        with mujoco_messages():
            model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise CommandError(f"MuJoCo rejects {path}: {one_line(error)}") from None
    return {
        "name": name,
        "joints": [model.joint(i).name or _UNNAMED for i in range(model.njnt)],
        "actuators": [model.actuator(i).name or _UNNAMED for i in range(actuator_count(model))],
        "sensors": [model.sensor(i).name or _UNNAMED for i in range(model.nsensor)],
        "cameras": [model.camera(i).name or _UNNAMED for i in range(model.ncam)],
        "keyframes": [model.key(i).name or _UNNAMED for i in range(model.nkey)],
        "path": str(path),
    }


def _table(robots: list[dict[str, Any]]) -> str:
    headings = ["name", *_COUNTED, "keyframes"]
    rows = [[str(robot[name]) for name in headings[:-1]] + [", ".join(robot["keyframes"])] for robot in robots]
    return aligned([headings, *rows], right=range(1, len(headings) - 1))
