"""The server that `urlab demo` drives: one that it starts, or a running one that it prepares."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol, TypeVar

import mujoco

from urlab_client import CreateLevelFailed, ImportFailed, URLabClient
from urlab_client._mujoco import flat_model
from urlab_client.cli._arguments import ServerArguments, make_client
from urlab_client.cli._common import CommandError, one_line
from urlab_client.cli.robot_file import RobotFile
from urlab_client.protocol.base import DialectName
from urlab_client.server.assets.bundled_robots import bundled_models
from urlab_client.server.simulated import SimulatedServer

__all__ = ["LEVELS", "DemoServer", "running_server", "started_server"]

C = TypeVar("C")

LEVELS = ("demo_one", "demo_two")
"""The levels that the demo authors."""


class Connect(Protocol):
    """Makes a client of one of the two classes."""

    def __call__(self, flavour: Callable[..., C]) -> C: ...


@dataclass(frozen=True)
class DemoServer:
    """A server for the demo.

    Attributes:
        connect: Makes a client for it.
        robot: The robot, with a file that this server can load.
    """

    connect: Connect
    robot: RobotFile


@contextlib.contextmanager
def started_server(robot: RobotFile, dialect: DialectName) -> Generator[DemoServer]:
    """Run a simulated server for as long as the block lasts."""
    with SimulatedServer(model_roots=[robot.path.parent], mjcf_options=True, dialect=dialect) as server:

        def connect(flavour: Callable[..., C]) -> C:
            return flavour(**server.client_options(), step_mode="direct")

        yield DemoServer(connect, robot)


@contextlib.contextmanager
def running_server(robot: RobotFile, address: str, arguments: ServerArguments) -> Generator[DemoServer]:
    """Prepare a running server: end play, empty the demo's levels, and find a way to send it the model.

    Raises:
        CommandError: The server cannot author levels, or cannot load the model.
        URLabError: The server refused a request, or does not answer.
    """

    def connect(flavour: Callable[..., C]) -> C:
        return make_client(flavour, address, arguments, step_mode="direct")

    with TemporaryDirectory() as folder:
        with connect(URLabClient) as client:
            client.discover()
            if not client.server.features.offers("create_level"):
                raise CommandError(f"{address}: this server has no editor: the demo cannot author its levels there")
            client.sim.stop()
            for level in LEVELS:
                _empty(client, level)
            placed = _placeable(client, robot, address, Path(folder))
        yield DemoServer(connect, placed)


def _empty(client: URLabClient, level: str) -> None:
    """Remove what an earlier demo, perhaps of another robot, left in one of its levels."""
    try:
        client.scene.create_level(level)
    except CreateLevelFailed:
        client.scene.load_level(level)
    for actor in client.scene.snapshot().actors:
        if actor.is_articulation:
            client.scene.destroy_actor(actor.name, by_name=True)
    client.scene.save_level()


def _placeable(client: URLabClient, robot: RobotFile, address: str, folder: Path) -> RobotFile:
    """Return the robot with a file that `apply_scene` can send to the server."""
    files = [robot.path, *([bundled_models()["floor"]] if robot.needs_floor else [])]
    try:
        for file in files:
            client.scene.import_xml(str(file))
    except ImportFailed as refusal:
        if not client.server.features.uploads:
            raise CommandError(
                f"{address}: this server does not accept uploads, so {' and '.join(map(str, files))} must be where it "
                f"can read them: {one_line(refusal)}"
            ) from None
        # An uploaded model replaces the previous one, so robot and floor are uploaded as one.
        return replace(robot, path=_with_floor(robot, folder), needs_floor=False) if robot.needs_floor else robot
    return robot


def _with_floor(robot: RobotFile, folder: Path) -> Path:
    spec = mujoco.MjSpec.from_file(str(robot.path))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.5], pos=[0, 0, -robot.lift])
    try:
        spec.compile()
        xml, files = flat_model(spec)
    except (ValueError, mujoco.FatalError) as error:
        raise CommandError(f"{robot.path} cannot be given a floor: {one_line(error)}") from None
    for name, content in files.items():
        (folder / name).write_bytes(content)
    path = folder / robot.path.name
    path.write_text(xml, encoding="utf-8")
    return path
