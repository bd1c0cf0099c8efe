"""What there is in the simulation, as the page and programs get to know it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from msgspec import Struct, field

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabCameraView, URLabClient

__all__ = ["WorldDescription", "describe"]

_JOINTS = ("free", "ball", "slide", "hinge")


class ActuatorView(Struct):
    """One actuator; `index` is its place in `ctrl`."""

    name: str
    index: int
    kind: str | None
    joint: str | None
    range: tuple[float, float] | None


class JointView(Struct):
    """One joint; `index` is its place in `qpos`. Radians, or metres for `slide`."""

    name: str
    index: int
    kind: str
    range: tuple[float, float] | None


class SensorView(Struct):
    """One sensor; `kind` is MuJoCo's word for it."""

    name: str
    dim: int
    kind: str


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
    """One articulation."""

    key: str
    actor_id: str
    actuators: list[ActuatorView]
    joints: list[JointView]
    sensors: list[SensorView]
    cameras: list[CameraDescription]
    controller: ControllerView | None


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


def describe(client: URLabClient, version: int, no_view: str) -> WorldDescription:
    """Describe what the client knows."""
    model = client.model
    return WorldDescription(
        version=version,
        urlab_version=client.urlab_version,
        mujoco_version=client.mujoco_version,
        playing=client.manager_present,
        no_view=no_view,
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
        actuators=[
            ActuatorView(name, act.ctrl_local.start, None if act.type is None else str(act.type), act.joint,
                         act.ctrlrange)
            for name, act in art.actuators.items()
        ],
        joints=[
            JointView(name, joint.qpos_local_offset, _JOINTS[joint.jnt_type], joint.range)
            for name, joint in art.joints.items()
        ],
        sensors=[SensorView(name, sensor.dim, _sensor_kind(client, sensor.id)) for name, sensor in art.sensors.items()],
        cameras=[_camera(view, f"{art.prefix}/{name}") for name, view in art.cameras.items()],
        controller=None
        if controller is None
        else ControllerView(str(controller.kind), dict(controller.params), dict(controller.schema)),
    )  # fmt: skip


def _camera(view: URLabCameraView, path: str) -> CameraDescription:
    width, height = view.resolution
    return CameraDescription(view.name, path, str(view.mode), width, height)


def _sensor_kind(client: URLabClient, sensor: int) -> str:
    if client.model is None or sensor < 0:
        return ""
    import mujoco  # noqa: PLC0415

    return mujoco.mjtSensor(client.model.sensor_type[sensor]).name.removeprefix("mjSENS_").lower()
