"""Tables that map the elements of a compiled model to articulations and props."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import (
    QPOS_WIDTH,
    QVEL_WIDTH,
    control_counts,
    control_starts,
    force_counts,
    force_starts,
    spans,
)
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.refusal import CompileFailed
from urlab_client.simulation.cameras import DEFAULT_CAMERA_SIZE, SceneCamera
from urlab_client.simulation.controller_config import CUSTOM_TEXT, ControllerConfig

Ints = NDArray[np.int32]
Addresses = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True, eq=False)
class ArticulationIndex:
    """Ids and addresses of an articulation's elements. Ids ascend; names are short and parallel to the ids.

    Attributes:
        key: Actor name.
        prefix: `key` and an underscore, the beginning of its compiled names.
        actor_id: Stable id given by the client; may be empty.
        root_body: Lowest body id; 0, the world, if the MJCF has only world geoms.
        qpos_adr: Index into `mjData.qpos` of every coordinate, in joint order.
        qvel_adr: Index into `mjData.qvel` of every velocity, in joint order.
        ctrl_adr: Index into `mjData.ctrl` of every control, in actuator order; an actuator may have several.
        act_adr: For every control the index into `mjData.act` of its actuator's first activation; -1 if stateless.
        force_adr: Index into `mjData.actuator_force` of every output, in actuator order; an actuator may have several.
        actuator_types: Actuator name to MJCF element; `motor` for `<general>`.
        controller: The controller that the level or the MJCF gives it; None for none.
    """

    key: str
    prefix: str
    actor_id: str
    root_body: int
    bodies: Ints
    joints: Ints
    actuators: Ints
    sensors: Ints
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...]
    sensor_names: tuple[str, ...]
    qpos_adr: Addresses
    qvel_adr: Addresses
    ctrl_adr: Addresses
    act_adr: Ints
    force_adr: Addresses
    actuator_types: Mapping[str, str]
    cameras: tuple[SceneCamera, ...]
    controller: ControllerConfig | None = None


@dataclass(frozen=True, kw_only=True)
class EntityIndex:
    """A body that belongs to no articulation.

    Attributes:
        name: Compiled body name.
        body: Body id.
        free_joint: Name of its free joint, or None if it is fixed or driven.
        free_joint_id: Id of that joint; -1 without one.
        qpos_adr: Index of its 7 coordinates in `mjData.qpos`; -1 without a free joint.
        qvel_adr: Index of its 6 velocities in `mjData.qvel`; -1 without a free joint.
    """

    name: str
    body: int
    free_joint: str | None = None
    free_joint_id: int = -1
    qpos_adr: int = -1
    qvel_adr: int = -1


def index_articulation(
    model: mujoco.MjModel, actor: Actor, blueprint: Blueprint, camera_size: tuple[int, int] | None
) -> ArticulationIndex:
    """Find an articulation's elements by their exact compiled names, so that similar prefixes are not confused."""

    def find(kind: int, names: Iterable[str]) -> tuple[Ints, tuple[str, ...]]:
        ids = {name: mujoco.mj_name2id(model, kind, f"{actor.prefix}{name}") for name in names}
        # Bodies that compilation has fused are in the spec, but not in the model.
        found = sorted((index, name) for name, index in ids.items() if index >= 0)
        return np.array([index for index, _ in found], dtype=np.int32), tuple(name for _, name in found)

    objects = mujoco.mjtObj
    bodies, body_names = find(objects.mjOBJ_BODY, (body.name for body in blueprint.spec.bodies[1:]))
    joints, joint_names = find(objects.mjOBJ_JOINT, blueprint.joints)
    actuators, actuator_names = find(objects.mjOBJ_ACTUATOR, blueprint.actuators)
    sensors, sensor_names = find(objects.mjOBJ_SENSOR, blueprint.sensors)
    cameras, camera_names = find(objects.mjOBJ_CAMERA, blueprint.cameras)
    kinds = model.jnt_type[joints]
    controls = control_counts(model)[actuators]
    return ArticulationIndex(
        key=actor.name,
        prefix=actor.prefix,
        actor_id=actor.actor_id,
        root_body=int(bodies[0]) if bodies.size else 0,
        bodies=bodies,
        joints=joints,
        actuators=actuators,
        sensors=sensors,
        body_names=body_names,
        joint_names=joint_names,
        actuator_names=actuator_names,
        sensor_names=sensor_names,
        qpos_adr=spans(model.jnt_qposadr[joints], QPOS_WIDTH[kinds]),
        qvel_adr=spans(model.jnt_dofadr[joints], QVEL_WIDTH[kinds]),
        ctrl_adr=spans(control_starts(model)[actuators], controls),
        act_adr=np.repeat(model.actuator_actadr[actuators], controls).astype(np.int32),
        force_adr=spans(force_starts(model)[actuators], force_counts(model)[actuators]),
        actuator_types=MappingProxyType({name: blueprint.actuator_types[name] for name in actuator_names}),
        cameras=tuple(
            _camera(model, int(index), name, camera_size) for index, name in zip(cameras, camera_names, strict=True)
        ),
        controller=_controller(actor, blueprint),
    )


def _controller(actor: Actor, blueprint: Blueprint) -> ControllerConfig | None:
    """Return the controller of an articulation, from the level or else from its MJCF."""
    authored = [text.data for text in blueprint.spec.texts if text.name == CUSTOM_TEXT]
    text = actor.controller or next(iter(authored), "")
    try:
        return ControllerConfig.parse(text) if text else None
    except ValueError as error:
        raise CompileFailed(f"{blueprint.stem}: custom text '{CUSTOM_TEXT}': {error}") from None


def _camera(model: mujoco.MjModel, index: int, name: str, size: tuple[int, int] | None) -> SceneCamera:
    width, height = (int(pixels) for pixels in model.cam_resolution[index])
    if width * height <= 1:  # MuJoCo's default, 1x1: the MJCF gives none
        width, height = size or DEFAULT_CAMERA_SIZE
    return SceneCamera(name=name, id=index, resolution=(width, height), fovy=float(model.cam_fovy[index]))


def index_entity(model: mujoco.MjModel, body: str, joint: str | None) -> EntityIndex:
    """Find the body of a converted mesh, and its free joint, by their compiled names."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
    if joint is None:
        return EntityIndex(name=body, body=index)
    joint_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    return EntityIndex(
        name=body,
        body=index,
        free_joint=joint,
        free_joint_id=joint_id,
        qpos_adr=int(model.jnt_qposadr[joint_id]),
        qvel_adr=int(model.jnt_dofadr[joint_id]),
    )
