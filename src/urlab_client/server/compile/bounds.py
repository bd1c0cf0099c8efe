"""Boxes around actors and geoms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import MODEL_FILE, compiled_file
from urlab_client.server.assets.actors import Actor
from urlab_client.server.assets.importer import mujoco_messages, one_line
from urlab_client.server.compile.composition import add_mesh
from urlab_client.server.refusal import CompileFailed
from urlab_client.values.rotation import Vec3, rotate

Floats = NDArray[np.float64]

Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest corner of an axis-aligned box, metres, world frame."""


def actor_bounds(actor: Actor, *, every_geom: bool = False) -> tuple[Vec3, Vec3] | None:
    """Return the lower and upper corner of the box around an actor at its authored pose, world frame, metres.

    Returns:
        The corners; None for an actor without geoms. Planes are endless and do not count.

    Raises:
        CompileFailed: The actor's own model does not compile.
    """
    try:
        if actor.blueprint is not None:
            boxes = _blueprint_boxes(actor.blueprint.folder)
        elif actor.mesh is not None:
            spec = mujoco.MjSpec()
            add_mesh(spec, spec.worldbody, actor, actor.mesh, name="geom")
            boxes = _boxes(spec.compile())
        else:
            return None
    except (ValueError, mujoco.FatalError) as error:
        raise CompileFailed(one_line(error)) from None
    chosen = boxes.solid | every_geom
    if not chosen.any():
        return None
    turn = np.array([rotate(actor.rotation, axis) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]).T
    centers = boxes.centers[chosen] @ turn.T + np.array(actor.location)
    halves = np.einsum("nij,nj->ni", np.abs(turn @ boxes.axes[chosen]), boxes.halves[chosen])
    lower, upper = (centers - halves).min(axis=0).tolist(), (centers + halves).max(axis=0).tolist()
    return (lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes around the geoms of a model at its reference: centres (n, 3), axes (n, 3, 3), half sizes (n, 3)."""

    centers: Floats
    axes: Floats
    halves: Floats
    solid: NDArray[np.bool_]


def _boxes(model: mujoco.MjModel) -> _Boxes:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bounded = model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
    axes: Floats = data.geom_xmat.reshape(-1, 3, 3)[bounded]
    aabb: Floats = model.geom_aabb[bounded]
    return _Boxes(
        centers=data.geom_xpos[bounded] + np.einsum("nij,nj->ni", axes, aabb[:, :3]),
        axes=axes,
        halves=aabb[:, 3:],
        solid=((model.geom_contype | model.geom_conaffinity) != 0)[bounded],
    )


@lru_cache(maxsize=64)
def _blueprint_boxes(folder: Path) -> _Boxes:
    with mujoco_messages():
        return _boxes(compiled_file(folder / MODEL_FILE))


def box_around(model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.bool_]) -> Box:
    """Return the box around the chosen geoms, of which there must be one at least; none may be a plane.

    Args:
        geoms: Mask, shape (ngeom,).
    """
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    middle = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotation, model.geom_aabb[geoms, :3])
    reach = np.einsum("nij,nj->ni", np.abs(rotation), model.geom_aabb[geoms, 3:])
    return (middle - reach).min(axis=0), (middle + reach).max(axis=0)
