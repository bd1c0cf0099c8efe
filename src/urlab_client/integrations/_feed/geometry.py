"""The visible geoms of a compiled model as primitives and triangles, in the frames of their bodies."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import model_names, shown_colours
from urlab_client.integrations._feed.messages import (
    Color,
    CylinderPrimitive,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneUpdate,
    SolidPrimitive,
    Time,
    TriangleListPrimitive,
    Vector3,
)

if TYPE_CHECKING:
    import mujoco

_VISIBLE_GROUPS = 3  # as in MuJoCo's viewers: 0 to 2 are shown; collision geometry is usually in 3
_EVERYTHING = 1  # SceneEntityDeletion.ALL
_PLANE_M = 20.0  # size of infinite planes
_PLANE_THICKNESS_M = 0.001


class Kind(StrEnum):
    """Kind of a shape, which determines the meaning of its size, metres."""

    BOX = "box"
    """Half of each side."""
    ELLIPSOID = "ellipsoid"
    """Half of each axis."""
    CAPSULE = "capsule"
    """Radius, and half of the length along z without the caps."""
    CYLINDER = "cylinder"
    """Radius, and half of the length along z."""
    MESH = "mesh"
    """Unused; the vertices determine the size."""


@dataclass(frozen=True, slots=True)
class Shape:
    """One geom.

    Attributes:
        body: Name of its body's frame.
        name: Its name, or one made from its id.
        kind: Kind of shape.
        size: Three numbers; see `Kind`.
        position: Position in the body's frame, metres.
        orientation: Quaternion (w, x, y, z) in the body's frame.
        rgba: Colour, each component 0 to 1.
        vertices: Vertices of a mesh, shape (n, 3), metres.
        triangles: Triangles of a mesh, shape (m, 3), indices of vertices.
    """

    body: str
    name: str
    kind: Kind
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    rgba: tuple[float, float, float, float]
    vertices: NDArray[np.float32] | None = None
    triangles: NDArray[np.uint32] | None = None


def shapes_of(model: mujoco.MjModel, bodies: list[str]) -> list[Shape]:
    """Return the geoms that MuJoCo's viewers show by default.

    Args:
        model: The model.
        bodies: Name of each body.
    """
    names = model_names(model, "geom")
    found: list[Shape] = []
    for geom, rgba in enumerate(shown_colours(model, model.geom_rgba, np.arange(int(model.ngeom)))):
        if int(model.geom_group[geom]) >= _VISIBLE_GROUPS or rgba[3] == 0:
            continue
        outline = _outline(model, geom)
        if outline is None:
            continue
        kind, size, vertices, triangles = outline
        found.append(
            Shape(
                body=bodies[int(model.geom_bodyid[geom])],
                name=names[geom] or f"geom_{geom}",
                kind=kind,
                size=size,
                position=tuple(model.geom_pos[geom].tolist()),
                orientation=tuple(model.geom_quat[geom].tolist()),
                rgba=tuple(rgba.tolist()),
                vertices=vertices,
                triangles=triangles,
            )
        )
    return found


_Outline = tuple[Kind, tuple[float, float, float], NDArray[np.float32] | None, NDArray[np.uint32] | None]


def _outline(model: mujoco.MjModel, geom: int) -> _Outline | None:
    import mujoco

    x, y, z = model.geom_size[geom].tolist()
    types, data = mujoco.mjtGeom, int(model.geom_dataid[geom])
    solids: dict[int, tuple[Kind, tuple[float, float, float]]] = {
        types.mjGEOM_PLANE: (Kind.BOX, (x or _PLANE_M, y or _PLANE_M, _PLANE_THICKNESS_M)),
        types.mjGEOM_SPHERE: (Kind.ELLIPSOID, (x, x, x)),
        types.mjGEOM_CAPSULE: (Kind.CAPSULE, (x, y, 0.0)),
        types.mjGEOM_ELLIPSOID: (Kind.ELLIPSOID, (x, y, z)),
        types.mjGEOM_CYLINDER: (Kind.CYLINDER, (x, y, 0.0)),
        types.mjGEOM_BOX: (Kind.BOX, (x, y, z)),
    }
    kind = int(model.geom_type[geom])
    if kind in solids:
        return *solids[kind], None, None
    if kind == types.mjGEOM_MESH:
        first, face = int(model.mesh_vertadr[data]), int(model.mesh_faceadr[data])
        vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[data])].astype(np.float32)
        triangles = model.mesh_face[face : face + int(model.mesh_facenum[data])].astype(np.uint32)
        return Kind.MESH, (0.0, 0.0, 0.0), vertices, triangles
    if kind == types.mjGEOM_HFIELD:
        return Kind.MESH, (0.0, 0.0, 0.0), *_height_field(model, data)
    return None  # signed distance fields can be drawn only by MuJoCo's plugins


def _height_field(model: mujoco.MjModel, field: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    rows, columns, start = int(model.hfield_nrow[field]), int(model.hfield_ncol[field]), int(model.hfield_adr[field])
    x: float
    y: float
    top: float
    x, y, top, _ = model.hfield_size[field].tolist()
    heights = model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    vertices = np.empty((rows, columns, 3), np.float32)
    vertices[..., 0] = np.linspace(-x, x, columns)
    vertices[..., 1] = np.linspace(-y, y, rows)[:, None]
    vertices[..., 2] = top * heights
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)])


def scene_update(shapes: Iterable[Shape], time: Time) -> SceneUpdate:
    """Return shapes as the message that Foxglove's 3-D panel draws, in place of everything drawn before."""
    by_body: dict[str, list[Shape]] = {}
    for shape in shapes:
        by_body.setdefault(shape.body, []).append(shape)
    entities = [_entity(body, those, time) for body, those in by_body.items()]
    return SceneUpdate([SceneEntityDeletion(time, _EVERYTHING, "")], entities)


def _entity(body: str, shapes: Iterable[Shape], time: Time) -> SceneEntity:
    entity = SceneEntity(time, body, body, frame_locked=True, cubes=[], spheres=[], cylinders=[], triangles=[])
    for shape in shapes:
        pose, (x, y, z), colour = _pose(shape), shape.size, Color(*shape.rgba)
        match shape.kind:
            case Kind.BOX | Kind.ELLIPSOID:
                solids = entity.cubes if shape.kind is Kind.BOX else entity.spheres
                solids.append(SolidPrimitive(pose, Vector3(2 * x, 2 * y, 2 * z), colour))
            case Kind.CYLINDER | Kind.CAPSULE:
                entity.cylinders.append(CylinderPrimitive(pose, Vector3(2 * x, 2 * x, 2 * y), 1.0, 1.0, colour))
                if shape.kind is Kind.CAPSULE:
                    ball, ends = Vector3(2 * x, 2 * x, 2 * x), (_pose(shape, -y), _pose(shape, y))
                    entity.spheres.extend(SolidPrimitive(end, ball, colour) for end in ends)
            case Kind.MESH:
                if shape.vertices is not None and shape.triangles is not None:
                    points = [Vector3(*point) for point in shape.vertices.tolist()]
                    mesh = TriangleListPrimitive(pose, points, colour, [], shape.triangles.ravel().tolist())
                    entity.triangles.append(mesh)
    return entity


def _pose(shape: Shape, along_z: float = 0.0) -> Pose:
    """Return a shape's pose in its body's frame, or that of a point on the shape's z axis."""
    w, x, y, z = shape.orientation
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    at = np.asarray(shape.position) + along_z * axis
    return Pose(Vector3(*at.tolist()), Quaternion(x, y, z, w))
