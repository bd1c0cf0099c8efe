"""The two runs of `urlab demo`: one robot through the blocking client, and two robots through the async client."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from msgspec import Struct

from urlab_client import URLabAsset, URLabClient, URLabError, aio
from urlab_client.cli.demo_controllers import DemoController, DemoRobot, NoController, make_demo_controller
from urlab_client.cli.demo_server import LEVELS, DemoServer
from urlab_client.cli.figures import Quantity, Trace
from urlab_client.cli.robot_file import RobotFile
from urlab_client.server.assets.bundled_robots import bundled_models

if TYPE_CHECKING:
    import mujoco

__all__ = ["SEED", "DemoRun", "Outcome", "Pose", "drive_one", "drive_two"]

SEED = 0

Client: TypeAlias = URLabClient | aio.URLabClient

Advance = Callable[[], None]
"""Called after each step."""

_TURNS = (-0.4, 0.4)  # the robot on the right walks to the right
_FREE = 0
_UNITS = {3: "hinge joints (rad)", 2: "slide joints (m)"}


class Pose(Struct):
    """Pose of a robot's base: metres, quaternion (w, x, y, z), world frame."""

    robot: str
    position: list[float]
    quaternion: list[float]


class Outcome(Struct):
    """Result of a run; times in seconds."""

    client: str
    level: str
    robots: int
    steps: int
    sim_time: float
    wall_time: float
    steps_per_second: float
    real_time_factor: float
    final_base_poses: list[Pose]


class DemoRun:
    """A finished run.

    Attributes:
        outcome: The result.
        controllers: The controllers that drove the robots.
        trace: Joint positions of the first robot.
        model: The model.
        data: The last state.
    """

    def __init__(
        self,
        outcome: Outcome,
        controllers: list[DemoController],
        trace: Trace,
        model: mujoco.MjModel,
        data: mujoco.MjData,
    ) -> None:
        self.outcome = outcome
        self.controllers = controllers
        self.trace = trace
        self.model = model
        self.data = data

    @property
    def driven(self) -> bool:
        """Whether anything drove the robots."""
        return not all(isinstance(controller, NoController) for controller in self.controllers)


def drive_one(server: DemoServer, steps: int, advance: Advance) -> DemoRun:
    """Author a level with one robot and drive it through the blocking client."""
    robot = server.robot
    with server.connect(URLabClient) as client:
        client.discover()
        client.scene.apply_scene(LEVELS[0], _assets(robot, 1))
        level = client.scene.current_level()
        client.sim.start()
        client.reset(seed=SEED, per_articulation_qpos=_home(client, robot, 1))

        art = client.articulations_by_id[robot.name]
        controller = make_demo_controller(robot, art)
        recorder = _Recorder(art, steps)
        started = time.perf_counter()
        for _ in range(steps):
            controller.act(client.sim_time)
            client.step()
            recorder.note(client.sim_time)
            advance()
        wall = time.perf_counter() - started

        run = _run(
            "blocking", client, robot, number=1, level=level, recorder=recorder, controllers=[controller], wall=wall
        )
        client.sim.stop()
        return run


async def drive_two(server: DemoServer, steps: int, advance: Advance) -> DemoRun:
    """Author a level with two robots and drive each from its own task, through one async client."""
    robot = server.robot
    async with server.connect(aio.URLabClient) as client:
        await client.discover()
        await client.scene.apply_scene(LEVELS[1], _assets(robot, 2))
        level = await client.scene.current_level()
        await client.sim.start()
        await client.reset(seed=SEED, per_articulation_qpos=_home(client, robot, 2))

        arts = [client.articulations_by_id[name] for name in _ids(robot, 2)]
        recorder = _Recorder(arts[0], steps)
        controllers = [make_demo_controller(robot, art, turn) for art, turn in zip(arts, _TURNS, strict=True)]
        both = asyncio.Barrier(len(controllers))

        async def drive(controller: DemoController) -> None:
            for _ in range(steps):
                controller.act(client.sim_time)
                if await both.wait() == 0:  # every robot has its set-points; one task takes the step for all
                    await client.step()
                    recorder.note(client.sim_time)
                    advance()
                await both.wait()

        started = time.perf_counter()
        try:
            async with asyncio.TaskGroup() as tasks:
                for controller in controllers:
                    tasks.create_task(drive(controller))
        except ExceptionGroup as group:  # one task steps at a time, so there is one error
            raise group.exceptions[0] from None
        wall = time.perf_counter() - started

        run = _run("async", client, robot, number=2, level=level, recorder=recorder, controllers=controllers, wall=wall)
        await client.sim.stop()
        return run


class _Recorder:
    """Records a robot's positions: hinges, slides and base."""

    def __init__(self, robot: DemoRobot, steps: int) -> None:
        self._robot = robot
        self._quantities: list[Quantity] = []
        self._columns: list[int] = []
        for kind, label in _UNITS.items():
            joints = [joint for joint in robot.joints.values() if joint.jnt_type == kind]
            self._add(label, [joint.name for joint in joints], [joint.qpos_local_offset for joint in joints])
        free = next((joint for joint in robot.joints.values() if joint.jnt_type == _FREE), None)
        if free is not None:
            self._add("base position (m)", "xyz", range(free.qpos_local_offset, free.qpos_local_offset + 3))
        self._times = np.zeros(steps)
        self._values = np.zeros((steps, len(self._columns)))
        self._count = 0

    def note(self, sim_time: float) -> None:
        """Record the positions after a step."""
        self._times[self._count] = sim_time
        self._values[self._count] = self._robot.qpos_array[self._columns]
        self._count += 1

    def trace(self, title: str) -> Trace:
        """Return the recorded positions."""
        return Trace(title, self._times[: self._count], self._values[: self._count], self._quantities)

    def _add(self, label: str, names: Sequence[str], offsets: Sequence[int]) -> None:
        if names:
            first = len(self._columns)
            self._quantities.append(Quantity(label, [*names], range(first, first + len(names))))
            self._columns += offsets


def _ids(robot: RobotFile, number: int) -> list[str]:
    return [robot.name] if number == 1 else [f"{robot.name}_{index}" for index in range(1, number + 1)]


def _assets(robot: RobotFile, number: int) -> list[URLabAsset]:
    """Place robots side by side along y, and a floor below them if they need one."""
    assets = [
        URLabAsset(name, str(robot.path), (0.0, (index - (number - 1) / 2) * robot.spacing, robot.lift))
        for index, name in enumerate(_ids(robot, number))
    ]
    if robot.needs_floor:
        assets.append(URLabAsset("floor", str(bundled_models()["floor"])))
    return assets


def _home(client: Client, robot: RobotFile, number: int) -> dict[str, dict[str, float]]:
    # Not reset("home"): the keyframe of each copy would put its free base where the file says, onto the others.
    return {client.articulations_by_id[name].prefix: robot.home for name in _ids(robot, number)}


def _run(
    kind: str,
    client: Client,
    robot: RobotFile,
    *,
    number: int,
    level: str,
    recorder: _Recorder,
    controllers: list[DemoController],
    wall: float,
) -> DemoRun:
    model, data = client.model, client.data
    if model is None or data is None:
        raise URLabError("The server sent no model.")
    poses = [
        Pose(name, art.root_pos_w.tolist(), art.root_quat_w.tolist())
        for name in _ids(robot, number)
        for art in (client.articulations_by_id[name],)
    ]
    steps, sim_time = client.step_count, client.sim_time
    outcome = Outcome(kind, level, number, steps, sim_time, wall, steps / wall, sim_time / wall, poses)
    return DemoRun(
        outcome, controllers, recorder.trace(f"{robot.name}, {steps} steps through the {kind} client"), model, data
    )
