"""Description of the simulation's contents, for the page and programs."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from msgspec import Struct, field

from urlab_client.console.mujoco_viewer import no_view

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio import Actuator, URLabArticulation, URLabCameraView, URLabClient


class ActuatorView(Struct):
    """One actuator; `index` is its place in `ctrl`.

    `takes` is what a set-point means, `force`, `position` or `velocity`, in `unit`, and `range` its limits; with a PD
    controller in force a position. `home` is the set-point of the keyframe `home`, or of the model's start.
    """

    name: str
    index: int
    kind: str | None
    joint: str | None
    takes: str
    unit: str
    range: tuple[float, float] | None
    home: float


class JointView(Struct):
    """One joint; `index` is its place in `qpos`, `dof` that in `qvel`. Radians, or metres for `slide`."""

    name: str
    index: int
    dof: int
    kind: str
    unit: str
    range: tuple[float, float] | None


class SensorView(Struct):
    """One sensor; `kind` is MuJoCo's word for it."""

    name: str
    dim: int
    kind: str
    unit: str


class CameraDescription(Struct):
    """One camera; `path` is its place under `/api/cameras/`."""

    name: str
    path: str
    mode: str
    width: int
    height: int


class ControllerView(Struct):
    """The controller of an articulation."""

    kind: str
    params: dict[str, Any]
    schema: dict[str, Any]


class ArticulationView(Struct):
    """One articulation; `height` is that of a free base in the keyframe `home`, or at the model's start, metres."""

    key: str
    actor_id: str
    actuators: list[ActuatorView]
    joints: list[JointView]
    sensors: list[SensorView]
    cameras: list[CameraDescription]
    controller: ControllerView | None
    height: float | None = None


class WorldDescription(Struct):
    """Everything there is. `version` grows with each change; `no_view` says why there is no 3-D view, if so."""

    version: int = 0
    urlab_version: str = ""
    mujoco_version: str = ""
    playing: bool = False
    no_view: str = "The console has not reached the server yet."
    timestep: float | None = None
    articulations: list[ArticulationView] = field(default_factory=list[ArticulationView])
    cameras: list[CameraDescription] = field(default_factory=list[CameraDescription])
    entities: list[str] = field(default_factory=list[str])


def describe(client: URLabClient, version: int) -> WorldDescription:
    """Describe what the client knows."""
    model = client.model
    return WorldDescription(
        version=version,
        urlab_version=client.urlab_version,
        mujoco_version=client.mujoco_version,
        playing=client.manager_present,
        no_view=no_view(client),
        timestep=None if model is None else float(model.opt.timestep),
        articulations=[_articulation(client, art) for art in client.articulations.values()]
        if client.manager_present
        else [],
        cameras=[_camera(view, f"-/{name}") for name, view in client.global_cameras.items()],
        entities=[name for name in client.entities if name not in client.articulations],
    )


def _articulation(client: URLabClient, art: URLabArticulation) -> ArticulationView:
    controller = art.controller
    return ArticulationView(
        key=art.prefix,
        actor_id=art.actor_id,
        actuators=[_actuator(client, art, act) for act in art.actuators.values()],
        joints=[
            JointView(name, joint.qpos_local_offset, joint.qvel_local_offset, str(joint.kind), joint.unit, joint.limits)
            for name, joint in art.joints.items()
        ],
        sensors=[SensorView(name, sensor.dim, sensor.kind, sensor.unit) for name, sensor in art.sensors.items()],
        cameras=[_camera(view, f"{art.prefix}/{name}") for name, view in art.cameras.items()],
        controller=None
        if controller is None
        else ControllerView(str(controller.kind), dict(controller.params), dict(controller.schema)),
        height=_height(client.model, art),
    )


def _camera(view: URLabCameraView, path: str) -> CameraDescription:
    width, height = view.resolution
    return CameraDescription(view.name, path, str(view.mode), width, height)


def _actuator(client: URLabClient, art: URLabArticulation, actuator: Actuator) -> ActuatorView:
    said = actuator.describe()
    joint = None if actuator.joint is None else art.joints[actuator.joint]
    limits = said.limits
    if limits is None and said.takes == "position" and joint is not None:
        limits = joint.limits
    home, model = 0.0, client.model
    if model is not None and said.takes == "position" and joint is not None:
        home = float(home_of(model, art)[int(model.jnt_qposadr[joint.id])])
    place = actuator.ctrl_local.start
    return ActuatorView(said.name, place, said.kind, said.joint, said.takes, said.unit, limits, home)


def _height(model: mujoco.MjModel | None, art: URLabArticulation) -> float | None:
    free = next((joint for joint in art.joints.values() if joint.kind == "free"), None)
    if model is None or free is None:
        return None
    return float(home_of(model, art)[int(model.jnt_qposadr[free.id]) + 2])


def home_of(model: mujoco.MjModel, art: URLabArticulation) -> Any:
    """Return all positions of the robot's keyframe `home`, or where the model starts."""
    for name in (rf"{re.escape(art.compiled_prefix)}[_/]?home", r"(.*[_/])?home"):
        for key in range(model.nkey):
            if re.fullmatch(name, model.key(key).name):
                return model.key_qpos[key]
    return model.qpos0
