"""Validation of a handshake before any part of it is applied.

For the client's state. Ids, offsets, sizes and names from a handshake index MuJoCo's and NumPy's memory for the whole
session, so this module checks each of them against the model once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from msgspec import Struct

from urlab_client.aio.controllers import check_controller
from urlab_client.aio.model.layout import FREE, ArticulationLayout, articulation_layouts
from urlab_client.aio.model.mirror import model_names
from urlab_client.errors import ProtocolError
from urlab_client.protocol.messages.session import CameraInfo, EntityInfo, HelloOk
from urlab_client.values.names import owner_of
from urlab_client.values.pictures import check_picture_size

if TYPE_CHECKING:
    import mujoco

_LAST_PORT = 65535


class Examined(Struct, frozen=True):
    """The result of checking a handshake against its model.

    Attributes:
        layouts: Layout of each articulation's values, by key; empty layouts without a model.
        entities: Plain entities by name.
    """

    layouts: Mapping[str, ArticulationLayout]
    entities: Mapping[str, EntityInfo]


def examine(hello: HelloOk, model: mujoco.MjModel | None) -> Examined:
    """Check a handshake against its model and derive the layouts and entities.

    Raises:
        ProtocolError: A value of the handshake is invalid.
    """
    keys = [info.prefix for info in hello.articulations]
    if "" in keys or len(set(keys)) < len(keys):
        raise _refused(f"its articulations are called {', '.join(map(repr, keys))}; keys must be unique and not empty")
    if hello.instance is not None and not 0 <= hello.instance.state_port <= _LAST_PORT:
        raise _refused(f"its state stream is on port {hello.instance.state_port}, which is not a valid port")
    for info in hello.articulations:
        _check_cameras(f"articulation {info.prefix!r}", info.camera_topics)
        if info.controller is not None:
            check_controller(info.prefix, info.controller)
    _check_cameras("the scene", hello.global_cameras or {})
    entities = hello.plain_entities
    for name, entity in entities.items():
        _check_entity(name, entity, model)
    if model is None:
        return Examined({key: ArticulationLayout() for key in keys}, entities)
    prefixes = {info.prefix: info.compiled_prefix for info in hello.articulations}
    try:
        layouts = articulation_layouts(model, prefixes)
        return Examined(layouts, entities or _entities_of(model, frozenset(prefixes.values())))
    except UnicodeDecodeError as error:
        raise _refused(f"a name in its model is not text: {error}") from error


def _refused(problem: str) -> ProtocolError:
    return ProtocolError(f"hello: {problem}.", op="hello")


def _check_cameras(owner: str, cameras: Mapping[str, CameraInfo]) -> None:
    for name, info in cameras.items():
        try:
            check_picture_size(*info.resolution)
        except ValueError as error:
            raise _refused(f"camera {name!r} of {owner}: {error}") from None


def _check_entity(name: str, info: EntityInfo, model: mujoco.MjModel | None) -> None:
    reported = (info.free_joint_id, info.qpos_offset, info.qvel_offset)
    if model is None:
        if info.id < 1 or any(number is not None and number < 0 for number in reported):
            raise _refused(f"entity {name!r} has the invalid body {info.id} or joint and offsets {reported}")
        return
    if not 0 < info.id < model.nbody:
        raise _refused(f"entity {name!r} is body {info.id}, but the bodies of its model are 1 to {model.nbody - 1}")
    joint = int(model.body_jntadr[info.id])
    free = joint >= 0 and model.jnt_type[joint] == FREE
    if free != info.has_free_base:
        raise _refused(f"entity {name!r} has {'a' if info.has_free_base else 'no'} free base, unlike its model")
    places = (joint, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])) if free else (None, None, None)
    if any(number not in (None, place) for number, place in zip(reported, places, strict=True)):
        raise _refused(f"entity {name!r} has joint and offsets {reported}, but in its model they are {places}")


def _entities_of(model: mujoco.MjModel, keys: frozenset[str]) -> dict[str, EntityInfo]:
    """Find the dynamic bodies outside articulations in the model, because the plugin does not list them."""
    bodies, joints = model_names(model, "body"), model_names(model, "joint")
    found: dict[str, EntityInfo] = {}
    for body_id, name in enumerate(bodies):
        if body_id == 0 or not name or owner_of(name, keys) is not None:
            continue
        joint = int(model.body_jntadr[body_id])
        if joint >= 0 and model.jnt_type[joint] == FREE:
            found[name] = EntityInfo(
                id=body_id,
                has_free_base=True,
                free_joint=joints[joint] or None,
                free_joint_id=joint,
                qpos_offset=int(model.jnt_qposadr[joint]),
                qvel_offset=int(model.jnt_dofadr[joint]),
            )
        elif model.body_mocapid[body_id] >= 0:
            found[name] = EntityInfo(id=body_id, has_free_base=False)
    return found
