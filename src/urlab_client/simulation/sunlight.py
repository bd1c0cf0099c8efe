"""Directional lights that follow the subject of a picture.

A directional light shines everywhere, but its shadows are drawn around its position only, as far as
`vis.map.shadowclip` times the model's extent. A robot that walks away from there loses its shadow, or parts of it.
"""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

_WIDER: Final = 8.0
_WIDE_M: Final = 5.0

_SEEN_COSINE: Final = 0.5
"""Half the cone, 60 degrees, in which a geom counts as seen."""


def shadow_clip(own: float) -> float:
    """Return how far shadows should reach, metres, if MuJoCo would draw them up to `own`.

    The ground is speckled where they end, so that small scenes have them end outside the picture.
    """
    return max(own, min(_WIDER * own, _WIDE_M))


def moving_geoms(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the geoms of bodies that are not welded to the world; of a scene without them, all but planes."""
    bounded = model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
    moving = bounded & (model.body_weldid[model.geom_bodyid] != 0)
    return np.flatnonzero(moving if moving.any() else bounded)


def follow_subject(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData, geoms: NDArray[np.intp]) -> None:
    """Move the suns of a scene along the ground to a place above what the camera sees; their light does not change.

    Args:
        scene: The scene, with camera and lights as they are to be drawn.
        model: The model.
        data: Its data with positions computed.
        geoms: Geoms to consider, from `moving_geoms`.
    """
    if not geoms.size:
        return
    camera: Any = scene.camera[0]
    places = data.geom_xpos[geoms]
    away = places - camera.pos
    seen = away @ camera.forward > _SEEN_COSINE * np.linalg.norm(away, axis=1)
    if not seen.any():
        return
    far = float(np.linalg.norm(np.ptp(places[seen], axis=0)))
    middle = (places[seen].min(axis=0) + places[seen].max(axis=0)) / 2.0
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    for light in scene.lights[: scene.nlight]:
        if light.type == directional and light.castshadow and not light.headlight:
            light.pos[:] = middle - max(model.stat.extent, far) * light.dir
