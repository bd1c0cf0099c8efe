"""The rows of the state stream, and how each is encoded."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.protocol.rows import ActionsRow, BaseStateRow, JointRow, SceneRow, SensorRow, TwistRow
from urlab_client.protocol.topics import StreamTopic, TopicKind
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.physics.controllers import ArticulationControl

logger: logging.Logger = logging.getLogger("urlab_client.server")

Floats: TypeAlias = NDArray[np.float64]
Encoder: TypeAlias = Callable[[], bytes | None]

_ROW_KINDS: Final = {
    int(mujoco.mjtJoint.mjJNT_FREE): TopicKind.BASE_STATE,
    int(mujoco.mjtJoint.mjJNT_BALL): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_HINGE): TopicKind.JOINT,
    int(mujoco.mjtJoint.mjJNT_SLIDE): TopicKind.JOINT,
}


@dataclass(frozen=True, slots=True)
class PublishedRow:
    """A row of the state stream: its topic, and a function that encodes the current data; None for no message."""

    topic: bytes
    encode: Encoder


def topic_frame(kind: TopicKind, owner: str, name: str = "") -> bytes | None:
    """Return a topic frame; None for names that cannot be part of a topic."""
    try:
        return StreamTopic(kind, owner, name).encode()
    except ValueError as error:
        logger.warning("%s of '%s' is not streamed: %s", kind, owner, error)
        return None


def published_rows(
    scene: CompiledScene, data: mujoco.MjData, controls: Iterable[ArticulationControl]
) -> Iterator[PublishedRow]:
    """Yield every row in the order of a tick: articulation by articulation, then the scene."""
    none = True
    for control in controls:
        none = False
        for kind, name, encode in _articulation_rows(scene.model, data, control):
            topic = topic_frame(kind, control.index.key, name)
            if topic is not None:
                yield PublishedRow(topic, encode)
    if none:  # as in the plugin, the scene comes with the articulations
        return
    for entity in scene.entities:
        values = {TopicKind.XPOS: data.xpos[entity.body], TopicKind.XQUAT: data.xquat[entity.body]}
        if entity.free_joint is not None:
            values[TopicKind.QPOS] = data.qpos[entity.qpos_adr : entity.qpos_adr + 7]
            values[TopicKind.QVEL] = data.qvel[entity.qvel_adr : entity.qvel_adr + 6]
        for kind, view in values.items():
            topic = topic_frame(kind, entity.name)
            if topic is not None:
                yield PublishedRow(topic, SceneRow(kind, view).encode)


def _articulation_rows(
    model: mujoco.MjModel, data: mujoco.MjData, control: ArticulationControl
) -> Iterator[tuple[TopicKind, str, Encoder]]:
    index = control.index
    for joint, name in zip(index.joints.tolist(), index.joint_names, strict=True):
        kind = _ROW_KINDS[int(model.jnt_type[joint])]
        encode = _base_state if kind is TopicKind.BASE_STATE else _joint
        yield kind, name, encode(model, data, joint)
    for sensor, name in zip(index.sensors.tolist(), index.sensor_names, strict=True):
        first, dim = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
        yield TopicKind.SENSOR, name, _sensor(sensor, data.sensordata[first : first + dim])
    twist = control.twist
    yield TopicKind.TWIST, "", lambda: TwistRow(twist.vx, twist.vy, twist.yaw_rate).encode()
    yield TopicKind.ACTIONS, "", lambda: ActionsRow(twist.actions).encode() if twist.actions else None


def _joint(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Encoder:
    qpos, qvel, qacc = data.qpos, data.qvel, data.qacc
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return lambda: JointRow(joint, float(qpos[position]), float(qvel[velocity]), float(qacc[velocity])).encode()


def _base_state(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> Encoder:
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    qpos, qvel = data.qpos[position : position + 7], data.qvel[velocity : velocity + 6]
    return lambda: BaseStateRow.from_free_joint(qpos, qvel).encode()


def _sensor(sensor: int, values: Floats) -> Encoder:
    return lambda: SensorRow(sensor, values.astype("<f4")).encode()
