"""Adding the meshes and lights of a level to the scene's spec."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import mujoco

from urlab_client.server.assets.actors import Actor, Mesh
from urlab_client.server.assets.decomposition import convex_parts
from urlab_client.values.rotation import rotate, wxyz

FULL_BRIGHTNESS: Final = 5000.0
"""Intensity that corresponds to MuJoCo's full diffuse colour; the engine's default."""

_SPOT_CUTOFF: Final = 44.0
"""Unreal's default outer cone angle, degrees."""


def add_light(spec: mujoco.MjSpec, actor: Actor) -> None:
    """Add a light actor to the world."""
    light = actor.light
    if light is None:
        return
    types = {
        "directional": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        "point": mujoco.mjtLightType.mjLIGHT_POINT,
        "spot": mujoco.mjtLightType.mjLIGHT_SPOT,
    }
    brightness = min(max(light.intensity / FULL_BRIGHTNESS, 0.0), 2.0)
    spec.worldbody.add_light(
        name=f"{actor.prefix}Light",
        type=types[light.kind],
        pos=actor.location,
        dir=rotate(actor.rotation, (1.0, 0.0, 0.0)),
        diffuse=[channel * brightness for channel in light.color],
        cutoff=_SPOT_CUTOFF if light.kind == "spot" else 45.0,
    )


def add_static_mesh(spec: mujoco.MjSpec, actor: Actor, mesh: Mesh) -> tuple[str, str | None] | None:
    """Add a static mesh actor; return its body and free joint if it is converted to a body."""
    pose = {"pos": actor.location, "quat": wxyz(actor.rotation)}
    convert = actor.quick_convert
    if convert is None:
        add_mesh(spec, spec.worldbody, actor, mesh, name=f"{actor.prefix}Mesh", contype=0, conaffinity=0, **pose)
        return None
    body = spec.worldbody.add_body(name=f"{actor.prefix}MjBody", mocap=convert.driven_by_unreal, **pose)
    joint: str | None = None
    if not convert.static and not convert.driven_by_unreal:
        joint = f"{actor.name}FreeJoint"
        body.add_freejoint(name=joint)
    name = unique_name("Geom_0_0", {geom.name for geom in spec.geoms}, separator="_")
    settings = {"solref": [0.02, 1.0], "solimp": [0.9, 0.95, 0.001, 0.5, 2.0], "friction": convert.friction}
    if convert.complex_mesh and mesh.shape == "file":
        _add_parts(spec, body, actor, mesh, convert.coacd_threshold, name=name, **settings)
    else:  # MuJoCo makes one convex hull of a mesh, and the primitives are convex
        add_mesh(spec, body, actor, mesh, name=name, **settings)
    return body.name, joint


def _add_parts(
    spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, threshold: float, *, name: str, **settings: Any
) -> None:
    for vertices, faces in convex_parts(Path(mesh.file), threshold):
        part = unique_name(name, {geom.name for geom in spec.geoms}, separator="_")
        asset = spec.add_mesh(
            name=f"{actor.prefix}{part}",
            uservert=vertices.ravel().tolist(),
            userface=faces.ravel().tolist(),
            scale=actor.scale,
        )
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": asset.name}
        body.add_geom(name=part, rgba=mesh.rgba, **shape, **settings)


def add_mesh(spec: mujoco.MjSpec, body: Any, actor: Actor, mesh: Mesh, *, name: str, **settings: Any) -> None:
    """Add the geom of a mesh to a body, with the actor's scale; `settings` are further attributes of the geom."""
    sx, sy, sz = (abs(factor) for factor in actor.scale)
    if mesh.shape == "file":
        asset = spec.add_mesh(name=f"{actor.prefix}{name}", file=mesh.file, scale=actor.scale)
        settings |= {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": asset.name}
    else:
        types = {
            "box": (mujoco.mjtGeom.mjGEOM_BOX, (sx, sy, sz)),
            "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (sx, sy, sz)),
            "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (max(sx, sy, sz),)),
            "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, (max(sx, sy), sz)),
            "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, (max(sx, sy), sz)),
            "plane": (mujoco.mjtGeom.mjGEOM_PLANE, (sx, sy)),
        }
        kind, factors = types[mesh.shape]
        size = [length * factor for length, factor in zip(mesh.size, factors, strict=True)]
        if mesh.shape == "plane":
            size.append(0.05)  # spacing of the grid lines, which are not drawn
        settings |= {"type": kind, "size": [*size, 0.0, 0.0][:3]}
    body.add_geom(name=name, rgba=mesh.rgba, **settings)


def unique_name(name: str, taken: set[str], *, separator: str = "") -> str:
    """Return `name`, or its first numbered variant that is free."""
    stem, dot, suffix = name.partition(".")
    candidate, count = name, 0
    while candidate in taken:
        count += 1
        candidate = f"{stem}{separator or '_'}{count}{dot}{suffix}"
    return candidate
