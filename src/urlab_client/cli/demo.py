"""`urlab demo`: drive a robot through both clients on a simulated server, and write the results to disk.

Start a simulated server, drive one robot through the blocking client and two robots through the async client, and write
joints.png, last_state.png and run.json. Needs the extra 'urlab-client[demo]'.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import math
import platform
import time
from argparse import Namespace
from collections.abc import Callable, Generator
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from urlab_client._installation import need
from urlab_client._platform.files import replaced
from urlab_client.cli._arguments import DIALECT
from urlab_client.cli._common import CommandError, aligned, import_mujoco, one_line, progress_bar
from urlab_client.cli.snapshot import write_picture

if TYPE_CHECKING:
    from urlab_client import URLabArticulation, URLabClient, aio
    from urlab_client.protocol.base import DialectName, Floats
    from urlab_client.server import SimulatedServer

    Robot = URLabArticulation | aio.URLabArticulation

_ASYNC_SHARE = 4  # the async run takes a quarter of the steps
_SEED = 0
_PICTURE = (1280, 960)
_FREE = 0  # MuJoCo's number of a free joint
_LABELS = {3: "hinge joints (rad)", 2: "slide joints (m)"}
_PACKAGES = ("urlab-client", "mujoco", "numpy", "pyzmq", "msgspec")

USAGE = f"""
MODEL=quadruped  an MJCF file or the name of a bundled robot
{DIALECT}
--output DIR=urlab-demo  where to write
--steps N=2000  steps of the blocking run; the async run takes a quarter
--no-render  do not draw the picture of the last state
examples:
urlab demo  the bundled quadruped; results in urlab-demo/
urlab demo robot.xml --steps 500 --output run1  your own model
urlab demo arm --no-render  without a picture of the last state
"""


def run(arguments: Namespace) -> int:
    """Run the demonstration."""
    need("matplotlib", "PIL", extra="demo")
    import_mujoco()
    from urlab_client import URLabClient

    file, floor = _scene(arguments.model)
    folder, steps = arguments.output, arguments.steps
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandError(f"--output {folder}: cannot write there: {error.strerror or error}") from None
    with _serving([str(file), *floor], arguments.dialect) as (server, options), URLabClient(**options) as client:
        client.discover()
        client.reset(seed=_SEED)
        with progress_bar("blocking client, one robot", steps) as progress:
            one = Run(client, progress)
            for _ in range(steps):
                one.act()
                client.step()
                one.note()
            runs = [one.outcome("blocking")]
        picture = "not drawn: --no-render" if arguments.no_render else _draw(server, folder / "last_state.png")
    with _serving([str(file), str(file), *floor], arguments.dialect) as (_, options):
        runs.append(asyncio.run(_drive_two(options, max(1, steps // _ASYNC_SHARE))))
    print(f"{file.stem}, direct mode", _table(runs, poses=one.free), sep="\n")
    if runs[0]["controllers"] == ["none"]:
        print(f"{file.stem}: 0 actuators: nothing is driven; gravity alone moves it.")
    one.plot(f"{file.stem}, {steps} steps through the blocking client", folder / "joints.png")
    with replaced(folder / "run.json") as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(_record(file, client, runs)), indent=2) + b"\n")
    print(f"{folder / 'joints.png'}  joint positions over the {runs[0]['sim_time']:.3f} s of the blocking run")
    print(f"{folder / 'last_state.png'}  {picture}")
    print(f"{folder / 'run.json'}  versions, model, options, seed and results")
    return 0


async def _drive_two(options: dict[str, Any], steps: int) -> dict[str, Any]:
    from urlab_client import aio

    async with aio.URLabClient(**options) as client:
        await client.discover()
        await client.reset(seed=_SEED)
        with progress_bar("async client, two robots", steps) as progress:
            two = Run(client, progress)
            for _ in range(steps):
                two.act()
                await client.step()
                two.note()
            return two.outcome("async")


def _scene(given: str) -> tuple[Path, list[str]]:
    """Return the file of a robot that can move, and the floor that it needs if it can fall and brings none."""
    import mujoco

    from urlab_client.server.assets.bundled_robots import bundled_models, unknown_model
    from urlab_client.server.assets.importer import mujoco_messages

    path = Path(given) if Path(given).is_file() else bundled_models().get(given)
    if path is None:
        raise CommandError(unknown_model(given))
    try:
        with mujoco_messages():  # the server repeats MuJoCo's messages about the model
            model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise CommandError(f"MuJoCo rejects {path}: {one_line(error)}") from None
    if not model.njnt:
        raise CommandError(f"{path} has no joints, so nothing in it can move; name a robot")
    falls = (model.jnt_type == _FREE).any() and not model.nhfield
    grounded = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any()
    return path.resolve(), ["floor"] if falls and not grounded else []


@contextlib.contextmanager
def _serving(models: list[str], dialect: DialectName) -> Generator[tuple[SimulatedServer, dict[str, Any]]]:
    """Serve models, in play; yield the server and a client's options."""
    from urlab_client.server import SimulatedServer, bundled_models

    logger = logging.getLogger("urlab_client.server")
    before = logger.level
    if Path(models[0]).stem in bundled_models():
        logger.setLevel(logging.ERROR)  # the only warning would be about the floor in each copy
    try:
        with SimulatedServer(*models, play=True, mjcf_options=True, render_quality="high", dialect=dialect) as server:
            yield server, {**server.client_options(), "step_mode": "direct"}
    finally:
        logger.setLevel(before)


def _draw(server: SimulatedServer, file: Path) -> str:
    """Draw the robot as the editor's viewport would show it; return what is in the picture, or why there is none."""
    from urlab_client.server import RenderingUnavailable

    try:
        picture = server.snapshot(_PICTURE, frame_all=True)
    except RenderingUnavailable as reason:
        file.unlink(missing_ok=True)  # one of an earlier run would show another state
        return f"not drawn: {one_line(reason)}"
    write_picture(file, picture)
    return "last state of the blocking run"


def _table(runs: list[dict[str, Any]], *, poses: bool) -> str:
    headings = "client", "robots", "steps", "sim (s)", "steps/s", "real-time factor"
    rows = [[*headings, "final base pose: x y z (m), quaternion w x y z" if poses else ""]]
    for one in runs:
        numbers = "{robots} {steps} {sim_time:.3f} {steps_per_second:.0f} {real_time_factor:.2f}".format(**one)
        shown = [" ".join(f"{value:6.3f}" for value in pose) for pose in one["final_base_poses"]] if poses else [""]
        rows.append([one["client"], *numbers.split(), shown[0]])
        rows += [[*[""] * len(headings), pose] for pose in shown[1:]]
    return aligned(rows, right=range(1, len(headings)))


def _record(file: Path, client: URLabClient, runs: list[dict[str, Any]]) -> dict[str, Any]:
    import mujoco

    system = {"python": platform.python_version(), "platform": platform.platform()}
    option: Any = client.model.opt if client.model is not None else None
    kinds = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver}
    physics = {name: kind(getattr(option, name)).name for name, kind in kinds.items()}
    physics |= {"timestep": option.timestep, "gravity": option.gravity.tolist()}
    return {
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {**system, **{package: version(package) for package in _PACKAGES}},
        "model": {"path": str(file), "sha256": hashlib.sha256(file.read_bytes()).hexdigest()},
        "seed": _SEED,
        "options": {"step_mode": "direct", **physics},
        "runs": runs,
    }


class Trot:
    """Makes the bundled quadruped trot: diagonal pairs of feet take turns, and torques move the joints.

    A foot moves straight back on the ground and in an arc forward through the air; the leg's two equal links give the
    joint angles in closed form.

    Args:
        robot: The bundled quadruped, standing.
        turn: How much longer the strides of the right legs are than average, as a share; positive turns left.
    """

    STRIDES_PER_S = 2.0
    STRIDE_M, LIFT_M, LINK_M = 0.12, 0.05, 0.2
    ON_GROUND = 0.6  # share of a stride
    KP, KD = 150.0, 4.0  # N m / rad, N m s / rad
    RAMP_S = 0.6  # until full stride
    BEND = math.pi / 4  # slope of both links where the joint angles are zero, radians
    JOINTS = tuple(f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf"))
    PHASES = np.array([0.0, 0.5, 0.5, 0.0])
    SIDES = np.array([-1.0, 1.0, -1.0, 1.0])

    def __init__(self, robot: Robot, turn: float = 0.0) -> None:
        self._robot = robot
        joints = [robot.joints[name] for name in self.JOINTS]
        self._qpos = np.array([joint.qpos_local_offset for joint in joints])
        self._qvel = np.array([joint.qvel_local_offset for joint in joints])
        self._ctrl = np.array([robot.actuators[joint.name].ctrl_local.start for joint in joints])
        self._strides = self.STRIDE_M * (1 + turn * self.SIDES)

    def act(self, time: float) -> None:
        """Write the set-points for the next step, `time` seconds into the simulation."""
        share = min(1.0, time / self.RAMP_S)
        error = self.angles(time, share * self._strides, share) - self._robot.qpos_array[self._qpos]
        self._robot.ctrl_array[self._ctrl] = self.KP * error - self.KD * self._robot.qvel_array[self._qvel]

    @classmethod
    def angles(cls, time: float, strides: Floats, lift: float) -> Floats:
        """Return the joint angles, shape (12,), from each leg's stride in metres and the share of the full lift."""
        phase = (time * cls.STRIDES_PER_S + cls.PHASES) % 1
        grounded = phase < cls.ON_GROUND
        # Progress through the part of the stride the leg is in; the arc starts and ends at rest.
        part = np.where(grounded, phase / cls.ON_GROUND, (phase - cls.ON_GROUND) / (1 - cls.ON_GROUND))
        arc = part - np.sin(2 * math.pi * part) / (2 * math.pi)
        x = strides * np.where(grounded, 0.5 - part, arc - 0.5)
        height = 2 * cls.LINK_M * math.cos(cls.BEND)
        z = np.where(grounded, 0.0, lift * cls.LIFT_M * np.sin(math.pi * part) ** 2) - height
        slope = np.arctan2(-x, -z)
        bend = np.arccos(np.hypot(x, z) / (2 * cls.LINK_M))
        thigh, calf = slope + bend - cls.BEND, 2 * (cls.BEND - bend)
        return np.column_stack([np.zeros_like(thigh), thigh, calf]).ravel()


class Swing:
    """Moves each actuator of a robot at rest gently back and forth within its control range."""

    HERTZ = 0.5
    SHARE = 0.2  # amplitude as a share of half the control range
    UNLIMITED = 0.1  # amplitude of an actuator without a control range
    RAMP_S = 1.0  # until the full amplitude
    PHASE_STEP = math.pi * (3 - math.sqrt(5))  # golden angle: no two actuators are ever in phase

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        count = len(robot.ctrl_array)
        self._centre, self._amplitude = np.zeros(count), np.zeros(count)
        self._phase = self.PHASE_STEP * np.arange(count)
        for actuator in robot.actuators.values():
            low, high = actuator.ctrlrange or (-math.inf, math.inf)
            amplitude = self.UNLIMITED if math.isinf(high - low) else self.SHARE * (high - low) / 2
            joint = robot.joints.get(actuator.joint or "") if actuator.type == "position" else None
            rest = 0.0 if joint is None else float(robot.qpos_array[joint.qpos_local_offset])
            self._centre[actuator.ctrl_local] = min(max(rest, low + amplitude), high - amplitude)
            self._amplitude[actuator.ctrl_local] = amplitude

    def act(self, time: float) -> None:
        """Write the set-points for the next step, `time` seconds into the simulation."""
        swing = np.sin(2 * math.pi * self.HERTZ * time + self._phase)
        self._robot.ctrl_array[:] = self._centre + min(1.0, time / self.RAMP_S) * self._amplitude * swing


class Run:
    """A run under way: the robots with their controllers, and the positions of the first robot."""

    def __init__(self, client: URLabClient | aio.URLabClient, progress: Callable[[float], None]) -> None:
        self._client, self._progress = client, progress
        self._robots: list[Robot] = [one for one in client.articulations_by_id.values() if one.joints]  # no floor
        turns = (-0.4, 0.4) if len(self._robots) > 1 else (0.0,)  # the robot on the right walks to the right
        self._controllers = [
            Trot(robot, turn) if set(robot.actuators) == set(Trot.JOINTS) else Swing(robot)
            for robot, turn in zip(self._robots, turns, strict=True)
        ]
        self._times: list[float] = []
        self._positions: list[Floats] = []
        self._began = time.perf_counter()

    @property
    def free(self) -> bool:
        """Whether the first robot can go elsewhere, so that it matters where it ends."""
        return self._robots[0].has_free_base

    def act(self) -> None:
        """Write all set-points for the next step."""
        for controller in self._controllers:
            controller.act(self._client.sim_time)

    def note(self) -> None:
        """Note the positions after a step."""
        self._times.append(self._client.sim_time)
        self._positions.append(self._robots[0].qpos_array.copy())
        self._progress(len(self._times))

    def outcome(self, flavour: str) -> dict[str, Any]:
        """Return the result so far: seconds, metres, quaternions (w, x, y, z), world frame."""
        wall, steps, passed = time.perf_counter() - self._began, self._client.step_count, self._client.sim_time
        pairs = list(zip(self._controllers, self._robots, strict=True))
        return {
            "client": flavour,
            "robots": len(self._robots),
            "steps": steps,
            "sim_time": passed,
            "wall_time": wall,
            "steps_per_second": steps / wall,
            "real_time_factor": passed / wall,
            "final_base_poses": [[*robot.root_pos_w.tolist(), *robot.root_quat_w.tolist()] for robot in self._robots],
            "controllers": [type(one).__name__.lower() if robot.actuators else "none" for one, robot in pairs],
        }

    def plot(self, title: str, file: Path) -> None:
        """Draw the positions over simulation time."""
        from urlab_client.cli.plot import Curves, plot_curves

        lines: dict[str, list[tuple[str, int]]] = {}  # by axis label: name and index of each position
        for joint in self._robots[0].joints.values():
            place = joint.qpos_local_offset
            if joint.jnt_type == _FREE:
                lines.setdefault("base position (m)", []).extend(zip("xyz", range(place, place + 3), strict=True))
            elif joint.jnt_type in _LABELS:
                lines.setdefault(_LABELS[joint.jnt_type], []).append((joint.name, place))
        positions = np.array(self._positions)
        curves = [
            Curves(label, [name for name, _ in some], positions[:, [place for _, place in some]])
            for label, some in lines.items()
        ]
        plot_curves(title, np.array(self._times), curves, file)
