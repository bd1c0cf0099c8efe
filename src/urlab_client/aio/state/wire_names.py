"""Translation of users' names of robots, bodies and geoms to the server's names, and back.

For `client.runtime`. A key, an actor id and the name of an engine object can all identify a robot, and each may prefix
the name of a body or geom. The server knows only one of them, or the compiled name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from msgspec.structs import asdict, replace

from urlab_client.aio.state.scene_objects import SceneObjects
from urlab_client.protocol.base import Reply, Request
from urlab_client.protocol.messages.runtime import (
    GetContacts,
    GetContactsOk,
    MocapReply,
    ReadMocapPose,
    SetControlSource,
    SetMocapPose,
    SetTwist,
)
from urlab_client.values.names import UnknownName, compiled_names

if TYPE_CHECKING:
    import mujoco

Q = TypeVar("Q", bound=Request[Any])
R = TypeVar("R", bound=Reply)


def for_the_server(request: Q, objects: SceneObjects, model: mujoco.MjModel | None) -> Q:
    """Return a request with names that the server knows. Unknown names stay unchanged.

    Raises:
        UnknownName: A name is ambiguous; nothing was sent.
    """
    match request:
        case SetTwist(articulation=str(name)) | SetControlSource(articulation=str(name)):
            robot = objects.articulations.get(name)
            return request if robot is None else replace(request, articulation=robot.prefix)
        # MuJoCo crashes the process if a name is not text. Later checks report such names.
        case SetMocapPose(body=str(body)) | ReadMocapPose(body=str(body)):
            return replace(request, body=_compiled("body", body, objects, model))
        case GetContacts(filter=names) if names is not None:
            meant = {
                side: _compiled("body" if side.startswith("body") else "geom", name, objects, model)
                if isinstance(name, str) and name
                else name
                for side, name in asdict(names).items()
            }
            return replace(request, filter=replace(names, **meant))
        case _:
            return request


def as_written(reply: R, request: Request[Any]) -> R:
    """Return a reply with the names that the user's request contains."""
    match reply, request:
        case MocapReply(), (SetMocapPose(body=body) | ReadMocapPose(body=body)):
            return replace(reply, body=body)
        case GetContactsOk(contacts=contacts), GetContacts(filter=names) if names is not None:
            written: Mapping[str, str] = {side: name for side, name in asdict(names).items() if name}
            return replace(reply, contacts=[replace(contact, **written) for contact in contacts])
        case _:
            return reply


def _compiled(kind: Literal["body", "geom"], name: str, objects: SceneObjects, model: mujoco.MjModel | None) -> str:
    if model is None:
        return name
    import mujoco

    number = mujoco.mjtObj.mjOBJ_BODY if kind == "body" else mujoco.mjtObj.mjOBJ_GEOM

    def exists(candidate: str) -> bool:
        return mujoco.mj_name2id(model, number, candidate) >= 0

    if exists(name):
        return name
    prefixes = {
        called: robot.compiled_prefix
        for key, robot in objects.articulations.items()
        for called in (key, robot.actor_id)
        if called
    }
    found = sorted(filter(exists, compiled_names(name, prefixes)))
    if len(found) > 1:
        raise UnknownName(kind, name, tuple(found), tuple(found), ())
    return found[0] if found else name
