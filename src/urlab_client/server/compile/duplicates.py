"""Floors and suns that several robots' models contain. Only one of each is drawn."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_SAME: Final = 1e-6


def coinciding_planes(model: mujoco.MjModel) -> list[list[int]]:
    """Return the sets of static, colliding planes that coincide, such as the floors of several robots' models."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    static = model.body_weldid[model.geom_bodyid] == 0
    groups: list[tuple[Floats, float, list[int]]] = []
    for geom in np.flatnonzero((model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)) & solid & static).tolist():
        normal: Floats = data.geom_xmat[geom].reshape(3, 3)[:, 2].copy()
        offset = float(normal @ data.geom_xpos[geom])
        for other, at, members in groups:
            if np.abs(other - normal).max() < _SAME and abs(at - offset) < _SAME:
                members.append(geom)
                break
        else:
            groups.append((normal, offset, [geom]))
    return [members for _, _, members in groups if len(members) > 1]


def draw_once(model: mujoco.MjModel, planes: list[list[int]]) -> None:
    """Hide duplicates of floors and suns. Physics is not affected.

    One of several coinciding floors is drawn, as large as all together, because overlapping floors flicker. One of
    several directional lights with the same direction and colour stays on.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for members in planes:
        sizes: Floats = model.geom_size[members, :2]
        # Half size 0 is endless.
        drawn = members[int(np.argmax(np.where(sizes == 0.0, np.inf, sizes).sum(axis=1)))]
        turn: Floats = data.geom_xmat[drawn].reshape(3, 3)
        for other in members:
            if other == drawn:
                continue
            center = turn.T @ (data.geom_xpos[other] - data.geom_xpos[drawn])
            reach = np.abs(turn.T @ data.geom_xmat[other].reshape(3, 3))[:2, :2] @ model.geom_size[other, :2]
            size: Floats = model.geom_size[drawn, :2]
            model.geom_size[drawn, :2] = np.where(size == 0.0, 0.0, np.maximum(size, np.abs(center[:2]) + reach))
            model.geom_matid[other] = -1
            model.geom_rgba[other, 3] = 0.0
    suns: list[Floats] = []
    for light in np.flatnonzero(model.light_type == int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)).tolist():
        sun = np.concatenate([model.light_dir[light], model.light_diffuse[light]])
        if model.light_bodyid[light] == 0 and any(np.abs(sun - other).max() < _SAME for other in suns):
            model.light_active[light] = False
        else:
            suns.append(sun)


def floor_warning(model: mujoco.MjModel, members: list[int]) -> str:
    """Return a warning about floors that coincide."""
    names = ", ".join(model.geom(geom).name for geom in members[:4])
    return (
        f"{len(members)} floors coincide ({names}{', …' if len(members) > 4 else ''}): what stands on them has "
        f"{len(members)} contacts for one, which costs time and makes the ground a little stiffer"
    )
